"""Annealing, the bandit and epsilon-greedy on landscapes with a known failure rate.

Uniform sampling needs log(2) / p in the median, p being the share of the cube that fails.
"""

import math
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.search import Cube, Evaluated
from verifai_jax.search.annealing import Annealing
from verifai_jax.search.bandit import Bandit
from verifai_jax.search.epsilon_greedy import EpsilonGreedy

BATCH, ROUNDS, SEEDS = 16, 66, 25
# The choices matter on one landscape only: on the others a search must see that they do not.
SMALL = Cube((0, 0, 0, 0, 4, 3), ordered=(True, True, True, True, False, False))
WIDE = Cube((0,) * 50)
BALL = jnp.array([0.3, 0.62, 0.71, 0.4])
BALL_SHARE = math.pi**2 / 2 * 0.1193**4


def ball(u):
    """A cone whose tip fails."""
    return jnp.linalg.norm(u[:4] - BALL + 1e-9) - 0.1193


def ridge(u):
    """A narrow valley across three dimensions that sinks towards one place."""
    along = jnp.array([1.0, 1.0, 0.5, -0.5]) / math.sqrt(2.5)
    offset = u[:4] - jnp.array([0.75, 0.7, 0.4, 0.5])
    distance = offset @ along
    across = offset - distance * along
    return jnp.sqrt(1e-6 + (distance / 4) ** 2 + across @ across) - 0.082


def saddles(u):
    """Two products, least in four of the sixteen corners."""
    x = 2 * u - 1
    return 1.5 - x[0] * x[1] - x[2] * x[3]


def minima(u):
    """Hundreds of local minima around one place (Rastrigin's function)."""
    x = 5 * (u[:4] - BALL)
    return jnp.sum(x**2 + 3 * (1 - jnp.cos(2 * jnp.pi * x))) - 4.6


def mixed(u):
    """A cone in three dimensions for the right two of twelve combinations of two choices."""
    wrong = 0.3 * (jnp.floor(u[4] * 4) != 2) + 0.3 * (jnp.floor(u[5] * 3) > 1)
    return jnp.linalg.norm(u[:3] - jnp.array([0.3, 0.6, 0.8]) + 1e-9) - 0.112 + wrong


def needle(u):
    """The ball again, but the robustness says nothing outside."""
    return jnp.where(ball(u) < 0, -1.0, 1.0)


def few(u):
    """A cone in five of fifty dimensions."""
    centre = jnp.array([0.3, 0.62, 0.71, 0.4, 0.55])
    return jnp.linalg.norm(u[3::11] - centre + 1e-9) - 0.18


def plane(u):
    """All of fifty dimensions matter alike."""
    return 31.33 - jnp.sum(u)


LANDSCAPES = {  # name: robustness, cube, share that fails
    "ball": (ball, SMALL, BALL_SHARE),
    "ridge": (ridge, SMALL, 9.2e-4),
    "saddles": (saddles, SMALL, 7.9e-4),
    "minima": (minima, SMALL, 1.01e-3),
    "mixed": (mixed, SMALL, 4 / 3 * math.pi * 0.112**3 / 6),
    "needle": (needle, SMALL, BALL_SHARE),
    "few": (few, WIDE, 8 * math.pi**2 / 15 * 0.18**5),
    "plane": (plane, WIDE, 9.3e-4),
}
SEARCHES = {Annealing(): 2.5, Bandit(): 4.0, EpsilonGreedy(): 4.0}


@pytest.mark.parametrize("name", LANDSCAPES)
def test_the_failure_rates_are_as_stated(name):
    rho, cube, share = LANDSCAPES[name]
    u = np.random.default_rng(0).random((2**18, cube.dim), np.float32)
    failures = int(np.sum(jax.jit(jax.vmap(rho))(u) < 0))
    assert abs(failures - share * 2**18) < 5 * math.sqrt(share * 2**18)


@lru_cache
def play(search, cube):
    """Points `[landscapes, seeds, rounds * batch, d]` and their robustness, on all of a cube."""
    names = [name for name, (_, its, _) in LANDSCAPES.items() if its == cube]

    def one(which, key):
        def rho(u):
            return jnp.stack([LANDSCAPES[name][0](u) for name in names])[which]

        def step(state, _):
            u, state = search.ask(state, cube, BATCH)
            value = jax.vmap(rho)(u)
            told = Evaluated(u, value, jnp.ones(BATCH, bool))
            return search.tell(state, cube, told), (u[:, :6], value)

        _, seen = jax.lax.scan(step, search.init(key, cube, BATCH), None, length=ROUNDS)
        return jax.tree.map(lambda leaf: leaf.reshape(ROUNDS * BATCH, *leaf.shape[2:]), seen)

    keys = jax.random.split(jax.random.key(7), SEEDS)
    every = jax.vmap(jax.vmap(one, (None, 0)), (0, None))
    u, value = jax.jit(every)(jnp.arange(len(names)), keys)
    return {n: (np.asarray(u[i]), np.asarray(value[i])) for i, n in enumerate(names)}


def played(search, name):
    return play(search, LANDSCAPES[name][1])[name]


def median_first(search, name):
    """Median simulations to the first failure."""
    failing = played(search, name)[1] < 0
    return np.median(np.where(failing.any(1), failing.argmax(1) + 1.0, np.inf))


EACH = pytest.mark.parametrize("search", SEARCHES, ids=lambda search: type(search).__name__)


@pytest.mark.parametrize("name", [name for name in LANDSCAPES if name != "needle"])
@EACH
def test_beats_uniform(search, name):
    limit = math.log(2) / LANDSCAPES[name][2] / SEARCHES[search]
    assert median_first(search, name) <= limit


@EACH
def test_is_not_much_worse_than_uniform_where_nothing_can_be_learned(search):
    assert median_first(search, "needle") <= 1.5 * math.log(2) / BALL_SHARE


@EACH
def test_goes_on_to_other_failures(search):
    u, value = played(search, "saddles")
    corners = [
        len({tuple(p) for p in np.round(points[rho < 0, :4]).astype(int)})
        for points, rho in zip(u, value, strict=True)
    ]
    assert np.mean(corners) >= 1.6
    # And goes on failing: at random it would be one in a thousand.
    assert np.mean(value[:, value.shape[1] // 2 :] < 0) > 0.08


@EACH
def test_never_stops_exploring(search):
    # Two of sixteen rows or so, to the end: over every seed's and coordinate's whole range.
    u, _ = played(search, "ball")
    late = u[:, -480:, :4]
    assert np.all(late.min(axis=1) < 0.15)
    assert np.all(late.max(axis=1) > 0.85)
    cells = np.asarray(SMALL.cells(u[:, -480:]))
    assert np.all(np.min(np.mean(cells[..., 0, None] == np.arange(4), axis=1), axis=1) > 0.005)
