"""Rows of a batch that is not finished yet, on disk as soon as they are judged.

    journal = Journal(folder)
    journal.add(row, point, judged)                     # appended and flushed
    journal.recall(first, points)                       # {i: judged} of those that are there
    journal.settle(rows)                                # the table and its snapshot have so many

For simulators of which one simulation takes minutes: a run that is killed in the middle of a batch
does not simulate its finished rows again. A row is recalled only for the same point.
"""

import hashlib
import json
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

JOURNAL = "inflight.jsonl"


class Judged(NamedTuple):
    """What is known of one simulation: see `engine.Evaluation`. One number may stand for all."""

    rho: Float[np.ndarray, " formulas"] | Float[np.ndarray, ""]
    status: int
    holds: Bool[np.ndarray, " formulas"] | Bool[np.ndarray, ""]
    message: str


class Journal:
    """The judged rows of the batch in flight, in `folder`; see the module's docstring."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / JOURNAL
        self._file: IO[str] | None = None
        self._known = _read(self.path)
        self._last = max(self._known, default=-1)

    def add(self, row: int, point: Float[np.ndarray, " d"], judged: Judged) -> None:
        """Keep a row; it is on disk when this returns.

        **Raises:** `OSError` where it cannot be written.
        """
        entry = {
            "row": row,
            "point": _fingerprint(point),
            "rho": np.asarray(judged.rho, np.float64).tolist(),
            "status": int(judged.status),
            "holds": np.asarray(judged.holds).tolist(),
            "message": judged.message,
        }
        self._last = max(self._last, row)
        if self._file is None:
            self._file = open(self.path, "a")  # noqa: SIM115 - lives as long as the run
        self._file.write(json.dumps(entry) + "\n")
        self._file.flush()

    def recall(self, first: int, points: Float[np.ndarray, "n d"]) -> dict[int, Judged]:
        """The rows from `first` on that are known, of the same points, by their place in it."""
        if not self._known:
            return {}
        found = {}
        for i, point in enumerate(points):
            fingerprint, judged = self._known.get(first + i, ("", None))
            if judged is not None and fingerprint == _fingerprint(point):
                found[i] = judged
        return found

    def settle(self, rows: int) -> None:
        """The table and its snapshot have `rows` rows now: those need not be kept here."""
        if self._file is not None:
            self._file.close()
            self._file = None
        if self._last < rows:
            self._known = {}
            self.path.unlink(missing_ok=True)


def _fingerprint(point: Any) -> str:
    return hashlib.sha256(np.ascontiguousarray(point, np.float32).tobytes()).hexdigest()[:16]


def _read(path: Path) -> dict[int, tuple[str, Judged]]:
    if not path.exists():
        return {}
    known = {}
    for line in path.read_text().splitlines():
        try:
            entry = json.loads(line)
            judged = Judged(
                np.asarray(entry["rho"], np.float64),
                int(entry["status"]),
                np.asarray(entry["holds"], bool),
                str(entry["message"]),
            )
            known[int(entry["row"])] = (str(entry["point"]), judged)
        except (ValueError, KeyError, TypeError):
            continue  # The line that was being written when the process died.
    return known
