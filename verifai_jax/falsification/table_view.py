"""The rows of an error table as they are read, in memory and in segments on disk.

table.all               # every simulation: features, rho, violated, status
table.violating         # rows that ended properly and broke the property, as simulated
table.counterexamples   # of these, rows that closer replays confirmed
table.unconfirmed       # the others: refused, or not replayed
table.safe              # rows that ended properly and kept it
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Int

from verifai_jax.core.display.notebook import InNotebook, frame_html
from verifai_jax.core.store.files import record_checksum
from verifai_jax.falsification import segments
from verifai_jax.falsification.columns import (
    ROW,
    Batch,
    Columns,
    column_checksum,
    cut,
    from_frame,
    length,
    merge,
    row_numbers,
    to_frame,
)
from verifai_jax.falsification.counts import Counts, count, standing, violating_rows
from verifai_jax.falsification.segments import Segment, standing_out

if TYPE_CHECKING:
    import pandas as pd
FEW = 64
"""Maximum number of batches in memory that are read without joining, which copies them."""


class TableView(InNotebook):
    """Rows by number: those of closed segments first, then batches in memory.

    **Attributes:** those of `ErrorTable`.
    """

    def __init__(self, features: Sequence[str]) -> None:
        self.features = tuple(features)
        self.missing: tuple[range, ...] = ()
        self.damage = ""
        self.changed = False
        self._segments: list[Segment] = []
        # Batches after the segments, each with the number of its first row.
        self._batches: list[Batch] = []
        self._small = 0  # Batches at the end of these that are not joined yet.
        self._next = 0
        self._frame: pd.DataFrame | None = None
        self._counts: Counts | None = None
        self._digested: tuple[int, int, dict[str, int]] = (0, 0, {})

    def __len__(self) -> int:
        return self._next - sum(map(len, self.missing))

    @property
    def all(self) -> "pd.DataFrame":
        """All simulations, each once, indexed by row number.

        If rows are missing or have changed since they were written, a `UserWarning` says so.
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
        [(_, own)] = self._parts(number, number + 1)
        return to_frame(np.array([number]), own).loc[number]

    def entry(
        self, row: "int | np.integer | pd.Series | Mapping[str, object]"
    ) -> "tuple[int | None, pd.Series | Mapping[str, object]]":
        """Return the number, if known, and the values of a row given by number or as a row.

        **Raises:** `TypeError` for another type; `IndexError` for a number that the table does not
        have.
        """
        if isinstance(row, int | np.integer) and not isinstance(row, bool):
            return int(row), self.row(int(row))
        if isinstance(row, bool | int | np.integer) or not hasattr(row, "items"):
            raise TypeError(
                "a row must be the number of a row of the table, such a row, or a mapping with its "
                f"feature columns; got {row!r}"
            )
        name = getattr(row, "name", None)
        return int(name) if isinstance(name, int | np.integer) else None, row

    @property
    def counts(self) -> Counts:
        """Counts over all rows, computed once from the rows that stand out."""
        if self._counts is None:
            self._counts = count(self._standing_out())
        return self._counts

    @property
    def counterexamples(self) -> "pd.DataFrame":
        """Rows that violate the property and that closer replays confirmed.

        Without closer replays (`confirm=False`), all rows that violate the property.
        """
        return self._select(lambda columns: standing(columns).claimed)

    @property
    def unconfirmed(self) -> "pd.DataFrame":
        """Rows that violate the property as simulated, but were not confirmed by closer replays."""
        return self._select(lambda columns: violating_rows(columns) & ~standing(columns).claimed)

    @property
    def not_refused(self) -> "pd.DataFrame":
        """Rows that violate the property and that closer replays confirmed or did not reach."""
        return self._select(lambda columns: violating_rows(columns) & ~standing(columns).refused)

    @property
    def violating(self) -> "pd.DataFrame":
        """Rows that violate the property as simulated, whatever closer replays say."""
        return self._select(violating_rows)

    @property
    def failed(self) -> "pd.DataFrame":
        """Rows without a verdict: the simulation raised, timed out or became non-finite."""
        return self._select(lambda columns: columns["status"] != "ok")

    @property
    def safe(self) -> "pd.DataFrame":
        """Rows that ended properly and satisfy the property."""
        blocks = self.blocks() if self._segments else (self.all,)
        safe = (rows.loc[(rows["status"] == "ok") & ~rows["violated"]] for rows in blocks)
        return self._concatenate([*safe])

    def digest(self, rows: int) -> int:
        """Return a checksum of the first `rows` rows, from names of closed segments and other rows.

        It does not depend on how the rows were divided into batches.
        """
        closed = [s for s in self._segments if s.stop <= rows and len(s) == segments.SEGMENT_ROWS]
        begin = closed[-1].stop if closed else 0
        known_from, known_to, checksums = self._digested
        if known_from != begin or known_to > rows:
            known_to, checksums = begin, {}
        checksums = dict(checksums)
        for _, columns in self._parts(known_to, rows):
            for name, values in columns.items():
                checksums[name] = column_checksum(values, checksums.get(name))
        self._digested = begin, rows, checksums
        return record_checksum(
            {"columns": checksums, "segments": [each.path.name for each in closed]}
        )

    def distrust(self, sentence: str) -> None:
        """Record that rows have changed since they were written."""
        self.changed = True
        self._note(sentence)

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

    def _join(self) -> None:
        """Join the batches in memory to one, so that each is copied only once."""
        if len(self._batches) > 1 and not self.missing:
            self._batches, self._small = [(self._batches[0][0], merge(self._batches))], 0

    def _parts(self, begin: int, stop: int) -> Iterator[Batch]:
        """Yield the rows from `begin` to `stop - 1`: number of the first, columns."""
        for segment in self._segments:
            if segment.first < stop and begin < segment.stop:
                yield cut((segment.first, from_frame(segment.read())), begin, stop)
        for first, batch in self._batches:
            if first < stop and begin < first + length(batch):
                yield cut((first, batch), begin, stop)

    def _memory(self) -> Iterator[tuple[Int[np.ndarray, " n"], Columns]]:
        """Yield numbers and columns of the rows in memory, in blocks."""
        if len(self._batches) > FEW:
            self._join()
        maximum = segments.SEGMENT_ROWS
        for first, batch in self._batches:
            for begin in range(first, first + length(batch), maximum):
                part = cut((first, batch), begin, begin + maximum)
                yield row_numbers([part]), part[1]

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

    def _note(self, sentence: str) -> None:
        self.damage = f"{self.damage}; {sentence}" if self.damage else sentence
