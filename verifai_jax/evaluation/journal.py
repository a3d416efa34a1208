"""Rows of a batch that is not finished yet, on disk as soon as they have a verdict.

    journal = Journal(folder)
    journal.add(row, point, verdict)                    # in the log when it returns
    journal.recall(first, points)                       # {i: verdict} of those that are there
    journal.settle(rows)                                # the table and its checkpoint have so many

For simulators of which one simulation takes minutes: a run that is killed in the middle of a batch
does not simulate its finished rows again. A row is recalled only for the same point.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from verifai_jax.evaluation.verdicts import RowVerdict
from verifai_jax.store.log import Log

JOURNAL = "inflight.rows"
"""Name of the journal in a run's folder, a log with an entry a row."""


class Journal:
    """The finished rows of the batch in flight, in `folder`; see the module's docstring."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / JOURNAL
        self._log = Log(self.path)
        self._known = _read(self._log)
        self._last = max(self._known, default=-1)

    def add(self, row: int, point: Float[np.ndarray, " d"], verdict: RowVerdict) -> None:
        """Keep a row; it is with the operating system when this returns.

        **Raises:** `OSError` where it cannot be written.
        """
        arrays = {name: value for name, value in verdict._asdict().items() if value is not None}
        entry = {name: np.asarray(value) for name, value in arrays.items()}
        self._last = max(self._last, row)
        self._log.put({str(row): {"point": np.asarray(point, np.float32), **entry}})

    def recall(self, first: int, points: Float[np.ndarray, "n d"]) -> dict[int, RowVerdict]:
        """Return the known rows from `first` on, of the same points, by their place among them."""
        if not self._known:
            return {}
        found = {}
        for i, point in enumerate(points):
            known = self._known.get(first + i)
            if known is not None and np.array_equal(known[0], np.asarray(point, np.float32)):
                found[i] = known[1]
        return found

    def settle(self, rows: int) -> None:
        """Forget the journal once the table and its checkpoint have all of its rows."""
        if self._last < rows:
            self._known = {}
            self._log.clear()


def count_unfinished(folder: Path, rows: int) -> int:
    """Count the finished simulations in `folder` after the first `rows`, those of the table."""
    return sum(row >= rows for row in _read(Log(folder / JOURNAL)))


def _read(log: Log) -> dict[int, tuple[np.ndarray, RowVerdict]]:
    known = {}
    for name, arrays in log.entries():
        try:
            point, status = arrays.pop("point"), int(arrays.pop("status"))
            message = str(arrays.pop("message"))
            known[int(name)] = point, RowVerdict(status=status, message=message, **arrays)
        except (ValueError, KeyError, TypeError):
            continue  # Of another program.
    return known
