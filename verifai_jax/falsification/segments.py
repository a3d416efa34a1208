"""The rows of a long run on disk: closed Parquet files of a fixed number of rows each.

    table/rows-000000000000-000001048576-9f3c2a1b.parquet       rows 0 to 1048575
    failures/rows-000000000000-000001048576-07d1e44a.parquet    those of them that stand out

A file is written completely and then renamed; its name has its first row, the row after its last
one, and its checksum. A second file has those rows of the segment that stand out: violations, rows
without a verdict or with a gradient that is not finite, and the row of least robustness. Counts and
views of failures read only this file. `pandas.read_parquet` opens either folder as one table.

The rows after the last segment are the tail, `rows.tail`: batches in Arrow's format, each an entry
of a log under the number of its first row.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int

from verifai_jax.core.messages.text import format_error, printable
from verifai_jax.core.store.files import DamagedError, checksum, write_complete
from verifai_jax.core.store.foreign_files import read_bytes
from verifai_jax.core.store.log import Arrays, Log
from verifai_jax.falsification.columns import ROW, Columns, column_to_arrow, to_arrow

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
SEGMENT_ROWS = 1 << 20
"""Rows of a closed segment, which is read and checked as a whole."""
SEGMENTS = "table"
"""Name of the folder of the segments."""
FAILURES = "failures"
"""Name of the folder of the rows that stand out."""
TAIL = "rows.tail"
"""Name of the file of the rows after the last segment."""
_STREAM = "arrow"
_NAME = re.compile(r"rows-(\d{12})-(\d{12})-([0-9a-f]{8})\.parquet")
MAX_ROWS = 10**12 - 1
"""The greatest number that a row can have: names of segments have twelve digits."""


class TableError(DamagedError):
    """An error for a table on disk that is damaged."""


def damaged(path: Path, error: Exception) -> TableError:
    """Return the error for a file that a library cannot read."""
    return TableError(f"{path} is damaged: {printable(format_error(error), 300)}")


@dataclass(frozen=True)
class Segment:
    """The rows `first` to `stop - 1` of a table on disk, in the file `path`."""

    first: int
    stop: int
    path: Path

    def __len__(self) -> int:
        return self.stop - self.first

    @property
    def damage(self) -> str:
        """Describe how the file differs from what was written; empty if it does not."""
        try:
            own = checksum(self._read())
        except OSError as error:
            return printable(format_error(error), 300)
        return "" if self._is_of(own) else "its bytes have changed"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its columns.

        **Raises:** `TableError` for a file that is damaged.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            names = pq.read_schema(pa.BufferReader(self._read())).names
            return tuple(name for name in names if name != ROW)
        except Exception as error:
            raise damaged(self.path, error) from error

    def read(self, columns: Sequence[str] | None = None) -> "pd.DataFrame":
        """Return its rows, or some columns of them, indexed by row number.

        **Raises:** `TableError` for a file that is damaged.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            content = self._read()
            if not self._is_of(checksum(content)):
                raise TableError(f"{self.path} is damaged: its bytes have changed")
            names = None if columns is None else [ROW, *columns]
            return pq.read_table(pa.BufferReader(content), columns=names).to_pandas()
        except (TableError, PermissionError):
            raise
        except FileNotFoundError as error:
            raise TableError(f"{self.path} is gone; was the run's folder moved?") from error
        except Exception as error:  # Whoever wrote the file, it is none of ours.
            raise damaged(self.path, error) from error

    def read_standing_out(self) -> "pd.DataFrame":
        """Return only the rows that stand out, from their own file if it is whole."""
        folder = self.path.parent.parent / FAILURES
        for others in list_segments(folder):
            if (others.first, others.stop) == (self.first, self.stop) and not others.damage:
                return others.read()
        frame = self.read()
        return frame.iloc[standing_out({str(name): frame[name].to_numpy() for name in frame})]

    def _read(self) -> bytes:
        return read_bytes(self.path, within=self.path.parents[1])

    def _is_of(self, own: int) -> bool:
        return self.path.name.endswith(f"-{own:08x}.parquet")


