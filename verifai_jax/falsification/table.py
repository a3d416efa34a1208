"""The error table: one row for each simulation, written to disk while it grows.

    table.append(columns)   a batch of them
    table.all               all of them, and more of the kind in `table_view.py`

On disk (`segments.py`) the batches of a growing table are appended to its tail, a log; a process
that dies loses at most the batch in flight. Every 1 048 576 rows become a segment, and leave
memory. A finished table that has no segment is one Parquet file, `table.parquet`; a longer one is
the folder `table/` of its segments.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from verifai_jax.core.store.files import write_complete
from verifai_jax.core.store.foreign_archives import read_parquet
from verifai_jax.core.store.locks import settled
from verifai_jax.core.store.log import Log, write_log
from verifai_jax.falsification import segments
from verifai_jax.falsification.columns import Columns, cut, from_frame, length, merge, wrong_column
from verifai_jax.falsification.segments import (
    SEGMENTS,
    TAIL,
    Segment,
    TableError,
    damaged,
    list_segments,
    parquet,
    read_tail,
    remove_segments,
    tail_entry,
    write_segment,
)
from verifai_jax.falsification.table_view import TableView

if TYPE_CHECKING:
    import pandas as pd
FINISHED = "table.parquet"
"""Name of a finished table without segments on disk."""
RESERVED = (
    "row",
    "rho",
    "violated",
    "status",
    "message",
    "gradient_finite",
    "differentiated",
    "verdict",
    "rho_again",
    "new_coverage",
)
"""Names of the table's own columns, which no feature may have."""
_FEW = 256
"""Number of small batches in memory from which on they are joined."""


