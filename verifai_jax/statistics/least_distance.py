"""The next parameters, from robustness and its slopes in several environments: two small problems.

`uphill` raises the least of the linearised robustnesses as far as a box allows (a linear program);
`least_change` is the point nearest to the nominal parameters at which all of them reach a target (a
quadratic one). Both are exact for their linear model; who takes the step checks it by simulation.
"""

import numpy as np
from jaxtyping import Bool, Float


def uphill(
    theta: Float[np.ndarray, " p"],
    rho: Float[np.ndarray, " n"],
    slopes: Float[np.ndarray, "n p"],
    radius: float,
    *,
    free: Bool[np.ndarray, " p"],
    bounded: bool,
) -> Float[np.ndarray, " p"]:
    """The step within `radius` a coordinate that raises `min(rho + slopes @ step)` most.

    - `free`: coordinates that may move; `bounded`: whether they stay in the unit cube.
    """
    step = np.zeros_like(theta)
    places = np.flatnonzero(free & np.any(slopes != 0, axis=0))
    rows = np.flatnonzero(np.isfinite(rho))
    if not len(places) or not len(rows):
        return step
    low, high = np.full(len(places), -radius), np.full(len(places), radius)
    if bounded:
        low, high = np.maximum(low, -theta[places]), np.minimum(high, 1 - theta[places])
    linear = slopes[np.ix_(rows, places)]
    if len(rows) == 1:
        step[places] = np.where(linear[0] > 0, high, np.where(linear[0] < 0, low, 0.0))
        return step
    from scipy.optimize import linprog

    # In units of the radius and of the largest slope, which a solver's tolerances are made for.
    scale = np.abs(linear).max() * radius
    least = rho[rows].min()
    found = linprog(
        np.append(np.zeros(len(places)), -1.0),
        A_ub=np.hstack([-linear * radius / scale, np.ones((len(rows), 1))]),
        b_ub=(rho[rows] - least) / scale,
        bounds=[*zip(low / radius, high / radius, strict=True), (None, None)],
    )
    if found.status == 0:
        step[places] = np.clip(found.x[:-1] * radius, low, high)
    return step


def least_change(
    theta: Float[np.ndarray, " p"],
    nominal: Float[np.ndarray, " p"],
    rho: Float[np.ndarray, " n"],
    slopes: Float[np.ndarray, "n p"],
    target: float,
    *,
    free: Bool[np.ndarray, " p"],
    bounded: bool,
) -> Float[np.ndarray, " p"] | None:
    """The step to the point nearest to `nominal` with `rho + slopes @ step >= target`.

    None where the linear model has no such point. Least distance programming by non-negative least
    squares: Lawson and Hanson, Solving least squares problems (1974), chapter 23.
    """
    places = np.flatnonzero(free)
    rows = np.flatnonzero(np.isfinite(rho))
    linear = slopes[np.ix_(rows, places)]
    gap = (theta - nominal)[places]
    # With z = theta + step - nominal: linear @ z >= bound.
    bound = target - rho[rows] + linear @ gap
    sizes = np.linalg.norm(linear, axis=1)
    if np.any((sizes == 0) & (bound > 0)):
        return None
    moved = sizes > 0
    matrix, bound = linear[moved] / sizes[moved, None], bound[moved] / sizes[moved]
    if bounded:
        identity = np.eye(len(places))
        matrix = np.vstack([matrix, identity, -identity])
        bound = np.concatenate([bound, -nominal[places], nominal[places] - 1])
    step = np.zeros_like(theta)
    if np.all(bound <= 0):
        step[places] = -gap
        return step
    from scipy.optimize import nnls

    size = np.abs(bound).max()
    right = np.append(np.zeros(len(places)), 1.0)
    try:
        weights, _ = nnls(np.vstack([matrix.T, bound / size]), right)
    except RuntimeError:
        return None  # It has not converged.
    residual = np.vstack([matrix.T, bound / size]) @ weights - right
    if residual @ residual < 1e-14:
        return None
    step[places] = -residual[:-1] / residual[-1] * size - gap
    return step
