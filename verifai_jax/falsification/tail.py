"""The end of a growing table on disk: batches of rows in Arrow's format, entries of a log.

tail = Log(folder / TAIL)
tail.put(tail_entry(1024, batch))                   # rows 1024 and on
read_tail(folder)                                   # [(first row, batch)] of those whole
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from verifai_jax.core.store.log import Arrays, Log
from verifai_jax.falsification.segments import MAX_ROWS

if TYPE_CHECKING:
    import pyarrow as pa
TAIL = "rows.tail"
"""Name of the file in a run's folder."""
_STREAM = "arrow"


def tail_entry(first: int, batch: "pa.RecordBatch") -> dict[str, Arrays]:
    """Return a batch as an entry of the tail; `first` is the number of its first row."""
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema) as writer:
        writer.write_batch(batch)
    return {str(first): {_STREAM: np.frombuffer(sink.getvalue(), np.uint8)}}


def read_tail(folder: Path) -> "list[tuple[int, pa.RecordBatch]]":
    """Return the undamaged batches of a tail, each with the number of its first row.

    **Raises:** `DamagedError` if the path is not a file.
    """
    import pyarrow as pa

    found = []
    for name, arrays in Log(folder / TAIL).entries():
        if not name.isdecimal() or len(name) > len(str(MAX_ROWS)) or _STREAM not in arrays:
            continue  # Of another program.
        try:
            for batch in pa.ipc.open_stream(pa.py_buffer(arrays[_STREAM])):
                # A checksum is no proof of who wrote it: offsets may point anywhere.
                batch.validate(full=True)
                found.append((int(name), batch))
        except pa.ArrowException:
            continue
    return found
