"""Files of a folder that are replaced together, whatever ends the process that does it.

    with write_lock(folder), replacing_all(folder, ("table.parquet", "run.json")) as made:
        ...                                     # writes both files below `made`

The new files are complete in a folder `.part-*` and synchronised to the disk before anything else
happens. One rename to `.whole` then decides: before it the old files are the result, after it the
new ones. They are moved to their places one by one, and `.whole` is removed when it is empty. A
process killed in between leaves `.whole`, and the next that writes in the folder or reads from it
finishes the moves (`locks.write_lock`, `locks.settled`); any `.part-*` is then a leftover.

The folder itself is never exchanged. So it may be a mount point, a link or somebody's current
folder, may lie where nothing can be written, and keeps its permissions and all files of a user.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from verifai_jax.core.store.atomic_files import unwritable

WHOLE = ".whole"
"""Name of the folder of new files that are the result already, and move to their places."""
_PART = ".part-"
_GONE = ".gone"
"""Name of the file in that folder that lists the old files which have no successor."""


@contextlib.contextmanager
def replacing_all(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yield a folder for files that replace those in `folder` together when all are complete.

    If the disk is full, the old files stay and no new one remains.

    **Arguments:**
    - `folder`: an existing folder without another writer.
    - `names`: the names of all files and folders that belong together, including optional ones.
    **Raises:** `OSError` that names `folder`, if the file system refuses, and `ValueError` if
    something is mounted on one of these names.
    """
    for name in names:
        if os.path.ismount(folder / name):
            raise ValueError(f"{folder / name} is a mount point, which cannot be replaced")
    try:
        with tempfile.TemporaryDirectory(
            prefix=_PART, dir=folder, ignore_cleanup_errors=True
        ) as made:
            part = Path(made)
            yield part
            gone = [name for name in names if not (part / name).exists()]
            gone += [f".{name}.part" for name in names]  # Of writers that were killed.
            (part / _GONE).write_text("\n".join(gone))
            for path in (*part.rglob("*"), part):
                _synchronise(path)
            part.rename(folder / WHOLE)
        _synchronise(folder)
        recover(folder)
    except OSError as error:
        raise unwritable(folder, error, "The results are still in memory") from error


def recover(folder: Path) -> None:
    """Finish a replacement that was decided, and remove the parts of others.

    **Arguments:**
    - `folder`: a folder that only this process writes in.
    **Raises:** `OSError` of the file system.
    """
    whole = folder / WHOLE
    if whole.is_dir() and not whole.is_symlink():
        if (whole / _GONE).is_file():  # Otherwise all files are in their places.
            for name in (whole / _GONE).read_text().split("\n"):
                # A stranger's list may name other folders.
                if name.isprintable() and Path(name).name == name not in ("", "..", WHOLE):
                    _remove(folder / name)
            for new in [path for path in whole.iterdir() if path.name != _GONE]:
                _remove(folder / new.name)
                new.rename(folder / new.name)
            (whole / _GONE).unlink()
        whole.rmdir()
    for part in folder.glob(f"{_PART}*"):
        _remove(part)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _synchronise(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    if path.is_symlink() or os.name == "nt":  # Windows opens no folder.
        return
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(file)
    finally:
        os.close(file)
