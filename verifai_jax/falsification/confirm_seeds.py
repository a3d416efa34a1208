"""Closer replays of the violations in `repeat`, to find the failures that `falsify` would claim.

    confirmer = SeedConfirmer(problem, "float32", seeds, thorough=False)
    refused, greatest = confirmer(seed, numbers, u, rho)      # of violating simulations

A replay costs as much as many simulations. So the violations of each seed are replayed in order
until one is claimed, and those of all seeds together in few large batches.
"""

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.compute.compilation import Slot, pad_rows
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.evaluation.confirmer import LIMIT, Confirmer
from verifai_jax.evaluation.engine import Engine
from verifai_jax.problem.problem import Problem

MORE = 4
"""So many times as many rows of a seed are replayed next, after none of its last was claimed: few
programs in few calls, and at most four times as many replays as are needed."""
DRAWS: Slot[str, bool] = Slot("randomness of the system")
"""Whether the system uses its random key, by precision."""


class SeedConfirmer:
    """Verdicts of closer replays for many seeds, by the rule of `falsify`.

    At most `LIMIT` violations of a seed are replayed; later ones count as claimed, as in `falsify`.

    **Arguments:**
    - `problem`: the problem, on a backend that JAX traces.
    - `precision`: the precision of the simulations.
    - `seeds`: the seeds of the runs.
    - `thorough`: replay all violations of a seed, not only those up to the first claimed one.
    """

    def __init__(
        self, problem: Problem, precision: str, seeds: Int[np.ndarray, " seeds"], thorough: bool
    ) -> None:
        self.problem, self.precision, self.seeds = problem, precision, seeds
        self.thorough = thorough
        self._examined = np.zeros(len(seeds), int)
        self._confirmers: dict[int, Confirmer] = {}

    def __call__(
        self,
        seed: Int[np.ndarray, " n"],
        numbers: Int[np.ndarray, " n"],
        u: Float[np.ndarray, "n d"],
        rho: Float[np.ndarray, " n"],
    ) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Replay violating simulations.

        **Arguments:**
        - `seed`: index of the seed of each simulation, ascending.
        - `numbers`: the numbers of the simulations in their runs, ascending for each seed.
        - `u`, `rho`: their points and the least formula's robustness.
        **Returns:** for each simulation, whether it is not claimed, and the greatest robustness of
        its replays, at least 1e-6, or NaN without replays.
        """
        refused, greatest = np.zeros(len(seed), bool), np.full(len(seed), np.nan)
        left, width = np.arange(len(seed)), 1
        while len(left):
            rank = _rank(seed[left])
            now = left if self.thorough else left[rank < width]
            known = self._examined[seed[now]] + _rank(seed[now]) >= LIMIT
            taken = now[~known]
            if len(taken):
                refused[taken], greatest[taken] = self._replayed(
                    seed[taken], numbers[taken], u[taken], rho[taken]
                )
                np.add.at(self._examined, seed[taken], 1)
            if self.thorough:
                break
            done = np.unique(seed[now[~refused[now]]])
            left = left[(rank >= width) & ~np.isin(seed[left], done)]
            width *= MORE
        return refused, greatest

    def _replayed(
        self,
        seed: Int[np.ndarray, " n"],
        numbers: Int[np.ndarray, " n"],
        u: Float[np.ndarray, "n d"],
        rho: Float[np.ndarray, " n"],
    ) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        rows = self._rows(u) | {"rho": rho}
        # Without random numbers all seeds simulate the same.
        whose = seed if self._draws else np.zeros_like(seed)
        refused, greatest = np.zeros(len(seed), bool), np.full(len(seed), np.nan)
        for one in np.unique(whose).tolist():
            own = np.flatnonzero(whose == one)
            columns = {name: column[own] for name, column in rows.items()}
            refused[own], greatest[own] = self._confirmer(one)(columns, numbers[own]).refuse()
        return refused, greatest

    def _rows(self, u: Float[np.ndarray, "n d"]) -> dict[str, np.ndarray]:
        """Return the rows of the table at these points."""
        space = self.problem.space
        with in_precision(self.precision):
            features = space.features_at(pad_rows(u).astype(self.precision))
            columns = space.rows(jax.tree.map(np.asarray, features))
        return {name: column[: len(u)] for name, column in columns.items()}

    def _confirmer(self, seed: int) -> Confirmer:
        if seed not in self._confirmers:
            self._confirmers[seed] = Confirmer(self.problem, self.precision, int(self.seeds[seed]))
        return self._confirmers[seed]

    @property
    def _draws(self) -> bool:
        def trace() -> bool:
            engine = Engine(self.problem, 1, precision=self.precision, own_keys=True, alone=True)
            return engine.program.draws()

        return self.problem.programs.get(DRAWS, self.precision, trace)


def _rank(seed: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Return the position of each row among the rows of its seed, from 0; seeds are ascending."""
    return np.arange(len(seed)) - np.searchsorted(seed, seed)
