"""Bandits: the models of the default search alone, on which each arm is a point.

VerifAI has a bandit with an arm for each interval of a coordinate. This one works in batches and
learns before the first failure: from Thompson sampling of an additive model, and confidence bounds
of a Gaussian process (`search.surrogate`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, UInt32

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Observations, Search
from verifai_jax.search.halton import halton_points
from verifai_jax.search.surrogate import CHOICES, Surrogate


class BanditState(NamedTuple):
    key: Key[Array, ""]
    round: UInt32[Array, ""]
    model: Surrogate
    lowest: Float[Array, ""]  # robustness so far, 0 for a failure
    stale: Int[Array, ""]  # simulations since it fell


@dataclass(frozen=True)
class Bandit(Search[BanditState]):
    """Thompson sampling of an additive model, and confidence bounds of a Gaussian process."""

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> BanditState:
        model, lowest = Surrogate.nothing(cube.dim), jnp.full((), jnp.inf, jnp.float32)
        return BanditState(key, jnp.uint32(0), model, lowest, jnp.int32(0))

    def ask(self, state: BanditState, cube: Cube, batch: int) -> Asked[BanditState]:
        key = jax.random.fold_in(state.key, state.round)
        index = 1 + state.round * CHOICES + jnp.arange(CHOICES, dtype=jnp.uint32)
        points = halton_points(index, cube.dim, state.key)
        u = state.model.propose(key, cube, batch, points, state.stale)
        return u, state._replace(round=state.round + 1)

    def tell(self, state: BanditState, cube: Cube, observations: Observations) -> BanditState:
        score = observations.score
        lowest = jnp.min(score, initial=jnp.inf)
        count = jnp.sum(observations.usable, dtype=jnp.int32)
        return state._replace(
            model=state.model.learned(observations.u, score),
            lowest=jnp.minimum(lowest, state.lowest),
            stale=jnp.where((lowest < state.lowest) | (lowest == 0), 0, state.stale + count),
        )
