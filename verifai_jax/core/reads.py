"""The data files that a user's modules have opened in this process, by module.

    watch()                                             # once, before they are imported
    files_read_by("/home/me/specs/car.py")              # {"/home/me/specs/gains.csv"}

Python tells its audit hooks of every file that it opens. A file counts as read by the innermost
module of the user's that stands on the stack, and does not count where this package opens it for
itself: its runs, caches and reports are no part of a model. What a library opens in C is not seen.
"""

import os
import sys
from contextlib import suppress
from types import FrameType

from verifai_jax.core.user_files import PACKAGE, is_user_file

MAX_FILES = 200
"""Files of one module at most."""
_READS_FOR_A_MODEL = ("rl", "systems", "features", "perception", "scenes", "mtl", "blocks")
"""Rooms of this package that open files which a model is made of: policies, tables, programs."""
_READS_FOR_ITSELF = ("jax", "jaxlib", "matplotlib", "IPython")
"""Packages that read devices, caches and settings of their own while a user's module runs."""
_OF_THE_MACHINE = ("/sys/", "/proc/", "/dev/", "/etc/", "/usr/", "/run/")
"""Beginnings of paths that are no data of a model."""
_CODE = (".py", ".pyc", ".so", ".pyd", ".pth")
"""Endings of files that are imported; those have records of their own."""

_read: dict[str, set[str]] = {}
_watching = False


def watch() -> None:
    """Note from now on which files are opened; once for a process, whatever the number of calls."""
    global _watching
    if not _watching:
        _watching = True
        sys.addaudithook(_note)


def files_read_by(module: str) -> set[str]:
    """Return the files that a module has read so far.

    **Arguments:**

    - `module`: path of its file.
    """
    return _read.get(module, set())


def _note(event: str, arguments: tuple[object, ...]) -> None:
    # It is called for every event of every kind, and whatever it raises would reach the user.
    if event == "open":
        with suppress(Exception):
            _note_open(*arguments)


def _note_open(path: object, mode: object, flags: object) -> None:
    if not isinstance(path, str | bytes | os.PathLike):
        return
    text = os.fsdecode(path)
    if text.endswith(_CODE) or _writes(mode, flags):
        return
    module = _reader(sys._getframe(2))
    if module is None:
        return
    place = os.path.abspath(text)
    # What lies in a folder with a dot is a cache, or settings.
    hidden = f"{os.sep}." in place or place.startswith(_OF_THE_MACHINE)
    if not hidden and os.path.isfile(place) and is_user_file(place):
        files = _read.setdefault(module, set())
        if len(files) < MAX_FILES:
            files.add(place)


def _writes(mode: object, flags: object) -> bool:
    if isinstance(mode, str):
        return any(letter in mode for letter in "wax+")
    return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR))


def _reader(frame: FrameType | None) -> str | None:
    """Return the file of the innermost user's module on the stack, or None if no such one reads."""
    own = str(PACKAGE) + os.sep
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith("<frozen importlib") or _package(file) in _READS_FOR_ITSELF:
            return None
        if file.startswith(own):
            if file[len(own) :].partition(os.sep)[0] not in _READS_FOR_A_MODEL:
                return None
        elif is_user_file(file):
            return os.path.abspath(file)
        frame = frame.f_back
    return None


def _package(file: str) -> str:
    """Return the name of the installed package that a file is of; empty for another file."""
    _, installed, rest = file.rpartition("site-packages" + os.sep)
    return rest.partition(os.sep)[0] if installed else ""
