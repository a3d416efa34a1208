"""Ready callbacks: they write numbers of a computation to a CSV file, or for TensorBoard.

falsify(problem, callbacks=[CSVLogger("progress.csv"), TensorBoardLogger("logs/balance")])
"""

import csv
import io
import itertools
import os
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

from verifai_jax.core.store.atomic_files import append, replacing
from verifai_jax.core.store.foreign_files import read_text
from verifai_jax.core.user_code.callbacks import Values

STEP = "step"
"""Column of the step in a CSV file."""
_NUMBERS = itertools.count()


class CSVLogger:
    """A logger that writes a CSV file: a row for each call, with the step and the values.

    **Arguments:**
    - `path`: the path of the file; an existing one is continued. Cells without a value are empty.
    **Raises:** `ValueError` for an existing file without a column `step`.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._columns: list[str] = []
        if self.path.exists() and self.path.stat().st_size:
            self._columns = next(csv.reader(io.StringIO(read_text(self.path))), [])
            if self._columns[:1] != [STEP]:
                raise ValueError(
                    f"{self.path} is not the file of a CSVLogger: its first column is "
                    f"{self._columns[0]!r}, not {STEP!r}"
                )

    def __call__(self, step: int, values: Values) -> None:
        """Append a row, and with it columns for values that are new."""
        row = {STEP: step, **values}
        columns = [*self._columns, *(name for name in row if name not in self._columns)]
        if columns != self._columns:
            # Write the file anew with more columns.
            rows: list[dict[str, str]] = []
            if self._columns:
                rows = list(csv.DictReader(io.StringIO(read_text(self.path))))
            with replacing(self.path) as partial, partial.open("w", newline="") as file:
                writer = csv.DictWriter(file, columns)
                writer.writeheader()
                writer.writerows(rows)
            self._columns = columns
        line = io.StringIO()
        csv.DictWriter(line, self._columns).writerow(row)
        append(self.path, line.getvalue().encode())


class TensorBoardLogger:
    """A logger that writes scalars to an event file, which `tensorboard --logdir FOLDER` shows.

    It needs neither TensorBoard nor TensorFlow: records consist of a length, the event as a
    protocol buffer, and their checksums (tensorflow/core/lib/io/record_writer.cc,
    tensorflow/core/util/event.proto).

    **Arguments:**
    - `folder`: the folder of the event file; each logger starts its own file.
    - `prefix`: a prefix for the names of values, such as `"falsify/"`.
    """

    def __init__(self, folder: str | Path, prefix: str = "") -> None:
        self.folder, self.prefix = Path(folder), prefix
        name = f"{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}.{next(_NUMBERS)}"
        self.path = self.folder / f"events.out.tfevents.{name}"

    def __call__(self, step: int, values: Values) -> None:
        """Append an event with the values."""
        if not self.path.exists():
            self._append(_double(1, time.time()) + _bytes(3, b"brain.Event:2"))
        summary = b"".join(
            _bytes(1, _bytes(1, f"{self.prefix}{name}".encode()) + _float(2, value))
            for name, value in values.items()
        )
        self._append(_double(1, time.time()) + _integer(2, step) + _bytes(5, summary))

    def _append(self, event: bytes) -> None:
        length = struct.pack("<Q", len(event))
        append(self.path, length + _checksum(length) + event + _checksum(event))


def _varint(value: int) -> Iterator[int]:
    while value > 127:
        yield value & 127 | 128
        value >>= 7
    yield value


def _integer(field: int, value: int) -> bytes:
    return bytes([field << 3, *_varint(value)])


def _double(field: int, value: float) -> bytes:
    return bytes([field << 3 | 1]) + struct.pack("<d", value)


def _float(field: int, value: float) -> bytes:
    return bytes([field << 3 | 5]) + struct.pack("<f", value)


def _bytes(field: int, value: bytes) -> bytes:
    return bytes([field << 3 | 2, *_varint(len(value))]) + value


def _table() -> list[int]:
    """Return the table of CRC-32C, with the reflected polynomial of Castagnoli (RFC 3720)."""
    entries = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        entries.append(value)
    return entries


_CRC = _table()


def crc32c(data: bytes) -> int:
    """Compute CRC-32C; `b"123456789"` has 0xE3069283."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC[(crc ^ byte) & 255]
    return crc ^ 0xFFFFFFFF


def _checksum(data: bytes) -> bytes:
    """Return the masked checksum of a record's part."""
    crc = crc32c(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)
