"""Cross-entropy: sample around the best points so far, and repeat.

The method fits a parametric family to an elite of the samples and draws the next ones from the fit
(de Boer, Kroese, Mannor, Rubinstein, A tutorial on the cross-entropy method, Annals of Operations
Research 134, 2005). As in its algorithm for rare events the level of the elite stops at the event:
all failures are equally good, and the fit covers their region instead of its deepest point.

Three departures, all for small batches of expensive simulations:

- the elite is kept over the rounds rather than taken from the last batch alone;
- the family is a mixture with one component for each elite point, shrunk towards the mean so that
  the components do not add to the elite's variance (West, Approximating posterior distributions by
  mixture, 1993). Unlike one Gaussian it follows several failure regions and narrow valleys;
- Gaussians are projected to the cube, not truncated: failures are often in its corners.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt32

from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search, check_options
from verifai_jax.search.best_points import keep_best
from verifai_jax.search.draws import draw_columns, standard_normal
from verifai_jax.search.halton import halton_points

MAX_CELLS = 32
"""Cells up to which a coordinate has a histogram: a batch cannot fill one of more."""
FEW_COORDINATES = 4
"""Coordinates up to which the options that depend on the dimension are the given ones. Chosen
by hand; no comparison with other values is recorded."""
MORE_PATIENCE = 30
"""Simulations without progress that a search waits longer for each further coordinate. In ten
dimensions, batches of ten and 6 rounds alone, one search in three missed Rastrigin's function."""
NARROWER = 1.5
"""Power of the dimension with which `min_std` falls: to 0.005 in ten dimensions, where 0.02 and
0.008 are too wide to hit a ball of radius 0.007."""


class CrossEntropyState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]
    elite: Float[Array, "k d"]
    score: Float[Array, " k"]  # robustness, 0 for all failures; infinite where there is no point
    stale: Int[Array, ""]  # rounds without progress
    explored: UInt32[Array, ""]  # how many points of the prior were asked for
    highest: Float[Array, ""]  # robustness so far


