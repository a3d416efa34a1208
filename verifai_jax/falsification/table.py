"""The error table: one row a simulation, written to disk while it grows.

    table.all               every simulation: features, rho, violated, status
    table.violating         rows that ended properly and broke the property, as simulated
    table.counterexamples   those among them that a closer look did not refute
    table.unconfirmed       the others: refuted, or not sure
    table.safe              rows that ended properly and kept it

On disk the batches of a growing table are appended to its tail (`tail.py`), each with a checksum; a
process that dies loses at most the batch in flight. Every 1 048 576 rows become a segment
(`segments.py`), and leave memory. A finished table that has no segment is one Parquet file,
`table.parquet`; a longer one is the folder `table/` of its segments.
"""

import contextlib
import json
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Int

from verifai_jax.core.notebook import InNotebook, frame_html
from verifai_jax.core.text import format_error, printable
from verifai_jax.falsification import segments
from verifai_jax.falsification.columns import (
    ROW,
    Batch,
    Columns,
    checksum,
    cut,
    from_frame,
    length,
    merge,
    row_numbers,
    to_arrow,
    to_frame,
    wrong_column,
)
from verifai_jax.falsification.counts import Counts, claimed_rows, count, violating_rows
from verifai_jax.falsification.segments import (
    SEGMENTS,
    Segment,
    TableError,
    list_segments,
    parquet,
    remove_segments,
    standing_out,
    write_complete,
    write_segment,
)
from verifai_jax.falsification.tail import TAIL, Tail, read_tail, replace_tail

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
    "suggested",
)
"""Names of the table's own columns, which no feature may have."""
_FEW = 256
"""Small batches in memory that are joined to one."""


