"""The house: layers of rooms, no circle of files, few files at the root, light imports."""

import ast
import functools
import importlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "verifai_jax"

LAYERS = (
    {"core", "statistics", "_version"},
    {"features", "mtl", "search"},
    {"systems"},
    {"problem"},
    {"evaluation"},
    {"falsification"},
    {"counterexamples", "pictures"},
    {"cli", "testing"},
)
"""Rooms of the core from the ground up: each may import itself and the layers below its own."""

STANDS_ON = {
    # Neighbours in a layer do not know each other, with these exceptions.
    "statistics": {"core"},
    "pictures": {"counterexamples"},
}
ADDONS = {
    "native": set(),
    "clusters": set(),
    "agents": set(),
    "checking": set(),
    "events": set(),
    "simulators": set(),
    "scenic": set(),
    "searches": set(),
    "fuzzing": {"events", "searches"},
    "analysis": set(),
    "reports": {"analysis"},
    "monitoring": {"clusters", "native", "reports"},
    "verification": {"reports"},
    "rl": {"simulators"},
    "estimation": {
        "analysis",
        "clusters",
        "monitoring",
        "reports",
        "rl",
        "searches",
        "verification",
    },
    "avoidability": {"verification"},
    "faults": {"estimation", "reports"},
    "synthesis": {"estimation", "verification"},
    "perception": {"analysis"},
    "training": {"analysis", "clusters", "estimation", "monitoring", "reports", "rl"},
    "assurance": {"analysis", "checking", "estimation", "monitoring", "reports", "verification"},
}
"""The other add-ons that each add-on may import; each is below those that import it."""
USES_PUBLIC_NAMES = {"cli"}
"""Rooms that import what a user imports, from `verifai_jax` itself."""
BESIDE = {"__init__", "__main__"}
"""Files at the root that no room imports: the public names, the command line as a module."""


def module_name(file: Path) -> str:
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(file): file for file in sorted(PACKAGE.rglob("*.py"))}


