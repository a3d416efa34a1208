"""How many simulations the active searches need on landscapes with a known failure rate.

Uniform sampling needs log(2) / p in the median, p being the share of the cube that fails.
"""

import math
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.landscapes import LANDSCAPES as ALL
from verifai_jax.search import CrossEntropy, Evaluated, Gradient

BATCH, ROUNDS, SEEDS = 16, 60, 25
NAMES = ("ball", "ridge", "saddles", "corner", "mixed")
LANDSCAPES = {name: ALL[name] for name in NAMES}
FLAT = LANDSCAPES["ball"].cube


@lru_cache
def play(search, landscapes, cube, batch=BATCH, rounds=ROUNDS, seeds=SEEDS):
    """Points `[landscapes, seeds, rounds * batch, d]` and their robustness.

    All landscapes in one program, which several tests share: compiling is what takes time.
    """

    def one(which, key):
        def rho(u):
            return jnp.stack([landscape(u) for landscape in landscapes])[which]

        def step(state, _):
            u, state = search.ask(state, cube, batch)
            value = jax.vmap(rho)(u)
            gradient = jax.vmap(jax.grad(rho))(u) if search.wants_gradient else None
            told = Evaluated(u, value, jnp.ones(batch, bool), gradient)
            return search.tell(state, cube, told), (u, value)

        _, seen = jax.lax.scan(step, search.init(key, cube, batch), None, length=rounds)
        return jax.tree.map(lambda leaf: leaf.reshape(rounds * batch, *leaf.shape[2:]), seen)

    keys = jax.random.split(jax.random.key(11), seeds)
    every = jax.vmap(jax.vmap(one, (None, 0)), (0, None))
    u, value = jax.jit(every)(jnp.arange(len(landscapes)), keys)
    return np.asarray(u), np.asarray(value)


@pytest.mark.parametrize("name", ALL)
def test_the_failure_rates_are_as_stated(name):
    rho, cube, share = ALL[name]
    u = np.random.default_rng(0).random((2**18, cube.dim), np.float32)
    failures = int(np.sum(jax.jit(jax.vmap(rho))(u) < 0))
    assert abs(failures - share * 2**18) < 5 * math.sqrt(share * 2**18)


GROUPS = {  # cube: names of its landscapes
    cube: tuple(name for name, (_, its, _) in LANDSCAPES.items() if its == cube)
    for cube in {cube for _, cube, _ in LANDSCAPES.values()}
}
BOTH = pytest.mark.parametrize(
    "search", [CrossEntropy(), Gradient()], ids=["cross_entropy", "gradient"]
)
FACTOR = {CrossEntropy(): 6, Gradient(): 8}


def played(search, name):
    """Points and robustness `[seeds, simulations]` of a search on a landscape."""
    cube = LANDSCAPES[name][1]
    u, value = play(search, tuple(LANDSCAPES[n][0] for n in GROUPS[cube]), cube)
    place = GROUPS[cube].index(name)
    return u[place], value[place]


@pytest.mark.parametrize("name", LANDSCAPES)
@BOTH
def test_beats_uniform(search, name):
    failing = played(search, name)[1] < 0
    first = np.where(failing.any(1), failing.argmax(1) + 1.0, np.inf)
    assert np.median(first) <= math.log(2) / LANDSCAPES[name][2] / FACTOR[search]


@BOTH
def test_goes_on_to_other_failures(search):
    u, value = played(search, "saddles")
    corners = [
        len({tuple(p) for p in np.round(points[rho < 0]).astype(int)})
        for points, rho in zip(u, value, strict=True)
    ]
    assert min(corners) >= 2
    assert np.mean(corners) >= 3
    # And goes on failing: at random it would be one in a thousand.
    assert np.all(np.mean(value[:, value.shape[1] // 2 :] < 0, axis=1) > 0.03)


def test_cross_entropy_never_stops_exploring():
    # Two of sixteen rows, to the end: over every seed's and coordinate's whole range.
    u, _ = played(CrossEntropy(), "corner")
    late = u[:, -480:].reshape(SEEDS, 30, BATCH, 4)[:, :, -2:].reshape(SEEDS, 60, 4)
    assert np.all(late.min(axis=1) < 0.1)
    assert np.all(late.max(axis=1) > 0.9)
    assert np.all(np.abs(late.mean(axis=1) - 0.5) < 0.1)


def test_cross_entropy_learns_in_large_batches_too():
    _, (value,) = play(
        CrossEntropy(), (LANDSCAPES["ball"].rho,), FLAT, batch=512, rounds=6, seeds=4
    )
    failing = (value < 0).reshape(4, 6, 512).mean(axis=2)
    assert np.all(failing[:, -1] > 0.2)
    assert np.all(failing[:, 0] < 0.02)
