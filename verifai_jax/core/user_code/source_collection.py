"""The files that define an object, found from its functions and modules.

    made = made_here()                                  # where a problem is made, remembered there
    sources = sources_of(problem, made)                 # taken when a run begins
    scan(Path("specs/car.py").read_bytes()).imports     # (Import(0, "envs", ("car",)), ...)

The user's modules are followed through the imports, opened files and file names in their text;
nothing is run. A text counts if it may name a file that is read; arguments of `save`, `write`,
`to_csv` and similar functions name results and do not count.
"""

import ast
import hashlib
import importlib.machinery
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from verifai_jax.core.user_code.reads import documents, files_read_by, modules_loaded_by
from verifai_jax.core.user_code.source_objects import (
    Function,
    Module,
    OwnFiles,
    is_notebook_cell,
    is_user_file,
    parts_of,
)
from verifai_jax.core.user_code.sources import (
    CALLER,
    FUNCTION,
    IMPORTED,
    MODEL,
    NAMED,
    PROBLEM,
    READ,
    Maker,
    Source,
    Sources,
    file_hash,
    shown_path,
    tree_commits,
    tree_of,
    versions,
)

MAX_NAME = 200
"""Characters of a text that may be the name of a file, at most."""
MAX_FILES = 200
"""Files of one model at most."""
_WRITERS = ("save", "to_", "write", "report", "plot", "animate", "dump", "export", "mkdir")
"""Beginnings of the names of functions that are given the names of results."""
_MODELS = (".xml", ".mjcf", ".urdf")
"""Endings of files that describe a model and refer to further files."""
_REFERENCE = re.compile(r"""\b(?:file|file\w+|filename)\s*=\s*["']([^"']+)["']""")
_FOLDER = re.compile(r"""\b(?:meshdir|texturedir|assetdir)\s*=\s*["']([^"']+)["']""")


class Import(NamedTuple):
    """An import statement: `level` dots, the `module` after them, and the `names` taken from it."""

    level: int
    module: str
    names: tuple[str, ...]


class Scan(NamedTuple):
    """The imports of a program, and the texts in it that may be file names."""

    imports: tuple[Import, ...]
    texts: tuple[str, ...]


