"""The data files and modules that each of a user's modules has opened in this process.

    watch()                                             # once, before they are imported
    files_read_by("/home/me/specs/car.py")              # {"/home/me/specs/gains.csv"}
    modules_loaded_by("/home/me/specs/car.py")          # {"/home/me/specs/plant.py"}

Python reports every opened file to its audit hooks. A file counts as read by the user's innermost
module on the stack. Files that this package opens for itself (runs, caches, reports) do not count,
as they are no part of a model. Files opened by libraries in C are not seen.
"""

import importlib.util
import os
import sys
from contextlib import suppress
from types import FrameType

from verifai_jax.core.user_code.source_objects import PACKAGE, is_user_file, library_prefixes

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
_OPENS = ("open", "sqlite3.connect", "ctypes.dlopen")
"""Events of Python by which a file is opened."""
_read: dict[str, set[str]] = {}
_loaded: dict[str, set[str]] = {}
_watching = False
documents: set[str] = set()
"""Files of requirements, whose entries are recorded one by one: no part of a model."""


def watch() -> None:
    """Start recording which files are opened; later calls in a process have no effect."""
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


def modules_loaded_by(module: str) -> set[str]:
    """Return the files of the modules that a module was the first to import.

    **Arguments:**
    - `module`: path of its file.
    """
    return _loaded.get(module, set())


def _note(event: str, arguments: tuple[object, ...]) -> None:
    # It is called for every event of every kind, and whatever it raises would reach the user.
    if event in _OPENS:
        with suppress(Exception):
            _note_open(event, *arguments)


def _note_open(event: str, path: object, mode: object = None, flags: object = 0) -> None:
    if not isinstance(path, str | bytes | os.PathLike):
        return
    text = os.fsdecode(path)
    if event == "open" and text.endswith(_CODE):
        if not text.startswith(library_prefixes()):
            _note_import(text)
        return
    if _writes(mode, flags):
        return
    module = _reader(sys._getframe(2))
    if module is None:
        return
    absolute = os.path.abspath(text)
    # What lies in a folder with a dot is a cache, or settings.
    hidden = f"{os.sep}." in absolute or absolute.startswith(_OF_THE_MACHINE)
    hidden |= absolute in documents
    if not hidden and os.path.isfile(absolute) and is_user_file(absolute):
        files = _read.setdefault(module, set())
        if len(files) < MAX_FILES:
            files.add(absolute)


def _note_import(text: str) -> None:
    """Note the module that a file is of, for the module whose statement imports it."""
    frame, importing = sys._getframe(3), False
    while frame is not None and not is_user_file(frame.f_code.co_filename):
        importing |= frame.f_code.co_filename.startswith("<frozen importlib")
        if not importing or frame.f_code.co_filename.startswith(str(PACKAGE)):
            return
        frame = frame.f_back
    if frame is None:
        return
    absolute = importlib.util.source_from_cache(text) if text.endswith(".pyc") else text
    absolute = os.path.abspath(absolute)
    if os.path.isfile(absolute) and is_user_file(absolute):
        files = _loaded.setdefault(os.path.abspath(frame.f_code.co_filename), set())
        if len(files) < MAX_FILES:
            files.add(absolute)


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
