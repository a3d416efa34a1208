"""Libraries of machine code that this machine's own compiler makes, kept on disk.

    path = library_file("monitor-4f2a", lambda: (source, ("-std=c99", "-O2")))

A file is used only if its content has the checksum in its name, from a folder that nobody
else can write to.
"""

import hashlib
import os
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Callable
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
    return Path(found).resolve()


Program = tuple[str, tuple[str, ...]]
"""The source of a library, and the flags with which it is compiled."""


def library_file(name: str, program: Callable[[], Program]) -> Path:
    """Return the file of the library with this name, compiling it if there is none.

    **Arguments:**
    - `name`: a name that identifies everything the library depends on.
    - `program`: a function that returns the source and the compiler's flags, called if needed.
    **Raises:** `Unavailable` if it cannot be compiled or stored.
    """
    try:
        folder = library_folder()
        path = next(filter(_is_whole, sorted(folder.glob(f"{name}-*.so"))), None)
        return path or compile_library(folder, name, *program())
    except OSError as error:
        raise Unavailable(f"the cache of compiled programs cannot be used: {error}") from error


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


def compile_library(folder: Path, name: str, source: str, flags: tuple[str, ...]) -> Path:
    """Compile a library into a folder, and return its file, whose name ends with a checksum.

    **Raises:** `Unavailable` if there is no compiler, or if it fails.
    """
    tool = _compiler()
    with tempfile.TemporaryDirectory(dir=folder) as cell:
        code, made = Path(cell) / "program.cpp", Path(cell) / "program.so"
        code.write_text(source)
        command = [str(tool), "-shared", "-fPIC", "-w", *flags, str(code), "-o", str(made), "-lm"]
        try:
            done = subprocess.run(
                command, capture_output=True, timeout=MAX_SECONDS, check=False, cwd=cell,
                stdin=subprocess.DEVNULL,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise Unavailable(f"{tool} took more than {MAX_SECONDS:z.0f} s") from None
        if done.returncode != 0 or not made.is_file():
            said = done.stderr.decode(errors="replace").strip().splitlines() or ["it said nothing"]
            raise Unavailable(f"{tool} failed: {said[0][:200]}")
        path = folder / f"{name}-{_checksum(read_bytes(made))}.so"
        # At once, or not at all: another process may be compiling the same.
        os.replace(made, path)
        return path
