"""Files that are there whole or not at all, records in JSON, the checksum of all that is stored.

write_complete(path, content)
write_record(path, {"seed": 0})
read_record(path)                               # DamagedError, where it has changed since
"""

import contextlib
import json
import shutil
import tempfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.atomic_files import replacing, unwritable

if TYPE_CHECKING:
    import pyarrow as pa
_CHECKSUM = "checksum"
"""Entry of a record with the checksum of the others."""


class DamagedError(ValueError):
    """An error for a file that is not as it was written."""


def checksum(content: "bytes | memoryview | pa.Buffer", before: int = 0) -> int:
    """Return the checksum of bytes (CRC-32), that of what comes `before` them included.

    It finds damage, not forgery: what a file holds is never executed, whoever wrote it.
    """
    return zlib.crc32(content, before)


def write_complete(path: Path, content: "pa.Buffer | bytes", locked: bool = True) -> Path:
    """Write a file such that a reader never meets a half of it; return its path.

    - `locked`: as of `replacing`. A folder that is gone stays so then: the files of a run are of
      use together.

    **Raises:** `OSError` where it cannot be written, as `replacing`; what was at `path` stays.
    """
    with replacing(path, locked=locked) as partial:
        partial.write_bytes(content)
    return path


@contextlib.contextmanager
def replacing_all(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yield a folder for files that take the place of those in `folder` once all are whole.

    So a full disk leaves what was there, and nothing of what was to come.

    **Arguments:**
    - `folder`: which is there, and has no other writer.
    - `names`: the names of all files and folders that belong together, also those that may be
      missing. The last one is that without which the others are worth nothing: it goes first and
      comes last.
    **Raises:** `OSError` that names `folder`, for whatever the file system refuses.
    """
    *others, last = names
    try:
        with tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as made:
            yield Path(made)
            for name in (last, *others):
                old = folder / name
                if old.is_dir() and not old.is_symlink():
                    shutil.rmtree(old)
                else:
                    old.unlink(missing_ok=True)
            for name in (*others, last):
                if (new := Path(made) / name).exists():
                    new.replace(folder / name)
    except OSError as error:
        raise unwritable(folder, error, "The results are in memory all the same") from error


def write_record(path: Path, record: Mapping[str, Any], locked: bool = True) -> dict[str, Any]:
    """Write plain data as JSON with a checksum, whole; return it as it is read back.

    - `locked`: as of `write_complete`.

    **Raises:** `OSError` where it cannot be written.
    """
    stored = json.loads(json.dumps(record))
    write_complete(path, f"{json.dumps(sealed(stored), indent=2)}\n".encode(), locked)
    return stored


def read_record(path: Path) -> dict[str, Any]:
    """Read what `write_record` has written.

    **Raises:** `FileNotFoundError` for a missing file; `DamagedError` for anything that is not a
    record, or not as it was written.
    """
    try:
        record = json.loads(path.read_text())
    except FileNotFoundError:
        raise
    except (ValueError, RecursionError, OSError) as error:
        why = f"it cannot be read as JSON ({one_line(str(error))})"
        raise DamagedError(f"{path} is damaged, or of another program: {why}") from error
    if not isinstance(record, dict) or _CHECKSUM not in record:
        raise DamagedError(f"{path} is damaged, or of another program: it has no checksum")
    own = record.pop(_CHECKSUM)
    if own != record_checksum(record):
        raise DamagedError(f"{path} is damaged: its content has changed since it was written")
    return record


def plain(value: object) -> Any:
    """Convert data to what JSON can hold: arrays to lists, and what JSON lacks to text."""

    def convert(each: Any) -> Any:
        return each.tolist() if hasattr(each, "tolist") else str(each)

    return json.loads(json.dumps(value, default=convert))


def record_checksum(record: Mapping[str, Any]) -> int:
    """Return the checksum of plain data."""
    return checksum(json.dumps(record, sort_keys=True).encode())


def sealed(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain data with its checksum, as it stands in a file."""
    content = {name: value for name, value in record.items() if name != _CHECKSUM}
    return {**content, _CHECKSUM: record_checksum(content)}
