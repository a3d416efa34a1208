"""The inputs of a report with their hashes, chained, and the versions of what made it.

    inputs = record_inputs(folder) + project_inputs("specs/cartpole.py:balance")
    chained(inputs)[-1].chain                       # one hash that all inputs decide

A link of the chain is the SHA-256 of the link before, the name of the input and its content's hash,
so that the last link stands for all inputs in their order.
"""

import ast
import hashlib
import platform
from collections.abc import Iterable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from verifai_jax._version import __version__
from verifai_jax.core.revisions import commit_of, split_revision

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "pandas", "scikit-learn", "matplotlib", "mujoco")
"""Packages whose versions decide numbers and pictures."""
PACKAGE = Path(__file__).resolve().parents[1]
"""Folder of this package."""
MOST_FILES = 200
"""Files of a project that are hashed at most."""
LONGEST_NAME = 200
"""Characters of a text in a program that may be the name of a file, at most."""


class Input(NamedTuple):
    """An input of a report: its name, what it is, and the SHA-256 of its content."""

    name: str
    role: str
    sha256: str


class Link(NamedTuple):
    """An input with the hash of the chain up to it."""

    input: Input
    chain: str


def chained(inputs: Iterable[Input]) -> list[Link]:
    """Chain the hashes of inputs in their order."""
    chain, links = "", []
    for each in inputs:
        chain = hashlib.sha256(f"{chain}\n{each.name}\n{each.sha256}".encode()).hexdigest()
        links.append(Link(each, chain))
    return links


def folder_inputs(folder: Path, roles: Sequence[tuple[str, str]]) -> list[Input]:
    """Hash files of a folder of results.

    **Arguments:**

    - `folder`: the folder.
    - `roles`: patterns of file names, and what these files are; the order is that of the chain.
    """
    return [
        Input(file.relative_to(folder).as_posix(), role, file_hash(file))
        for pattern, role in roles
        for file in sorted(folder.glob(pattern))
        if file.is_file()
    ]


def project_inputs(target: str | None) -> list[Input]:
    """Hash the file of a target, the project's files that it imports, and those that they name.

    Nothing is run: imports are read from the source. A file is named where a text in a program is
    its path, from the program's folder or from the current one. Only files below the current
    folder count.

    **Arguments:**

    - `target`: `FILE.py:NAME`; anything else has no inputs. That of a revision of git,
      `FILE.py:NAME@REVISION`, is the commit, whose hash decides all its files.
    """
    target, revision = split_revision(target or "")
    if revision is not None:
        commit = hashlib.sha256(commit_of(revision).encode()).hexdigest()
        return [Input(f"{target} at {commit_of(revision)}", "a commit of git", commit)]
    place = target.rpartition(":")[0] or target
    root = Path.cwd().resolve()
    first = Path(place)
    if not place.endswith(".py") or not first.is_file():
        return []
    first = first.resolve()
    if not first.is_relative_to(root):
        return []
    programs, named = {first}, set()
    waiting = [first]
    while waiting and len(programs) + len(named) < MOST_FILES:
        program = waiting.pop()
        try:
            tree = ast.parse(program.read_bytes())
        except (SyntaxError, ValueError):
            continue
        for file in sorted(_imported(tree, program, root)):
            if file not in programs:
                programs.add(file)
                waiting.append(file)
        named |= set(_named(tree, program, root))
    others = sorted(programs - {first}) + sorted(named - programs)
    roles = (
        ["the problem"] + ["imported"] * (len(programs) - 1) + ["named in a program"] * len(named)
    )
    return [
        Input(file.relative_to(root).as_posix(), role, file_hash(file))
        for file, role in zip([first, *others], roles, strict=False)
    ]


def _imported(tree: ast.Module, program: Path, root: Path) -> Iterator[Path]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = program.parents[node.level - 1]
                if not above.is_relative_to(root):
                    continue
                parts = [*above.relative_to(root).parts, *([base] if base else [])]
                base = ".".join(parts)
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        else:
            continue
        for name in names:
            path = root.joinpath(*name.split("."))
            for file in (path.with_suffix(".py"), path / "__init__.py"):
                if name and file.is_file() and _of_project(file.resolve(), root):
                    yield file.resolve()


def _of_project(file: Path, root: Path) -> bool:
    """Return whether a file is the project's own, and not of this package, which has a version."""
    return file.is_relative_to(root) and not file.is_relative_to(PACKAGE)


def _named(tree: ast.Module, program: Path, root: Path) -> Iterator[Path]:
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str):
            continue
        text = node.value
        if not 0 < len(text) <= LONGEST_NAME or "." not in text or not text.isprintable():
            continue
        for base in (program.parent, root):
            file = (base / text).resolve()
            if _of_project(file, root) and file.is_file():
                yield file


def file_hash(file: Path) -> str:
    """Return the SHA-256 of a file."""
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def versions() -> list[tuple[str, str]]:
    """Return names and versions of what rebuilds a report: Python, this package, and others."""
    found = [("verifai_jax", __version__), ("Python", platform.python_version())]
    for package in PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            continue
    return [*found, ("machine", f"{platform.system()} {platform.machine()}")]


def shown_folder(folder: Path) -> str:
    """Return the path of a folder as a command names it: relative to the current one, if below."""
    here, folder = Path.cwd().resolve(), folder.resolve()
    return folder.relative_to(here).as_posix() if folder.is_relative_to(here) else folder.as_posix()
