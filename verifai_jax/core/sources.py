"""The record of what a result was made of: hashes of the files of its model, and versions.

    made = made_here()                                  # where a problem is made, remembered there
    sources = sources_of(problem, made)                 # taken when a run begins
    sources.changes(sources_of(problem, made))          # later: which files are others by now

The files are those of the user: the module that makes the problem, modules of the user that it
imports and that its functions come from, and the data that they open or name. The hash of a module
is that of the file as it was imported, so that a module which is edited and not imported again is
what it was. Python, this package and what is installed are recorded by their versions.
"""

import hashlib
import importlib.machinery
import os
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from verifai_jax.core.reads import files_read_by, modules_loaded_by
from verifai_jax.core.source_objects import (
    Function,
    Module,
    OwnFiles,
    is_notebook_cell,
    is_user_file,
    parts_of,
)
from verifai_jax.core.source_scan import MAX_FILES, Import, files_of_model, scan

PACKAGES = (
    *(
        "verifai_jax",
        "jax",
        "jaxlib",
        "numpy",
        "scipy",
        "pandas",
        "sklearn",
        "mujoco",
        "brax",
        "gymnax",
    ),
    *("gymnasium", "diffrax", "scenic", "torch"),
)
"""Packages whose versions decide numbers; the version of one that is imported is recorded."""
PROBLEM, CALLER, IMPORTED = "the problem", "calls what makes the problem", "imported"
FUNCTION, READ, NAMED, MODEL = "a function", "read", "named in a program", "part of a model"
"""Roles of a file. That of a caller counts only where the same caller makes the problem again."""
SHOWN = 12
"""Digits of a hash in a sentence."""
MAX_SHOWN = 3
"""Changes that a sentence lists."""


