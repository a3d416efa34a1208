"""The modules that a program imports and the files that it names, read from its text.

    found = scan(Path("specs/car.py").read_bytes())
    found.imports                                       # (Import(0, "envs", ("car",)), ...)
    found.texts                                         # ("data/gains.csv", ...), maybe files
    files_of_model(Path("arm.xml"))                     # includes, meshes, textures of MJCF

Nothing is run. A text counts where it may name a file that is read: one that is handed to
`save`, `write`, `to_csv` and their like names a result.
"""

import ast
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

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
    """The imports of a program, and the texts in it that may be names of files."""

    imports: tuple[Import, ...]
    texts: tuple[str, ...]


@lru_cache(maxsize=512)
def scan(program: bytes) -> Scan:
    """Read a program; nothing is found in one that is not Python."""
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
    """Return the files that a model in XML refers to: includes, meshes, textures, height fields.

    **Arguments:**
    - `model`: the file; one that is not a model refers to none.
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
