"""Memory of the points that were simulated, so that none of them is simulated again.

A search that learns may propose a point twice: a corner to which two descents lead, a known point
whose gradients it wants. The same simulation once more says nothing new, so that such a point is
moved by `NUDGE`, or another one takes its turn.
"""

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key, UInt64

from verifai_jax.core.cube import Cube

MEMORY = 1 << 16
"""Points that are remembered at most, the first of a run: later ones are seldom repeated."""

NUDGE = 2.0**-16
"""Greatest distance, in unit coordinates, by which a repeated point is moved. Derivatives there are
those of the point itself, and float32 tells the two apart."""

TRIES = 16
"""Draws until points are taken though they are repeated: in a space of few points all may be."""


class Repetition:
    """The points that were simulated so far, each as a number that tells it apart.

    - `codes`: the numbers, in the order of the simulations. The array is never written to: to go
      on with those of an earlier process, set it.
    """

    def __init__(self, cube: Cube, key: Key[Array, ""]) -> None:
        self._cube, self._levels = cube, np.array(cube.levels)
        self._seed = [int(word) for word in np.asarray(jax.random.key_data(key)).ravel()]
        rng = np.random.default_rng(cube.dim)
        self._factors = rng.integers(0, 2**63, cube.dim, np.uint64) * np.uint64(2) + np.uint64(1)
        self.codes = np.zeros(0, np.uint64)

    def add(self, points: Float[np.ndarray, "n d"]) -> None:
        """Remember points that are simulated."""
        if len(self.codes) < MEMORY and len(points):
            self.codes = np.concatenate([self.codes, self._code(points)])[:MEMORY]

    def avoid(
        self,
        points: Float[np.ndarray, "n d"],
        wanted: Bool[np.ndarray, " n"],
        anywhere: bool,
        number: int,
    ) -> Float[np.ndarray, "n d"]:
        """Return the points, with others for those that were simulated or stand there twice.

        **Arguments:**

        - `points`: proposals, in the unit cube.
        - `wanted`: which of them will be simulated.
        - `anywhere`: whether any point of the cube may take a turn; otherwise one next to it.
        - `number`: proposals before these, from which the random numbers follow.
        """
        repeated = wanted & self._repeated(points)
        if not repeated.any():
            return points
        points = points.copy()
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
        return points

    def _repeated(self, points: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
        """Return which points are remembered, or stand among these before."""
        codes = self._code(points)
        first = np.zeros(len(codes), bool)
        first[np.unique(codes, return_index=True)[1]] = True
        return ~first | np.isin(codes, self.codes)

    def _code(self, points: Float[np.ndarray, "n d"]) -> UInt64[np.ndarray, " n"]:
        """Return a number for each point, the same for all points of a cell."""
        points = np.array(points, np.float32)
        if len(self._cube.discrete):
            points[:, self._cube.discrete] = self._cube.cells(points)
        words = points.view(np.uint32).astype(np.uint64)
        mixed = (words + np.uint64(1)) * self._factors
        return np.asarray(np.sum(mixed ^ (mixed >> np.uint64(29)), axis=1, dtype=np.uint64))
