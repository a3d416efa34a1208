"""The regular grid: every combination of evenly spaced values, once, and then an end."""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt32

from verifai_jax.core.checks import check_count
from verifai_jax.core.cube import Cube
from verifai_jax.search.base import Observations, Search

MOST_POINTS = 2**31 - 1
"""Points of a grid at most."""


class GridState(NamedTuple):
    index: UInt32[Array, ""]


@dataclass(frozen=True)
class Grid(Search[GridState]):
    """A grid with both ends of each continuous coordinate and the middle of each cell.

    Discrete coordinates change fastest, and among the discrete and among the continuous ones the
    first does: for each place in the continuous coordinates all choices are tried. Batches beyond
    the end repeat the last point.

    **Arguments:**

    - `points`: number of values of each continuous coordinate, or a tuple with one number each; 1
      is the middle.

    **Raises:** `ValueError` for numbers below 1. `check` raises it for a tuple that does not go
    with the space, and for more than `2^31 - 1` points in all.
    """

    points: int | tuple[int, ...] = 21
    learns: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if isinstance(self.points, tuple):
            for place, points in enumerate(self.points):
                check_count(f"points[{place}]", points)
        else:
            check_count("points", self.points)

    def check(self, cube: Cube) -> None:
        """Raise `ValueError` where `points` does not go with the space, or for too many points."""
        if isinstance(self.points, tuple) and len(self.points) != len(cube.continuous):
            raise ValueError(
                f"points must have {len(cube.continuous)} entries, one for each continuous unit "
                f"coordinate; got {self.points}"
            )
        total = self.total(cube)
        if total > MOST_POINTS:
            size = f"{total}" if total < 10**15 else f"about 10^{len(str(total)) - 1}"
            raise ValueError(
                f"a grid with points={self.points} on the {len(cube.continuous)} continuous and "
                f"{len(cube.discrete)} discrete unit coordinates of this space has {size} points; "
                f"at most {MOST_POINTS} are allowed. Take fewer points, such as "
                "points=(5, 1, 1, ...) for each continuous coordinate, or search a part of the "
                "space by grid and the rest by another search"
            )

    def total(self, cube: Cube) -> int:
        return math.prod(self._sizes(cube))

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> GridState:
        return GridState(jnp.uint32(0))

    def ask(
        self, state: GridState, cube: Cube, batch: int
    ) -> tuple[Float[Array, "batch d"], GridState]:
        total = self.total(cube)
        rest = jnp.minimum(state.index + jnp.arange(batch, dtype=jnp.uint32), np.uint32(total - 1))
        figures = []
        for size in self._sizes(cube):
            figures.append((rest % np.uint32(size)).astype(jnp.int32))
            rest = rest // np.uint32(size)
        k = len(cube.discrete)
        places = jnp.stack(figures, axis=1) if figures else jnp.zeros((batch, 0), jnp.int32)
        u = jnp.zeros((batch, cube.dim), jnp.float32)
        u = u.at[:, cube.discrete].set(cube.centres(places[:, :k]))
        sizes = np.array(self._sizes(cube)[k:], np.int32)
        steps = places[:, k:] / np.maximum(sizes - 1, 1).astype(np.float32)
        u = u.at[:, cube.continuous].set(jnp.where(sizes > 1, steps, np.float32(0.5)))
        # Stays at the end, so that the number never wraps around.
        return u, GridState(jnp.minimum(state.index + batch, np.uint32(total)).astype(jnp.uint32))

    def tell(self, state: GridState, cube: Cube, observations: Observations) -> GridState:
        return state

    def _sizes(self, cube: Cube) -> tuple[int, ...]:
        """Return the number of values of each coordinate, the fastest first: discrete ones."""
        cells = tuple(cube.levels[i] for i in cube.discrete)
        if isinstance(self.points, tuple):
            return cells + self.points
        return cells + (self.points,) * len(cube.continuous)