def standing_out(columns: Columns) -> Int[np.ndarray, " k"]:
    """Return the indices of the rows that counts, statistics and searches for failures need."""
    proper = columns["status"] == "ok"
    out = ~proper | columns["violated"].astype(bool)
    if "gradient_finite" in columns:
        out = out | ~columns["gradient_finite"].astype(bool)
    rho = np.where(proper, columns["rho"], np.nan)
    if not np.all(np.isnan(rho)):
        out[np.nanargmin(rho)] = True
    return np.flatnonzero(out)


def write_segment(run: Path, first: int, columns: Columns) -> Segment:
    """Write rows from `first` on to a run's folder, and the rows that stand out to their own file.

    **Raises:** `OSError` where they cannot be written.
    """
    indices = standing_out(columns)
    few = {name: values[indices] for name, values in columns.items()}
    stop = first + len(columns["rho"])
    # First: without its segment it is none, and the segment comes with one.
    _write(run / FAILURES, first, stop, parquet(few, first + indices))
    path = _write(run / SEGMENTS, first, stop, parquet(columns, np.arange(first, stop)))
    return Segment(first, stop, path)


def _write(folder: Path, first: int, stop: int, content: "pa.Buffer") -> Path:
    folder.mkdir(exist_ok=True)
    name = f"rows-{first:012d}-{stop:012d}-{checksum(content):08x}.parquet"
    return write_complete(folder / name, content)


def parquet(columns: Columns, rows: Int[np.ndarray, " n"]) -> "pa.Buffer":
    """Return rows as the content of a Parquet file, indexed by row number for pandas."""
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {ROW: pa.array(rows), **{name: column_to_arrow(v) for name, v in columns.items()}}
    one = pd.DataFrame({name: values[:1] for name, values in columns.items()})
    one.index = pd.Index(rows[:1], name=ROW)
    metadata = pa.Schema.from_pandas(one, preserve_index=True).metadata
    table = pa.table(arrays).replace_schema_metadata(metadata)
    texts = [field.name for field in table.schema if pa.types.is_string(field.type)]
    sink = pa.BufferOutputStream()
    pq.write_table(
        table,
        sink,
        # Numbers that a search chose hardly repeat, and those of the rows follow each other.
        use_dictionary=texts,  # pyright: ignore[reportArgumentType]
        column_encoding={ROW: "DELTA_BINARY_PACKED"},
        write_page_checksum=True,
    )
    return sink.getvalue()


def list_segments(folder: Path) -> list[Segment]:
    """Return the segments of a folder in the order of their rows, including damaged ones."""
    found = []
    if folder.is_dir():
        for path in folder.iterdir():
            if (match := _NAME.fullmatch(path.name)) and int(match[1]) < int(match[2]):
                found.append(Segment(int(match[1]), int(match[2]), path))
    return sorted(found, key=lambda each: (each.first, each.stop, each.path.name))


def remove_segments(run: Path, begin: int) -> None:
    """Remove the segments of a run with rows from `begin` on, starting with the last."""
    for name in (SEGMENTS, FAILURES):
        folder = run / name
        for segment in reversed(list_segments(folder)):
            if segment.stop > begin:
                segment.path.unlink(missing_ok=True)
        if not folder.is_symlink() and folder.is_dir():
            for partial in folder.glob(".rows-*.part"):
                partial.unlink(missing_ok=True)
            if not any(folder.iterdir()):
                folder.rmdir()


def tail_entry(first: int, rows: Columns) -> dict[str, Arrays]:
    """Return rows from number `first` on as an entry of the tail."""
    import pyarrow as pa

    batch, sink = to_arrow(rows), pa.BufferOutputStream()
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
