"""Least distance programming: the shortest vector that satisfies linear inequalities.

    shortest(np.array([[1.0, 1.0]]), np.array([2.0]))                # [1, 1]: x + y >= 2

Solved by non-negative least squares on the dual problem: Lawson and Hanson, Solving least squares
problems (1974), chapter 23.
"""

import numpy as np
from jaxtyping import Float


def shortest(
    matrix: Float[np.ndarray, "m k"], bound: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " k"] | None:
    """Compute the shortest `z` with `matrix @ z >= bound`.

    **Arguments:**
    - `matrix`: rows of norm one, up to rounding, so that one tolerance fits all of them.
    - `bound`: lower bound of each row.
    **Returns:** the vector; None if the inequalities contradict each other.
    """
    if np.all(bound <= 0):
        return np.zeros(matrix.shape[1])
    size = np.abs(bound).max()
    dual = np.vstack([matrix.T, bound / size])
    right = np.append(np.zeros(matrix.shape[1]), 1.0)
    weights = _nonnegative(dual, right)
    if weights is None:
        return None  # It has not converged.
    residual = dual @ weights - right
    if residual @ residual < 1e-14:
        return None
    return -residual[:-1] / residual[-1] * size


def _nonnegative(
    matrix: Float[np.ndarray, "r m"], right: Float[np.ndarray, " r"]
) -> Float[np.ndarray, " m"] | None:
    """Minimise `|matrix @ x - right|` over `x >= 0`; None if that takes too many steps.

    SciPy has the same, but importing its `optimize` takes longer than a whole shrinking.
    """
    x = np.zeros(matrix.shape[1])
    positive, refused = x > 0, x > 0
    rounding = 1e-13 * np.linalg.norm(matrix) * np.linalg.norm(right)
    for _ in range(3 * len(x)):
        slope = np.where(positive | refused, 0.0, matrix.T @ (right - matrix @ x))
        entering = int(np.argmax(slope))
        if slope[entering] <= rounding:
            return x
        positive[entering] = True
        while True:
            solved = np.zeros(len(x))
            solved[positive] = np.linalg.lstsq(matrix[:, positive], right, rcond=None)[0]
            below = np.flatnonzero(positive & (solved <= 0))
            if not len(below):
                refused[:] = False
                x = solved
                break
            if entering in below and not x[entering]:
                # Rounding alone made its slope positive.
                positive[entering], refused[entering] = False, True
                break
            share = x[below] / (x[below] - solved[below])
            x = np.where(positive, x + share.min() * (solved - x), 0.0)
            x[below[share == share.min()]] = 0.0
            positive &= x > 0
    return None


def shortest_in_box(
    rows: Float[np.ndarray, "m k"], maximum: Float[np.ndarray, " m"], low: Float[np.ndarray, " k"],
    high: Float[np.ndarray, " k"],
) -> Float[np.ndarray, " k"] | None:  # fmt: skip
    """Compute the shortest `z` with `rows @ z <= maximum` and `low <= z <= high`.

    **Arguments:**
    - `rows`, `maximum`: linear inequalities; rows of zeros are left out.
    - `low`, `high`: the box; infinite where it has no end.
    **Returns:** the vector, or None.
    """
    sizes = np.linalg.norm(rows, axis=1)
    rows, maximum, sizes = rows[sizes > 0], maximum[sizes > 0], sizes[sizes > 0]
    identity = np.eye(rows.shape[1])
    bound = np.concatenate([-maximum / sizes, low, -high])
    matrix = np.concatenate([-rows / sizes[:, None], identity, -identity])
    z = shortest(matrix[np.isfinite(bound)], bound[np.isfinite(bound)])
    return None if z is None else np.clip(z, low, high)
