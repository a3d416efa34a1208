"""A distinction of files: a user's own, and those of Python, of packages and of this one.

    is_user_file("specs/cartpole.py")                   # True
    is_user_file(numpy.__file__)                        # False

It imports neither JAX nor anything else of this package, so that it may be asked at any time.
"""

import os
import sysconfig
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
"""Folder of this package."""
_INSTALLED = ("site-packages", "dist-packages")
"""Names of folders into which packages are installed."""


def is_notebook_cell(file: str) -> bool:
    """Return whether a name stands for the cell of a notebook."""
    return "ipykernel_" in file or file.startswith("<ipython")


@cache
def is_user_file(file: str) -> bool:
    """Return whether a file is a user's: neither this package nor Python nor installed."""
    if file.startswith("<") and not file.startswith(("<stdin", "<string", "<ipython")):
        return False
    if "ipykernel_" in file:
        return True
    path = Path(file).absolute()
    if any(name in path.parts for name in _INSTALLED):
        return False
    return not any(path.is_relative_to(folder) for folder in _libraries())


@cache
def library_prefixes() -> tuple[str, ...]:
    """Return the beginnings of paths of Python's files and of most that are installed."""
    return tuple(f"{folder}{os.sep}" for folder in _libraries())


@cache
def _libraries() -> tuple[Path, ...]:
    """Return the folders of this package, of Python and of what is installed."""
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    folders = {Path(sysconfig.get_path(name)) for name in names}
    folders |= {PACKAGE, Path(__file__).parents[1], Path(os.__file__).parent}
    # The plugin of pytest stands next to the package.
    folders |= {folder.parent / "_verifai_jax_pytest.py" for folder in tuple(folders)}
    return tuple(folders | {folder.resolve() for folder in folders})
