"""VerifAI's cross-entropy: one histogram for each coordinate, updated by one sample at a time.

After each point that fails, `rho < threshold`, every histogram is multiplied by `alpha` and gets `1
- alpha` in the point's bucket, in the order of the rows (Dreossi et al., VerifAI: a toolkit for the
formal design and analysis of artificial intelligence-based systems, CAV 2019). Before the first
failure it learns nothing. It is meant for comparisons; otherwise use `CrossEntropy`.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt32

from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search
from verifai_jax.search.draws import draw_uniform

MAX_COMBINATIONS = 1024
"""Maximum number of combinations of the lengths of arrays: in a run of a thousand
simulations more of them would be met once or never, and their histograms would learn nothing."""
MAX_BINS = 2**22
"""Maximum number of bins of all histograms, which take 16 MB."""


class CECompatState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]
    # One set of histograms for each combination of lengths, `bins` wide, zero where there is none.
    histograms: Float[Array, "sets d bins"]


@dataclass(frozen=True)
class CECompat(Search[CECompatState]):
    """The one-sample histogram rule of VerifAI, reproduced exactly.

    Histograms start as the prior. A continuous coordinate has equally wide buckets, a discrete one
    a bin for each cell. Lengths of arrays are always drawn from the prior, and each combination of
    lengths has its own histograms.

    **Arguments:**
    - `buckets`: number of buckets of a continuous coordinate.
    - `alpha`: share of a histogram that remains at each failure.
    - `threshold`: points with a robustness strictly below this are failures.
    **Raises:** `ValueError` for values out of range. `check` raises it for more than 1024
    combinations of lengths, or histograms that would not fit into memory.
    """

    buckets: int = 5
    alpha: float = 0.9
    threshold: float = 0.0

    def __post_init__(self) -> None:
        check_count("buckets", self.buckets)
        check_fraction("alpha", self.alpha, zero=True, one=True)
        number = isinstance(self.threshold, int | float) and not isinstance(self.threshold, bool)
        if not (number and math.isfinite(self.threshold)):
            raise ValueError(f"threshold must be a finite number; got {self.threshold!r}")

    def check(self, cube: Cube) -> None:
        """Raise `ValueError` for too many combinations of lengths, or too many bins."""
        lengths = [cube.levels[i] for i in cube.lengths]
        sets = math.prod(lengths)
        if sets > MAX_COMBINATIONS:
            raise ValueError(
                f"search ce_compat keeps histograms for each combination of the arrays' lengths, "
                f"{MAX_COMBINATIONS} at most; this space has {' * '.join(map(str, lengths))} = "
                f"{sets}. Use 'cross_entropy'"
            )
        bins = sets * cube.dim * max(self._sizes(cube), default=0)
        if bins > MAX_BINS:
            raise ValueError(
                f"search ce_compat would keep {bins} histogram bins on this space, {MAX_BINS} at "
                "most are allowed. Use 'cross_entropy'"
            )

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> CECompatState:
        sizes = self._sizes(cube)
        prior = np.zeros((cube.dim, max(sizes, default=0)), np.float32)
        for i in cube.continuous:
            prior[i, : self.buckets] = 1 / self.buckets
        for i, probabilities in zip(cube.discrete, cube.probabilities, strict=True):
            prior[i, : sizes[i]] = probabilities
        sets = math.prod(cube.levels[i] for i in cube.lengths)
        return CECompatState(key, jnp.uint32(0), jnp.tile(jnp.asarray(prior), (sets, 1, 1)))

    def ask(self, state: CECompatState, cube: Cube, batch: int) -> Asked[CECompatState]:
        key = jax.random.fold_in(state.key, state.round)
        pick, inside = draw_uniform(key, (2, batch, cube.dim))
        after = state._replace(round=state.round + 1)
        if cube.dim == 0:
            return pick, after
        which, index = self._set(pick, cube)[:, None], np.arange(cube.dim)
        limits = jnp.cumsum(state.histograms, axis=-1)
        # Rounding leaves a sum next to one: a pick must not fall after the last bin.
        scaled = pick * limits[which, index, -1]
        sizes = np.array(self._sizes(cube), np.int32)
        # The first bin whose limit is above the pick, by bisection.
        bins = jnp.zeros((batch, cube.dim), jnp.int32)
        for step in 2 ** np.arange(int(sizes.max() - 1).bit_length())[::-1]:
            further = jnp.minimum(bins + step, sizes - 1)
            bins = jnp.where(limits[which, index, further - 1] <= scaled, further, bins)
        u = jnp.clip((bins + inside) / sizes, 0.0, 1.0)
        u = u.at[:, cube.discrete].set(cube.centres(bins[:, cube.discrete]))
        lengths = np.array(cube.lengths, np.int32)
        return u.at[:, lengths].set(pick[:, lengths]), after

    def tell(self, state: CECompatState, cube: Cube, observations: Observations) -> CECompatState:
        fails = observations.valid & (observations.rho < self.threshold)  # False where it is NaN
        if cube.dim == 0:
            return state
        which = self._set(observations.u, cube)
        sets, _, max_bins = state.histograms.shape
        own = jax.nn.one_hot(which, sets, dtype=jnp.int32) * fails[:, None]
        total = jnp.sum(own, axis=0)
        # A failure's share shrinks with each further one of the same set, as row by row it would.
        later = jnp.take_along_axis(total - jnp.cumsum(own, axis=0), which[:, None], axis=1)[:, 0]
        share = jnp.where(fails, (1 - self.alpha) * self._power(later), 0.0)
        new = jnp.zeros((sets, cube.dim, max_bins), jnp.float32)
        bins = self._bins(observations.u, cube)
        new = new.at[which[:, None], np.arange(cube.dim), bins].add(share[:, None])
        histograms = self._power(total)[:, None, None] * state.histograms + new
        return state._replace(histograms=histograms)

    def _power(self, count: Int[Array, "..."]) -> Float[Array, "..."]:
        """Return `alpha` to the power of whole numbers; the zeroth of zero is one."""
        return jnp.power(jnp.float32(self.alpha), count.astype(jnp.float32))

    def _sizes(self, cube: Cube) -> tuple[int, ...]:
        return tuple(level or self.buckets for level in cube.levels)

    def _bins(self, u: Float[Array, "n d"], cube: Cube) -> Int[Array, "n d"]:
        bins = jnp.clip((u * self.buckets).astype(jnp.int32), 0, self.buckets - 1)
        return bins.at[:, cube.discrete].set(cube.cells(u))

    def _set(self, u: Float[Array, "n d"], cube: Cube) -> Int[Array, " n"]:
        """Return the number of the combination of lengths that each point has."""
        number = jnp.zeros(len(u), jnp.int32)
        cells = cube.cells(u)
        for i in cube.lengths:
            index = int(np.flatnonzero(cube.discrete == i)[0])
            number = number * cube.levels[i] + cells[:, index]
        return number
