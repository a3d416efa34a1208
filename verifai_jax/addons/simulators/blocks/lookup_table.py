"""Lookup tables: numbers on a grid, interpolated linearly.

torque = LookupTable([800, 1600, 2400], [90.0, 130.0, 110.0])
torque(rpm)
delay = LookupTable([1000, 2000], [0.1, 0.2, 0.3], numbers, beyond="extrapolate")
delay(rpm, load)                                     # numbers[i][j] at the i-th and the j-th
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.core.messages.errors import unknown_name

BEYOND = ("clip", "extrapolate")
"""Courses beyond the ends of a table: the value at the end, or its last line going on."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, init=False)
class LookupTable:
    """A function of one or more numbers, interpolated linearly between the points of a grid.

    It can be jitted, vmapped and differentiated with respect to its arguments and its values. At a
    breakpoint the derivative is that of the line after it.

    **Arguments:**
    - `axes_and_values`: the increasing breakpoints of each argument, at least two of each, followed
      by the values, of shape `[len(first axis), len(second axis), ...]`. Further axes make a table
      of vectors.
    - `beyond`: outside of an axis `"clip"` returns the value at its end, and `"extrapolate"`
      continues the last line.
    **Raises:** `ValueError` for breakpoints that do not increase, values that are not finite or of
    another shape, and an unknown `beyond`.
    """

    # JAX rebuilds the class with placeholders and with batches, which have other shapes.
    __no_type_check__ = True
    axes: tuple[tuple[float, ...], ...] = field(metadata={"static": True})
    values: Float[Array | np.ndarray, "*grid"]
    beyond: str = field(default="clip", metadata={"static": True})

    def __init__(
        self, *axes_and_values: Any, beyond: str = "clip",
        axes: tuple[tuple[float, ...], ...] | None = None, values: Any = None,
    ) -> None:  # fmt: skip
        if axes is None:
            if len(axes_and_values) < 2:
                raise ValueError(
                    "a LookupTable needs the breakpoints of each argument and then the values, as "
                    f"in LookupTable([0, 1], [5.0, 6.0]); got {len(axes_and_values)} of these"
                )
            *given, values = axes_and_values
            axes = tuple(_breakpoints(axis, i) for i, axis in enumerate(given))
            if not isinstance(values, jax.Array):
                values = _real(values, "the values of a LookupTable")
                if not np.all(np.isfinite(values)):
                    raise ValueError(
                        "the values of a LookupTable must be finite; "
                        f"got {values[~np.isfinite(values)][0]}"
                    )
            shape = tuple(len(axis) for axis in axes)
            if values.shape[: len(shape)] != shape:
                raise ValueError(
                    f"the values of a LookupTable with breakpoints {list(shape)} must have this "
                    f"shape; got {list(values.shape)}"
                )
        if beyond not in BEYOND:
            raise unknown_name("beyond", beyond, BEYOND)
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "beyond", beyond)

    def __call__(self, *arguments: Any) -> Any:
        """Return the value at the arguments, numbers or arrays of one shape.

        **Raises:** `TypeError` for another number of arguments than the table has.
        """
        if len(arguments) != len(self.axes):
            raise TypeError(
                f"this LookupTable is a function of {len(self.axes)} numbers; got {len(arguments)}"
            )
        arrays = [jnp.asarray(argument) for argument in arguments]
        dtype = jnp.result_type(
            float, *(a for a in arrays if jnp.issubdtype(a.dtype, jnp.floating))
        )
        values = jnp.asarray(self.values, dtype)
        positions = [
            self._position(axis, x.astype(dtype)) for axis, x in zip(self.axes, arrays, strict=True)
        ]
        total: Any = 0.0
        # The corners of the cell, each weighted by the shares along the axes.
        for corner in itertools.product((0, 1), repeat=len(positions)):
            index = tuple(left + side for (left, _), side in zip(positions, corner, strict=True))
            weight: Any = 1.0
            for (_, share), side in zip(positions, corner, strict=True):
                weight = weight * (share if side else 1 - share)
            entry = values[index]
            weight = jnp.asarray(weight, dtype)
            total = total + entry * weight.reshape(weight.shape + (1,) * (entry.ndim - weight.ndim))
        return total

    def _position(self, axis: tuple[float, ...], x: Any) -> tuple[Any, Any]:
        """Return the index of the breakpoint before a number, and the share of the way on."""
        points = np.asarray(axis)
        if self.beyond == "clip":
            # Unlike jnp.clip, whose derivative at an end is halved.
            x = jnp.where(x < axis[0], axis[0], jnp.where(x > axis[-1], axis[-1], x))
        inner = jnp.asarray(points[1:-1], x.dtype)
        # Comparing with all is quicker for a batch than a search, lane by lane.
        left = jnp.sum(x[..., None] >= inner, axis=-1).astype(jnp.int32)
        gap = jnp.asarray(np.diff(points), x.dtype)[left]
        return left, (x - jnp.asarray(points, x.dtype)[left]) / gap


def _real(values: Any, what: str) -> np.ndarray:
    if np.ma.is_masked(values):
        raise ValueError(f"{what} must be numbers; one of {np.size(values)} is masked")
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        raise ValueError(f"{what} must be real numbers; got {values!r}") from None


def _breakpoints(axis: Any, i: int) -> tuple[float, ...]:
    flat = _real(axis, f"the breakpoints of argument {i}")
    points: Sequence[float] = flat.tolist() if flat.ndim == 1 else ()
    finite = all(math.isfinite(point) for point in points)
    if len(points) < 2 or not finite or any(b <= a for a, b in pairwise(points)):
        raise ValueError(
            f"the breakpoints of argument {i} must be two or more numbers that increase; got {axis}"
        )
    return tuple(points)