def imports_in(source: str) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield the import statements of a file. Expressions, nine tenths of the nodes, have none."""
    inside: list[ast.AST] = [ast.parse(source)]
    while inside:
        node = inside.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        for block in ("body", "orelse", "handlers", "finalbody", "cases"):
            inside += getattr(node, block, ())


def imports_of(nodes: Iterable[ast.Import | ast.ImportFrom], files: set[str]) -> set[str]:
    """Return the modules of this package that statements import, late ones too."""
    found = set()

    def nearest(name: str) -> None:
        while name and name not in files:
            name = name.rpartition(".")[0]
        if name:
            found.add(name)

    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                nearest(alias.name)
        else:
            assert node.level == 0, "imports are absolute"
            for alias in node.names:
                nearest(f"{node.module}.{alias.name}")
    return found


def circles(edges: dict[str, set[str]]) -> list[set[str]]:
    """Strongly connected components of more than one file (Tarjan, 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(file: str) -> None:
        index[file] = low[file] = len(index)
        stack.append(file)
        for other in edges[file]:
            if other not in index:
                visit(other)
                low[file] = min(low[file], low[other])
            elif other in stack:
                low[file] = min(low[file], index[other])
        if low[file] == index[file]:
            place = stack.index(file)
            component = set(stack[place:])
            del stack[place:]
            if len(component) > 1:
                found.append(component)

    for file in edges:
        if file not in index:
            visit(file)
    return found


@functools.cache
def imports() -> dict[str, list[ast.Import | ast.ImportFrom]]:
    """Return the import statements of each file of the package, which several laws read."""
    return {name: list(imports_in(file.read_text())) for name, file in FILES.items()}


@functools.cache
def graph() -> dict[str, set[str]]:
    names = set(FILES)
    return {name: imports_of(found, names) - {name} for name, found in imports().items()}


def room_of(module: str) -> str:
    """Return the room of a module: a folder of the package, and `addons.NAME` for an add-on."""
    parts = module.split(".")
    if parts[1:2] == ["addons"] and len(parts) > 2:
        return f"addons.{parts[2]}"
    return parts[1] if len(parts) > 1 else "__init__"


def test_no_circle_of_files():
    assert circles(graph()) == []


def test_a_circle_would_be_found():
    late = "def f():\n    from verifai_jax.b import g\n"
    checking = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import verifai_jax.a\n"
    names = {"verifai_jax.a", "verifai_jax.b"}
    edges = {
        "verifai_jax.a": imports_of(imports_in(late), names),
        "verifai_jax.b": imports_of(imports_in(checking), names),
    }
    assert circles(edges) == [names]


def folder_of(module: str) -> str:
    """Return the folder that holds a file, down to the second level of its room."""
    depth = 2 + (room_of(module).startswith("addons."))
    return ".".join(FILES[module].relative_to(PACKAGE).parent.parts[:depth])


def test_no_circle_of_folders_within_a_room():
    """What a room is called by, `__init__.py`, gives names of all its folders, and is left out."""
    edges = {folder_of(module): set() for module in FILES}
    for module, imported in graph().items():
        if FILES[module].name != "__init__.py":
            mine = folder_of(module)
            room = {other for other in imported if room_of(other) == room_of(module)}
            edges[mine] |= {folder_of(other) for other in room} - {mine}
    assert circles(edges) == []


def test_imports_point_downwards():
    level = {room: height for height, layer in enumerate(LAYERS) for room in layer}
    wrong = []
    for module, imported in graph().items():
        room = room_of(module)
        if room in BESIDE or room.startswith("addons"):
            continue
        for other in imported:
            to = room_of(other)
            if to == "__init__":
                allowed = room in USES_PUBLIC_NAMES
            else:
                allowed = to == room or level[to] < level[room] or to in STANDS_ON.get(room, ())
            if not allowed:
                wrong.append(f"{module} imports {other}")
    assert wrong == []


def test_every_room_stands_in_a_layer():
    rooms = {room_of(module) for module in FILES} - BESIDE
    assert rooms == {"addons", *(f"addons.{name}" for name in ADDONS)} | set().union(*LAYERS)


def test_the_core_imports_no_add_on_and_names_none():
    """What the core says of add-ons are groups of entry points."""
    wrong = [
        name
        for name, file in FILES.items()
        if not room_of(name).startswith("addons")
        and room_of(name) not in BESIDE
        and "verifai_jax.addons" in file.read_text()
    ]
    assert wrong == []


def test_add_ons_import_each_other_along_the_list():
    assert circles({name: set(others) for name, others in ADDONS.items()}) == []
    wrong = []
    for module, imported in graph().items():
        room = room_of(module)
        if room.startswith("addons."):
            others = {room_of(other) for other in imported} - {room}
            addons = {each.removeprefix("addons.") for each in others if each.startswith("addons.")}
            wrong += [f"{module}: {each}" for each in addons - ADDONS[room.split(".")[1]]]
    assert wrong == []


def test_entry_points_name_what_exists():
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    groups = [group for group in data if group.startswith("verifai_jax.")]
    assert len(groups) >= 6
    for group in groups:
        for target in data[group].values():
            module, _, name = target.partition(":")
            found = importlib.import_module(module)
            assert not name or hasattr(found, name), target


KINDS = {"mtl": ("Formula", "Expression"), "features": ("Domain",), "search": ("Search",)}
"""Rooms of whose kinds of things nobody outside asks the class, with the classes that they stand
below. What others ask of them is a method, which has a default."""
AT_HOME = {"mtl": ("addons.monitoring", "addons.reports", "addons.verification")}
"""Add-ons that evaluate formulas in a way of their own, by the kind of node."""


def kinds_of(room: str, bases: tuple[str, ...]) -> set[str]:
    """Return the names of the classes of a room that stand below these, however far."""
    below: dict[str, set[str]] = {}
    for name, file in FILES.items():
        if room_of(name) == room:
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.ClassDef):
                    below[node.name] = {ast.unparse(base).split("[")[0] for base in node.bases}
    found = set(bases)
    while more := {name for name, above in below.items() if above & found} - found:
        found |= more
    return found - set(bases)