@dataclass(frozen=True)
class CrossEntropy(Search[CrossEntropyState]):
    """Cross-entropy with Gaussian and categorical mixtures around the best points so far.

    **Arguments:**
    - `elite`: size of the elite, as a share of the batch; at least `min_elite` points.
    - `focus`: in `[0, 1]`; 0 draws from one Gaussian, 1 from the neighbourhoods of elite points.
    - `exploration`: share of each batch that is always drawn from the prior.
    - `widening`: factor on the elite's standard deviation; above 1 it reaches beyond the elite.
    - `min_std`: minimum standard deviation of a coordinate, in unit coordinates; smaller in more
      than four dimensions, since a point must be near in every coordinate.
    - `patience`: rounds without progress after which it restarts elsewhere; 30 simulations more for
      each coordinate beyond four.
    **Raises:** `ValueError` for values out of range.
    """

    elite: float = 0.1
    min_elite: int = 6
    focus: float = 0.7
    exploration: float = 0.1
    widening: float = 1.5
    min_std: float = 0.02
    patience: int = 6

    def __post_init__(self) -> None:
        counts = {"min_elite": 2, "patience": 1}
        check_options(self, counts, ["elite", "exploration", "min_std"], ["widening"])
        check_fraction("focus", self.focus, zero=True, one=True)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> CrossEntropyState:
        k = max(self.min_elite, int(np.ceil(self.elite * batch)))
        return CrossEntropyState(
            key=key,
            round=jnp.uint32(0),
            elite=jnp.full((k, cube.dim), 0.5, jnp.float32),
            score=jnp.full(k, jnp.inf, jnp.float32),
            stale=jnp.int32(0),
            explored=jnp.uint32(0),
            highest=jnp.full((), -jnp.inf, jnp.float32),
        )

    def ask(self, state: CrossEntropyState, cube: Cube, batch: int) -> Asked[CrossEntropyState]:
        key = jax.random.fold_in(state.key, state.round)
        fitted = self._draw(key, state, cube, batch)
        row = jnp.arange(batch, dtype=jnp.uint32)
        # Of points that are equally good, and do not fail, none says where to go.
        known = jnp.sum(jnp.isfinite(state.score)) >= 2
        known &= (state.highest > state.score[0]) | (state.score[0] == 0)
        exploited = jnp.where(known, batch - int(np.ceil(self.exploration * batch)), 0)
        exploited = exploited.astype(jnp.uint32)
        # Numbered without gaps: every 16th point of the sequence would stay in one half of it.
        prior = halton_points(1 + state.explored + row - exploited, cube.dim, state.key)
        u = jnp.where((row < exploited)[:, None], fitted, prior)
        explored = state.explored + batch - exploited
        return u, state._replace(round=state.round + 1, explored=explored)

    def tell(
        self, state: CrossEntropyState, cube: Cube, observations: Observations
    ) -> CrossEntropyState:
        elite, score = keep_best(observations.u, observations.score, state.elite, state.score)
        level, before = score[-1], state.score[-1]
        progress = ~jnp.isfinite(before) | (level < 0.99 * before)
        stale = jnp.where(progress, 0, state.stale + 1)
        more = MORE_PATIENCE * max(cube.dim - FEW_COORDINATES, 0)
        again = stale >= self.patience + -(-more // len(observations.rho))
        return state._replace(
            elite=elite,
            score=jnp.where(again, jnp.inf, score),
            stale=jnp.where(again, 0, stale).astype(jnp.int32),
            highest=jnp.maximum(
                state.highest,
                jnp.max(observations.rho, where=observations.usable, initial=-jnp.inf),
            ),
        )

    def _draw(
        self, key: Key[Array, ""], state: CrossEntropyState, cube: Cube, batch: int
    ) -> Float[Array, "batch d"]:
        """Draw points from the mixture around the elite."""
        # Indices among the discrete coordinates, and among all.
        narrow = np.array(
            [j for j, i in enumerate(cube.discrete) if cube.levels[i] <= MAX_CELLS], np.int32
        )
        cells = cube.discrete[narrow]
        widths = (1, cube.dim, len(cells), len(cells))
        pick, noise, draw, inherit = draw_columns(key, batch, *widths)
        weight = jnp.isfinite(state.score).astype(jnp.float32)
        count = jnp.maximum(jnp.sum(weight), 1.0)
        # The elite is sorted: the points that exist come first.
        parent = state.elite[jnp.minimum((pick[:, 0] * count).astype(jnp.int32), len(weight) - 1)]
        mean = weight @ state.elite / count
        std = jnp.sqrt(weight @ (state.elite - mean) ** 2 / count)
        fewer = min(1.0, FEW_COORDINATES / max(cube.dim, 1))
        std = jnp.maximum(self.widening * std, self.min_std * fewer**NARROWER)
        normal = standard_normal(noise)
        spread = float(np.sqrt(1 - self.focus**2))
        u = jnp.clip(mean + self.focus * (parent - mean) + spread * std * normal, 0.0, 1.0)
        if len(cells) == 0:
            return u
        levels = np.array([cube.levels[i] for i in cells], np.int32)
        prior = np.zeros((len(cells), levels.max()), np.float32)
        for row, j in zip(prior, narrow, strict=True):
            row[: len(cube.probabilities[j])] = cube.probabilities[j]
        elite_cells = cube.cells(state.elite)[:, narrow]
        counts = jnp.einsum("k,kcl->cl", weight, jax.nn.one_hot(elite_cells, int(levels.max())))
        # With one pseudo-count of the prior, so that no choice dies out.
        limits = jnp.cumsum((counts + prior) / (count + 1), axis=1)
        drawn = jnp.sum(draw[:, :, None] > limits, axis=-1)
        # Inherited as often as keeps the correlation that a continuous coordinate has.
        inherited = jnp.asarray(cube.cells(parent))
        cell = jnp.where(inherit < self.focus**2, inherited[:, narrow], drawn)
        cell = inherited.at[:, narrow].set(jnp.clip(cell, 0, levels - 1).astype(jnp.int32))
        return u.at[:, cells].set(cube.centres(cell)[:, narrow])
