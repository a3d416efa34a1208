"""One writer for a folder: a lock that goes with the process that holds it.

    with write_lock(folder):            # FolderInUse, where another process writes there
        ...

The lock is the operating system's, on a file of the folder: it ends with the process, also one that
is killed. The file says who holds it. Where there are no such locks (`fcntl` is missing, or the
file system has none), nothing is locked. Reading needs no lock.
"""

import contextlib
import errno
import os
import socket
import weakref
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

try:
    import fcntl
except ImportError:
    fcntl = None

LOCK = "writer.lock"
"""Name of the file in a folder that is being written; `NAME.lock` next to a file NAME that is."""
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}


class FolderInUse(ValueError):
    """An error for a folder or file that another process is writing."""


_held: "weakref.WeakSet[FileIO]" = weakref.WeakSet()


def _let_go_in_child() -> None:
    # A forked child has a copy of the open file, which would keep the lock when its parent dies.
    for file in list(_held):
        with contextlib.suppress(OSError):
            file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go_in_child)


@contextlib.contextmanager
def returning_once() -> Iterator[None]:
    """Run code of the user that may fork: only the process that entered continues after it.

    A copy of this process that comes back, as where an `exec` fails, ends without a word: it would
    answer for its parent, and write into the folder of its parent's run.
    """
    owner = os.getpid()
    try:
        yield
    finally:
        if os.getpid() != owner:
            os._exit(1)


@contextlib.contextmanager
def write_lock(folder: Path | None) -> Iterator[None]:
    """Be the only one who writes to a place; None is no place.

    **Arguments:**

    - `folder`: a folder that exists, or a file in one.

    **Raises:** `FolderInUse`, which names the process that has the lock; `OSError` where the file
    of the lock cannot be written.
    """
    if folder is None or fcntl is None:
        yield
        return
    path = folder / LOCK if folder.is_dir() else folder.with_name(f"{folder.name}.lock")
    file, owner = _acquire(path, folder), os.getpid()
    try:
        yield
    finally:
        if os.getpid() == owner:
            _release(file, path)


def _release(file: FileIO, path: Path) -> None:
    _held.discard(file)
    # While it is held: whoever opened the file before finds that it is another one's.
    with contextlib.suppress(OSError):
        path.unlink()
    file.close()


def _acquire(path: Path, folder: Path) -> FileIO:
    assert fcntl is not None
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
    return f"{str(folder)!r} is being written by {who}; wait until that ends, or give another place"
