"""Look-up tables with linear interpolation and extrapolation, without looking anything up.

    table = hinges([0, 1, 3], [(5.0, 0.0), (6.0, 0.0), (2.0, 1.0)])
    first, second = interpolated(table, x)

A piecewise linear function is a sum of hinges. Lanes of a batch evaluate that in step with one
another, where a gather from memory would take them one by one.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jaxtyping import Array, Float

Scalar = Float[Array, ""]


class Hinges(NamedTuple):
    """Functions `base + slope (x - x0) + sum bend[i] max(x - at[i], 0)`, one for each column.

    They go on along their first and their last piece.
    """

    x0: float
    base: np.ndarray
    slope: np.ndarray
    at: np.ndarray
    bend: np.ndarray


def hinges(x: npt.ArrayLike, y: npt.ArrayLike) -> Hinges:
    """Interpolate the columns of `y[i]` at increasing `x[i]`."""
    xs, ys = np.asarray(x, float), np.asarray(y, float)
    slopes = np.diff(ys, axis=0) / np.diff(xs)[:, None]
    return Hinges(float(xs[0]), ys[0], slopes[0], xs[1:-1], np.diff(slopes, axis=0))


def interpolated(table: Hinges, x: Scalar) -> list[Scalar]:
    """Return the value of each column at `x`."""
    over = [jnp.maximum(x - float(at), 0) for at in table.at]
    # Column by column: XLA makes one loop over the lanes of it.
    return [
        sum(
            (float(b) * o for b, o in zip(bends, over, strict=True) if b),
            float(base) + float(slope) * (x - table.x0),
        )
        for base, slope, bends in zip(table.base, table.slope, table.bend.T, strict=True)
    ]


class Bilinear(NamedTuple):
    """A function of two numbers: hinges of the second, with coefficients that the first gives."""

    coefficients: Hinges
    y0: float
    at: np.ndarray

    def along(self, x: Scalar) -> Callable[[Scalar], Scalar]:
        """Return the function of the second number that is left at `x`."""
        level, tilt, *bends = interpolated(self.coefficients, x)

        def value(y: Scalar) -> Scalar:
            total = level + tilt * (y - self.y0)
            for at, bend in zip(self.at, bends, strict=True):
                total = total + bend * jnp.maximum(y - float(at), 0)
            return total

        return value


def bilinear(x: npt.ArrayLike, y: npt.ArrayLike, z: npt.ArrayLike) -> Bilinear:
    """Interpolate the values `z[i, j]` at `x[i], y[j]`."""
    rows = hinges(y, np.transpose(z))
    coefficients = np.concatenate([rows.base[None], rows.slope[None], rows.bend])
    return Bilinear(hinges(x, coefficients.T), rows.x0, rows.at)
