"""Files that are there whole or not at all, records in JSON, the checksum of all that is stored.

write_complete(path, content)
write_record(path, {"seed": 0})
read_record(path)                               # DamagedError, where it has changed since
"""

import contextlib
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from verifai_jax.core.text import one_line

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


def write_complete(path: Path, content: "pa.Buffer | bytes") -> Path:
    """Write a file such that a reader never meets a half of it; return its path.

    **Raises:** `OSError` where it cannot be written; what was at `path` stays.
    """
    partial = path.with_name(f".{path.name}.part")  # Readers of a folder leave it out.
    try:
        with open(partial, "wb") as file:
            file.write(content)
        partial.replace(path)
    except OSError:
        with contextlib.suppress(OSError):  # What little room there is, others need.
            partial.unlink(missing_ok=True)
        raise
    return path


def write_record(path: Path, record: Mapping[str, Any]) -> dict[str, Any]:
    """Write plain data as JSON with a checksum, whole; return it as it is read back.

    **Raises:** `OSError` where it cannot be written.
    """
    stored = json.loads(json.dumps(record))
    write_complete(path, f"{json.dumps(sealed(stored), indent=2)}\n".encode())
    return stored


def read_record(path: Path) -> dict[str, Any]:
    """Read what `write_record` has written.

    **Raises:** `FileNotFoundError` where there is none; `DamagedError` for anything that is not a
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
    """Return data as JSON has it: arrays as lists, and a text of what it does not have."""

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
