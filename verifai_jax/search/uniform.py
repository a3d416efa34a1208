"""Uniform sampling: independent draws from the prior, the only search that gives failure rates."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, UInt32

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, PointSequence


class UniformState(NamedTuple):
    key: Key[Array, ""]
    index: UInt32[Array, ""]


@dataclass(frozen=True)
class Uniform(PointSequence[UniformState]):
    """Independent uniform points; point `i` depends only on the key and `i`, not on the batch."""

    samples_prior: ClassVar[bool] = True

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> UniformState:
        return UniformState(key, jnp.uint32(0))

    def ask(self, state: UniformState, cube: Cube, batch: int) -> Asked[UniformState]:
        index = state.index + jnp.arange(batch, dtype=jnp.uint32)
        return uniform_points(state.key, index, cube.dim), state._replace(index=state.index + batch)


def uniform_points(
    key: Key[Array, ""], index: UInt32[Array, " n"], dim: int
) -> Float[Array, "n dim"]:
    """Compute points of the random sequence of `key` by their `index`."""
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, index)
    return jax.vmap(lambda key: jax.random.uniform(key, (dim,), jnp.float32))(keys)
