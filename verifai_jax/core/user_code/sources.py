"""The record of the origins of a result: hashes of its model's files, its program, and versions.

    then.changes(now)                                   # which files are others by now

`source_collection.py` says which files these are. A system that JAX traces is also recorded by the
fingerprint of its program, which contains all of its constants. Python, this package and installed
packages are recorded by their versions.
"""

import hashlib
import os
import platform
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from verifai_jax.core.user_code.user_files import file_hash

PACKAGES = (
    *("verifai_jax", "jax", "jaxlib", "numpy", "scipy", "pandas", "sklearn", "mujoco", "brax"),
    *("gymnax", "gymnasium", "diffrax", "scenic", "torch"),
)
"""Packages whose versions decide numbers; the version of one that is imported is recorded."""
PROBLEM, CALLER, IMPORTED = "the problem", "calls what makes the problem", "imported"
FUNCTION, DECLARED, PROGRAM = "a function", "declared", "the traced program"
"""Roles of a file. That of a caller counts only where the same caller makes the problem again."""
SHOWN = 12
"""Digits of a hash in a sentence."""
MAX_SHOWN = 3
"""Changes that a sentence lists."""
tree_commits: dict[Path, str] = {}
"""Folders with the project's files at commits of git, while they exist."""


class Source(NamedTuple):
    """A file by its name, its role, and the SHA-256 of its content.

    The name is relative to the working directory, or absolute if the file lies elsewhere. Functions
    that are in no file and the traced program are recorded like files.
    """

    name: str
    role: str
    sha256: str


class Maker(NamedTuple):
    """A module whose code makes a problem: its path, hash and role; no path for a notebook."""

    file: str
    sha256: str
    role: str


class Change(NamedTuple):
    """A changed file: its hash then, None if it was not used, and now, None if it is missing."""

    name: str
    was: str | None
    now: str | None

    def __str__(self) -> str:
        if self.was is None:
            return f"{self.name} makes it now, and had no part in it then"
        now = "it is missing now" if self.now is None else f"{self.now[:SHOWN]} now"
        return f"{self.name} (SHA-256 {self.was[:SHOWN]} then, {now})"


@dataclass(frozen=True)
class Sources:
    """The files and versions from which a result was made, at that time.

    - `files`: the files of the model, with their hashes.
    - `versions`: versions by the name of the package.
    - `without_file`: parts of the model that are in no file, such as notebook cells.
    - `root`: the working directory, to which names of files are relative.
    - `first`: the first row of the table to which they apply.
    - `commit`: the git commit that is checked out; empty outside of a repository.
    - `dirty`: whether tracked files differ from that commit.
    - `revision`: the commit from which the files were taken; empty for the working directory.
    """

    files: tuple[Source, ...]
    versions: Mapping[str, str]
    without_file: tuple[str, ...] = ()
    root: str = ""
    first: int = 0
    commit: str = ""
    dirty: bool = False
    revision: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "first": self.first, "root": self.root, "commit": self.commit, "dirty": self.dirty,
            "revision": self.revision, "files": [list(file) for file in self.files],
            "without_file": list(self.without_file), "versions": dict(self.versions),
        }  # fmt: skip

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Sources":
        """Read the output of `to_json`.

        **Raises:** `ValueError` for other data.
        """
        try:
            files = tuple(Source(*map(str, file)) for file in data["files"])
            versions = {str(name): str(value) for name, value in data["versions"].items()}
            without = tuple(map(str, data["without_file"]))
            root, first, commit = str(data["root"]), int(data["first"]), str(data["commit"])
            dirty, revision = bool(data["dirty"]), str(data["revision"])
            return cls(files, versions, without, root, first, commit, dirty, revision)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError("the record of the files of a model has another form") from error

    @property
    def code(self) -> str:
        """A common hash of the modules, functions, declared files and the program."""
        hashes = sorted(file.sha256 for file in self.files if file.role != CALLER)
        hashes.append(self.revision)
        return hashlib.sha256("\n".join(hashes).encode()).hexdigest()

    def changes(self, now: "Sources | None" = None) -> tuple[Change, ...]:
        """Return the files that have changed.

        **Arguments:**
        - `now`: the present sources of the problem. When left out, and for files that these do not
          include, the files on disk are compared.
        """
        if self.revision:
            return ()  # It stays what it is.
        found = []
        present = {} if now is None else {file.name: file for file in now.files}
        for file in self.files:
            match = _same_name(file.name, present)
            if match is None and file.role == CALLER:
                continue  # Somebody else may call what makes the problem.
            if now is None:
                if file.role in (FUNCTION, PROGRAM):
                    continue  # It lies nowhere but in the problem.
            elif file.role == PROGRAM and (match is None or self.other_versions(now)):
                continue  # Other versions trace otherwise, and a backend on the host not at all.
            sha256 = self._on_disk(file.name) if match is None else present[match].sha256
            if sha256 != file.sha256:
                found.append(Change(file.name, file.sha256, sha256))
        own = {file.name: file for file in self.files}
        for file in present.values():
            if file.role == PROBLEM and _same_name(file.name, own) is None:
                found.append(Change(file.name, None, file.sha256))
        return tuple(found)

    def other_versions(self, now: "Sources") -> tuple[str, ...]:
        """Describe the packages whose version has changed."""
        return tuple(
            f"{name} {was} then, {now.versions[name]} now"
            for name, was in self.versions.items()
            if name in now.versions and now.versions[name] != was
        )

    def _on_disk(self, name: str) -> str | None:
        paths = [Path(name), Path(self.root) / name]
        return next((file_hash(path) for path in paths if path.is_file()), None)


def _same_name(name: str, others: Mapping[str, Source]) -> str | None:
    """Return the name, among some, of the same file as seen from another folder."""
    if name in others:
        return name
    found = [other for other in others if name.endswith(f"/{other}") or other.endswith(f"/{name}")]
    return found[0] if len(found) == 1 else None


def list_changes(changes: Sequence[Change]) -> str:
    """Describe changes in one line."""
    listed = ", ".join(map(str, changes[:MAX_SHOWN]))
    more = len(changes) - MAX_SHOWN
    return f"{listed} and {more} more" if more > 0 else listed


def hashed_files(paths: Iterable[Path], role: str) -> list[Source]:
    """Return files, and all files in folders, with their sizes and hashes."""
    found = []
    for path in dict.fromkeys(paths):
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_dir():
                continue
            try:
                size, sha256 = f"{role}, {file.stat().st_size:,} bytes", file_hash(file)
            except OSError as error:
                size, sha256 = f"{role}, unreadable: {error.strerror}", ""
            found.append(Source(shown_path(os.path.abspath(file)), size, sha256))
    return found


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package and of other imported packages."""
    found = {"Python": platform.python_version()}
    for name in PACKAGES:
        version = getattr(sys.modules.get(name), "__version__", None)
        if isinstance(version, str):
            found[name] = version
    return found


def shown_path(file: str) -> str:
    """Return the path of a file: relative to the working directory, or absolute if elsewhere."""
    path = Path(file)
    for root in (tree_of(file), Path.cwd(), Path.cwd().resolve()):
        if root is not None and path.is_relative_to(root):
            return path.relative_to(root).as_posix()
    return path.as_posix()


def add_tree(folder: Path, commit: str) -> None:
    """Make names of files below a folder relative to it, and imports of them possible."""
    tree_commits[folder] = commit


def remove_tree(folder: Path) -> None:
    """Undo `add_tree`."""
    del tree_commits[folder]


def tree_of(file: str) -> Path | None:
    return next((tree for tree in tree_commits if Path(file).is_relative_to(tree)), None)
