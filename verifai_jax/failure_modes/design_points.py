"""Likeliest failures where several limits meet, such as at the corner of a failing region.

    nearest = approach_corner(limit_state, failures)

One gradient says how a failing region ends in one direction. A step by it towards the middle of the
prior stops at the first limit, and slides along it only as far as the next one. So the planes that
touch the limit state at all points so far count together: the next point is the one nearest to the
origin within all of them.

Sources: Kelley, The cutting-plane method for solving convex programs, Journal of the Society for
Industrial and Applied Mathematics 8 (1960); Lawson and Hanson, Solving Least Squares Problems
(1974), chapter 23, for the least distant point.
"""

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.estimation.normal_space import LimitState, scores_of

PLANES = 6
"""Planes of a failure, at most."""
HALVINGS = 10
"""Halvings of the way to the nearest point within the planes."""
MOST_OF_CORNER = PLANES * (HALVINGS + 3)
"""Simulations that a failure takes, at most."""
INSIDE = 3e-4
"""Part of its distance from the origin by which a point lies within a plane."""


def approach_corner(
    limit_state: LimitState, z: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "n d"]:
    """Move failures to the least distant ones near them, by all their tangent planes together.

    The way to the point that all planes allow is followed as far as it fails. What ends it there is
    the next plane.

    **Arguments:**

    - `limit_state`: one with gradients.
    - `z`: failures.

    **Returns:** failures, none farther from the origin than its start.
    """
    best, beyond, rows = z.copy(), z.copy(), np.arange(len(z))
    planes: list[list[tuple[Float[np.ndarray, " d"], float]]] = [[] for _ in z]
    for _ in range(PLANES):
        _, rho, gradient = limit_state.linearize(beyond[rows])
        target = best.copy()
        for row, value, slope in zip(rows, rho, gradient, strict=True):
            size = float(np.linalg.norm(slope))
            if size and np.isfinite(value):
                offset = (float(slope @ beyond[row]) - float(value)) / size
                planes[row].append((slope / size, offset))
                within = _least_distant(planes[row])
                target[row] = best[row] if within is None else within
        rows = np.flatnonzero(np.sum(target**2, axis=1) < np.sum(best**2, axis=1))
        if not len(rows):
            break
        fails, low, high = _last_failing(limit_state, best[rows], target[rows])
        best[rows], beyond[rows] = low, high
        rows = rows[~fails]
    return best


def _last_failing(
    limit_state: LimitState, begin: Float[np.ndarray, "n d"], end: Float[np.ndarray, "n d"]
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
    """Follow ways from failures, and return which fail at their end, and the points about the last.

    **Returns:** which ways fail at their end; the last failure found, nearer to the origin than the
    beginning; and a point just beyond it.
    """
    low = np.zeros(len(begin))
    fails = scores_of(limit_state, end) == -np.inf
    low[fails], high = 1.0, np.ones(len(begin))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        open_ones = np.flatnonzero(~fails)
        points = begin + middle[:, None] * (end - begin)
        inside = np.zeros(len(begin), bool)
        inside[open_ones] = scores_of(limit_state, points[open_ones]) == -np.inf
        low, high = np.where(inside, middle, low), np.where(inside | fails, high, middle)
    last, first = (begin + share[:, None] * (end - begin) for share in (low, high))
    nearer = np.sum(last**2, axis=1) < np.sum(begin**2, axis=1)
    return fails, np.where(nearer[:, None], last, begin), first


def _least_distant(
    planes: list[tuple[Float[np.ndarray, " d"], float]],
) -> Float[np.ndarray, " d"] | None:
    """Return the point nearest to the origin on the inner side of all planes; None without one."""
    from scipy.optimize import nnls

    inward = -np.stack([normal for normal, _ in planes])
    depth = -np.array([offset for _, offset in planes])
    depth = depth + INSIDE * np.abs(depth)
    table = np.vstack([inward.T, depth])
    wanted = np.append(np.zeros(inward.shape[1]), 1.0)
    weight, _ = nnls(table, wanted)
    left = table @ weight - wanted
    if abs(left[-1]) < 1e-9:
        return None
    return -left[:-1] / left[-1]
