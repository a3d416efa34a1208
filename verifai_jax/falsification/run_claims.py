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

from verifai_jax.evaluation.confirmation import LIMIT, SHARE, Confirmer
from verifai_jax.problem.problem import Problem

CONFIRMER = "confirmer"
"""Entry of a checkpoint: rows examined, how far replays moved one, and the worst row."""


class Claimed(NamedTuple):
    """Verdicts of closer replays on the rows of a round.

    - `verdict`: in a word; empty where nothing is violated.
    - `refused`: rows that violate the property and are not claimed.
    - `greatest`: robustness that the search learns of these, the greatest of their replays.
    - `compile_seconds`: that their programs took to compile.
    """

    verdict: Shaped[np.ndarray, " n"]
    refused: Bool[np.ndarray, " n"]
    greatest: Float[np.ndarray, " n"]
    compile_seconds: float = 0.0


class RunClaims:
    """Closer replays of the violating rows of one run.

    **Arguments:**

    - `problem`: on the backend that it runs on.
    - `precision`: of the run.
    - `seed`: of the run.
    """

    def __init__(self, problem: Problem, precision: str, seed: int) -> None:
        self._confirmer = Confirmer(problem, precision, seed)

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
        claimed = Claimed(verdict, refused, greatest)
        if not len(rows):
            return claimed
        confirmer = self._confirmer
        if not confirmer.finer:
            # To simulate it again may take as long as the run, and would say little.
            verdict[rows] = "unchecked"
            return claimed
        own = {name: column[rows] for name, column in columns.items()}
        compiled = confirmer.compile_seconds
        checked = confirmer(own, first + rows, max(LIMIT, (first + count) // SHARE))
        compiled = confirmer.compile_seconds - compiled
        verdict[rows] = checked.verdict
        refused[rows], greatest[rows] = checked.refuse(own["rho"])
        return claimed._replace(compile_seconds=compiled)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return what decides which rows are examined next, as an entry of a checkpoint."""
        seen = self._confirmer
        return {CONFIRMER: np.array([seen.examined, seen.band, seen.worst], np.float64)}

    def restore(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on from a checkpoint."""
        if CONFIRMER in checkpoint:
            # Checkpoints of before the worst row was noted hold two numbers.
            examined, band, *worst = checkpoint[CONFIRMER]
            self._confirmer.examined, self._confirmer.band = int(examined), float(band)
            self._confirmer.worst = float(worst[0]) if worst else np.inf