class ErrorTable(InNotebook):
    """Rows in the order in which they were simulated; append-only.

    **Arguments:**

    - `features`: names of the feature columns; may not be one of `RESERVED`.
    - `folder`: where to keep the rows; in memory only when left out.

    **Attributes:**

    - `missing`: ranges of rows that are missing, as their files are damaged or gone.
    - `damage`: what is damaged and what is missing; empty if nothing is.
    - `changed`: whether rows are others than those that were written, so that no number of the
      table can be relied on.

    **Raises:** `ValueError` for a feature with a reserved name.
    """

    _internal = frozenset((
        "append", "blocks", "close", "count_rows", "counts", "damage", "digest", "exists",
        "load", "missing", "resumed",
    ))  # fmt: skip

    def __init__(self, features: tuple[str, ...], folder: Path | None = None) -> None:
        for name in features:
            if name in RESERVED:
                raise ValueError(
                    f"a feature may not be called {name!r}: the error table has a column of that "
                    f"name; reserved are {', '.join(RESERVED)}"
                )
        self.features = tuple(features)
        self.missing: tuple[range, ...] = ()
        self.damage = ""
        self.changed = False
        self._folder = None if folder is None else folder.absolute()
        self._tail = None if self._folder is None else Tail(self._folder)
        self._segments: list[Segment] = []
        # Batches after the segments, each with the number of its first row.
        self._batches: list[Batch] = []
        self._small = 0  # Batches at the end of these that are not joined yet.
        self._next = 0
        self._frame: pd.DataFrame | None = None
        self._counts: Counts | None = None
        self._digested: tuple[int, int, dict[str, int]] = (0, 0, {})
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)

    def __len__(self) -> int:
        return self._next - sum(map(len, self.missing))

    @property
    def path(self) -> Path | None:
        """File or folder of the finished table, which `pandas.read_parquet` opens."""
        if self._folder is None:
            return None
        return self._folder / (SEGMENTS if self._segments else FINISHED)

    def append(self, columns: Columns) -> None:
        """Add a batch: a mapping of column name to `[n]` values, with `rho` and `status`.

        **Raises:** `OSError` where it cannot be written; it is then in memory all the same.
        """
        first, batch = self._next, {name: np.asarray(each) for name, each in columns.items()}
        self._hold(first, batch)
        if self._tail is None:
            return
        if self._next - self._begin < segments.SEGMENT_ROWS:
            self._tail.append(first, to_arrow(batch))
            return
        while self._next - self._begin >= segments.SEGMENT_ROWS:
            self._close_segment(segments.SEGMENT_ROWS)
        # A view would keep the whole batch in memory.
        self._batches = [
            (begin, {name: values.copy() for name, values in rest.items()})
            for begin, rest in self._batches
        ]
        self._tail.restart()
        for begin, rest in self._batches:
            self._tail.append(begin, to_arrow(rest))

    def close(self) -> None:
        """Turn what the tail holds into Parquet.

        **Raises:** `OSError` where it cannot be written; the tail then stays as it is.
        """
        if self._tail is None:
            return
        tail, self._tail = self._tail, None
        tail.close()
        assert self._folder is not None
        if not self._segments:
            self._write_finished(self._folder)
        elif self._next > self._begin:
            self._close_segment(self._next - self._begin)
        (self._folder / TAIL).unlink(missing_ok=True)

    @property
    def all(self) -> "pd.DataFrame":
        """Every simulation asked for, once, indexed by row number.

        Where rows are missing or have changed since they were written, a `UserWarning` says so.
        """
        if self.damage:
            warnings.warn(f"the error table is damaged: {self.damage}", stacklevel=2)
        if self._frame is None:
            self._join()
            frames = [segment.read() for segment in self._segments]
            if self._batches:
                frames.append(to_frame(row_numbers(self._batches), merge(self._batches)))
            self._frame = self._concatenate(frames)
        return self._frame

    def blocks(self, columns: Sequence[str] | None = None) -> "Iterator[pd.DataFrame]":
        """Yield the rows of `all` in their order, at most 1 048 576 in memory at a time.

        **Arguments:**

        - `columns`: the columns wanted; all when left out.

        **Raises:** `TableError` for a file that is damaged.
        """
        for segment in self._segments:
            yield segment.read(columns)
        for numbers, block in self._memory():
            yield to_frame(numbers, block, columns)

    def row(self, number: int) -> "pd.Series":
        """Return a row by its number, without reading the others of a long table.

        **Raises:** `IndexError` for a number that the table does not have.
        """
        number = int(number)
        where = f"row {number} is not in the table of {len(self)} simulations"
        if any(number in gone for gone in self.missing):
            raise IndexError(f"{where}: {self.damage}")
        if not 0 <= number < self._next:
            raise IndexError(where)
        if self._frame is not None:
            return self._frame.loc[number]
        for segment in self._segments:
            if segment.first <= number < segment.stop:
                return segment.read().loc[number]
        for first, batch in self._batches:
            if first <= number < first + length(batch):
                _, own = cut((first, batch), number, number + 1)
                return to_frame(np.array([number]), own).loc[number]
        raise AssertionError(number)

    @property
    def counts(self) -> Counts:
        """Counts over all rows, from those that stand out: they are counted once."""
        if self._counts is None:
            self._counts = count(self._standing_out())
        return self._counts

    @property
    def counterexamples(self) -> "pd.DataFrame":
        """Rows that ended properly and violate the property, also when looked at closely.

        That is without those whose column `verdict` says `fragile` or `refuted`.
        """
        return self._select(claimed_rows)

    @property
    def unconfirmed(self) -> "pd.DataFrame":
        """Rows that violate the property as simulated, and not surely when looked at closely."""
        return self._select(lambda columns: violating_rows(columns) & ~claimed_rows(columns))

    @property
    def violating(self) -> "pd.DataFrame":
        """Rows that violate the property as simulated, whatever a closer look said."""
        return self._select(violating_rows)

    @property
    def failed(self) -> "pd.DataFrame":
        """Rows without a verdict: the simulation raised, timed out or went non-finite."""
        return self._select(lambda columns: columns["status"] != "ok")

    @property
    def safe(self) -> "pd.DataFrame":
        """Rows that ended properly and satisfy the property."""
        blocks = self.blocks() if self._segments else (self.all,)
        safe = (rows.loc[(rows["status"] == "ok") & ~rows["violated"]] for rows in blocks)
        return self._concatenate([*safe])

    @classmethod
    def load(
        cls, folder: Path, features: tuple[str, ...], numbers: Sequence[str] = ()
    ) -> "ErrorTable":
        """Read a table back, finished or cut off; its segments are read when they are wanted.

        What is damaged is left out: `missing` and `damage` say what.

        **Arguments:**

        - `folder`: of the table.
        - `features`: names of the feature columns.
        - `numbers`: those among them that are numbers, where that is known.

        **Raises:** `FileNotFoundError` where there is none; `TableError` for a `table.parquet` that
        is damaged, or a column that is missing or holds what it cannot.
        """
        if not cls.exists(folder):
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
        return (
            (folder / FINISHED).exists()
            or (folder / TAIL).exists()
            or bool(list_segments(folder / SEGMENTS))
        )

    @staticmethod
    def count_rows(folder: Path) -> int:
        """Return how many rows the table in a folder has, whether its files are whole or not."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        stops = [segment.stop for segment in list_segments(folder / SEGMENTS)]
        stops += [first + batch.num_rows for first, batch in read_tail(folder)]
        if (folder / FINISHED).is_file():
            with contextlib.suppress(pa.ArrowException, OSError):
                stops.append(pq.read_metadata(folder / FINISHED).num_rows)
        return max(stops, default=0)

    def resumed(self, rows: int, folder: Path | None = None) -> "ErrorTable":
        """Return a table with the first `rows` rows of this one, to which more can be appended.

        With a `folder` it is kept there, in place of what the folder held.

        **Raises:** `TableError` where rows are missing.
        """
        if self.missing:
            raise TableError(f"rows cannot be added to a table that misses some: {self.damage}")
        table = ErrorTable(self.features, folder)
        if folder is None or table._folder != self._folder:
            table._replace_by(self._parts(0, rows))
            return table
        assert table._folder is not None
        begin = rows - rows % segments.SEGMENT_ROWS
        begin = max((each.stop for each in self._segments if each.stop <= begin), default=0)
        # This table keeps the rows whose files go.
        self._recall(begin)
        table._segments = list(self._segments)
        table._next = begin
        for first, part in self._parts(begin, rows):
            table._hold(first, part)
        table._join()
        # Whenever the process dies, what is left has these rows: the tail first, then the others.
        replace_tail(folder, begin, to_arrow(merge(table._batches)) if table._batches else None)
        remove_segments(folder, begin)
        (folder / FINISHED).unlink(missing_ok=True)
        return table

    def save(self, folder: Path) -> "ErrorTable":
        """Write the rows to `folder`, in place of a table there; return the table of the folder.

        **Raises:** `OSError` where they cannot be written; `TableError` where rows are missing.
        """
        if self.missing:
            raise TableError(f"a table that misses rows is not copied: {self.damage}")
        if folder.absolute() == self._folder:
            table = self.resumed(self._next, folder)
        elif self._next < segments.SEGMENT_ROWS:
            folder.mkdir(parents=True, exist_ok=True)
            self._write_finished(folder)
            remove_segments(folder, 0)
            (folder / TAIL).unlink(missing_ok=True)
            return ErrorTable.load(folder, self.features)
        else:
            table = ErrorTable(self.features, folder)
            table._replace_by(self._parts(0, self._next))
        table.close()
        return table

    def digest(self, rows: int) -> int:
        """Return a checksum of the first `rows` rows: names of closed segments, and other rows.

        It does not depend on the batches in which the rows came.
        """
        closed = [s for s in self._segments if s.stop <= rows and len(s) == segments.SEGMENT_ROWS]
        begin = closed[-1].stop if closed else 0
        known_from, known_to, checksums = self._digested
        if known_from != begin or known_to > rows:
            known_to, checksums = begin, {}
        checksums = dict(checksums)
        for _, columns in self._parts(known_to, rows):
            for name, values in columns.items():
                checksums[name] = checksum(values, checksums.get(name))
        self._digested = begin, rows, checksums
        names = [segment.path.name for segment in closed]
        return zlib.crc32(json.dumps([names, sorted(checksums.items())]).encode())

    def _notebook_parts(self) -> Iterator[str]:
        if self.changed:
            return
        # Of a long table a part is read, not all of it.
        rows = next(iter(self.blocks())) if self._segments else self.all
        if len(rows):
            failing = rows.loc[rows["violated"]]
            yield frame_html(failing if len(failing) else rows)

    def __repr__(self) -> str:
        if self.changed:
            return f"ErrorTable({len(self)} rows that say nothing: {self.damage})"
        counts = self.counts
        safe = len(self) - counts.violating - counts.without_verdict
        return (
            f"ErrorTable({len(self)} simulations: {counts.claimed} counterexamples, "
            f"{safe} safe, {counts.without_verdict} without a verdict)"
        )

    @property
    def _begin(self) -> int:
        """Number of the first row that is in no segment."""
        return self._segments[-1].stop if self._segments else 0

    def _concatenate(self, frames: "list[pd.DataFrame]") -> "pd.DataFrame":
        import pandas as pd

        if not frames:
            return self._empty
        frames = [frame for frame in frames if len(frame)] or frames[:1]
        return frames[0] if len(frames) == 1 else pd.concat(frames)

    @property
    def _empty(self) -> "pd.DataFrame":
        import pandas as pd

        columns = {name: np.zeros(0) for name in self.features}
        columns |= {"rho": np.zeros(0, np.float32), "violated": np.zeros(0, bool)}
        frame = pd.DataFrame({**columns, "status": np.zeros(0, object)})
        frame.index.name = ROW
        return frame

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

    def _join(self) -> None:
        """Make one batch of those in memory, so that each is copied but once."""
        if len(self._batches) > 1 and not self.missing:
            self._batches, self._small = [(self._batches[0][0], merge(self._batches))], 0

    def _memory(self) -> Iterator[tuple[Int[np.ndarray, " n"], Columns]]:
        """Yield numbers and columns of the rows in memory, in blocks."""
        maximum = segments.SEGMENT_ROWS
        group: list[Batch] = []
        for first, batch in self._batches:
            if group and sum(length(each) for _, each in group) + length(batch) > maximum:
                yield row_numbers(group), merge(group)
                group = []
            if length(batch) <= maximum:
                group.append((first, batch))
                continue
            for begin in range(0, length(batch), maximum):
                part = cut((first, batch), first + begin, first + begin + maximum)
                yield row_numbers([part]), part[1]
        if group:
            yield row_numbers(group), merge(group)

    def _parts(self, begin: int, stop: int) -> Iterator[Batch]:
        """Yield the rows from `begin` to `stop - 1`: number of the first, columns."""
        for segment in self._segments:
            if segment.first < stop and begin < segment.stop:
                yield cut((segment.first, from_frame(segment.read())), begin, stop)
        for first, batch in self._batches:
            if first < stop and begin < first + length(batch):
                yield cut((first, batch), begin, stop)

    def _standing_out(self) -> Iterator[tuple[Int[np.ndarray, " n"], Columns]]:
        for segment in self._segments:
            frame = segment.read_standing_out()
            yield frame.index.to_numpy(), from_frame(frame)
        for numbers, block in self._memory():
            indices = standing_out(block)
            yield numbers[indices], {name: values[indices] for name, values in block.items()}

    def _select(self, wanted: Callable[[Columns], Bool[np.ndarray, " n"]]) -> "pd.DataFrame":
        """Return rows that stand out, in their order."""
        found = []
        for numbers, block in self._standing_out():
            indices = np.flatnonzero(wanted(block))
            few = {name: values[indices] for name, values in block.items()}
            found.append(to_frame(numbers[indices], few))
        return self._concatenate(found)

    def _close_segment(self, rows: int) -> None:
        """Write the first rows that are in memory as a segment, and drop them there."""
        assert self._folder is not None
        begin = self._begin
        columns = merge(list(self._parts(begin, begin + rows)))
        segment = write_segment(self._folder, begin, columns)
        rest = list(self._parts(segment.stop, self._next))
        self._segments.append(segment)
        self._batches, self._small, self._frame = rest, 0, None

    def _write_finished(self, folder: Path) -> None:
        batches = list(self._parts(0, self._next))
        columns = merge(batches) if batches else from_frame(self._empty)
        write_complete(folder / FINISHED, parquet(columns, np.arange(self._next)))

    def _replace_by(self, parts: Iterator[Batch]) -> None:
        """Take these rows, in place of what the folder holds."""
        if self._folder is not None:
            (self._folder / TAIL).unlink(missing_ok=True)
            remove_segments(self._folder, 0)
            (self._folder / FINISHED).unlink(missing_ok=True)
        for _, part in parts:
            self.append(part)

    def _recall(self, begin: int) -> None:
        """Take the rows from `begin` on into memory, from segments that are about to go."""
        if begin < self._begin:
            rows = list(self._parts(begin, self._next))
            self._segments = [each for each in self._segments if each.stop <= begin]
            self._batches, self._small = rows, 0

    def _attach_segments(self, found: list[Segment]) -> None:
        """Take the segments that are whole, and say which rows the others had."""
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
        """Take rows from a file into memory, as far as they are not there."""
        have, n = self._next, length(batch)
        if first + n <= have:
            return
        self._miss(first)
        self._hold(*cut((first, batch), have, first + n))

    def _miss(self, first: int) -> None:
        """Note that the rows before `first` are missing, where they are."""
        if first > self._next:
            self.missing = (*self.missing, range(self._next, first))
            self._note(f"rows {self._next} to {first - 1} are missing")
            self._next = first

    def distrust(self, sentence: str) -> None:
        """Note that rows have changed since they were written."""
        self.changed = True
        self._note(sentence)

    def _note(self, sentence: str) -> None:
        self.damage = f"{self.damage}; {sentence}" if self.damage else sentence

    def _check(self, numbers: Sequence[str]) -> None:
        """Refuse a table without a column that it must have, or with one of another type."""
        parts = [segment.names for segment in self._segments]
        parts += [tuple(batch) for _, batch in self._batches]
        if not parts or not len(self):
            return
        for name in (*self.features, "rho", "violated", "status"):
            if name not in parts[0]:
                raise TableError(
                    f"the table in {self._folder} is damaged: it has no column {name!r}"
                )
        other = next((part for part in parts if set(part) != set(parts[0])), None)
        if other is not None:
            name = sorted(set(other) ^ set(parts[0]))[0]
            raise TableError(
                f"the table in {self._folder} is damaged: only some of its rows have {name!r}"
            )
        for _, batch in self._batches:
            if wrong := wrong_column(batch, numbers):
                raise TableError(f"the table in {self._folder} is damaged: {wrong}")


def _read_finished(path: Path) -> "pd.DataFrame":
    import pyarrow.parquet as pq

    if not path.is_file():
        # Pandas would read a folder as a table of the files in it.
        raise TableError(f"{path} is damaged: it is not a file")
    try:
        frame = pq.read_table(path, page_checksum_verification=True).to_pandas()
    except PermissionError:
        raise
    except Exception as error:  # Bytes can be wrong in any way.
        raise TableError(f"{path} is damaged: {printable(format_error(error), 300)}") from error
    wrong = np.flatnonzero(frame.index.to_numpy() != np.arange(len(frame)))
    if len(wrong):
        raise TableError(
            f"{path} is damaged: where row {wrong[0]} should be, there is {frame.index[wrong[0]]}"
        )
    return frame
