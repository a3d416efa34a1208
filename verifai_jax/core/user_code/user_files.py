"""Files that are a user's own, and their names and hashes.

    is_user_file("/home/me/specs/car.py")               # not of Python, a package, or this one
    file_hash(Path("specs/car.py"))                     # its SHA-256

This file imports neither JAX nor other parts of this package, so it can be used at any time.
"""

import hashlib
import os
import sysconfig
from collections.abc import Iterable
from functools import cache, lru_cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2]
"""Folder of this package."""
FENCE = "VERIFAI_JAX_FENCE"
"""Variable of the environment with the only folder whose files may be run; unset, all may."""
_INSTALLED = ("site-packages", "dist-packages")
"""Names of folders into which packages are installed."""


def is_notebook_cell(file: str) -> bool:
    """Return whether a name is that of a notebook cell."""
    return "ipykernel_" in file or file.startswith("<ipython")


@cache
def is_user_file(file: str) -> bool:
    """Return whether a file is a user's: not of this package, Python, or an installed package."""
    if file.startswith("<") and not file.startswith(("<stdin", "<string", "<ipython")):
        return False
    if "ipykernel_" in file:
        return True
    path = Path(file).absolute()
    if any(name in path.parts for name in _INSTALLED):
        return False
    return not any(path.is_relative_to(folder) for folder in _libraries())


@cache
def _libraries() -> tuple[Path, ...]:
    """Return the folders of this package, of Python and of what is installed."""
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    folders = {Path(sysconfig.get_path(name)) for name in names}
    folders |= {PACKAGE, Path(__file__).parents[2], Path(os.__file__).parent}
    # The plugin of pytest stands next to the package.
    folders |= {folder.parent / "_verifai_jax_pytest.py" for folder in tuple(folders)}
    return tuple(folders | {folder.resolve() for folder in folders})


def file_hash(file: Path) -> str:
    """Return the SHA-256 of a file; it is read again only if its size or time has changed."""
    about = os.stat(file)
    return _hash(os.path.abspath(file), about.st_mtime_ns, about.st_size, about.st_ino)


def declared_files(files: Iterable[str | Path]) -> dict[str, str]:
    """Return the hashes of files that a user names, by their absolute paths.

    **Raises:** `ValueError` for anything but names of files; `FileNotFoundError` for a missing one.
    """
    if isinstance(files, str | Path):
        raise ValueError(f"files must be a list of files, files=[{str(files)!r}]; got {files!r}")
    found = {}
    for file in files:
        if not Path(file).is_file():
            raise FileNotFoundError(f"files names {str(file)!r}, which is no file; name each file")
        found[os.path.abspath(file)] = file_hash(Path(file))
    return found


@lru_cache(maxsize=4096)
def _hash(file: str, changed: int, size: int, number: int) -> str:
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
