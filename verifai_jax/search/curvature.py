"""Quasi-Newton steps inside the cube, for many simultaneous descents.

    state = begin(descents, dim)
    state, points = advance(state, points, value, slope, fresh, radius)

Each descent keeps the last differences of its points and of its slopes, and takes the step of
L-BFGS (Nocedal, Wright, Numerical Optimization, 2006, algorithm 7.4) from its best point. A trust
region limits the step; it shrinks after a step without improvement and grows after an improvement
at its edge (ibid., algorithm 4.1). Coordinates at a face of the cube that the slope presses against
rest there (projected Newton: Bertsekas, SIAM Journal on Control and Optimization 20, 1982). A step
without improvement still updates the curvature.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

PAIRS = 8
"""Remembered differences of a descent: Nocedal and Wright recommend 3 to 20."""
SHRINKS, GROWS = 0.25, 2.0
"""Factors on the trust region after a step that was no better, and after one to its edge that was:
those of algorithm 4.1."""
ENOUGH = 1e-4
"""Share of what the slope promises that a step has to bring, as usual in Armijo's rule."""
BENT = 1e-6
"""Cosine between a step and the difference of the slopes below which the two say nothing: float32
has seven digits."""


class Curvature(NamedTuple):
    point: Float[Array, "n d"]  # the best of each descent, from which it steps
    value: Float[Array, " n"]
    slope: Float[Array, "n d"]
    steps: Float[Array, "n pairs d"]  # differences of points, the latest first; zero for none
    turns: Float[Array, "n pairs d"]  # and of their slopes
    radius: Float[Array, " n"]  # of the trust region, in every coordinate


def begin(descents: int, dim: int) -> Curvature:
    """Return the state before the first descent."""
    pairs = jnp.zeros((descents, PAIRS, dim), jnp.float32)
    return Curvature(
        point=jnp.full((descents, dim), 0.5, jnp.float32),
        value=jnp.full(descents, jnp.inf, jnp.float32),
        slope=jnp.zeros((descents, dim), jnp.float32),
        steps=pairs,
        turns=pairs,
        radius=jnp.zeros(descents, jnp.float32),
    )


def advance(
    state: Curvature, point: Float[Array, "n d"], value: Float[Array, " n"],
    slope: Float[Array, "n d"], fresh: Bool[Array, " n"], radius: Float[Array, " n"],
) -> tuple[Curvature, Float[Array, "n d"]]:  # fmt: skip
    """Learn from one point of each descent, and return the next point.

    **Arguments:**
    - `point`, `value`, `slope`: the last proposal and its result; all finite.
    - `fresh`: descents that start at their point.
    - `radius`: trust regions of these descents.
    """
    step, turn = point - state.point, slope - state.slope
    bent = jnp.sum(step * turn, axis=1)
    size = jnp.linalg.norm(step, axis=1) * jnp.linalg.norm(turn, axis=1)
    kept = (~fresh & (bent > BENT * size))[:, None, None]
    promised = jnp.sum(state.slope * step, axis=1)
    better = fresh | (value < state.value + ENOUGH * jnp.minimum(promised, 0.0))
    longest = jnp.max(jnp.abs(step), axis=1, initial=0.0)
    grown = jnp.where(longest > 0.9 * state.radius, GROWS * state.radius, state.radius)
    trusted = jnp.where(better, jnp.minimum(grown, 1.0), SHRINKS * longest)

    def pairs(new: Float[Array, "n d"], old: Float[Array, "n pairs d"]) -> Array:
        old = jnp.where(fresh[:, None, None], 0.0, old)
        return jnp.where(kept, jnp.concatenate([new[:, None], old[:, :-1]], axis=1), old)

    state = Curvature(
        point=jnp.where(better[:, None], point, state.point),
        value=jnp.where(better, value, state.value),
        slope=jnp.where(better[:, None], slope, state.slope),
        steps=pairs(step, state.steps),
        turns=pairs(turn, state.turns),
        radius=jnp.where(fresh, radius, trusted).astype(jnp.float32),
    )
    return state, jax.vmap(_next)(state)


def _next(state: Curvature) -> Float[Array, " d"]:
    """Return the next point of one descent."""
    point, slope = state.point, state.slope
    rests = (point <= 0) & (slope > 0) | (point >= 1) & (slope < 0)
    free = ~rests & (slope != 0)
    direction = -_inverse_hessian_times(
        jnp.where(free, slope, 0.0),
        jnp.where(free, state.steps, 0.0),
        jnp.where(free, state.turns, 0.0),
        state.radius,
    )
    longest = jnp.max(jnp.abs(direction), initial=0.0)
    scale = jnp.minimum(1.0, state.radius / jnp.maximum(longest, 1e-30))
    return jnp.clip(point + scale * direction, 0.0, 1.0)


def _inverse_hessian_times(
    vector: Float[Array, " d"], steps: Float[Array, "pairs d"], turns: Float[Array, "pairs d"],
    radius: Float[Array, ""],
) -> Float[Array, " d"]:  # fmt: skip
    """Return an approximate inverse Hessian times a vector, by the two loops of L-BFGS.

    Without a pair it is the vector as long as the trust region, in its greatest coordinate.
    """
    bent = jnp.sum(steps * turns, axis=1)
    there = bent > 0
    inverse = jnp.where(there, 1 / jnp.where(there, bent, 1.0), 0.0)
    shares = []
    for i in range(PAIRS):  # From the latest to the first one, and back.
        shares.append(inverse[i] * jnp.dot(steps[i], vector))
        vector = vector - shares[i] * turns[i]
    newest = jnp.argmax(there)
    square = jnp.sum(turns[newest] ** 2)
    longest = jnp.max(jnp.abs(vector), initial=0.0)
    plain = radius / jnp.maximum(longest, 1e-30)
    scale = jnp.where(jnp.any(there), bent[newest] / jnp.maximum(square, 1e-30), plain)
    vector = scale * vector
    for i in reversed(range(PAIRS)):
        vector = vector + (shares[i] - inverse[i] * jnp.dot(turns[i], vector)) * steps[i]
    return vector
