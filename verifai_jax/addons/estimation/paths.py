"""Paths of failures: whether two failing points belong to one failing region, and where one ends.

    connected(limit_state, a, b)                    # [n], for points a [n, d] and b [n, d]
    last, beyond = halve(limit_state, a, b, 10)     # about the end of the failures on the way to b

Two paths are tried: the straight line, which stays inside a convex region, and an arc about the
origin between the distances of its ends, which follows a region around the prior.
"""

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.estimation.normal_space import LimitState, fails_at

FRACTIONS = np.array([0.5, 0.25, 0.75, 0.1, 0.9])
"""Fractions of a path at which it is simulated, the middle first."""
OUTWARD = 1.02
"""Factor on the distances of an arc, so that one along a boundary lies inside."""
COST_OF_PATHS = 2 * len(FRACTIONS)
"""Simulations for a pair of points, at most."""


def connected(
    limit_state: LimitState, a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "n d"]
) -> Bool[np.ndarray, " n"]:
    """Return for each pair of failing points whether one of two paths between them fails.

    **Raises:** `Ended` when the time is over.
    """
    joined = np.zeros(len(a), bool)
    for path in (straight, arc):
        rows = np.flatnonzero(~joined)
        for fraction in FRACTIONS:
            if not len(rows):
                break
            fails = fails_at(limit_state, path(a[rows], b[rows], fraction))
            rows = rows[fails]
        joined[rows] = True
    return joined


def halve(
    limit_state: LimitState, begin: Float[np.ndarray, "n d"], end: Float[np.ndarray, "n d"],
    halvings: int,
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:  # fmt: skip
    """Bisect straight lines to find how far they fail.

    **Arguments:**
    - `begin`: failures.
    - `end`: points that are assumed not to fail; they are not simulated.
    **Returns:** the last failure found on each line, and a point just beyond it.
    **Raises:** `Ended` when the time is over.
    """
    low, high = np.zeros((len(begin), 1)), np.ones((len(begin), 1))
    for _ in range(halvings):
        middle = (low + high) / 2
        fails = fails_at(limit_state, straight(begin, end, middle))[:, None]
        low, high = np.where(fails, middle, low), np.where(fails, high, middle)
    return straight(begin, end, low), straight(begin, end, high)


def straight(
    a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "n d"],
    fraction: float | Float[np.ndarray, "n 1"],
) -> Float[np.ndarray, "n d"]:  # fmt: skip
    """Return points on straight lines."""
    return (1 - fraction) * a + fraction * b


def arc(
    a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "n d"], fraction: float
) -> Float[np.ndarray, "n d"]:
    """Return points on arcs, along which angle and distance from the origin change linearly."""
    far_a = np.linalg.norm(a, axis=1, keepdims=True)
    far_b = np.linalg.norm(b, axis=1, keepdims=True)
    one, other = a / np.maximum(far_a, 1e-12), b / np.maximum(far_b, 1e-12)
    angle = np.arccos(np.clip(np.sum(one * other, axis=1, keepdims=True), -1 + 1e-9, 1 - 1e-9))
    turned = np.sin((1 - fraction) * angle) * one + np.sin(fraction * angle) * other
    return OUTWARD * ((1 - fraction) * far_a + fraction * far_b) * turned / np.sin(angle)
