"""Records with a checksum of their own content, which shows whether a file was changed.

file.write_text(json.dumps(sealed(record)))
is_intact(json.loads(file.read_text()))
"""

import json
import zlib
from collections.abc import Mapping
from typing import Any

_SEAL = "checksum"


def sealed(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record of plain data with the checksum of its content."""
    return {**record, _SEAL: _checksum(record)}


def is_intact(record: Mapping[str, Any]) -> bool:
    """Return whether a record is as it was sealed."""
    return record.get(_SEAL) == _checksum(record)


def _checksum(record: Mapping[str, Any]) -> int:
    content = {name: value for name, value in record.items() if name != _SEAL}
    return zlib.crc32(json.dumps(content, sort_keys=True).encode())
