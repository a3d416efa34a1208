"""Exact non-dominated sorting: the non-dominated points, then those of the rest, and so on.

    fronts([[0.0, 5.0], [1.0, 1.0], [2.0, 6.0]])      # 0, 0, 1: all objectives are minimised

One point dominates another if it is nowhere worse and somewhere better (Deb et al., A fast and
elitist multiobjective genetic algorithm: NSGA-II, IEEE Transactions on Evolutionary Computation 6
(2002), section III.A). Equal points do not dominate each other: they share a front.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

_MAX_PAIRS = 2**24
"""Comparisons made in one go."""


def fronts(points: ArrayLike) -> Int[np.ndarray, " n"]:
    """Return each point's Pareto front: 0 if none dominates it, 1 if only front 0 does, ...

    **Arguments:**
    - `points`: `[n, objectives]`, all objectives, to be minimised. Infinite entries are compared
      too.
    **Returns:** the numbers of the fronts; -1 for a point with a NaN, which is ignored.
    **Raises:** `ValueError` for points that are not a matrix.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2:
        raise ValueError(f"points must have shape [n, objectives]; got {list(points.shape)}")
    numbers = np.full(len(points), -1, np.int64)
    indices = np.flatnonzero(~np.isnan(points).any(axis=1))
    # Equal points share a front: the distinct ones are enough, and there are often few.
    distinct, which = np.unique(points[indices], axis=0, return_inverse=True)
    numbers[indices] = _fronts_of_distinct(distinct)[which.ravel()]
    return numbers


def _fronts_of_distinct(points: Float[np.ndarray, "n objectives"]) -> Int[np.ndarray, " n"]:
    """Return the fronts of points that differ and are sorted by their first objective."""
    numbers = np.full(len(points), -1, np.int64)
    left, front = np.arange(len(points)), 0
    while len(left):
        some = points[left]
        dominated = np.zeros(len(left), bool)
        together = max(1, _MAX_PAIRS // max(1, some.size))
        for begin in range(0, len(left), together):
            part = some[begin : begin + together]
            # Distinct points: nowhere worse means somewhere better, but for the point itself.
            lowest = (some[None] <= part[:, None]).all(axis=2).sum(axis=1)
            dominated[begin : begin + together] = lowest > 1
        numbers[left[~dominated]] = front
        left, front = left[dominated], front + 1
    return numbers
