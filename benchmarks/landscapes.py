"""Robustness landscapes over the unit cube with a known share of failures, for comparing searches.

Each fails on about one sample in a thousand, so that uniform sampling needs `log(2) / share`,
about 700 simulations, in the median to its first failure.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from verifai_jax.core.values.clauses import CLAUSES
from verifai_jax.core.values.cube import Cube
from verifai_jax.mtl.clauses import ABSENT
from verifai_jax.search import Observations


class Landscape(NamedTuple):
    """Robustness of a point `u[d]`, the cube it lives on, and the share of it that fails."""

    rho: Callable
    cube: Cube
    share: float


def ball(u):
    """A cone whose tip fails: radius 0.1193 in four dimensions."""
    return jnp.linalg.norm(u - jnp.array([0.3, 0.62, 0.71, 0.4]) + 1e-9) - 0.1193


def ridge(u):
    """A narrow valley across three dimensions that sinks towards one place."""
    along = jnp.array([1.0, 1.0, 0.5, -0.5]) / math.sqrt(2.5)
    offset = u - jnp.array([0.75, 0.7, 0.4, 0.5])
    distance = offset @ along
    across = offset - distance * along
    return jnp.sqrt(1e-6 + (distance / 4) ** 2 + across @ across) - 0.082


def saddles(u):
    """Two products, least in four of the sixteen corners."""
    x = 2 * u - 1
    return 1.5 - x[0] * x[1] - x[2] * x[3]


def corner(u):
    """A plane that fails in one corner, a simplex with legs of 0.39."""
    return 4 - 0.39 - jnp.sum(u)


def mixed(u):
    """A cone in three dimensions for the right two of twelve combinations of two choices."""
    wrong = 0.3 * (jnp.floor(u[3] * 4) != 2) + 0.3 * (jnp.floor(u[4] * 3) > 1)
    return jnp.linalg.norm(u[:3] - jnp.array([0.3, 0.6, 0.8]) + 1e-9) - 0.112 + wrong


def ripples(u):
    """A bowl under ripples, 6 to a side: over a thousand local minima, of which some 30 fail."""
    offset = u - jnp.array([0.37, 0.58, 0.66, 0.29])
    waves = jnp.sum(1 - jnp.cos(2 * math.pi * 6 * offset))
    return jnp.sqrt(1e-6 + offset @ offset) + 0.05 * waves - RIPPLES_LEVEL


RIPPLES_LEVEL = 0.266

MATTER = np.array([3, 11, 24, 37, 48])


def few_of_many(u):
    """A ball in 5 of 50 dimensions, the others do not matter."""
    return jnp.linalg.norm(u[MATTER] - jnp.array([0.3, 0.6, 0.7, 0.4, 0.5]) + 1e-9) - 0.1801


def all_of_many(u):
    """The sum of 50 coordinates beyond 3.09 standard deviations from its mean."""
    return 1 + (25 - jnp.sum(u)) / math.sqrt(50 / 12) / 3.09


def needle(u):
    """The ball, and nothing that leads to it: only luck helps."""
    return jnp.where(ball(u) < 0, -1.0, 1.0)


FLAT = Cube((0, 0, 0, 0))
LANDSCAPES = {
    "ball": Landscape(ball, FLAT, math.pi**2 / 2 * 0.1193**4),
    "ridge": Landscape(ridge, FLAT, 8.9e-4),
    "saddles": Landscape(saddles, FLAT, 7.9e-4),
    "corner": Landscape(corner, FLAT, 0.39**4 / 24),
    "mixed": Landscape(
        mixed,
        Cube((0, 0, 0, 4, 3), ordered=(True, True, True, False, False)),
        4 / 3 * math.pi * 0.112**3 / 6,
    ),
    "ripples": Landscape(ripples, FLAT, 1.0e-3),
    "few_of_many": Landscape(few_of_many, Cube((0,) * 50), 8 * math.pi**2 / 15 * 0.1801**5),
    "all_of_many": Landscape(all_of_many, Cube((0,) * 50), 9.1e-4),
    "needle": Landscape(needle, FLAT, math.pi**2 / 2 * 0.1193**4),
}


def tell_of(search, state, cube, u, rho, slope):
    """Return the observations of points of one clause, as far as the search asks for them."""
    observations = Observations(
        u, rho, jnp.ones(len(u), bool), slope if search.wants.gradient else None
    )
    if not search.wants.clauses:
        return observations
    plan = search.plan(state, cube, len(u))
    gradients = jnp.zeros((len(u), CLAUSES, u.shape[1])).at[:, 0].set(slope)
    return observations._replace(
        valid=jnp.arange(len(u)) < plan.rows,
        clauses=jnp.full((len(u), CLAUSES), ABSENT).at[:, 0].set(rho),
        clause_gradients=jnp.where(plan.differentiate, gradients, 0.0),
    )
