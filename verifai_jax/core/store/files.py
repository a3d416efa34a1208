"""Atomic files, records in JSON, and the checksum of all stored data.

write_complete(path, content)
write_record(path, {"seed": 0})
read_record(path)                               # DamagedError, where it has changed since
"""

import json
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any, Union, get_args, get_origin

from verifai_jax.core.messages.checks import is_number
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import read_json

if TYPE_CHECKING:
    import pyarrow as pa
MAX_INTEGER = 2**63 - 1
"""Greatest whole number of a record."""
_CHECKSUM = "checksum"
"""Entry of a record with the checksum of the others."""


class DamagedError(ValueError):
    """An error for a file whose content is not as written."""


def checksum(content: "bytes | memoryview | pa.Buffer", before: int = 0) -> int:
    """Return the CRC-32 checksum of bytes, continued from that of the bytes `before` them.

    It detects damage, not forgery; no content of files is ever executed.
    """
    return zlib.crc32(content, before)


def write_complete(path: Path, content: "pa.Buffer | bytes", locked: bool = True) -> Path:
    """Write a file such that a reader never sees a part of it; return its path.

    - `locked`: as in `replacing`; a missing folder is then not made again, since the files of a run
      are useful only together.

    **Raises:** the `OSError` of `replacing` if it cannot be written; the old file stays.
    """
    with replacing(path, locked=locked) as partial:
        partial.write_bytes(content)
    return path


def write_record(path: Path, record: Mapping[str, Any], locked: bool = True) -> dict[str, Any]:
    """Write plain data as JSON with a checksum, atomically; return it as it will be read back.

    - `locked`: as in `write_complete`.

    **Raises:** `OSError` if it cannot be written.
    """
    stored = json.loads(json.dumps(record))
    write_complete(path, f"{json.dumps(sealed(stored), indent=2)}\n".encode(), locked)
    return stored


def read_record(path: Path) -> dict[str, Any]:
    """Read data written by `write_record`.

    **Raises:** `FileNotFoundError` for a missing file; `DamagedError` for a file that is not a
    record, or whose content has changed.
    """
    try:
        record = read_json(path, within=path.parent)
    except FileNotFoundError:
        raise
    except (ValueError, OSError) as error:
        why = str(error).removeprefix(f"{path} ")
        raise DamagedError(f"{path} is damaged, or of another program: it {why}") from error
    if not isinstance(record, dict) or _CHECKSUM not in record:
        raise DamagedError(f"{path} is damaged, or of another program: it has no checksum")
    own = record.pop(_CHECKSUM)
    if own != record_checksum(record):
        raise DamagedError(f"{path} is damaged: its content has changed since it was written")
    return record


def is_of(value: object, kind: Any) -> bool:
    """Return whether plain data fits an annotation: of numbers, texts, sequences and mappings."""
    outer, inner = get_origin(kind), get_args(kind)
    if outer in (Union, UnionType):
        return any(is_of(value, each) for each in inner)
    if kind in (int, float):
        wanted = int if kind is int else int | float
        limit = MAX_INTEGER if kind is int else sys.float_info.max
        # A number that is not one passes: nothing is known in its place.
        return is_number(value) and isinstance(value, wanted) and not abs(value) > limit
    if outer is None:
        return (
            kind is Any or value is None if kind in (Any, type(None)) else isinstance(value, kind)
        )
    if issubclass(outer, Mapping):
        return isinstance(value, dict) and all(is_of(each, inner[1]) for each in value.values())
    return isinstance(value, list | tuple) and all(is_of(each, inner[0]) for each in value)


def plain(value: object) -> Any:
    """Convert data to JSON types: arrays become lists, and other types text."""

    def convert(each: Any) -> Any:
        return each.tolist() if hasattr(each, "tolist") else str(each)

    return json.loads(json.dumps(value, default=convert))


def record_checksum(record: Mapping[str, Any]) -> int:
    """Return the checksum of plain data."""
    return checksum(json.dumps(record, sort_keys=True).encode())


def sealed(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain data together with its checksum, as stored in a file."""
    content = {name: value for name, value in record.items() if name != _CHECKSUM}
    return {**content, _CHECKSUM: record_checksum(content)}
