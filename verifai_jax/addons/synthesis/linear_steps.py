"""Steps of parameters that are the best ones for linear models of the robustness.

    max_min_step(theta, rho, gradients, radius=0.1, free=free, bounded=True)      # linear program
    smallest_change(theta, nominal, rho, gradients, 0.2, free=free, bounded=True)

The caller checks a step by simulation.
"""

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.statistics.shortest_vector import shortest_in_box


def max_min_step(
    theta: Float[np.ndarray, " p"],
    rho: Float[np.ndarray, " n"],
    gradients: Float[np.ndarray, "n p"],
    radius: float,
    *,
    free: Bool[np.ndarray, " p"],
    bounded: bool,
) -> Float[np.ndarray, " p"]:
    """Compute the step within `radius` a coordinate that maximises `min(rho + gradients @ step)`.

    **Arguments:**
    - `theta`: the present parameters.
    - `rho`, `gradients`: robustness in each environment at `theta`, and its derivatives.
    - `radius`: maximum change of a coordinate.
    - `free`: coordinates that may move.
    - `bounded`: whether they stay in the unit cube.
    **Returns:** the step; zero if there is no improvement, or the solver finds none.
    """
    step = np.zeros_like(theta)
    indices = np.flatnonzero(free & np.any(gradients != 0, axis=0))
    rows = np.flatnonzero(np.isfinite(rho))
    if not len(indices) or not len(rows):
        return step
    low, high = np.full(len(indices), -radius), np.full(len(indices), radius)
    if bounded:
        low, high = np.maximum(low, -theta[indices]), np.minimum(high, 1 - theta[indices])
    linear = gradients[np.ix_(rows, indices)]
    if len(rows) == 1:
        step[indices] = np.where(linear[0] > 0, high, np.where(linear[0] < 0, low, 0.0))
        return step
    from scipy.optimize import linprog

    # In units of the radius and of the largest derivative, which a solver's tolerances suit.
    scale = np.abs(linear).max() * radius
    lowest = rho[rows].min()
    solution = linprog(
        np.append(np.zeros(len(indices)), -1.0),
        A_ub=np.hstack([-linear * radius / scale, np.ones((len(rows), 1))]),
        b_ub=(rho[rows] - lowest) / scale,
        bounds=[*zip(low / radius, high / radius, strict=True), (None, None)],
    )
    if solution.status == 0:
        step[indices] = np.clip(solution.x[:-1] * radius, low, high)
    return step


def smallest_change(
    theta: Float[np.ndarray, " p"],
    nominal: Float[np.ndarray, " p"],
    rho: Float[np.ndarray, " n"],
    gradients: Float[np.ndarray, "n p"],
    target: float,
    *,
    free: Bool[np.ndarray, " p"],
    bounded: bool,
) -> Float[np.ndarray, " p"] | None:
    """Compute the step to the point nearest to `nominal` with `rho + gradients @ step >= target`.

    **Arguments:** those of `max_min_step`, and
    - `nominal`: parameters to stay close to.
    - `target`: robustness to reach in every environment.
    **Returns:** the step; None if the linear model has no such point.
    """
    indices = np.flatnonzero(free)
    rows = np.flatnonzero(np.isfinite(rho))
    linear = gradients[np.ix_(rows, indices)]
    gap = (theta - nominal)[indices]
    # With z = theta + step - nominal: linear @ z >= bound.
    bound = target - rho[rows] + linear @ gap
    if np.any((np.linalg.norm(linear, axis=1) == 0) & (bound > 0)):
        return None
    unit = np.array([[0.0], [1.0]]) if bounded else np.array([[-np.inf], [np.inf]])
    z = shortest_in_box(-linear, -bound, *(unit - nominal[indices]))
    if z is None:
        return None
    step = np.zeros_like(theta)
    step[indices] = z - gap
    return step
