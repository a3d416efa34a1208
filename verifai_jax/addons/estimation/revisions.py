"""Objects as they were at a revision of git: `specs/ball.py:drop@main`.

    with load_at_revision("specs/ball.py:drop@HEAD~1", Problem) as problem:
        ...                                             # its files are there until the block ends

All files of the revision are written into a temporary folder through a separate index, so neither
the checkout nor anything else of the repository changes. Modules of the project are imported from
there, and the present ones restored afterwards, so that both versions of a module coexist. Imports
and relative paths that a function uses only when it is called refer to the present files.
"""

import contextlib
import importlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from verifai_jax.core.user_code.sources import add_tree, remove_tree
from verifai_jax.core.user_code.targets import Kind, TargetError, load_target
from verifai_jax.core.user_code.user_files import is_user_file

_AT = re.compile(r"(?P<target>.+?\.py(?::[^@]*)?)@(?P<revision>.+)", re.DOTALL)
_OWN = "verifai_jax"
"""Files of this package do not count, not even in its own repository."""


def split_revision(target: str) -> tuple[str, str | None]:
    """Split `FILE.py:NAME@REVISION` into the target and the revision; None without one."""
    found = _AT.fullmatch(target)
    return (target, None) if found is None else (found["target"], found["revision"])


def commit_of(revision: str) -> str:
    """Return the hash of the commit that a revision names.

    **Raises:** `TargetError` for an unknown revision, and outside of a repository.
    """
    root = Path(_git("rev-parse", "--show-toplevel")).resolve()
    try:
        return _git(
            "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}"
        )
    except TargetError:
        raise TargetError(f"git knows no revision {revision!r} in {root}") from None


@contextlib.contextmanager
def load_at_revision(target: str, kind: type[Kind]) -> Iterator[Kind]:
    """Load the object named by a target, at its revision if it has one.

    **Arguments:**
    - `target`: `FILE.py:NAME`, or `FILE.py:NAME@REVISION` with any revision that git knows.
    - `kind`: class of the object.
    **Returns:** a context with the object; at its end the files of the revision are removed.
    **Raises:** `TargetError` for an unknown revision, or without a repository; the errors of
    `load_target`.
    """
    plain, revision = split_revision(target)
    if revision is None:
        yield load_target(plain, kind)
        return
    root = Path(_git("rev-parse", "--show-toplevel")).resolve()
    commit = commit_of(revision)
    with tempfile.TemporaryDirectory(prefix="verifai-jax-") as temporary:
        folder = Path(temporary).resolve()
        tree = folder / "tree"
        _write_files(commit, root, folder / "index", tree)
        inner = Path.cwd().resolve().relative_to(root)
        file = Path(plain.partition(".py")[0])
        if file.is_absolute():
            file = file.resolve().relative_to(root / inner)
            plain = f"{file}.py{plain.partition('.py')[2]}"
        try:
            with _imported_from(root, tree, inner):
                loaded = load_target(plain, kind)
        except TargetError as error:
            raise TargetError(f"at revision {revision}: {error}") from None
        add_tree(tree / inner, commit)
        try:
            yield loaded
        finally:
            remove_tree(tree / inner)


def _write_files(commit: str, root: Path, index: Path, tree: Path) -> None:
    """Write the files of a commit into a folder."""
    tree.mkdir()
    own = {**os.environ, "GIT_INDEX_FILE": str(index)}
    _git("read-tree", commit, cwd=root, env=own)
    _git("checkout-index", "--all", "--quiet", f"--prefix={tree}{os.sep}", cwd=root, env=own)


def _git(*words: str, cwd: Path | None = None, env: dict[str, str] | None = None) -> str:
    try:
        done = subprocess.run(["git", *words], cwd=cwd, env=env, capture_output=True, text=True)
    except FileNotFoundError:
        raise TargetError("a target with a revision needs git, which is not installed") from None
    if done.returncode:
        said = done.stderr.strip().splitlines()
        raise TargetError(f"git {words[0]} failed{f': {said[-1]}' if said else ''}")
    return done.stdout.strip()


@contextlib.contextmanager
def _imported_from(root: Path, tree: Path, inner: Path) -> Iterator[None]:
    """Import modules of the project from another tree of its files, standing in `inner` of it."""
    before, paths = Path.cwd(), list(sys.path)
    kept = {name: module for name, module in sys.modules.items() if lies_in(module, root)}
    for name in kept:
        del sys.modules[name]
    sys.path[:] = [_moved(path, root, tree) for path in paths]
    importlib.invalidate_caches()
    try:
        (tree / inner).mkdir(parents=True, exist_ok=True)
        os.chdir(tree / inner)
        yield
    finally:
        os.chdir(before)
        sys.path[:] = paths
        for name in [name for name, module in sys.modules.items() if lies_in(module, tree)]:
            del sys.modules[name]
        sys.modules.update(kept)
        importlib.invalidate_caches()


def lies_in(module: object, folder: Path) -> bool:
    """Return whether a module was imported from a folder; never true for this package."""
    name = getattr(module, "__name__", None) or ""
    if name.partition(".")[0] in (_OWN, "__main__"):
        return False
    file = getattr(module, "__file__", None)
    if file is None:
        # A folder without an `__init__.py` is a package of several places.
        try:
            paths = [str(path) for path in getattr(module, "__path__", ())]
        except KeyError:
            return False  # Its parent is gone: an import that failed has left it behind.
        return bool(paths) and all(Path(path).is_relative_to(folder) for path in paths)
    return is_user_file(file) and Path(file).resolve().is_relative_to(folder)


def _moved(path: str, root: Path, tree: Path) -> str:
    """Return the entry of `sys.path` in the other tree, where it is one of the project's code."""
    target = Path(path or ".").resolve()
    if not target.is_relative_to(root) or not is_user_file(str(target / "module.py")):
        return path
    return str(tree / target.relative_to(root))
