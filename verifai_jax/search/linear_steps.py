"""Steps that minimise linear clauses: inside a box, or to the other end of one coordinate."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from verifai_jax.core.values.clauses import CLAUSES
from verifai_jax.search.clause_values import NOTHING

HALVINGS = 24
"""Halvings of the interval that holds the weight at which two clauses are equal: as many as a
float32 has bits, so that more would change nothing."""


def minimax_direction(
    clauses: Float[Array, " clauses"],
    gradients: Float[Array, "clauses d"],
    point: Float[Array, " d"],
    radius: Float[Array, ""],
    free: Bool[np.ndarray, " d"],
    halvings: Int[Array, ""],
) -> Float[Array, " d"]:
    """Minimise the maximum of linear clauses over a box.

    The result is exact for two clauses. For more it is the best of all points that minimise one
    clause or lie where two are equal, or a point on the way there if they are worse than the start.
    """
    low, high = jnp.maximum(point - radius, 0.0), jnp.minimum(point + radius, 1.0)

    def corner(gradient: Float[Array, "*m d"]) -> Float[Array, "*m d"]:
        target = jnp.where(gradient > 0, low, jnp.where(gradient < 0, high, point))
        return jnp.where(free, target, point)

    def linear(points: Float[Array, "*m d"]) -> Float[Array, "*m clauses"]:
        return clauses + (points - point) @ gradients.T

    pairs = np.array(list(combinations(range(CLAUSES), 2)))
    one, two = gradients[pairs[:, 0]], gradients[pairs[:, 1]]
    apart, turned = clauses[pairs[:, 0]] - clauses[pairs[:, 1]], one - two

    def gap(points: Float[Array, "m d"]) -> Float[Array, " m"]:
        return apart + jnp.sum((points - point) * turned, axis=1)

    def halve(_: Int[Array, ""], weights: tuple[Array, Array]) -> tuple[Array, Array]:
        # At the lower weight on the first clause it is the greater one, at the upper the second.
        lower, upper = weights
        middle = (lower + upper) / 2
        above = gap(corner(middle[:, None] * one + (1 - middle)[:, None] * two)) > 0
        return jnp.where(above, middle, lower), jnp.where(above, upper, middle)

    zero = jnp.zeros(len(pairs), jnp.float32)
    lower, upper = jax.lax.fori_loop(0, halvings, halve, (zero, zero + 1))
    a, b = (corner(w[:, None] * one + (1 - w)[:, None] * two) for w in (lower, upper))
    above, below = jnp.maximum(gap(a), 0.0), jnp.maximum(-gap(b), 0.0)
    share = jnp.where(above + below > 0, below / (above + below), 0.5)[:, None]
    candidates = jnp.concatenate([corner(gradients), share * a + (1 - share) * b])
    greatest = jnp.max(linear(candidates), axis=1)
    # Of clauses that do not exist, and of equally good points the first: a corner.
    there = clauses > NOTHING
    usable = jnp.concatenate([there, there[pairs[:, 0]] & there[pairs[:, 1]]])
    greatest = jnp.where(usable, greatest, jnp.inf)
    # Three clauses can be higher at all of these points; the greatest of them is convex.
    parts = point + np.array([0.5, 0.25, 0.0])[:, None, None] * (candidates - point)
    partly = jnp.where(usable, jnp.max(linear(parts), axis=2), jnp.inf).ravel()
    whole = jnp.min(greatest) <= jnp.max(clauses)
    nearer = parts.reshape(-1, len(point))[jnp.argmin(partly)]
    return jnp.where(whole, candidates[jnp.argmin(greatest)], nearer)


def flip_weakest(
    clauses: Float[Array, " clauses"], gradients: Float[Array, "clauses d"],
    point: Float[Array, " d"], number: Int[Array, ""], free: Bool[np.ndarray, " d"],
) -> Float[Array, " d"]:  # fmt: skip
    """Move the coordinate with the `number`-th weakest effect to the other end of its range."""
    steep = jnp.abs(gradients[jnp.argmax(clauses)])
    # Coordinates without a derivative come last: they seem to have no effect.
    order = jnp.argsort(jnp.where((steep > 0) & free, steep, jnp.inf))
    chosen = order[jnp.minimum(number, len(point) - 1)]
    other = jnp.where(point[chosen] > 0.5, 0.0, 1.0)
    return point.at[chosen].set(other)
