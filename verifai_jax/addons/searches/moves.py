"""Moves from known points to new ones, shared by several searches."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from verifai_jax.core.values.cube import Cube

MAX_CELLS = 8
"""Ordered cells up to which a coordinate is discrete; more are stepped over as if continuous.
Chosen by hand; no comparison with other values is recorded."""


def has_fine_cells(cube: Cube) -> Bool[np.ndarray, " discrete"]:
    """Return which discrete coordinates have enough ordered cells to be moved by noise."""
    return np.array([cube.ordered[i] and cube.levels[i] > MAX_CELLS for i in cube.discrete], bool)


def all_or_some(coin: Float[Array, "n 1"], mask: Float[Array, "n d"]) -> Bool[Array, "n d"]:
    """Select the coordinates to move: all in every second row, else a third, or one on average.

    **Arguments:**
    - `coin`, `mask`: uniform random numbers.
    """
    return mask < jnp.where(coin < 0.5, 1.0, max(0.3, 1 / max(mask.shape[1], 1)))