@lru_cache(maxsize=512)
def scan(program: bytes) -> Scan:
    """Parse a program; the result is empty if it is not Python."""
    try:
        tree = ast.parse(program)
    except (SyntaxError, ValueError, RecursionError):
        return Scan((), ())
    imports: list[Import] = []
    texts: list[str] = []
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            imports += [Import(0, alias.name, ()) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = tuple(alias.name for alias in node.names)
            imports.append(Import(node.level, node.module or "", names))
        elif isinstance(node, ast.Call) and _writes(node):
            continue
        elif text := _name_of_file(node):
            texts.append(text)
        waiting += ast.iter_child_nodes(node)
    return Scan(tuple(imports), tuple(dict.fromkeys(texts)))


def _writes(call: ast.Call) -> bool:
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    if name == "open":
        modes = [*call.args[-1:], *(each.value for each in call.keywords if each.arg == "mode")]
        texts = [mode.value for mode in modes if isinstance(mode, ast.Constant)]
        return any(isinstance(text, str) and re.fullmatch(r"[wax][bt+]*", text) for text in texts)
    return name.startswith(_WRITERS)


def _name_of_file(node: ast.AST) -> str | None:
    """Return the name that an expression ends in, or None if it cannot name a file."""
    if isinstance(node, ast.Constant):
        parts = _texts([node])
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        parts = _texts(list(_operands(node)))
    elif isinstance(node, ast.Call):
        parts = _texts(node.args) if len(node.args) > 1 else []
    elif isinstance(node, ast.JoinedStr):
        parts = _texts(node.values)
    else:
        return None
    text = "/".join(part.strip("/") if i else part for i, part in enumerate(parts))
    if isinstance(node, ast.JoinedStr):
        text = text.lstrip("/")
    named = 0 < len(text) <= MAX_NAME and "." in text and text.isprintable()
    return text if named else None


def _texts(parts: Sequence[ast.expr]) -> list[str]:
    """Return the texts in which a sequence of expressions ends."""
    texts: list[str] = []
    for part in reversed(parts):
        if not isinstance(part, ast.Constant) or not isinstance(part.value, str):
            break
        texts.insert(0, part.value)
    return texts


def _operands(node: ast.expr) -> Iterator[ast.expr]:
    """Return what stands between the slashes of `folder / "data" / "gains.csv"`."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        yield from _operands(node.left)
        yield node.right
    else:
        yield node


def files_of_model(model: Path) -> list[Path]:
    """Return the files to which an XML model refers: includes, meshes, textures, height fields.

    **Arguments:**
    - `model`: the model's file; a file that is not a model refers to none.
    """
    found: dict[Path, None] = {}
    waiting, folders = [model.resolve()], {model.resolve().parent: None}
    while waiting and len(found) < MAX_FILES:
        file = waiting.pop()
        if file.suffix.lower() not in _MODELS:
            continue
        try:
            text = file.read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue
        folders[file.parent] = None
        for name in _FOLDER.findall(text):
            folders[(file.parent / name).resolve()] = None
        for name in _REFERENCE.findall(text):
            name = name.removeprefix("package://").removeprefix("file://")
            for folder in tuple(folders):
                path = (folder / name).resolve()
                if path != model.resolve() and path not in found and path.is_file():
                    found[path] = None
                    waiting.append(path)
    return list(found)


def made_here() -> tuple[Maker, ...]:
    """Return the user's modules on the call stack, from the innermost to the last import.

    Modules that import the one that makes a problem are not part of it.
    """
    found: dict[str, Maker] = {}
    frame = sys._getframe(1)
    while frame is not None:
        file = frame.f_code.co_filename
        if found and file.startswith("<frozen importlib"):
            break
        if is_user_file(file):
            role = PROBLEM if not found else CALLER
            # A cell, or what is executed as text, belongs to no file.
            path = os.path.abspath(file) if os.path.isfile(file) else ""
            if path not in found:
                owner = frame.f_globals.get("__spec__") or frame.f_globals
                sha256 = _as_imported(owner, path) if path else ""
                found[path] = Maker(path, sha256, role)
        frame = frame.f_back
    return tuple(found.values())


def sources_of(*things: object, made: Sequence[Maker] = (), first: int = 0) -> Sources:
    """Return the files and versions of some objects: code as imported, data as on disk.

    **Arguments:**
    - `things`: objects such as a problem; their functions, classes and files are included.
    - `made`: the modules in which they were made, from `made_here`.
    - `first`: the first row of a table to which they apply.
    """
    collector = _Collector()
    for maker in made:
        collector.add_maker(maker)
    for part in parts_of(things):
        if isinstance(part, Module):
            collector.add_module(part.file, _as_imported(part.owner, part.file), IMPORTED)
        elif isinstance(part, OwnFiles):
            for file, sha256 in part.files.items():
                collector.add_data(file, MODEL, sha256)
        else:
            collector.add_function(part)
    collector.follow()
    commits = [
        commit for tree, commit in tree_commits.items() if _any_below(collector.modules, tree)
    ]
    return Sources(
        files=tuple(collector.sources()),
        versions=versions(),
        without_file=tuple(dict.fromkeys(collector.without_file)),
        root=Path.cwd().as_posix(),
        first=first,
        commit=commits[0] if commits else "",
    )


def _any_below(files: Iterable[str], folder: Path) -> bool:
    return any(Path(file).is_relative_to(folder) for file in files)


class _Collector:
    """Files of a model, modules first; what modules refer to is followed at the end."""

    def __init__(self) -> None:
        self.modules: dict[str, Source] = {}
        self.data: dict[str, Source] = {}
        self.functions: dict[str, Source] = {}
        self.without_file: list[str] = []
        self.callers: set[str] = set()

    def sources(self) -> Iterator[Source]:
        order = (PROBLEM, CALLER, IMPORTED)
        yield from sorted(self.modules.values(), key=lambda f: (order.index(f.role), f.name))
        for found in (self.functions, self.data):
            yield from sorted(found.values())

    def add_maker(self, maker: Maker) -> None:
        if maker.file:
            self.add_module(maker.file, maker.sha256, maker.role)
        elif maker.role == PROBLEM:
            self.without_file.append("the problem is made in no file, as in a notebook")

    def add_module(self, file: str, sha256: str, role: str) -> None:
        known = self.modules.get(file)
        # What a function comes from is part of the model, whoever calls it.
        if known is None or (known.role == CALLER and role == IMPORTED):
            self.modules[file] = Source(shown_path(file), role, sha256)

    def add_data(self, file: str, role: str, sha256: str | None = None) -> None:
        known = file in self.data or file in self.modules
        if known or os.path.abspath(file) in documents or len(self.data) >= MAX_FILES:
            return
        try:
            self.data[file] = Source(shown_path(file), role, sha256 or file_hash(Path(file)))
        except OSError:
            self.without_file.append(f"{shown_path(file)} cannot be read, and was not recorded")

    def add_function(self, function: Function) -> None:
        where = "notebook" if is_notebook_cell(function.file) else "no file"
        name = f"{function.name} ({where})"
        # Of several of one name, such as lambdas, the hash stands for all in their order.
        if (known := self.functions.get(name)) is not None:
            joined = f"{known.sha256}{function.sha256}".encode()
            self.functions[name] = known._replace(sha256=hashlib.sha256(joined).hexdigest())
        else:
            self.functions[name] = Source(name, FUNCTION, function.sha256)

    def follow(self) -> None:
        """Add what modules import, open and name, and what models refer to."""
        # A caller does other things besides, which have no part in the model.
        waiting = [file for file, source in self.modules.items() if source.role != CALLER]
        done: set[str] = set()
        while waiting and len(done) < MAX_FILES:
            file = waiting.pop()
            if file in done:
                continue
            done.add(file)
            try:
                found = scan(Path(file).read_bytes())
            except OSError:
                continue
            imports = [name for each in found.imports for name in _imported(each, file)]
            for imported in (*imports, *sorted(modules_loaded_by(file))):
                if imported not in self.modules:
                    self.add_module(imported, self._hash_of_module(imported), IMPORTED)
                    waiting.append(imported)
            for read in files_read_by(file):
                if os.path.isfile(read):
                    self.add_data(read, READ)
            for text in found.texts:
                for named in _named(text, file):
                    self.add_data(named, NAMED)
        for file in tuple(self.data):
            for part in files_of_model(Path(file)):
                self.add_data(str(part), MODEL)

    def _hash_of_module(self, file: str) -> str:
        """Return the hash of a module as it was imported, or of its file if it was not imported."""
        values = self._loaded.get(file)
        if values is None:
            return _hash_of_code(file)
        return _as_imported(values.get("__spec__") or values, file)

    @cached_property
    def _loaded(self) -> dict[str, dict[str, Any]]:
        """The variables of the modules that are imported, by their files."""
        # Asked without __getattr__, by which some modules import others.
        every = [getattr(module, "__dict__", {}) for module in tuple(sys.modules.values())]
        return {values["__file__"]: values for values in every if values.get("__file__")}


def _named(text: str, program: str) -> Iterator[str]:
    """Return files of data that a text in a program names, from its folder or the current one."""
    folder = Path(program).parent
    for base in dict.fromkeys((folder, folder.parent, Path.cwd())):
        with_base = os.path.join(base, text)
        if not text.endswith(".py") and os.path.isfile(with_base) and is_user_file(with_base):
            yield os.path.abspath(with_base)
            return


def _imported(each: Import, program: str) -> Iterator[str]:
    """Return the user's files that an import statement of a program refers to."""
    if each.level:
        base = _package_of(program, each.level)
        names = [each.module] if each.module else []
        names += [f"{each.module}.{name}".lstrip(".") for name in each.names]
        roots = [base] if base is not None else []
        for name in names:
            yield from _found_below(name, roots, program)
        return
    top = each.module.partition(".")[0]
    if top in sys.stdlib_module_names or top == "verifai_jax":
        return
    names = [each.module, *(f"{each.module}.{name}" for name in each.names)]
    for name in names:
        yield from _found_below(name, _search_path(top, program), program)


def _package_of(program: str, level: int) -> Path | None:
    parents = Path(program).parents
    return parents[level - 1] if level <= len(parents) else None


def _search_path(top: str, program: str) -> list[Path]:
    """Return the folders in which a module of this name is, for a program."""
    tree = tree_of(program)
    if tree is not None:
        return [tree, Path(program).parent]
    module = sys.modules.get(top)
    if module is not None:
        folders = [Path(path).parent for path in getattr(module, "__path__", ())]
        file = getattr(module, "__file__", None)
        if file is not None and not is_user_file(file):
            return []  # An installed package, of which no file is looked for.
        return folders or ([] if file is None else [Path(file).parent])
    spec = importlib.machinery.PathFinder.find_spec(top)
    if spec is None:
        return []
    if spec.submodule_search_locations:
        return [Path(path).parent for path in spec.submodule_search_locations]
    return [Path(spec.origin).parent] if spec.origin else []


def _found_below(name: str, folders: Sequence[Path], program: str) -> Iterator[str]:
    """Return the files of a module and of the packages that it is in."""
    parts = name.split(".")
    for folder in folders:
        for count in range(1, len(parts) + 1):
            path = folder.joinpath(*parts[:count])
            endings = (".py", *importlib.machinery.EXTENSION_SUFFIXES)
            files = [path.with_name(f"{path.name}{ending}") for ending in endings]
            for file in (*files, path / "__init__.py"):
                text = os.path.abspath(file)
                if text != program and os.path.isfile(text) and is_user_file(text):
                    yield text


_imported_as: dict[int, tuple[object, str]] = {}


def _as_imported(owner: object, file: str) -> str:
    known = _imported_as.get(id(owner))
    if known is None or known[0] is not owner:
        known = _imported_as[id(owner)] = (owner, _hash_of_code(file))
    return known[1]


def _hash_of_code(file: str) -> str:
    try:
        return file_hash(Path(file))
    except OSError:
        return ""  # It is gone since it was imported.
