"""One writer for a folder: a lock that ends with the process that holds it.

    with write_lock(folder):            # FolderInUse, where another process writes there
        ...

The lock is the operating system's, on a file in the folder, so it ends with the process even after
a kill. The file names the process. Whoever locks a folder finishes the replacement of a killed
process, and removes its leftovers (`replacements.py`). Without such locks (`fcntl` is missing, or
the file system has none) nothing is locked. Reading needs no lock.
"""

import contextlib
import os
import socket
import weakref
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

from verifai_jax.core.store.atomic_files import held, reason
from verifai_jax.core.store.replacements import WHOLE, recover

LOCK = "writer.lock"
"""Name of the file in a folder that is being written."""


class FolderInUse(ValueError):
    """An error for a folder that another process is writing."""


_held: "weakref.WeakSet[FileIO]" = weakref.WeakSet()


def _let_go_in_child() -> None:
    # A forked child has a copy of the open file, which would keep the lock when its parent dies.
    for file in list(_held):
        with contextlib.suppress(OSError):
            file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go_in_child)


@contextlib.contextmanager
def write_lock(folder: Path | None) -> Iterator[None]:
    """Lock a folder for writing by this process, making it if needed; None locks nothing.

    **Raises:** `FolderInUse`, which names the process that has the lock; `ValueError` for a folder
    that cannot be written.
    """
    if folder is None:
        yield
        return
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        file, owner = _acquire(folder), os.getpid()
    try:
        with writing(folder):
            recover(folder)
        yield
    finally:
        if file is not None and os.getpid() == owner:
            path = folder / LOCK
            _held.discard(file)
            # While it is held: whoever opened the file before finds that it is another one's.
            with contextlib.suppress(OSError):
                path.unlink()
            file.close()


def settled(folder: Path) -> Path:
    """Return a folder that is to be read, after finishing what a killed process had decided.

    **Raises:** as `write_lock`, if a process was killed while it replaced the files.
    """
    if (folder / WHOLE).exists():
        with write_lock(folder):
            pass
    return folder


@contextlib.contextmanager
def writing(folder: Path | None) -> Iterator[None]:
    """Convert errors of the file system into one line with a remedy."""
    try:
        yield
    except OSError as error:
        raise ValueError(
            f"folder {str(folder)!r} cannot be written ({reason(error)}); give one that "
            "can be, or none to keep the results in memory"
        ) from error


def _acquire(folder: Path) -> FileIO | None:
    try:
        file = held(folder / LOCK)
    except BlockingIOError:
        owner = ""
        with contextlib.suppress(OSError), FileIO(folder / LOCK) as other:
            owner = other.read(200).decode(errors="replace")
        raise FolderInUse(_in_use(folder, owner)) from None
    if file is not None:
        _held.add(file)
        with contextlib.suppress(OSError):  # On a full disk the file does not name its holder.
            file.truncate(0)
            file.write(f"{os.getpid()} {socket.gethostname()}".encode())
    return file


def _in_use(folder: Path, owner: str) -> str:
    process, _, host = owner.partition(" ")
    if not (process.isdecimal() and host.isprintable()):
        who = "another process"
    elif int(process) == os.getpid() and host == socket.gethostname():
        who = f"this process ({process}) already"
    else:
        who = f"process {process} on {host}"
    return (
        f"{str(folder)!r} is being written by {who}; wait until that ends, or give another folder"
    )
