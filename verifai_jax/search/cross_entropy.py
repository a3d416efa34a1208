"""The cross-entropy method: sample, keep the elite, fit the sampler to it, repeat.

Source: de Boer, Kroese, Mannor and Rubinstein, A tutorial on the cross-entropy method, Annals of
Operations Research 134 (2005); equation numbers are theirs.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.search.base import Cube, Evaluated

MOST_CELLS = 32  # A coordinate of more levels is ordered finely enough for a Gaussian.


class CrossEntropyState(NamedTuple):
    """The sampler, and the best points so far."""

    key: Key[Array, ""]
    rounds: Int[Array, ""]
    mean: Float[Array, " d"]
    std: Float[Array, " d"]
    weights: Float[Array, "d cells"]
    elite_u: Float[Array, "elites d"]
    elite_rho: Float[Array, " elites"]


@dataclass(frozen=True)
class CrossEntropy:
    """Independent truncated Gaussians on continuous coordinates, categorical on discrete ones.

    - `elite`: share of a batch that the sampler is fitted to. The elite is kept across rounds, so
      that small batches learn too.
    - `least_elites`: elites at least.
    - `smoothing`: weight of the new fit against the old, in (0, 1] (their eq. 15).
    - `explore`: share of each batch drawn from the prior: the search never stops exploring.
    - `least_std`: standard deviation at least, in widths of the cube.

    **Raises:** `ValueError` for values out of range.
    """

    elite: float = 0.1
    least_elites: int = 6
    smoothing: float = 0.8
    explore: float = 0.1
    least_std: float = 0.03
    wants_gradient: ClassVar[bool] = False
    samples_prior: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name in ("elite", "smoothing"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} must lie in (0, 1]; got {getattr(self, name)!r}")
        if not 0 <= self.explore < 1:
            raise ValueError(f"explore must lie in [0, 1); got {self.explore!r}")
        if not 0 < self.least_std < 1:
            raise ValueError(f"least_std must lie in (0, 1); got {self.least_std!r}")
        if not isinstance(self.least_elites, int) or self.least_elites < 2:
            raise ValueError(
                f"least_elites must be an integer of at least 2; got {self.least_elites!r}"
            )

    def check(self, cube: Cube) -> None:
        """Every cube will do."""

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> CrossEntropyState:
        """The state before the first round, which is drawn from the prior."""
        elites = max(self.least_elites, math.ceil(self.elite * batch))
        return CrossEntropyState(
            key=key,
            rounds=jnp.int32(0),
            mean=jnp.full(cube.dim, 0.5),
            std=jnp.full(cube.dim, np.inf),
            weights=_uniform_weights(cube),
            elite_u=jnp.full((elites, cube.dim), 0.5),
            elite_rho=jnp.full(elites, np.inf),
        )

    def ask(
        self, state: CrossEntropyState, cube: Cube, batch: int
    ) -> tuple[Float[Array, "batch d"], CrossEntropyState]:
        """Draw from the sampler, and a share from the prior."""
        key = jax.random.fold_in(state.key, state.rounds)
        v = jax.random.uniform(key, (batch, cube.dim))
        prior = (jnp.arange(batch) < math.ceil(self.explore * batch)) | (state.rounds == 0)
        u = jnp.where(prior[:, None], v, self._draw(state, cube, v))
        return u, state._replace(rounds=state.rounds + 1)

    def _draw(
        self, state: CrossEntropyState, cube: Cube, v: Float[Array, "n d"]
    ) -> Float[Array, "n d"]:
        """Points whose quantiles under the sampler are `v`."""
        below, above = ndtr((0 - state.mean) / state.std), ndtr((1 - state.mean) / state.std)
        normal = state.mean + state.std * ndtri(below + v * (above - below))
        u = jnp.clip(jnp.where(jnp.isfinite(state.std), normal, v), 0, 1)
        categorical, levels = _categorical(cube)
        if not categorical.any():
            return u
        cumulative = jnp.cumsum(state.weights, axis=1)
        cell = jnp.minimum(jnp.sum(v[:, :, None] >= cumulative[None], axis=2), levels - 1)
        return jnp.where(categorical, (cell + 0.5) / levels, u)

    def tell(
        self, state: CrossEntropyState, cube: Cube, evaluated: Evaluated
    ) -> CrossEntropyState:
        """Merge the batch into the elite and fit the sampler to it (their eqs. 12 and 13)."""
        usable = evaluated.counted & ~jnp.isnan(evaluated.rho)
        rho = jnp.concatenate([state.elite_rho, jnp.where(usable, evaluated.rho, np.inf)])
        points = jnp.concatenate([state.elite_u, evaluated.u])
        best, order = jax.lax.top_k(-rho, len(state.elite_rho))
        elite_rho, elite_u = -best, points[order]
        known = (elite_rho < np.inf).astype(points.dtype)[:, None]
        count = jnp.sum(known)
        mean = jnp.sum(known * elite_u, axis=0) / jnp.maximum(count, 1)
        spread = jnp.sum(known * (elite_u - mean) ** 2, axis=0) / jnp.maximum(count - 1, 1)
        std = jnp.maximum(jnp.sqrt(spread), self.least_std)
        # Before the first fit there is nothing to smooth with; before two points, nothing to fit.
        first = ~jnp.isfinite(state.std)
        blended = self.smoothing * jnp.where(first, 0.0, std) + (1 - self.smoothing) * jnp.where(
            first, 0.0, state.std
        )
        enough = count >= 2
        fitted = state._replace(
            mean=_blend(state.mean, mean, jnp.where(first, 1.0, self.smoothing)),
            std=jnp.where(first, std, blended),
            weights=self._fit_cells(state, cube, elite_u, known, count),
        )
        chosen = jax.tree.map(lambda new, old: jnp.where(enough, new, old), fitted[2:5], state[2:5])
        return CrossEntropyState(state.key, state.rounds, *chosen, elite_u, elite_rho)

    def _fit_cells(
        self,
        state: CrossEntropyState,
        cube: Cube,
        elite_u: Float[Array, "elites d"],
        known: Float[Array, "elites 1"],
        count: Float[Array, ""],
    ) -> Float[Array, "d cells"]:
        _, levels = _categorical(cube)
        cells = jnp.minimum((elite_u * levels).astype(jnp.int32), levels - 1)
        hits = cells[:, :, None] == jnp.arange(state.weights.shape[1])
        shares = jnp.sum(known[:, :, None] * hits, axis=0) / jnp.maximum(count, 1)
        return _blend(state.weights, shares, self.smoothing)


def _blend(old: Array, new: Array, weight: Array | float) -> Array:
    return weight * new + (1 - weight) * old


def _categorical(cube: Cube) -> tuple[Bool[np.ndarray, " d"], Int[np.ndarray, " d"]]:
    """Which coordinates have a categorical sampler, and of how many cells (elsewhere 1)."""
    levels = np.asarray(cube.levels, np.int32)
    categorical = (levels > 0) & (levels <= MOST_CELLS)
    return categorical, np.where(categorical, levels, 1)


def _uniform_weights(cube: Cube) -> Float[Array, "d cells"]:
    levels = _categorical(cube)[1].reshape(-1, 1)
    inside = np.arange(levels.max(initial=1)) < levels
    return jnp.asarray(inside / inside.sum(axis=1, keepdims=True), jnp.result_type(float))
