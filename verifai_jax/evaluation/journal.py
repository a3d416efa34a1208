"""Rows of a batch that is not finished yet, on disk as soon as they have a verdict.

    journal = Journal(folder)
    journal.add(row, point, verdict)                    # appended and flushed
    journal.recall(first, points)                       # {i: verdict} of those that are there
    journal.settle(rows)                                # the table and its checkpoint have so many

For simulators of which one simulation takes minutes: a run that is killed in the middle of a batch
does not simulate its finished rows again. A row is recalled only for the same point, and only if
its line is the one that was written: each begins with its checksum.
"""

import hashlib
import json
import zlib
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float

from verifai_jax.evaluation.verdicts import RowVerdict

JOURNAL = "inflight.jsonl"
"""Name of the journal in a run's folder."""


class Journal:
    """The finished rows of the batch in flight, in `folder`; see the module's docstring."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / JOURNAL
        self._file: IO[str] | None = None
        self._known = _read(self.path)
        self._last = max(self._known, default=-1)

    def add(self, row: int, point: Float[np.ndarray, " d"], verdict: RowVerdict) -> None:
        """Keep a row; it is on disk when this returns.

        **Raises:** `OSError` where it cannot be written.
        """
        entry = {
            "row": row,
            "point": _fingerprint(point),
            "rho": np.asarray(verdict.rho, np.float64).tolist(),
            "status": int(verdict.status),
            "holds": np.asarray(verdict.holds).tolist(),
            "message": verdict.message,
            "coverage_ids": None
            if verdict.coverage_ids is None
            else np.asarray(verdict.coverage_ids).tolist(),
            "guidance": None if verdict.guidance is None else verdict.guidance.tolist(),
        }
        self._last = max(self._last, row)
        if self._file is None:
            self._file = open(self.path, "a")  # noqa: SIM115 - lives as long as the run
            if self._file.tell():
                self._file.write("\n")  # The last line may have been cut off.
        text = json.dumps(entry)
        self._file.write(f"{zlib.crc32(text.encode()):08x} {text}\n")
        self._file.flush()

    def recall(self, first: int, points: Float[np.ndarray, "n d"]) -> dict[int, RowVerdict]:
        """Return the known rows from `first` on, of the same points, by their index among them."""
        if not self._known:
            return {}
        found = {}
        for i, point in enumerate(points):
            fingerprint, verdict = self._known.get(first + i, ("", None))
            if verdict is not None and fingerprint == _fingerprint(point):
                found[i] = verdict
        return found

    def settle(self, rows: int) -> None:
        """Forget the journal once the table and its checkpoint have all of its rows."""
        if self._file is not None:
            self._file.close()
            self._file = None
        if self._last < rows:
            self._known = {}
            self.path.unlink(missing_ok=True)


def count_unfinished(folder: Path, rows: int) -> int:
    """Count the finished simulations in `folder` after the first `rows`, those of the table."""
    return sum(row >= rows for row in _read(folder / JOURNAL))


def _fingerprint(point: Float[np.ndarray, " d"]) -> str:
    return hashlib.sha256(np.ascontiguousarray(point, np.float32).tobytes()).hexdigest()[:16]


def _read(path: Path) -> dict[int, tuple[str, RowVerdict]]:
    if not path.is_file():
        return {}
    known = {}
    for line in path.read_bytes().split(b"\n"):
        checksum, _, text = line.partition(b" ")
        if checksum != f"{zlib.crc32(text):08x}".encode():
            continue  # It has changed, or was being written when the process died.
        try:
            entry = json.loads(text)
            coverage_ids, guidance = entry.get("coverage_ids"), entry.get("guidance")
            verdict = RowVerdict(
                np.asarray(entry["rho"], np.float64),
                int(entry["status"]),
                np.asarray(entry["holds"], bool),
                str(entry["message"]),
                None if coverage_ids is None else np.asarray(coverage_ids, np.int32),
                None if guidance is None else np.asarray(guidance, np.float32),
            )
            known[int(entry["row"])] = (str(entry["point"]), verdict)
        except (ValueError, KeyError, TypeError):
            continue  # Of another program.
    return known
