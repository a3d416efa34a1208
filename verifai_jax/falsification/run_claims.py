"""Closer replays of what the rounds of a run violate: which failures it claims.

    claims = RunClaims(problem, "float32", seed=0)
    found = claims(columns, first)                      # rows of a round, before they are stored
    found.verdict, found.refused                        # [n], and what the search learns instead

Of a run's violations so many are replayed as `evaluation/confirmation.py` says; the checkpoint
holds how many were, so that a run that is resumed goes on as one that was not interrupted.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from verifai_jax.core.executors import Executor
from verifai_jax.evaluation.confirmation import Confirmer
from verifai_jax.problem.problem import Problem

CONFIRMER = "confirmer"
"""Entry of a checkpoint: rows examined, how far replays moved one, the worst row, whether one came
again otherwise, and whether one did not fail again."""


class Claimed(NamedTuple):
    """Verdicts of closer replays on the rows of a round.

    - `verdict`: in a word; empty where nothing is violated.
    - `refused`: rows that violate the property and are not claimed.
    - `greatest`: robustness that the search learns of these, the greatest of their replays.
    - `again`: robustness when it was simulated once more, NaN where it was not; None for a system
      that JAX traces.
    - `compile_seconds`: that their programs took to compile.
    """

    verdict: Shaped[np.ndarray, " n"]
    refused: Bool[np.ndarray, " n"]
    greatest: Float[np.ndarray, " n"]
    again: Float[np.ndarray, " n"] | None = None
    compile_seconds: float = 0.0


class RunClaims:
    """Closer replays of the violating rows of one run.

    **Arguments:**

    - `problem`: on the backend that it runs on.
    - `precision`: of the run.
    - `seed`: of the run.
    - `executor`, `target`: of the run, whose workers simulate a host system again, too.
    """

    def __init__(
        self,
        problem: Problem,
        precision: str,
        seed: int,
        executor: Executor | None = None,
        target: str | None = None,
    ) -> None:
        self._confirmer = Confirmer(problem, precision, seed, executor=executor, target=target)
        self._host = problem.black_box

    def prepare(self) -> None:
        """Trace the replays before there is a row, while something else compiles."""
        self._confirmer.prepare()

    @property
    def checked(self) -> str:
        """Checks that a confirmed row has passed, in words; empty before any row was examined."""
        return self._confirmer.checked

    @property
    def raised(self) -> tuple[str, ...]:
        """Notes on the replay that raised first; none where none did."""
        return self._confirmer.raised

    def __call__(self, columns: Mapping[str, np.ndarray], first: int) -> Claimed:
        """Replay the violating ones of these rows.

        **Arguments:**

        - `columns`: of the rows, as the table will have them.
        - `first`: number of the first row in the run.
        """
        rows = np.flatnonzero(columns["violated"])
        count = len(columns["rho"])
        verdict = np.full(count, "", object)
        refused, greatest = np.zeros(count, bool), np.full(count, np.nan)
        again = np.full(count, np.nan) if self._host else None
        claimed = Claimed(verdict, refused, greatest, again)
        if not len(rows):
            return claimed
        confirmer = self._confirmer
        own = {name: column[rows] for name, column in columns.items()}
        compiled = confirmer.compile_seconds
        checked = confirmer(own, first + rows, confirmer.limit(first + count))
        compiled = confirmer.compile_seconds - compiled
        verdict[rows] = checked.verdict
        refused[rows], greatest[rows] = checked.refuse(own["rho"])
        if again is not None and "again" in checked.rho:
            again[rows] = checked.rho["again"]
        return claimed._replace(compile_seconds=compiled)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return what decides which rows are examined next, as an entry of a checkpoint."""
        seen = self._confirmer
        numbers = [seen.examined, seen.band, seen.worst, seen.wavers, seen.flips]
        return {CONFIRMER: np.array(numbers, np.float64)}

    def restore(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on from a checkpoint."""
        if CONFIRMER in checkpoint:
            examined, band, worst, wavers, flips = checkpoint[CONFIRMER]
            self._confirmer.examined, self._confirmer.band = int(examined), float(band)
            self._confirmer.worst = float(worst)
            self._confirmer.wavers, self._confirmer.flips = bool(wavers), bool(flips)