class ErrorTable(TableView):
    """Rows in the order in which they were simulated; append-only.

    **Arguments:**
    - `features`: names of the feature columns; none may be in `RESERVED`.
    - `folder`: where to keep the rows; in memory only when left out.

    **Attributes:**
    - `missing`: ranges of rows that are missing because their files are damaged or gone.
    - `damage`: a text on damaged files and missing rows; empty if there are none.
    - `changed`: whether rows differ from those written, so that no number of the table is reliable.

    **Raises:** `ValueError` for a feature with a reserved name.
    """

    _internal = frozenset((
        "append", "blocks", "close", "counts", "damage", "digest", "exists",
        "load", "missing", "resumed",
    ))  # fmt: skip

    def __init__(self, features: tuple[str, ...], folder: Path | None = None) -> None:
        for name in features:
            if name in RESERVED:
                raise ValueError(
                    f"a feature may not be called {name!r}: the error table has a column of that "
                    f"name; reserved are {', '.join(RESERVED)}"
                )
        super().__init__(features)
        self._folder = None if folder is None else folder.absolute()
        self._tail = None if self._folder is None else Log(self._folder / TAIL)
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)

    @property
    def path(self) -> Path | None:
        """File or folder of the finished table, which `pandas.read_parquet` opens."""
        if self._folder is None:
            return None
        return self._folder / (SEGMENTS if self._segments else FINISHED)

    def append(self, columns: Columns) -> None:
        """Append a batch: a mapping of column name to `[n]` values, with `rho` and `status`.

        **Raises:** `OSError` if it cannot be written; the rows are then still in memory.
        """
        first, batch = self._next, {name: np.asarray(each) for name, each in columns.items()}
        self._hold(first, batch)
        if self._tail is None:
            return
        if self._next - self._begin < segments.SEGMENT_ROWS:
            self._tail.put(tail_entry(first, batch))
            return
        while self._next - self._begin >= segments.SEGMENT_ROWS:
            self._close_segment(segments.SEGMENT_ROWS)
        # A view would keep the whole batch in memory.
        self._batches = [
            (begin, {name: values.copy() for name, values in rest.items()})
            for begin, rest in self._batches
        ]
        self._tail.clear()
        for begin, rest in self._batches:
            self._tail.put(tail_entry(begin, rest))

    def close(self) -> None:
        """Convert the rows of the tail to Parquet.

        **Raises:** `OSError` if it cannot be written; the tail then stays as it is.
        """
        if self._tail is None:
            return
        self._tail = None
        assert self._folder is not None
        if not self._segments:
            batches = list(self._parts(0, self._next))
            columns = merge(batches) if batches else from_frame(self._empty)
            write_complete(self._folder / FINISHED, parquet(columns, np.arange(self._next)))
        elif self._next > self._begin:
            self._close_segment(self._next - self._begin)
        (self._folder / TAIL).unlink(missing_ok=True)

    @classmethod
    def load(
        cls, folder: Path, features: tuple[str, ...], numbers: Sequence[str] = ()
    ) -> "ErrorTable":
        """Read a table, finished or cut off; its segments are read when needed.

        Damaged parts are left out: `missing` and `damage` describe them.

        **Arguments:**
        - `folder`: the folder of the table.
        - `features`: names of the feature columns.
        - `numbers`: the features that are numbers, if known.
        **Raises:** `FileNotFoundError` if there is none; `TableError` for a `table.parquet` that is
        damaged, or a column that is missing or holds values of a wrong type.
        """
        if not cls.exists(settled(folder)):
            raise FileNotFoundError(
                f"no error table in {folder}: neither {FINISHED} nor {SEGMENTS}/ nor {TAIL}"
            )
        table = cls(features)
        table._folder = folder.absolute()
        # In this order: a writer closes a segment before it drops the rows from its tail.
        batches = read_tail(folder)
        table._attach_segments(list_segments(folder / SEGMENTS))
        if not table._segments and (folder / FINISHED).exists():
            frame = _read_finished(folder / FINISHED)
            table._take(0, from_frame(frame))
        for first, batch in batches:
            table._take(first, from_frame(batch.to_pandas()))
        table._check(numbers)
        return table

    @staticmethod
    def exists(folder: Path) -> bool:
        """Return whether there is a table in `folder`, finished or growing."""
        files = ((folder / name).exists() for name in (FINISHED, TAIL))
        return any(files) or bool(list_segments(folder / SEGMENTS))

    def resumed(self, rows: int, folder: Path | None = None) -> "ErrorTable":
        """Return a table with the first `rows` rows of this one, to which more can be appended.

        With a `folder` the table is stored there and replaces the folder's content.

        **Raises:** `TableError` if rows are missing.
        """
        if self.missing:
            raise TableError(f"rows cannot be added to a table that misses some: {self.damage}")
        table = ErrorTable(self.features, folder)
        if folder is None or table._folder != self._folder:
            if folder is not None:
                (folder / TAIL).unlink(missing_ok=True)
                remove_segments(folder, 0)
                (folder / FINISHED).unlink(missing_ok=True)
            for _, part in self._parts(0, rows):
                table.append(part)
            return table
        assert table._folder is not None
        begin = rows - rows % segments.SEGMENT_ROWS
        begin = max((each.stop for each in self._segments if each.stop <= begin), default=0)
        if begin < self._begin:
            # This table keeps the rows whose files go.
            self._batches, self._small = list(self._parts(begin, self._next)), 0
            self._segments = [each for each in self._segments if each.stop <= begin]
        table._segments = list(self._segments)
        table._next = begin
        for first, part in self._parts(begin, rows):
            table._hold(first, part)
        table._join()
        # Whenever the process dies, what is left has these rows: the tail first, then the others.
        rest = tail_entry(begin, merge(table._batches)) if table._batches else {}
        write_log(folder / TAIL, rest)
        remove_segments(folder, begin)
        (folder / FINISHED).unlink(missing_ok=True)
        return table

    def save(self, folder: Path) -> "ErrorTable":
        """Write the rows to `folder`, replacing a table there; return the new table.

        **Raises:** `OSError` if they cannot be written; `TableError` if rows are missing.
        """
        table = self.resumed(self._next, folder)
        table.close()
        return table

    def _hold(self, first: int, batch: Columns) -> None:
        """Take rows into memory."""
        self._batches.append((first, batch))
        self._next = first + length(batch)
        self._small += 1
        self._frame = self._counts = None
        if self._small >= _FEW and not self.missing:
            small = self._batches[-self._small :]
            self._batches[-self._small :] = [(small[0][0], merge(small))]
            self._small = 0

    def _close_segment(self, rows: int) -> None:
        """Write the first rows that are in memory as a segment, and drop them there."""
        assert self._folder is not None
        begin = self._begin
        columns = merge(list(self._parts(begin, begin + rows)))
        segment = write_segment(self._folder, begin, columns)
        self._batches, self._small = list(self._parts(segment.stop, self._next)), 0
        self._segments.append(segment)
        self._frame = None

    def _attach_segments(self, found: list[Segment]) -> None:
        """Attach the undamaged segments, and record the missing rows of the others."""
        for segment in found:
            if segment.first < self._begin:
                continue  # Of an earlier part of the run; the rows are there.
            if why := segment.damage:
                self._note(f"{segment.path} is damaged: {why}")
                continue
            self._miss(segment.first)
            self._segments.append(segment)
            self._next = segment.stop

    def _take(self, first: int, batch: Columns) -> None:
        """Load rows of a file into memory if they are not there yet."""
        have, n = self._next, length(batch)
        if first + n <= have:
            return
        self._miss(first)
        self._hold(*cut((first, batch), have, first + n))

    def _miss(self, first: int) -> None:
        """Record rows before `first` as missing if they are."""
        if first > self._next:
            self.missing = (*self.missing, range(self._next, first))
            self._note(f"rows {self._next} to {first - 1} are missing")
            self._next = first

    def _check(self, numbers: Sequence[str]) -> None:
        """Refuse a table that lacks a required column, or has one of a wrong type."""
        parts = [segment.names for segment in self._segments]
        parts += [tuple(batch) for _, batch in self._batches]
        if not parts or not len(self):
            return
        damaged_table = f"the table in {self._folder} is damaged:"
        for name in (*self.features, "rho", "violated", "status"):
            if name not in parts[0]:
                raise TableError(f"{damaged_table} it has no column {name!r}")
        for part in parts:
            if others := set(part) ^ set(parts[0]):
                raise TableError(f"{damaged_table} only some of its rows have {min(others)!r}")
        for _, batch in self._batches:
            if wrong := wrong_column(batch, numbers):
                raise TableError(f"{damaged_table} {wrong}")


def _read_finished(path: Path) -> "pd.DataFrame":
    try:
        frame = read_parquet(path, within=path.parent).to_pandas()
    except PermissionError:
        raise
    except Exception as error:  # Bytes can be wrong in any way.
        raise damaged(path, error) from error
    wrong = np.flatnonzero(frame.index.to_numpy() != np.arange(len(frame)))
    if len(wrong):
        raise TableError(
            f"{path} is damaged: where row {wrong[0]} should be, there is {frame.index[wrong[0]]}"
        )
    return frame
