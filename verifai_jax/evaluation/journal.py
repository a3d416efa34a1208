"""Rows of an unfinished batch, written to disk as soon as they have a verdict.

    journal = Journal(folder)
    journal.add(row, point, verdict)                    # in the log when it returns
    journal.recall(first, points)                       # {i: verdict} of those that are there
    journal.settle(rows)                                # the table and its checkpoint have so many

For simulators that take minutes: a run killed in the middle of a batch does not simulate its
finished rows again. A row is recalled only for the same point.
"""

import contextlib
from pathlib import Path

import numpy as np
from jaxtyping import Float

from verifai_jax.core.store.log import Log
from verifai_jax.evaluation.verdicts import RowVerdict

JOURNAL = "inflight.rows"
"""Name of the journal in a run's folder, a log with an entry a row."""


class Journal:
    """The finished rows of the batch in progress, in `folder`; see the module's docstring."""

    def __init__(self, folder: Path, name: str = JOURNAL) -> None:
        self.path = folder / name
        self._known = _read(Log(self.path))
        self._log = Log(self.path)  # It is not read: what is put is not looked up.
        self._last = max(self._known, default=-1)

    def add(self, row: int, point: Float[np.ndarray, " d"], verdict: RowVerdict) -> None:
        """Write a row; the operating system has it when this returns.

        **Raises:** `OSError` if it cannot be written.
        """
        entry = {
            "point": np.asarray(point, np.float32).tolist(),
            "rho": np.asarray(verdict.rho, np.float64).tolist(),
            "status": int(verdict.status),
            "holds": np.asarray(verdict.holds).tolist(),
            "message": verdict.message,
            "coverage_ids": None if verdict.coverage_ids is None else verdict.coverage_ids.tolist(),
            "guidance": None if verdict.guidance is None else verdict.guidance.tolist(),
        }
        self._last = max(self._last, row)
        # In JSON, which takes less time than many small arrays.
        self._log.put_json(str(row), entry)

    def recall(self, first: int, points: Float[np.ndarray, "n d"]) -> dict[int, RowVerdict]:
        """Return the known rows of these points from `first` on, by their index."""
        if not self._known:
            return {}
        found = {}
        for i, point in enumerate(points):
            known = self._known.get(first + i)
            if known is not None and np.array_equal(known[0], np.asarray(point, np.float32)):
                found[i] = known[1]
        return found

    def settle(self, rows: int) -> None:
        """Delete the journal once the table and its checkpoint contain all of its rows."""
        if self._last < rows:
            self._known = {}
            self._log.clear()


def count_unfinished(folder: Path, rows: int) -> int:
    """Count the finished simulations in `folder` after the first `rows`, those in the table."""
    return sum(row >= rows for row in _read(Log(folder / JOURNAL)))


def _read(log: Log) -> dict[int, tuple[np.ndarray, RowVerdict]]:
    known = {}
    for name in log.names():
        with contextlib.suppress(ValueError, KeyError, TypeError):  # Of another program.
            entry = log.get_json(name)
            coverage_ids, guidance = entry["coverage_ids"], entry["guidance"]
            known[int(name)] = (
                np.asarray(entry["point"], np.float32),
                RowVerdict(
                    np.asarray(entry["rho"], np.float64),
                    int(entry["status"]),
                    np.asarray(entry["holds"], bool),
                    str(entry["message"]),
                    None if coverage_ids is None else np.asarray(coverage_ids, np.int32),
                    None if guidance is None else np.asarray(guidance, np.float32),
                ),
            )
    return known
