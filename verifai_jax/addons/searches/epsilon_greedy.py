"""Epsilon-greedy: mostly draw near the best known points, sometimes anywhere.

The rule of bandits (Sutton, Barto, Reinforcement Learning, 2nd edition, 2018, section 2.2) with the
best points instead of the best arm. A greedy draw starts at one of them, takes some coordinates
from another, as evolution strategies recombine parents (Beyer, Schwefel, 2002), and adds noise as
wide as their distances, so the search narrows as they converge.

The best points are replaced by new ones when they stop improving, and also when the draws around
them are not clearly better than the median of the prior. So the search is hardly worse than random
sampling if the robustness gives no direction.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from verifai_jax.addons.searches.moves import all_or_some, has_fine_cells
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search, check_options
from verifai_jax.search.best_points import keep_best
from verifai_jax.search.draws import draw_columns, standard_normal

# Chosen by hand; no comparison with other values is recorded. With them the search is held to 4
# times fewer simulations than uniform sampling (tests/search/test_quality.py).
SINGLE_STD = 0.1  # of the noise around a single best point, in unit coordinates
REMEMBERED = 64  # draws of the prior, for the median
RECOMBINED = 0.3  # share of greedy draws with a second parent
RESAMPLED = 0.2  # share of choices drawn anew
NARROWEST_NOISE = 0.4  # the factor on the noise is between this share of `reach` and `reach`


class EpsilonGreedyState(NamedTuple):
    key: Key[Array, ""]
    asks: UInt32[Array, ""]
    tells: UInt32[Array, ""]
    best: Float[Array, "k d"]  # sorted
    score: Float[Array, " k"]  # robustness, 0 for all failures; infinite where there is no point
    prior: Float[Array, " remembered"]  # scores of draws from the prior, infinite at first
    begun: Int[Array, ""]  # draws from the prior since the start, as far as they matter
    stale: Int[Array, ""]  # points without progress
    tried: Float[Array, ""]  # greedy draws since the start,
    better: Float[Array, ""]  # and those better than the prior's median; half of those equal to it


@dataclass(frozen=True)
class EpsilonGreedy(Search[EpsilonGreedyState]):
    """Draws around the best points so far, with a share `epsilon` from the prior.

    **Arguments:**
    - `epsilon`: share of points that are always drawn from the prior.
    - `best`: number of best points kept, as a share of the batch; at least `min_best`.
    - `reach`: maximum standard deviation of the noise, in units of that of the best points.
    - `min_std`: minimum standard deviation of a coordinate, in unit coordinates.
    - `begin`: number of draws from the prior before best points are chosen.
    - `patience`: rounds without progress after which it restarts; small rounds count as fractions
      of rounds of `begin` points.
    - `doubt`: it restarts unless greedy draws are this many standard errors above chance.
    **Raises:** `ValueError` for values out of range.
    """

    epsilon: float = 0.1
    best: float = 0.1
    min_best: int = 4
    reach: float = 2.0
    min_std: float = 0.01
    begin: int = 16
    patience: int = 6
    doubt: float = 3.0

    def __post_init__(self) -> None:
        counts = {"min_best": 2, "begin": 1, "patience": 1}
        check_options(self, counts, ["epsilon", "best", "min_std"], ["reach", "doubt"])

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> EpsilonGreedyState:
        k = max(self.min_best, int(np.ceil(self.best * batch)))
        return EpsilonGreedyState(
            key=key,
            asks=jnp.uint32(0),
            tells=jnp.uint32(0),
            best=jnp.full((k, cube.dim), 0.5, jnp.float32),
            score=jnp.full(k, jnp.inf, jnp.float32),
            prior=jnp.full(REMEMBERED, jnp.inf, jnp.float32),
            begun=jnp.int32(0),
            stale=jnp.int32(0),
            tried=jnp.float32(0),
            better=jnp.float32(0),
        )

    def ask(self, state: EpsilonGreedyState, cube: Cube, batch: int) -> Asked[EpsilonGreedyState]:
        key = jax.random.fold_in(state.key, state.asks)
        d, k = cube.dim, len(cube.discrete)
        row, prior, noise, inherit, move, choice = draw_columns(key, batch, 5, d, d, d, d, k)
        # Only those that are better than chance are parents; they are sorted.
        good = (state.score < self._median(state)).astype(jnp.float32)
        count = jnp.sum(good)
        parents = jnp.minimum((row[:, :2] * count).astype(jnp.int32), len(good) - 1)
        one, other = state.best[parents[:, 0]], state.best[parents[:, 1]]
        recombined = (inherit < 0.5) & (row[:, 2:3] < RECOMBINED)
        parent = jnp.where(recombined, other, one)
        mean = good @ state.best / jnp.maximum(count, 1.0)
        std = jnp.sqrt(good @ (state.best - mean) ** 2 / jnp.maximum(count, 1.0))
        # A single one does not show any.
        std = jnp.where(count >= 2, jnp.maximum(std, self.min_std), SINGLE_STD)
        factor = self.reach * NARROWEST_NOISE ** row[:, 3:4]
        step = factor * std * standard_normal(noise)
        step = jnp.where(all_or_some(row[:, 4:5], move), step, 0.0)
        u = jnp.clip(parent + step, 0.0, 1.0)
        many = has_fine_cells(cube)
        cell = jnp.where(many, cube.cells(u), cube.cells(parent))
        cell = jnp.where((choice < RESAMPLED) & ~many, cube.cells(prior), cell)
        u = u.at[:, cube.discrete].set(cube.centres(cell))
        greedy = ~self._exploring(state, batch) & (count > 0)
        return jnp.where(greedy[:, None], u, prior), state._replace(asks=state.asks + 1)

    def tell(
        self, state: EpsilonGreedyState, cube: Cube, observations: Observations
    ) -> EpsilonGreedyState:
        usable = observations.usable
        exploring = self._exploring(state, len(observations.rho))
        score = observations.score
        # What greed gained over the prior; equally good draws count half.
        greedy = usable & ~exploring
        median = self._median(state)
        gain = jnp.where(score < median, 1.0, jnp.where(score == median, 0.5, 0.0))
        tried = state.tried + jnp.sum(greedy)
        better = state.better + jnp.sum(jnp.where(greedy, gain, 0.0))
        useless = better - tried / 2 < self.doubt * jnp.sqrt(tried) / 2
        useless &= tried >= self.begin
        # Whatever the robustness says, close to failures there are others.
        useless &= state.score[0] > 0
        state = self._with_best(state, observations.u, score)
        stale = jnp.where(state.begun < self.begin, 0, state.stale)
        again = (stale >= self.patience * max(len(score), self.begin)) | useless
        # The newest draws of the prior first.
        drawn = jnp.concatenate([jnp.where(exploring, score, jnp.inf), state.prior])
        newest = jnp.argsort(jnp.isinf(drawn), stable=True)[:REMEMBERED]
        begun = jnp.minimum(state.begun + jnp.sum(usable & exploring), self.begin)
        return state._replace(
            tells=state.tells + 1,
            score=jnp.where(again, jnp.inf, state.score),
            prior=drawn[newest],
            begun=jnp.where(again, 0, begun).astype(jnp.int32),
            stale=jnp.where(again, 0, stale).astype(jnp.int32),
            tried=jnp.where(again, 0.0, tried),
            better=jnp.where(again, 0.0, better),
        )

    def warm_start(
        self, state: EpsilonGreedyState, cube: Cube, observations: Observations
    ) -> EpsilonGreedyState:
        """Take the best points; scores of the prior still have to be sampled."""
        score = observations.score
        return self._with_best(state, observations.u, score)._replace(stale=state.stale)

    def _with_best(
        self, state: EpsilonGreedyState, u: Float[Array, "n d"], score: Float[Array, " n"]
    ) -> EpsilonGreedyState:
        """Update the best points, and count the points without progress."""
        best, scores = keep_best(u, score, state.best, state.score)
        level, before = scores[-1], state.score[-1]
        # By a hundredth of what is between them and the prior, wherever zero is.
        far = jnp.maximum(self._median(state) - before, 0.0)
        progress = jnp.isinf(before) | (level < before - 0.01 * far)
        stale = jnp.where(progress, 0, state.stale + len(score)).astype(jnp.int32)
        return state._replace(best=best, score=scores, stale=stale)

    def _exploring(self, state: EpsilonGreedyState, batch: int) -> Bool[Array, " batch"]:
        """Return the rows of the next `tell` from the prior: every tenth, say, or all at first."""
        number = state.tells * batch + jnp.arange(batch, dtype=jnp.uint32)
        # In whole numbers, that may wrap around.
        share = np.uint32(round(self.epsilon * 2**16))
        due = (number * share) % np.uint32(2**16) + share >= 2**16
        return due | (state.begun < self.begin)

    def _median(self, state: EpsilonGreedyState) -> Float[Array, ""]:
        """Return the median score of the prior; infinite at first."""
        known = jnp.sum(jnp.isfinite(state.prior))
        return jnp.sort(state.prior)[jnp.maximum(known - 1, 0) // 2]
