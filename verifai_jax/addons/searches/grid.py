"""The regular grid: every combination of evenly spaced values, once, and then an end.

The order is a random permutation of the grid, drawn with the seed: a shortened run has points from
everywhere, while rows in order would stay in one corner. The permutation is not stored, but
computed point by point, by a Feistel network over numbers in two digits that leaves out what lies
beyond the grid (Black, Rogaway, Ciphers with arbitrary finite domains, CT-RSA 2002, methods
"generalized Feistel" and "cycle walking").
"""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt32

from verifai_jax.core.compute.keys import mixed_bits
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, PointSequence

MAX_POINTS = 2**31 - 1
"""Maximum number of points of a grid: numbers of points are 32 bits, and sums of two of them
too."""
STEPS = 6
"""Steps of the permutation; with fewer, small grids have fewer different orders."""


class GridState(NamedTuple):
    index: UInt32[Array, ""]
    keys: UInt32[Array, " steps"]  # of the permutation


@dataclass(frozen=True)
class Grid(PointSequence[GridState]):
    """A grid with both ends of each continuous coordinate and the middle of each cell.

    Each point comes once, in a random order determined by the seed. So a budget below the size of
    the grid simulates a random sample of it, and the run's notes say which share. Batches beyond
    the end repeat the last point.

    **Arguments:**
    - `points`: number of values of each continuous coordinate, or a tuple with one number for each;
      1 means the middle.
    **Raises:** `ValueError` for numbers below 1. `check` raises it for a tuple that does not fit
    the space, and for more than `2^31 - 1` points in all.
    """

    points: int | tuple[int, ...] = 21
    sequence: ClassVar[tuple[str, str]] = "grid", "in a random order over the whole grid"

    def __post_init__(self) -> None:
        if isinstance(self.points, tuple):
            for index, points in enumerate(self.points):
                check_count(f"points[{index}]", points)
        else:
            check_count("points", self.points)

    def check(self, cube: Cube) -> None:
        """Raise `ValueError` if `points` does not fit the space, or for too many points."""
        if isinstance(self.points, tuple) and len(self.points) != len(cube.continuous):
            raise ValueError(
                f"points must have {len(cube.continuous)} entries, one for each continuous unit "
                f"coordinate; got {self.points}"
            )
        total = self.total(cube)
        if total > MAX_POINTS:
            size = f"{total}" if total < 10**15 else f"about 10^{len(str(total)) - 1}"
            raise ValueError(
                f"a grid with points={self.points} on the {len(cube.continuous)} continuous and "
                f"{len(cube.discrete)} discrete unit coordinates of this space has {size} points; "
                f"at most {MAX_POINTS} are allowed. Take fewer points, such as "
                "points=(5, 1, 1, ...) for each continuous coordinate, or search a part of the "
                "space by grid and the rest by another search"
            )

    def total(self, cube: Cube) -> int:
        return math.prod(self._sizes(cube))

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> GridState:
        return GridState(jnp.uint32(0), jax.random.bits(key, (STEPS,), jnp.uint32))

    def ask(self, state: GridState, cube: Cube, batch: int) -> Asked[GridState]:
        total = self.total(cube)
        number = state.index + jnp.arange(batch, dtype=jnp.uint32)
        number = permuted(jnp.minimum(number, np.uint32(total - 1)), total, state.keys)
        # Stays at the end, so that the number never wraps around.
        index = jnp.minimum(state.index + batch, np.uint32(total)).astype(jnp.uint32)
        return self.points_at(number, cube), state._replace(index=index)

    def points_at(self, rest: UInt32[Array, " n"], cube: Cube) -> Float[Array, "n d"]:
        """Return the points of the grid with these numbers, in the order of its rows.

        Discrete coordinates change faster than continuous ones; of each kind the first is fastest.
        """
        figures, batch = [], len(rest)
        for size in self._sizes(cube):
            figures.append((rest % np.uint32(size)).astype(jnp.int32))
            rest = rest // np.uint32(size)
        k = len(cube.discrete)
        digits = jnp.stack(figures, axis=1) if figures else jnp.zeros((batch, 0), jnp.int32)
        u = jnp.zeros((batch, cube.dim), jnp.float32)
        u = u.at[:, cube.discrete].set(cube.centres(digits[:, :k]))
        sizes = np.array(self._sizes(cube)[k:], np.int32)
        steps = digits[:, k:] / np.maximum(sizes - 1, 1).astype(np.float32)
        return u.at[:, cube.continuous].set(jnp.where(sizes > 1, steps, np.float32(0.5)))

    def _sizes(self, cube: Cube) -> tuple[int, ...]:
        """Return the number of values of each coordinate, the fastest first: discrete ones."""
        cells = tuple(cube.levels[i] for i in cube.discrete)
        if isinstance(self.points, tuple):
            return cells + self.points
        return cells + (self.points,) * len(cube.continuous)


def permuted(
    number: UInt32[Array, " n"], total: int, keys: UInt32[Array, " steps"]
) -> UInt32[Array, " n"]:
    """Return the images of these numbers under a random permutation of the numbers below `total`.

    **Arguments:**
    - `number`: numbers below `total`.
    - `total`: at most `2^31 - 1`.
    - `keys`: random bits, one for each step; the same keys give the same permutation.
    """
    high = math.isqrt(total - 1) + 1
    low = -(-total // high)

    def once(number: UInt32[Array, " n"]) -> UInt32[Array, " n"]:
        # Each step shifts one of the two digits by what a hash makes of the other.
        one, two, sizes = number // np.uint32(low), number % np.uint32(low), (high, low)
        for step in range(STEPS):
            size = np.uint32(sizes[step % 2])
            one, two = two, (one + mixed_bits(two ^ keys[step]) % size) % size
        return one * np.uint32(low) + two

    def again(found: UInt32[Array, " n"]) -> UInt32[Array, " n"]:
        return jnp.where(found < total, found, once(found))

    return jax.lax.while_loop(lambda found: jnp.any(found >= total), again, once(number))
