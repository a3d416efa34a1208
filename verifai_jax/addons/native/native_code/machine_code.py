"""Libraries of machine code that this machine's own compiler makes, kept on disk.

    path, library = load_library("monitor-4f2a", lambda: (source, ("-std=c99", "-O2")), ["step"])

A file is used only if its content has the checksum in its name, from a folder that nobody
else can write to. What does not load is made once more.
"""

import contextlib
import ctypes
import hashlib
import os
import platform
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

from verifai_jax.core.compute.devices import cache_folder
from verifai_jax.core.store.foreign_files import read_bytes

COMPILERS = ("c++", "g++", "clang++")
"""Names under which a compiler is looked for."""
MAX_SECONDS = 60.0
"""Seconds that a compiler may take; the programs of the shipped problems take up to two."""


class Unavailable(Exception):
    """An error for a library that cannot be made, with the reason."""


def compiler() -> Path:
    """Return the C compiler of this machine, for a library that is stored.

    **Raises:** `Unavailable` without a compiler, or without a folder for libraries.
    """
    if cache_folder() is None:
        raise Unavailable("the cache of compiled programs is switched off")
    return _compiler()


def _compiler() -> Path:
    found = next(filter(None, map(shutil.which, COMPILERS)), None) if os.name == "posix" else None
    if found is None:
        raise Unavailable("there is no C++ compiler: none of c++, g++, clang++ is in PATH")
    # Not through its links: a program such as `ccache` is the compiler whose name it is called by.
    return Path(found).absolute()


Program = tuple[str, tuple[str, ...]]
"""The source of a library, and the flags with which it is compiled."""


def load_library(
    name: str, program: Callable[[], Program], symbols: Sequence[str]
) -> tuple[Path, ctypes.CDLL]:
    """Return the library with this name and its file, compiling it if there is none that is whole.

    **Arguments:**
    - `name`: a name that identifies everything the library depends on.
    - `program`: a function that returns the source and the compiler's flags, called if needed.
    - `symbols`: the functions that it must have.
    **Raises:** `Unavailable` if it cannot be compiled, stored or loaded.
    """
    try:
        folder = library_folder()
        for path in sorted(folder.glob(f"{name}-*.so")):
            with contextlib.suppress(OSError, AttributeError):
                if _is_whole(path):
                    return path, _loaded(path, symbols)
            path.unlink(missing_ok=True)
        path = compile_library(folder, name, *program(), symbols)
        return path, _loaded(path, symbols)
    except (OSError, AttributeError) as error:
        raise Unavailable(f"the cache of compiled programs cannot be used: {error}") from error


def _loaded(path: Path, symbols: Sequence[str]) -> ctypes.CDLL:
    library = ctypes.CDLL(str(path))
    for each in symbols:
        getattr(library, each)
    return library


def library_folder() -> Path:
    """Return the folder of libraries, to which only this user can write.

    **Raises:** `Unavailable` if others can write to it, or if the cache is switched off.
    """
    base = cache_folder()
    if base is None:
        raise Unavailable("the cache of compiled programs is switched off")
    folder = base / "native"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = os.lstat(folder)
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o022:
        raise Unavailable(f"others can write to {folder}, so no program of it is loaded")
    return folder


def _is_whole(path: Path) -> bool:
    """Return whether a library has the content that its name says."""
    try:
        return path.stem.endswith(f"-{_checksum(read_bytes(path))}")
    except OSError:
        return False


def _checksum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:32]


def compile_library(
    folder: Path, name: str, source: str, flags: tuple[str, ...], symbols: Sequence[str] = ()
) -> Path:
    """Compile a library into a folder, and return its file, whose name ends with a checksum.

    **Arguments:**
    - `symbols`: the functions that it must have; another process loads it to see them, since a
      library that a compiler left incomplete may kill the process that loads it.
    **Raises:** `Unavailable` if there is no compiler, or if it fails.
    """
    tool = _compiler()
    _remove_left(folder)
    with tempfile.TemporaryDirectory(
        dir=folder, prefix=f"tmp-{os.getpid()}-{_HOST}-", ignore_cleanup_errors=True
    ) as cell:
        code, made = Path(cell) / "program.cpp", Path(cell) / "program.so"
        code.write_text(source)
        command = [str(tool), "-shared", "-fPIC", "-w", *flags, str(code), "-o", str(made), "-lm"]
        status, said = _run(command, cell)
        if status != 0 or not made.is_file():
            raise Unavailable(f"{tool} failed: {said or 'it said nothing'}")
        if symbols:
            load = [sys.executable, "-I", "-S", "-c", _LOAD, str(made), *symbols]
            status, said = _run(load, cell)
            if status != 0:
                said = said or f"status {status}"
                raise Unavailable(f"what {tool} made cannot be loaded: {said}")
        path = folder / f"{name}-{_checksum(read_bytes(made))}.so"
        # At once, or not at all: another process may be compiling the same.
        os.replace(made, path)
        return path


_LOAD = """import ctypes, sys
try:
    library = ctypes.CDLL(sys.argv[1])
    [getattr(library, each) for each in sys.argv[2:]]
except (OSError, AttributeError) as error:
    sys.exit(str(error))
"""
_HOST = f"{zlib.crc32(platform.node().encode()):08x}"


def _run(command: list[str], cell: str) -> tuple[int, str]:
    """Run a command, and return its status and the first line of its errors.

    It is ended with all its processes after `MAX_SECONDS`: the compiler may be a script.
    """
    with open(Path(cell) / "said", "w+b") as said:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=said, cwd=cell,
            start_new_session=True,
        )  # fmt: skip
        try:
            status = process.wait(MAX_SECONDS)
        except BaseException as error:
            with contextlib.suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            raise Unavailable(f"{command[0]} took more than {MAX_SECONDS:z.0f} s") from None
        said.seek(0)
        lines = said.read(10_000).decode(errors="replace").strip().splitlines()
    return status, lines[0][:200] if lines else ""


def _remove_left(folder: Path) -> None:
    """Remove what processes that were killed while they compiled have left."""
    for left in folder.glob("tmp*"):
        _, process, host, *_ = *left.name.split("-"), "", "", ""
        with contextlib.suppress(OSError):
            # Whether a process of another machine lives is not known, but none compiles so long.
            dead = time.time() - left.stat().st_mtime > 10 * MAX_SECONDS
            if not dead and host == _HOST and process.isdecimal():
                try:
                    os.kill(int(process), 0)
                except ProcessLookupError:
                    dead = True
            if dead:
                shutil.rmtree(left)
