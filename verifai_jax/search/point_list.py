"""A list of points to simulate in order: those of a table, of an analysis, of a person."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, Origin, PointSequence


class PointListState(NamedTuple):
    index: Int[Array, ""]


@dataclass(frozen=True, eq=False, repr=False)
class PointList(PointSequence[PointListState]):
    """Given points of the unit cube in their order; the search ends with the last one.

    **Arguments:**
    - `points`: `[n, d]`, in `[0, 1]`.
    **Raises:** `ValueError` for no points, or points outside the unit cube; `check` for points of a
    dimension other than the cube's.
    """

    points: Float[Array | np.ndarray, "n d"] | Sequence[Sequence[float]]
    origin: ClassVar[Origin] = "given"

    def __post_init__(self) -> None:
        points = np.asarray(self.points, np.float32)
        if points.ndim != 2 or not len(points):
            raise ValueError(f"points must be [n, d] with n >= 1; got shape {list(points.shape)}")
        if not np.all((points >= 0) & (points <= 1)):
            raise ValueError("points must lie in the unit cube, [0, 1] in every coordinate")
        object.__setattr__(self, "points", points)

    def check(self, cube: Cube) -> None:
        dim = np.shape(self.points)[1]
        if dim != cube.dim:
            raise ValueError(f"the points have {dim} coordinates, the space has {cube.dim}")

    def total(self, cube: Cube) -> int | None:
        return len(self.points)

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> PointListState:
        return PointListState(jnp.int32(0))

    def ask(self, state: PointListState, cube: Cube, batch: int) -> Asked[PointListState]:
        rows = jnp.minimum(state.index + jnp.arange(batch), len(self.points) - 1)
        return jnp.asarray(self.points)[rows], PointListState(state.index + batch)

    def __repr__(self) -> str:
        return f"PointList({len(self.points)} points)"
