"""Moves from known points to new ones, shared by several searches."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.draws import standard_normal

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


def near_others(
    parent: Float[Array, "n d"], random: Float[Array, "n r"], cube: Cube, scales: Float[Array, " 2"]
) -> Float[Array, "n d"]:
    """Draw points around others: some coordinates moved by a step between two scales.

    - `random`: uniform numbers: one unused, the step, the share, then by coordinate.
    """
    d = cube.dim
    step = scales[0] * (scales[1] / scales[0]) ** random[:, 1:2]
    # From all coordinates to one on average, and always one.
    share = float(d) ** -random[:, 2:3]
    pick, noise = random[:, 3 : 3 + d], random[:, 3 + d :]
    moves = (pick < share) | (pick == jnp.min(pick, axis=1, keepdims=True))
    moved = jnp.clip(parent + step * standard_normal(noise), 0.0, 1.0)
    # An unordered choice has no neighbours: any other.
    codes = (np.array(cube.levels) > 0) & ~np.array(cube.ordered, bool)
    return jnp.where(moves, jnp.where(codes, noise, moved), parent)
