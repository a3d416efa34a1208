"""Distances between points of the unit cube."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from verifai_jax.core.values.cube import Cube


def apart(cube: Cube, one: Float[Array, "n d"], other: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """Return root mean square differences over coordinates; choices differ by 0 or 1."""
    if cube.dim == 0:
        return jnp.zeros((len(one), len(other)), jnp.float32)
    square = jnp.zeros((len(one), len(other)), jnp.float32)
    if len(cube.continuous):
        a, b = one[:, cube.continuous], other[:, cube.continuous]
        # Coordinate by coordinate: the product form would cancel digits of small distances.
        square = jnp.sum((a[:, None, :] - b[None, :, :]) ** 2, axis=-1)
    if len(cube.discrete):
        levels = np.array([max(cube.levels[i] - 1, 1) for i in cube.discrete], np.float32)
        ordered = np.array([cube.ordered[i] for i in cube.discrete])
        steps = cube.cells(one)[:, None, :] - cube.cells(other)[None, :, :]
        gap = jnp.where(ordered, jnp.abs(steps) / levels, (steps != 0).astype(jnp.float32))
        square += jnp.sum(gap**2, axis=-1)
    return jnp.sqrt(square / cube.dim)


def distinct(
    points: Sequence | np.ndarray | Array, radius: float, cube: Cube | None = None,
    order: Sequence[int] | np.ndarray | None = None,
) -> Int[np.ndarray, " k"]:  # fmt: skip
    """Choose distinct points: no two of them are within the radius.

    The first point is chosen, then each one beyond the radius of all chosen points.

    **Arguments:**
    - `points`: `[n, d]`, in the unit cube.
    - `radius`: root mean square distance over the coordinates, as in `search.Diverse`.
    - `cube`: the unit cube of the space; when left out, all coordinates are continuous.
    - `order`: indices of the points by preference, such as `np.argsort(rho)`.
    **Returns:** indices `[k]` of the chosen points, in that order.
    """
    u = np.asarray(points, np.float32)
    cube = cube or Cube((0,) * u.shape[1])
    chosen: list[int] = []
    near = np.zeros(len(u), bool)
    for i in range(len(u)) if order is None else np.asarray(order):
        if not near[i]:
            chosen.append(int(i))
            near |= np.asarray(apart(cube, u[i][None], u))[0] <= radius  # pyright: ignore[reportArgumentType]
    return np.array(chosen, int)
