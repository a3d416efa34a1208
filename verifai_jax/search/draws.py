"""Random numbers of searches, with few calls of the generator, which takes long to compile."""

import math

import jax
import jax.numpy as jnp
import jax.scipy as jsp
import numpy as np
from jaxtyping import Array, Float, Key


def draw_uniform(key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "*shape"]:
    """Draw uniform numbers in `[0, 1)`, equal to those of `jax.random.uniform`; compiles faster.

    XLA takes seconds to compile the generator in more than one dimension, and again for each use.
    """
    flat = jax.random.uniform(key, (math.prod(shape),), jnp.float32)
    return jax.lax.optimization_barrier(flat).reshape(shape)


def draw_columns(
    key: Key[Array, ""], rows: int, *widths: int
) -> tuple[Float[Array, "rows width"], ...]:
    """Draw several blocks of uniform numbers in `[0, 1)` in one call, which compiles faster."""
    whole = draw_uniform(key, (rows, sum(widths)))
    return tuple(jnp.split(whole, np.cumsum(widths[:-1]), axis=1))


def standard_normal(uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Map uniform numbers in `[0, 1)` to standard normal ones; finite at 0."""
    return jsp.special.ndtri(jnp.maximum(uniform, np.float32(2**-25)))