def asked_of(source: str, room: str, kinds: set[str]) -> list[str]:
    """Return the kinds of a room that a file asks for by `isinstance` or `match`."""
    tree = ast.parse(source)
    names: dict[str, str] = {}
    modules: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("verifai_jax"):
            for alias in node.names:
                inside = node.module == "verifai_jax" or room_of(str(node.module)) == room
                if inside and alias.name in kinds:
                    names[alias.asname or alias.name] = alias.name
                elif inside:
                    modules.add(alias.asname or alias.name)
    asked = []
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("isinstance", "issubclass")
        ):
            classes = node.args[1]
        elif isinstance(node, ast.MatchClass):
            classes = node.cls
        else:
            continue
        for part in ast.walk(classes):
            if isinstance(part, ast.Name) and part.id in names:
                asked.append(names[part.id])
            elif isinstance(part, ast.Attribute) and ast.unparse(part.value) in modules:
                asked += {part.attr} & kinds
    return asked


@pytest.mark.slow
def test_nobody_outside_of_its_room_asks_for_the_class_of_a_formula_a_domain_or_a_search():
    wrong = []
    for room, bases in KINDS.items():
        kinds = kinds_of(room, bases)
        assert len(kinds) > 3
        asks, named = re.compile(r"isinstance|issubclass|\bcase "), re.compile("|".join(kinds))
        for name, file in FILES.items():
            text = file.read_text()
            if not (asks.search(text) and named.search(text)):
                continue
            if room_of(name) not in (room, "testing", *AT_HOME.get(room, ())):
                wrong += [f"{name} asks for {kind}" for kind in asked_of(text, room, kinds)]
    assert wrong == []


def test_an_asked_class_would_be_found():
    kinds = kinds_of("mtl", KINDS["mtl"])
    assert {"Always", "Until", "Atom", "Number"} <= kinds
    direct = "from verifai_jax.mtl.formula import Always as A\nisinstance(x, int | A)"
    matched = "from verifai_jax.mtl import formula as f\nmatch x:\n    case f.Until(): pass"
    other = "from verifai_jax.features import Constant\nisinstance(x, Constant)"
    sources = (direct, matched, other)
    assert [asked_of(each, "mtl", kinds) for each in sources] == [["Always"], ["Until"], []]


def test_few_files_at_the_root():
    assert len(list(PACKAGE.glob("*.py"))) <= 3


def test_library_does_not_know_its_content():
    for name, nodes in imports().items():
        for node in nodes:
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            else:
                modules = [node.module or ""]
            tops = {module.split(".")[0] for module in modules}
            assert not tops & {"envs", "specs", "tests"}, f"{name} imports content"


def test_import_is_light():
    heavy = "jax numpy pandas sklearn brax mujoco gymnax matplotlib pyarrow optax lark rich scipy"
    code = f"import sys, verifai_jax\nprint(*[m for m in {heavy.split()} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_the_document_names_files_that_exist():
    text = (ROOT / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"`([\w/]+\.py)`", text))
    assert named
    assert [
        name
        for name in sorted(named)
        if not (PACKAGE / name).exists() and not (ROOT / name).exists()
    ] == []


def test_a_row_comes_about_in_ten_files():
    text = (ROOT / "docs" / "architecture.md").read_text()
    steps = re.findall(r"^(\d+)\. `([\w/]+\.py)`", text, re.MULTILINE)
    assert [int(number) for number, _ in steps] == list(range(1, len(steps) + 1))
    assert 5 <= len(steps) <= 10


def test_the_drawing_has_every_room():
    text = (ROOT / "docs" / "architecture.md").read_text()
    drawing = text.split("```")[1]
    for room in set().union(*LAYERS) - {"_version"}:
        assert f"{room}/" in drawing


def test_files_of_tests_have_names_of_their_own():
    """Two of one name in two folders cannot be collected together."""
    names = [file.name for file in (ROOT / "tests").rglob("*.py") if file.name != "conftest.py"]
    assert sorted(names) == sorted(set(names))


def test_tests_import_no_private_names():
    """A test goes through what a room calls public, so that it survives a change inside."""
    found = []
    private = re.compile(r"(?:import |, |^ +)_\w", re.MULTILINE)
    for file in sorted((ROOT / "tests").rglob("*.py")):
        text = file.read_text()
        for node in imports_in(text) if private.search(text) else ():
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("verifai_jax"):
                names = [alias.name for alias in node.names if alias.name.startswith("_")]
                modules = {module.rpartition(".")[2] for module in FILES}
                found += [f"{file.name}: {name}" for name in names if name not in modules]
    assert found == []