class Source(NamedTuple):
    """A file by its name, its role, and the SHA-256 of its content.

    The name is the path from the working directory, absolute where the file lies elsewhere.
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
    """A file that is another one by now: its hash then, None for one that had no part in it, and
    its hash now, None for one that is missing.
    """

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
    """The files and versions that a result was made of, as they were then.

    - `files`: of the model, with their hashes.
    - `versions`: by the name of the package.
    - `without_file`: what of the model is in no file, such as cells of a notebook.
    - `root`: the working directory, from which names of files go out.
    - `first`: the row of a table from which on this is what it was made of.
    - `commit`: of git, at which the files were taken; empty for those of the working directory.
    """

    files: tuple[Source, ...]
    versions: Mapping[str, str]
    without_file: tuple[str, ...] = ()
    root: str = ""
    first: int = 0
    commit: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "first": self.first,
            "root": self.root,
            "commit": self.commit,
            "files": [list(file) for file in self.files],
            "without_file": list(self.without_file),
            "versions": dict(self.versions),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Sources":
        """Read what `to_json` wrote.

        **Raises:** `ValueError` for anything else.
        """
        try:
            files = tuple(Source(*map(str, file)) for file in data["files"])
            versions = {str(name): str(value) for name, value in data["versions"].items()}
            without = tuple(map(str, data["without_file"]))
            root, first, commit = str(data["root"]), int(data["first"]), str(data["commit"])
            return cls(files, versions, without, root, first, commit)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError("the record of the files of a model has another form") from error

    def settled(self, begun: float) -> "Sources":
        """Return it at the end of the work that it is the record of.

        Files of data that have been written since the work began are what came of it, such as the
        state of a simulator, and no part of the model. Files that were read by then are, and
        modules that were imported by then.

        **Arguments:**

        - `begun`: seconds since the epoch.
        """
        files = {file.name: file for file in self.files}
        waiting = [file.name for file in self.files if file.role in (PROBLEM, IMPORTED)]
        while waiting:
            module = os.path.join(self.root, waiting.pop())
            opened = ((modules_loaded_by(module), IMPORTED), (files_read_by(module), READ))
            for path, role in ((path, role) for paths, role in opened for path in sorted(paths)):
                if os.path.isfile(path) and (name := _shown(path)) not in files:
                    files[name] = Source(name, role, file_hash(Path(path)))
                    waiting += [name] * (role == IMPORTED)
        written = {
            file.name
            for file in files.values()
            if file.role in (READ, NAMED) and not self._is_older(file.name, begun)
        }
        without = [f"{name} was written in the meantime, and is not recorded" for name in written]
        return replace(
            self,
            files=tuple(file for name, file in files.items() if name not in written),
            without_file=tuple(dict.fromkeys((*self.without_file, *sorted(without)))),
        )

    def _is_older(self, name: str, moment: float) -> bool:
        try:
            return os.stat(os.path.join(self.root, name)).st_mtime < moment
        except OSError:
            return False

    @property
    def code(self) -> str:
        """One hash of the modules, functions and models.

        Data that these read or name are not in it: they may be finished work that is written there.
        """
        roles = (PROBLEM, IMPORTED, FUNCTION, MODEL)
        hashes = sorted(file.sha256 for file in self.files if file.role in roles)
        return hashlib.sha256("\n".join(hashes).encode()).hexdigest()

    def changes(self, now: "Sources | None" = None) -> tuple[Change, ...]:
        """Return the files that are others by now.

        **Arguments:**

        - `now`: what the problem is made of now; what lies on the disk counts when left out, and
          for files that the problem of now does not have.
        """
        if self.commit:
            return ()  # It stays what it is.
        found = []
        present = {} if now is None else {file.name: file for file in now.files}
        for file in self.files:
            match = _same_name(file.name, present)
            if match is None and file.role == CALLER:
                continue  # Somebody else may call what makes the problem.
            if match is None and file.role == FUNCTION and now is None:
                continue  # It lies nowhere but in the problem.
            sha256 = self._on_disk(file.name) if match is None else present[match].sha256
            if sha256 != file.sha256:
                found.append(Change(file.name, file.sha256, sha256))
        own = {file.name: file for file in self.files}
        for file in present.values():
            if file.role == PROBLEM and _same_name(file.name, own) is None:
                found.append(Change(file.name, None, file.sha256))
        return tuple(found)

    def other_versions(self, now: "Sources") -> tuple[str, ...]:
        """Return packages whose version is another one now, as text."""
        return tuple(
            f"{name} {was} then, {now.versions[name]} now"
            for name, was in self.versions.items()
            if name in now.versions and now.versions[name] != was
        )

    def _on_disk(self, name: str) -> str | None:
        paths = [Path(name), Path(self.root) / name]
        return next((file_hash(path) for path in paths if path.is_file()), None)


def _same_name(name: str, others: Mapping[str, Source]) -> str | None:
    """Return the one of some names that stands for the same file, seen from another folder."""
    if name in others:
        return name
    found = [other for other in others if name.endswith(f"/{other}") or other.endswith(f"/{name}")]
    return found[0] if len(found) == 1 else None


def list_changes(changes: Sequence[Change]) -> str:
    """Write changes in one line."""
    listed = ", ".join(map(str, changes[:MAX_SHOWN]))
    more = len(changes) - MAX_SHOWN
    return f"{listed} and {more} more" if more > 0 else listed


def made_here() -> tuple[Maker, ...]:
    """Return the user's modules on the stack, from the innermost one to the import of the last.

    What imports the module that makes a problem has no part in it.
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
    """Return what some objects are made of, as it is imported, and as data lie on the disk.

    **Arguments:**

    - `things`: such as a problem; their functions, classes and files count.
    - `made`: where they were made, as `made_here` returned it there.
    - `first`: the row of a table from which on that holds.
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
    commits = [commit for tree, commit in _trees.items() if _any_below(collector.modules, tree)]
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
            self.modules[file] = Source(_shown(file), role, sha256)

    def add_data(self, file: str, role: str, sha256: str | None = None) -> None:
        if file in self.data or file in self.modules or len(self.data) >= MAX_FILES:
            return
        try:
            self.data[file] = Source(_shown(file), role, sha256 or file_hash(Path(file)))
        except OSError:
            self.without_file.append(f"{_shown(file)} cannot be read, and is not recorded")

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
        """Return the hash of a file as it was imported, or as it is where it is not imported."""
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
    tree = _tree_of(program)
    if tree is not None:
        return [tree, Path(program).parent]
    module = sys.modules.get(top)
    if module is not None:
        folders = [Path(path).parent for path in getattr(module, "__path__", ())]
        file = getattr(module, "__file__", None)
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
"""Hashes of modules as they were first seen, by their specs, which a reload replaces."""


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


def file_hash(file: Path) -> str:
    """Return the SHA-256 of a file; read again only where its size or its time has changed."""
    about = os.stat(file)
    return _hash(os.path.abspath(file), about.st_mtime_ns, about.st_size, about.st_ino)


@lru_cache(maxsize=4096)
def _hash(file: str, changed: int, size: int, number: int) -> str:
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package and of others that are imported."""
    found = {"Python": platform.python_version()}
    for name in PACKAGES:
        version = getattr(sys.modules.get(name), "__version__", None)
        if isinstance(version, str):
            found[name] = version
    return found


_trees: dict[Path, str] = {}
"""Folders with the project's files as they are at commits of git, while they are there."""


def add_tree(folder: Path, commit: str) -> None:
    """Let names of files below a folder go out from there, and imports of them be found there."""
    _trees[folder] = commit


def remove_tree(folder: Path) -> None:
    """End what `add_tree` began."""
    del _trees[folder]


def _tree_of(file: str) -> Path | None:
    return next((tree for tree in _trees if Path(file).is_relative_to(tree)), None)


def _shown(file: str) -> str:
    """Return the name of a file: from the working directory, or absolute where it is elsewhere."""
    path = Path(file)
    for root in (_tree_of(file), Path.cwd(), Path.cwd().resolve()):
        if root is not None and path.is_relative_to(root):
            return path.relative_to(root).as_posix()
    return path.as_posix()
