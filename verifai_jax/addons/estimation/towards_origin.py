"""Moves of failures towards the origin of normal space, the middle of the prior.

    z = come_in(limit_state, z)                     # straight, as far as that fails
    z = approach_origin(limit_state, z)             # along the limit state, by its gradients
    z = come_in_by_parts(limit_state, rng, z)       # in some coordinates only
    z, deciding = redraw_by_parts(limit_state, rng, z)

A failure often depends on a few coordinates only. The third method sets all other coordinates to
zero, so that failures of one region become similar in any number of dimensions.

Sources: Rackwitz and Fiessler, Structural reliability under combined random load sequences,
Computers and Structures 9 (1978), for the steps to the least distant failure; Zeller and
Hildebrandt, Simplifying and isolating failure-inducing input, IEEE Transactions on Software
Engineering 28 (2002), for the order of the parts.
"""

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.estimation.normal_space import LimitState, fails_at, scores_of
from verifai_jax.addons.estimation.paths import halve

HALVINGS = 5
"""Halvings of the way in towards the origin."""
BEYOND = 0.05
"""Share of the way to the limit state that a step with gradients goes beyond it."""
NEAREST_STEPS = 6
"""Steps to the least distant failure, at most, where there are gradients."""
SHORTEST = 0.05
"""Part of a step to the least distant failure below which no further one is tried."""


def come_in(limit_state: LimitState, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Halve the points' distances to the origin as long as they still fail."""
    return halve(limit_state, z, np.zeros_like(z), HALVINGS)[0]


def approach_origin(
    limit_state: LimitState, z: Float[np.ndarray, "n d"], steps: int = NEAREST_STEPS
) -> Float[np.ndarray, "n d"]:
    """Move failures to nearby ones closest to the origin, using the gradient.

    A step goes towards the point nearest to the origin at which the linearised robustness is just
    below zero (Rackwitz and Fiessler, 1978). If the simulation there does not fail, because the
    limit state is curved, a Newton step leads back to it. If the new point is no nearer, the next
    step is half as long, until steps are too short.

    **Returns:** failures `[n, d]`, none farther from the origin than its start.
    """
    best = z.copy()
    share = np.ones(len(z))
    for _ in range(steps):
        rows = np.flatnonzero(share > SHORTEST)
        if not len(rows):
            break
        here = best[rows]
        _, rho, gradient = limit_state.linearize(here)
        square = np.sum(gradient * gradient, axis=1)
        usable = np.isfinite(rho) & (square > 0)
        normal = gradient / np.where(usable, square, 1.0)[:, None]
        inner = np.sum(gradient * here, axis=1) - np.where(usable, rho, 0.0)
        target = inner[:, None] * normal * (1 + 1e-3)
        moved = np.where(usable[:, None], here + share[rows, None] * (target - here), here)
        score = scores_of(limit_state, moved)
        safe = np.flatnonzero(usable & (score > -np.inf) & np.isfinite(score))
        moved[safe] -= (1 + BEYOND) * score[safe, None] * normal[safe]
        score[safe] = scores_of(limit_state, moved[safe])
        closer = (score == -np.inf) & (np.sum(moved**2, axis=1) < np.sum(here**2, axis=1))
        best[rows] = np.where(closer[:, None], moved, here)
        share[rows] = np.where(closer, np.minimum(1.0, 1.5 * share[rows]), share[rows] / 2)
    return best


def come_in_by_parts(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "n d"]:
    """Set groups of coordinates to zero, the middle of the prior, while the points still fail."""
    return _replace_by_parts(limit_state, rng, z, np.zeros_like(z), z != 0)[0]


def redraw_by_parts(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "n d"]
) -> tuple[Float[np.ndarray, "n d"], Bool[np.ndarray, "n d"]]:
    """Redraw coordinates that are zero from the prior, as long as the points still fail.

    **Returns:** the failures `[n, d]`, and the deciding coordinates: those that were not redrawn.
    """
    return _replace_by_parts(limit_state, rng, z, rng.standard_normal(z.shape), z == 0)


def _replace_by_parts(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "n d"],
    values: Float[np.ndarray, "n d"], among: Bool[np.ndarray, "n d"],
) -> tuple[Float[np.ndarray, "n d"], Bool[np.ndarray, "n d"]]:  # fmt: skip
    """Replace parts of the coordinates of failures by other values, as far as they still fail.

    Halves are tried first, then quarters, and so on down to single coordinates; where no quarter
    can be replaced, no more is tried.

    **Returns:** the failures `[n, d]`, and the coordinates that have kept their value.
    """
    z, kept, d = z.copy(), np.ones(z.shape, bool), z.shape[1]
    # The position of each coordinate in the row of those that are tried; the others come last.
    index = np.argsort(np.argsort(np.where(among, rng.random(z.shape), 2.0), axis=1), axis=1)
    count = among.sum(axis=1)
    begin, size, quarter = np.zeros(len(z), int), (count + 1) // 2, (count + 3) // 4
    active = count > 0
    while active.any():
        rows = np.flatnonzero(active)
        end = np.minimum(begin[rows] + size[rows], count[rows])[:, None]
        part = (index[rows] >= begin[rows, None]) & (index[rows] < end)
        moved = np.where(part, values[rows], z[rows])
        fails = fails_at(limit_state, moved)
        # Another region may fail there too: in the same one the middle of the way fails as well.
        tried = np.flatnonzero(fails)
        middle = (moved[tried] + z[rows[tried]]) / 2
        fails[tried] = fails_at(limit_state, middle)
        z[rows] = np.where(fails[:, None], moved, z[rows])
        kept[rows] &= ~(part & fails[:, None])
        begin[rows] += size[rows]
        for row in rows[begin[rows] >= count[rows]]:
            # The parts of what is left are half as large.
            left = among[row] & kept[row]
            fruitless = size[row] <= quarter[row] and np.array_equal(left, among[row])
            active[row] = left.any() and size[row] > 1 and not fruitless
            index[row] = np.argsort(np.argsort(np.where(left, index[row], d)))
            begin[row], size[row], count[row] = 0, (size[row] + 1) // 2, np.sum(left)
    return z, kept
