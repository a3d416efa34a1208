"""Searches played on landscapes with a known share of failures, for the tests of their quality.

Uniform sampling needs log(2) / share simulations in the median.
"""

import math
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.landscapes import LANDSCAPES, tell_of
from verifai_jax.search import Observations

SEEDS = 25
# Those on one cube run in one program: compiling is what takes time.
FLAT = ("ball", "ridge", "saddles", "corner", "ripples", "needle")
MIXED = ("mixed",)
WIDE = ("few_of_many", "all_of_many")
ROUNDS = {FLAT: 75, MIXED: 50, WIDE: 22}


@lru_cache
def play(search, names, batch, rounds, seeds, together=True):
    """Points `[landscapes, seeds, rounds * batch, d]` and their robustness.

    `together` runs all side by side, which is faster unless the search saves time in some rounds.
    """
    landscapes, (cube,) = [LANDSCAPES[n].rho for n in names], {LANDSCAPES[n].cube for n in names}

    def one(case):
        which, key = case

        def rho(u):
            return jnp.stack([landscape(u) for landscape in landscapes])[which]

        def step(state, _):
            u, state = search.ask(state, cube, batch)
            value = jax.vmap(rho)(u)
            told = tell_of(search, state, cube, u, value, jax.vmap(jax.grad(rho))(u))
            # A row that is not simulated finds nothing.
            return search.tell(state, cube, told), (u, jnp.where(told.valid, value, jnp.inf))

        _, seen = jax.lax.scan(step, search.init(key, cube, batch), None, length=rounds)
        return jax.tree.map(lambda leaf: leaf.reshape(rounds * batch, *leaf.shape[2:]), seen)

    keys = jax.random.split(jax.random.key(11), seeds)
    every = jnp.repeat(jnp.arange(len(names)), seeds), jnp.tile(keys, len(names))
    played = jax.vmap(one) if together else lambda cases: jax.lax.map(one, cases)
    seen = jax.jit(played)(every)
    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, seeds, *leaf.shape[1:]), seen)


def played(search, name):
    """Points and robustness `[seeds, simulations]` of a search on a landscape."""
    group = next(names for names in ROUNDS if name in names)
    u, value = play(search, group, 16, ROUNDS[group], SEEDS)
    return u[group.index(name)], value[group.index(name)]


def gain(name, value):
    """How many times fewer simulations than uniform sampling until the first failure, in medians.

    `value` holds the robustness `[seeds, simulations]`.
    """
    failing = value < 0
    first = np.where(failing.any(1), failing.argmax(1) + 1.0, np.inf)
    return math.log(2) / LANDSCAPES[name].share / np.median(first)


@lru_cache
def jitted(search):
    """Its compiled ask and tell, which all tests of one search share."""
    return (
        jax.jit(search.ask, static_argnums=(1, 2)),
        jax.jit(search.tell, static_argnums=1),
    )


def asked(search, cube, rho, rounds, batch=8, key=None, valid=True):
    """Points of the first rounds, with this robustness, and the last state."""
    ask, tell = jitted(search)
    state, seen = search.init(jax.random.key(0) if key is None else key, cube, batch), []
    for _ in range(rounds):
        u, state = ask(state, cube, batch)
        value = jnp.asarray(rho(u), jnp.float32)
        state = tell(state, cube, Observations(u, value, jnp.full(batch, valid)))
        seen.append(np.asarray(u))
    return np.concatenate(seen), state
