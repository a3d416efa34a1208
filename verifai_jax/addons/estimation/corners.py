"""Likeliest failures where several limits meet, such as at the corner of a failing region.

    nearest, normals = approach_corner(limit_state, failures)

One gradient describes only one border of a failing region. A descent towards the middle of the
prior slides along this border and stops at the next one. So the tangent planes of the limit state
at all points so far are combined: the next point is the one nearest to the origin that lies inside
all planes.

Sources: Kelley, The cutting-plane method for solving convex programs, Journal of the Society for
Industrial and Applied Mathematics 8 (1960); Lawson and Hanson, Solving Least Squares Problems
(1974), chapter 23, for the least distant point.
"""

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.estimation.normal_space import LimitState, fails_at
from verifai_jax.addons.estimation.paths import halve

PLANES, HALVINGS = 6, 10
"""Planes of a failure, at most, and halvings of the way to the nearest point within them."""
INSIDE = 3e-4
"""Part of its distance from the origin by which a point lies within a plane."""


def approach_corner(
    limit_state: LimitState, z: Float[np.ndarray, "n d"], planes: int = PLANES,
    halvings: int = HALVINGS,
) -> tuple[Float[np.ndarray, "n d"], list[Float[np.ndarray, "_ d"]]]:  # fmt: skip
    """Move failures to nearby ones closest to the origin, using all their tangent planes.

    The path to the closest point that all planes allow is followed as long as it fails; the next
    plane is added where it ends.

    **Arguments:**
    - `limit_state`: a limit state with gradients.
    - `z`: the failures.
    - `planes`: maximum number of planes of a failure.
    - `halvings`: number of bisection steps on each path.
    **Returns:** failures, none farther from the origin than its start, and the unit normals of each
    failure's planes.
    """
    best, beyond, rows = z.copy(), z.copy(), np.arange(len(z))
    touching: list[list[tuple[Float[np.ndarray, " d"], float]]] = [[] for _ in z]
    for _ in range(planes):
        _, rho, gradient = limit_state.linearize(beyond[rows])
        target = best.copy()
        for row, value, slope in zip(rows, rho, gradient, strict=True):
            size = float(np.linalg.norm(slope))
            if size and np.isfinite(value):
                offset = (float(slope @ beyond[row]) - float(value)) / size
                touching[row].append((slope / size, offset))
                within = _nearest(touching[row])
                target[row] = best[row] if within is None else within
        rows = np.flatnonzero(np.sum(target**2, axis=1) < np.sum(best**2, axis=1))
        if not len(rows):
            break
        fails = fails_at(limit_state, target[rows])
        best[rows[fails]] = target[rows[fails]]
        rows = rows[~fails]
        last, beyond[rows] = halve(limit_state, best[rows], target[rows], halvings)
        nearer = np.sum(last**2, axis=1) < np.sum(best[rows] ** 2, axis=1)
        best[rows] = np.where(nearer[:, None], last, best[rows])
    none = np.zeros((0, z.shape[1]))
    return best, [np.array([n for n, _ in own]) if own else none for own in touching]


def cost_of_corner(planes: int = PLANES, halvings: int = HALVINGS) -> int:
    """Return the maximum number of simulations for one failure."""
    return planes * (halvings + 3)


def _nearest(planes: list[tuple[Float[np.ndarray, " d"], float]]) -> Float[np.ndarray, " d"] | None:
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
