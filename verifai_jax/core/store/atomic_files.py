"""Atomic files: complete or absent, whatever ends the process that writes them.

    with replacing("report.html") as partial:
        partial.write_text(page)                # takes the place of report.html at the end

All files of results are written by it: tables, records, pictures, films, policies, reports. Files
that belong together are complete before the first is renamed: `with replacing(a) as x, replacing(b)
as y`; `replacements.py` replaces the files of a folder of their own by one rename. The temporary
file is locked while it is written, so the next writer in the folder knows those that a killed
process left, and removes them.
"""

import contextlib
import errno
import io
import os
import re
import threading
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:
    fcntl = None
_PARTIAL = re.compile(r"\..*\.\d+-\d+\.part(\..*)?", re.DOTALL)
"""Names of temporary files of writers that may not be alone in a folder."""
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
_REMEDIES = {
    errno.ENOSPC: "make room on its disk, or give another path",
    errno.EDQUOT: "make room on its disk, or give another path",
    errno.EROFS: "give a path on a disk that may be written",
    errno.EACCES: "give a path that you may write",
    errno.EPERM: "give a path that you may write",
    errno.ENOENT: "its folder is gone; make it again, or give another path",
    errno.EISDIR: "it is a folder; give the path of a file",
    errno.ENAMETOOLONG: "give a shorter name",
}
"""Advice for a file that cannot be written, by the reason of the file system."""
_ELSE = "give another path"


@contextlib.contextmanager
def replacing(path: str | Path, *, locked: bool = False) -> Iterator[Path]:
    """Yield the path of a temporary file, which replaces the one at `path` when it is complete.

    It has the same file ending, from which some libraries infer the format. If writing fails, the
    file at `path` stays, and the new one is removed. Missing folders are made.

    **Arguments:**
    - `locked`: whether the folder exists and has no other writer. The temporary file then has a
      fixed name, so that the next writer reuses the one that a killed process left.
    **Raises:** `OSError` that names `path`, the reason and a remedy, if the file system refuses.
    """
    path = Path(path)
    # Several processes and threads may write it at once, such as tests of one problem.
    writer = f"{os.getpid()}-{threading.get_ident()}"
    name = f".{path.name}.part" if locked else f".{path.stem}.{writer}.part{path.suffix}"
    partial = path.with_name(name)
    with contextlib.ExitStack() as ends:
        try:
            if not locked:
                path.parent.mkdir(parents=True, exist_ok=True)
                _remove_leftovers(path.parent)
                if (file := held(partial)) is not None:
                    ends.enter_context(file)
            yield partial
            partial.replace(path)
        except OSError as error:
            raise unwritable(path, error) from error
        finally:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)


def held(path: Path) -> io.FileIO | None:
    """Open a file for writing, made if it is missing, and lock it until it is closed.

    It is None on a platform without such locks; a file system without them leaves it unlocked.

    **Raises:** `BlockingIOError` if another process has the lock; `OSError` of the file system.
    """
    while fcntl is not None:
        file = io.FileIO(path, "r+", opener=_open)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                file.close()
                raise
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()  # Its holder removed it meanwhile.
    return None


def _open(path: str, flags: int) -> int:
    # A folder from elsewhere may have a link of this name, to a file that is not to be emptied.
    return os.open(path, flags | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)


def _remove_leftovers(folder: Path) -> None:
    """Remove the temporary files in a folder that nobody has locked."""
    if fcntl is None:
        return
    for name in filter(_PARTIAL.fullmatch, os.listdir(folder)):
        with contextlib.suppress(OSError), io.FileIO(folder / name, "r+", opener=_open) as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (folder / name).unlink()


def append(path: Path, content: bytes) -> None:
    """Append bytes to a file, all or none of them; missing folders are made.

    **Raises:** the `OSError` of `replacing`.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab", buffering=0) as file:
            append_to(file, content)
    except OSError as error:
        raise unwritable(path, error) from error


def append_to(file: io.FileIO | io.BytesIO, content: bytes) -> int:
    """Append bytes to an unbuffered open file, all or none; return their position.

    **Raises:** `OSError` of the file system.
    """
    begin, rest = file.seek(0, os.SEEK_END), memoryview(content)
    try:
        while rest:
            rest = rest[file.write(rest) :]
    except OSError:
        with contextlib.suppress(OSError):  # What little room there is, others need.
            file.truncate(begin)
        raise
    return begin


def unwritable(path: str | Path, error: OSError, more: str = "") -> OSError:
    """Return the error for a file or folder that cannot be written.

    **Arguments:**
    - `error`: the error of the file system, or an error returned by this function.
    - `more`: a sentence on what happens to the results.
    **Returns:** an error of the same kind and `errno` that names the path, the reason and a remedy.
    """
    rest = f"{_REMEDIES.get(error.errno or 0, _ELSE)}{f'. {more}' if more else ''}"
    kind = type(error) if type(error).__module__ == "builtins" else OSError
    made = kind(f"{path} cannot be written ({reason(error)}); {rest}")
    made.errno = error.errno
    return made


def reason(error: OSError) -> str:
    """Return only the reason from the file system, such as `No space left on device`."""
    return os.strerror(error.errno) if error.errno else error.strerror or str(error)
