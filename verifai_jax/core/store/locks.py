"""One writer for a folder: a lock that ends with the process that holds it.

    with write_lock(folder):            # FolderInUse, where another process writes there
        ...

The lock is the operating system's, on a file in the folder, so it ends with the process even after
a kill. The file names the process. Without such locks (`fcntl` is missing, or the file system has
none) nothing is locked. Reading needs no lock.
"""

import contextlib
import errno
import os
import socket
import weakref
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

from verifai_jax.core.store.atomic_files import reason

try:
    import fcntl
except ImportError:
    fcntl = None
LOCK = "writer.lock"
"""Name of the file in a folder that is being written."""
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}


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
        yield
    finally:
        if file is not None and os.getpid() == owner:
            path = folder / LOCK
            _held.discard(file)
            # While it is held: whoever opened the file before finds that it is another one's.
            with contextlib.suppress(OSError):
                path.unlink()
            file.close()


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
    path = folder / LOCK
    if fcntl is None:
        return None
    while True:
        file = FileIO(path, "r+", opener=_open)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = file.read(200).decode(errors="replace")
            file.close()
            raise FolderInUse(_in_use(folder, owner)) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                file.close()
                raise
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        file.close()  # Its holder removed it meanwhile.
    _held.add(file)
    with contextlib.suppress(OSError):  # On a full disk nobody is told who has it.
        file.truncate(0)
        file.write(f"{os.getpid()} {socket.gethostname()}".encode())
    return file


def _open(path: str, flags: int) -> int:
    # A folder from elsewhere may have a link of this name, to a file that is not to be emptied.
    return os.open(path, flags | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)


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
