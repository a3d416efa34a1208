"""Laws of the files: one way to open what a stranger may have made, one way to write."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import verifai_jax

ROOT = Path(verifai_jax.__file__).parent
STORE = "core/store/"
READS = {
    "open", "os.open", "io.FileIO", "FileIO", "np.load", "zipfile.ZipFile", "json.load",
    "tomllib.load", "tomllib.loads", "pd.read_csv", "pd.read_parquet", "pq.read_table",
    "pq.read_schema", "pq.ParquetFile", "parquet.read_table", "ElementTree.parse",
    "ElementTree.fromstring", "sqlite3.connect", "pickle.load", "pickle.loads", "yaml.safe_load",
}  # fmt: skip
METHODS = {"read_text", "read_bytes", "open"}
CALLS = re.compile(rf"({'|'.join({name.rpartition('.')[2] for name in READS} | METHODS)})\s*\(")
"""What the text of a file must have to read another one. The files without it are not parsed."""
ALLOWED = {
    "systems/blackbox/worker_process.py": "the pipe to the process that has started it",
    "core/user_code/source_collection.py": "the user's own program",
    "core/user_code/user_files.py": "regular files that the user has named",
    "core/compute/devices.py": "/proc/cpuinfo",
    "addons/native/native_code/library.py": "/proc/cpuinfo",
    "addons/native/native_code/source.py": "a file of the package",
    "cli/new.py": "templates of the package",
    "cli/main.py": "the null device",
    "addons/reports/page.py": "files of the package",
    "addons/reports/studies.py": "a picture in memory",
    "addons/monitoring/parametric.py": "a file of the package",
    "addons/assurance/qualification/_qualify.py": "the files of the package, which it hashes",
    "addons/assurance/qualification/oracles.py": "what it has written itself, in its own folder",
    "addons/assurance/qualification/recorded_oracles.py": "what it has written, in its own folder",
    "addons/simulators/pictures/mujoco_film.py": "a film that it has written itself",
    "addons/estimation/trials/reading.py": "a file that the door has opened",
    "addons/estimation/comparison/score_tables.py": "a text that the door has read",
    "addons/faults/failure_table/sheet.py": "a text that the door has read",
    "addons/assurance/verify_report.py": "a file for others, which needs Python alone",
    "addons/monitoring/fmu_monitor.py": "an archive that it writes",
    "falsification/segments.py": "bytes that the door has read",
}  # fmt: skip
"""Files that read something in another way, and what that is."""


def name_of(function: ast.expr) -> str:
    return ast.unparse(function) if isinstance(function, ast.Name | ast.Attribute) else ""


def mode_of(call: ast.Call, at: int) -> str:
    given = [*call.args[at:], *(k.value for k in call.keywords if k.arg == "mode")]
    first = given[0] if given else None
    return first.value if isinstance(first, ast.Constant) and isinstance(first.value, str) else "r"


def reading(tree: ast.AST) -> Iterator[int]:
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = name_of(node.func)
        last = name.rpartition(".")[2] or getattr(node.func, "attr", "")
        method = isinstance(node.func, ast.Attribute) and last in METHODS and name not in READS
        if name == "open" or (method and last == "open"):
            reads = mode_of(node, 1 if name == "open" else 0)[0] not in "wxa"
        else:
            reads = name in READS or method
        if reads:
            yield node.lineno


LOOPS = {
    "cli/new.py": "files of a new project, each of which is asked for by itself",
}
"""Files that replace files one after the other, and why they may."""


def replaced_in_turn(function: ast.AST) -> bool:
    """Return whether a function replaces several files, not all complete before the first."""
    found = 0
    for node in ast.walk(function):
        if isinstance(node, ast.With) and any("replacing(" in ast.unparse(i) for i in node.items):
            inner = any(each is not node and isinstance(each, ast.With) and node in ast.walk(each)
                        for each in ast.walk(function))  # fmt: skip
            looped = any(isinstance(each, ast.For | ast.While) and node in ast.walk(each)
                         for each in ast.walk(function))  # fmt: skip
            found += 2 if looped else not inner
    return found > 1


def test_files_that_belong_together_are_complete_together():
    found = set()
    for file in sorted(ROOT.rglob("*.py")):
        if "replacing(" not in file.read_text():
            continue
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.FunctionDef) and replaced_in_turn(node):
                found.add(file.relative_to(ROOT).as_posix())
    assert found == set(LOOPS), "write them as core/store/atomic_files.py says"


def test_what_a_stranger_may_have_made_is_opened_in_one_way():
    found = {}
    for file in sorted(ROOT.rglob("*.py")):
        name, text = file.relative_to(ROOT).as_posix(), file.read_text()
        foreign = not name.startswith(STORE) and CALLS.search(text)
        if lines := list(reading(ast.parse(text))) if foreign else []:
            found[name] = lines
    others = {name: lines for name, lines in found.items() if name not in ALLOWED}
    assert not others, "open these through core/store/foreign_files.py"
    assert not ALLOWED.keys() - found.keys(), "these need no permission any more"
