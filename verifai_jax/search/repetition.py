"""Memory of the simulated points, so that none is simulated again.

A search that learns may propose a point twice: a corner reached by two descents, or a known point
whose gradients it wants. Repeating a simulation gives no information, so such a point is moved by
`NUDGE` or replaced by another one.
"""

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key, UInt64

from verifai_jax.core.values.cube import Cube

MEMORY = 1 << 16
"""Maximum number of remembered points, the first of a run: later ones are seldom repeated."""
NUDGE = 2.0**-16
"""Greatest distance, in unit coordinates, by which a repeated point is moved. Derivatives there are
those of the point itself, and float32 tells the two apart."""
TRIES = 16
"""Draws until points are taken though they are repeated: in a space of few points all may be."""


class Repetition:
    """The points simulated so far, each as a number that identifies it."""

    def __init__(self, cube: Cube, key: Key[Array, ""]) -> None:
        self._cube, self._levels = cube, np.array(cube.levels)
        self._seed = [int(word) for word in np.asarray(jax.random.key_data(key)).ravel()]
        rng = np.random.default_rng(cube.dim)
        self._factors = rng.integers(0, 2**63, cube.dim, np.uint64) * np.uint64(2) + np.uint64(1)
        self.restore(np.zeros(0, np.uint64))

    @property
    def codes(self) -> UInt64[np.ndarray, " n"]:
        """The numbers, in the order of the simulations; this array is never modified."""
        return self._codes[: self._count]

    def restore(self, codes: UInt64[np.ndarray, " n"]) -> None:
        """Continue with the codes of an earlier process."""
        # There is room at the end, so that a round does not copy those before it.
        self._codes, self._count = np.resize(codes, 2 * len(codes) + 1024), len(codes)
        self._known = set(codes.tolist())

    def add(self, points: Float[np.ndarray, "n d"]) -> None:
        """Record points that are simulated."""
        if self._count >= MEMORY or not len(points):
            return
        new = self._code(points)[: MEMORY - self._count]
        end = self._count + len(new)
        if end > len(self._codes):
            self._codes = np.resize(self._codes, 2 * end)
        self._codes[self._count : end] = new
        self._count = end
        self._known.update(new.tolist())

    def avoid(
        self, points: Float[np.ndarray, "n d"], wanted: Bool[np.ndarray, " n"], anywhere: bool,
        number: int,
    ) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:  # fmt: skip
        """Replace points that were simulated before, or that occur twice.

        **Arguments:**
        - `points`: proposals, in the unit cube.
        - `wanted`: which of the points will be simulated.
        - `anywhere`: whether any point of the cube may replace one; otherwise one next to it. In a
          cube without continuous coordinates any point may.
        - `number`: number of proposals so far, from which the random numbers are derived.
        **Returns:** the points to simulate, and those that the search observes: the same points, or
        the original proposals if the simulated points lie next to them.
        """
        repeated = wanted & self._repeated(points)
        if not repeated.any():
            return points, points
        proposed, points = points, points.copy()
        rng = np.random.default_rng([*self._seed, number])
        anywhere = anywhere or not len(self._cube.continuous)
        for _ in range(TRIES):
            random = rng.random((int(repeated.sum()), self._cube.dim), np.float32)
            if not anywhere:
                moved = points[repeated]
                inwards = np.where(moved < 0.5, NUDGE, -NUDGE) * (1 + random) / 2
                random = np.where(self._levels > 0, moved, moved + inwards).astype(np.float32)
            points[repeated] = random
            repeated = wanted & self._repeated(points)
            if not repeated.any():
                break
        return points, points if anywhere else proposed

    def _repeated(self, points: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
        """Return which points are remembered, or stand among these before."""
        codes = self._code(points)
        first = np.zeros(len(codes), bool)
        first[np.unique(codes, return_index=True)[1]] = True
        return ~first | np.array([code in self._known for code in codes.tolist()], bool)

    def _code(self, points: Float[np.ndarray, "n d"]) -> UInt64[np.ndarray, " n"]:
        """Return a number for each point, the same for all points of a cell."""
        points = np.array(points, np.float32)
        if len(self._cube.discrete):
            points[:, self._cube.discrete] = self._cube.cells(points)
        words = points.view(np.uint32).astype(np.uint64)
        mixed = (words + np.uint64(1)) * self._factors
        return np.asarray(np.sum(mixed ^ (mixed >> np.uint64(29)), axis=1, dtype=np.uint64))
