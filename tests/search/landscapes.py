"""Landscapes with a known share of failures, and searches played on them.

Uniform sampling needs log(2) / share simulations in the median.
"""

import math
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.search import Cube, Evaluated

BALL = jnp.array([0.3, 0.62, 0.71, 0.4])
FAR = jnp.array([0.9, 0.1, 0.85, 0.12])


def ball(u):
    """A cone whose tip fails: radius 0.1193 in four dimensions."""
    return jnp.linalg.norm(u - BALL + 1e-9) - 0.1193


def ridge(u):
    """A narrow valley across three dimensions that sinks towards one place."""
    along = jnp.array([1.0, 1.0, 0.5, -0.5]) / math.sqrt(2.5)
    offset = u - jnp.array([0.75, 0.7, 0.4, 0.5])
    distance = offset @ along
    across = offset - distance * along
    return jnp.sqrt(1e-6 + (distance / 4) ** 2 + across @ across) - 0.082


def minima(u):
    """A bowl with about 4^4 local minima, as Rastrigin's."""
    x = u - jnp.array([0.35, 0.6, 0.7, 0.4])
    return jnp.sum(4 * x**2 + 0.3 * (1 - jnp.cos(8 * jnp.pi * x))) - 0.585


def misleading(u):
    """A ball that fails near a corner, while the robustness falls towards another place."""
    inside = jnp.linalg.norm(u - FAR) < 0.13
    return jnp.where(inside, -0.1, 0.2 + jnp.linalg.norm(u - BALL + 1e-9))


def saddles(u):
    """Two products, least in four of the sixteen corners."""
    x = 2 * u - 1
    return 1.5 - x[0] * x[1] - x[2] * x[3]


def mixed(u):
    """A cone in three dimensions for the right two of twelve combinations of two choices."""
    wrong = 0.3 * (jnp.floor(u[3] * 4) != 2) + 0.3 * (jnp.floor(u[4] * 3) > 1)
    return jnp.linalg.norm(u[:3] - jnp.array([0.3, 0.6, 0.8]) + 1e-9) - 0.112 + wrong


def few(u):
    """A cone in five of fifty dimensions."""
    places = u[jnp.array([3, 11, 24, 30, 49])]
    return jnp.linalg.norm(places - jnp.array([0.3, 0.6, 0.7, 0.4, 0.55]) + 1e-9) - 0.181


def plane(u):
    """A sum of fifty coordinates, 3.09 standard deviations above its mean."""
    return 25 + 3.09 * math.sqrt(50 / 12) - jnp.sum(u)


FLAT, WIDE = Cube((0,) * 4), Cube((0,) * 50)
CHOICES = Cube((0, 0, 0, 4, 3), ordered=(True, True, True, False, False))
LANDSCAPES = {  # name: robustness, cube, share that fails
    "ball": (ball, FLAT, math.pi**2 / 2 * 0.1193**4),
    "ridge": (ridge, FLAT, 9.2e-4),
    "minima": (minima, FLAT, 1e-3),
    "saddles": (saddles, FLAT, 7.9e-4),
    "misleading": (misleading, FLAT, 1.38e-3),
    "mixed": (mixed, CHOICES, 4 / 3 * math.pi * 0.112**3 / 6),
    "few": (few, WIDE, 9.6e-4),
    "plane": (plane, WIDE, 9.2e-4),
}


@lru_cache
def play(search, names, batch, rounds, seeds, together=True):
    """Points `[landscapes, seeds, rounds * batch, d]` and their robustness.

    All landscapes, on the same cube, in one program: compiling is what takes time. `together` runs
    them side by side, which is faster unless the search saves time in some rounds.
    """
    landscapes, (cube,) = [LANDSCAPES[n][0] for n in names], {LANDSCAPES[n][1] for n in names}

    def one(case):
        which, key = case

        def step(state, _):
            u, state = search.ask(state, cube, batch)
            value = jax.vmap(lambda u: jnp.stack([rho(u) for rho in landscapes])[which])(u)
            told = Evaluated(u, value, jnp.ones(batch, bool), None)
            return search.tell(state, cube, told), (u, value)

        _, seen = jax.lax.scan(step, search.init(key, cube, batch), None, length=rounds)
        return jax.tree.map(lambda leaf: leaf.reshape(rounds * batch, *leaf.shape[2:]), seen)

    keys = jax.random.split(jax.random.key(11), seeds)
    every = jnp.repeat(jnp.arange(len(names)), seeds), jnp.tile(keys, len(names))
    played = jax.vmap(one) if together else lambda cases: jax.lax.map(one, cases)
    seen = jax.jit(played)(every)
    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, seeds, *leaf.shape[1:]), seen)


def gain(name, value):
    """How many times fewer simulations than uniform sampling until the first failure, in medians.

    `value` holds the robustness `[seeds, simulations]`.
    """
    failing = value < 0
    first = np.where(failing.any(1), failing.argmax(1) + 1.0, np.inf)
    return math.log(2) / LANDSCAPES[name][2] / np.median(first)
