"""The end of a growing table on disk: batches of rows in Arrow's format, each with a checksum.

    tail = Tail(folder)
    tail.append(1024, batch)                            # rows 1024 and on, flushed
    read_tail(folder)                                   # [(first row, batch)] of those whole

A frame is a header and an Arrow stream of one batch. The header has the number of the first row,
the length of the stream, its checksum and one of its own: a batch of which a bit has changed is
left out, those before and after it are read. A batch that was being written when its process
died is no frame yet.
"""

import struct
import zlib
from pathlib import Path
from typing import IO, TYPE_CHECKING

from verifai_jax.falsification.segments import TableError, write_complete

if TYPE_CHECKING:
    import pyarrow as pa

TAIL = "rows.tail"
"""Name of the file in a run's folder."""
_MARK = b"VJR1"
_HEADER = struct.Struct("<4sQQI")
"""Mark, number of the first row, length of the stream, checksum of the stream; its own follows."""
_CHECKSUM = struct.Struct("<I")
_MAX_ROWS = 10**12
"""Numbers of rows beyond it are none, and have more digits than the names of segments."""


class Tail:
    """The file to which the batches of a run are appended.

    **Arguments:**

    - `folder`: of the run. What its tail holds already is kept.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / TAIL
        self._file: IO[bytes] | None = None

    def append(self, first: int, batch: "pa.RecordBatch") -> None:
        """Append a batch; it is with the operating system when this returns.

        **Raises:** `OSError` where it cannot be written.
        """
        if self._file is None:
            self._file = open(self._path, "ab")  # noqa: SIM115 - lives as long as the run
        self._file.write(_frame(first, batch))
        self._file.flush()

    def restart(self) -> None:
        """Drop all batches, which are elsewhere by now."""
        self.close()
        self._path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file, also where the disk does not take what is left of it."""
        file, self._file = self._file, None
        if file is not None:
            file.close()


def replace_tail(folder: Path, first: int, batch: "pa.RecordBatch | None") -> None:
    """Put a tail of one batch, or an empty one, in place of that of a folder, never half.

    **Raises:** `OSError` where it cannot be written.
    """
    write_complete(folder / TAIL, b"" if batch is None else _frame(first, batch))


def read_tail(folder: Path) -> "list[tuple[int, pa.RecordBatch]]":
    """Return the batches of a tail that are whole, each with the number of its first row.

    **Raises:** `TableError` for anything that is not a file.
    """
    import pyarrow as pa

    try:
        content = memoryview((folder / TAIL).read_bytes())
    except FileNotFoundError:
        return []
    except IsADirectoryError as error:
        raise TableError(f"{folder / TAIL} is damaged: it is not a file") from error
    found, at, head = [], 0, _HEADER.size + _CHECKSUM.size
    while at + head <= len(content):
        header = content[at : at + _HEADER.size]
        (own,) = _CHECKSUM.unpack_from(content, at + _HEADER.size)
        if header[: len(_MARK)] != _MARK or zlib.crc32(header) != own:
            # The next frame begins wherever the next header does.
            following = content.obj.find(_MARK, at + 1)  # pyright: ignore[reportAttributeAccessIssue]
            at = len(content) if following < 0 else following
            continue
        _, first, length, checksum = _HEADER.unpack(header)
        stream = content[at + head : at + head + length]
        at += head + length
        if len(stream) < length or zlib.crc32(stream) != checksum or first > _MAX_ROWS:
            continue
        try:
            for batch in pa.ipc.open_stream(pa.py_buffer(stream)):
                # A checksum is no proof of who wrote it: offsets may point anywhere.
                batch.validate(full=True)
                found.append((first, batch))
        except pa.ArrowException:
            continue
    return found


def _frame(first: int, batch: "pa.RecordBatch") -> bytes:
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema) as writer:
        writer.write_batch(batch)
    stream = sink.getvalue()
    header = _HEADER.pack(_MARK, first, stream.size, zlib.crc32(stream))
    return b"".join((header, _CHECKSUM.pack(zlib.crc32(header)), stream))
