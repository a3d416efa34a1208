"""Parallel tempering: densities against quadrature, exchanges, warm starts, batches of one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.addons.searches.annealing import (
    Annealing,
    best_to_median,
    exchange,
    partners_of,
    reflect,
)
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations
from verifai_jax.testing import check_search


def run(search, cube, batch, rho, rounds, key=0):
    """The states after each round."""

    def step(state, _):
        u, state = search.ask(state, cube, batch)
        state = search.tell(state, cube, Observations(u, rho(u), jnp.ones(batch, bool)))
        return state, (u, state)

    state = search.init(jax.random.key(key), cube, batch)
    return jax.jit(lambda state: jax.lax.scan(step, state, None, length=rounds))(state)[1]


@pytest.mark.slow
def test_each_chain_has_the_density_of_its_temperature():
    # Two wells, one of which is a flat failure region; and a discrete coordinate.
    def rho(u):
        well = jnp.minimum(jnp.abs(u[:, 0] - 0.2) - 0.05, jnp.abs(u[:, 0] - 0.8) + 0.1)
        return well + jnp.where(u[:, 1] < 1 / 3, 0.2, 0.0)

    # Without giving up points, which is no part of the Metropolis rule.
    search = Annealing(chains=8, hottest=1.0, coldest=0.3, exploration=0.25, patience=10**6)
    cube = Cube((0, 3))
    _, states = run(search, cube, 8, rho, 6000)
    chains, spread = np.asarray(states.u[500:]), float(states.spread[-1])
    grid = np.stack(
        np.meshgrid((np.arange(2000) + 0.5) / 2000, [1 / 6, 1 / 2, 5 / 6], indexing="ij"), -1
    )
    energy = np.maximum(rho(jnp.asarray(grid.reshape(-1, 2))), 0).reshape(2000, 3)
    for chain, temperature in ((0, 0.3), (5, 1.0), (7, np.inf)):
        weight = np.exp(-energy / (temperature * spread))
        weight /= weight.sum()
        expected = weight.reshape(10, 200, 3).sum(1)
        cells = np.asarray(cube.cells(chains[:, chain])[:, 0])
        tenths = np.minimum((chains[:, chain, 0] * 10).astype(int), 9)
        shares = np.zeros((10, 3))
        np.add.at(shares, (tenths, cells), 1 / len(cells))
        np.testing.assert_allclose(shares, expected, atol=0.025)


def test_exchanges_sort_cold_chains_and_lose_no_point():
    energy = jnp.array([5.0, 3.0, jnp.inf, 1.0, 4.0, 2.0, 0.0])
    coldness = jnp.array([6.0, 5.0, 4.0, 3.0, 2.0, 1.0, 0.0]) * 1e6
    matchings = partners_of(7)
    place = np.asarray(exchange(energy, coldness, jnp.zeros(matchings.shape)))
    assert sorted(place.tolist()) == list(range(7))
    # Gains only are taken at this temperature: the best goes to the coldest chain in one go.
    assert energy[place[0]] == 0
    assert np.isinf(energy[place[-1]])
    # Pairs are pairs.
    for partner in matchings:
        np.testing.assert_array_equal(partner[partner], np.arange(7))
    assert {abs(int(p) - i) for row in matchings for i, p in enumerate(row)} == {0, 1, 2, 4}


@pytest.mark.thorough
def test_exchanges_follow_the_odds():
    # exp((1/T1 - 1/T2)(E1 - E2)) with a loss of 1.
    energy, coldness = jnp.array([0.0, 1.0]), jnp.array([1.5, 0.5])
    chance = jnp.log(jax.random.uniform(jax.random.key(0), (20000, 2, 2)))
    chance = chance.at[:, 1].set(0.0)
    place = jax.vmap(lambda chance: exchange(energy, coldness, chance))(chance)
    assert abs(float(jnp.mean(place[:, 0] == 1)) - np.exp(-1)) < 0.02


def test_reflection():
    u = jnp.array([[-0.25, 0.5, 1.25, 2.25, -1.5, 1.0]])
    np.testing.assert_allclose(reflect(u), [[0.25, 0.5, 0.75, 0.25, 0.5, 1.0]], atol=1e-6)


@pytest.mark.thorough
def test_the_spread_is_that_of_the_first_points():
    assert best_to_median(jnp.array([3.0, jnp.inf, 1.0, 2.0, 100.0, jnp.nan])) == 1.0
    assert best_to_median(jnp.full(3, jnp.inf)) == 0.0
    _, states = run(Annealing(), Cube((0, 0)), 1, lambda u: 3 * u[:, 0] + 5, 30)
    spread = np.asarray(states.spread)
    # Eight chains take turns: it is known after eight rounds.
    assert len(set(spread[:8].tolist())) > 2
    assert set(spread[8:].tolist()) == {spread[8]}
    assert 0.3 < spread[-1] < 2.7


@pytest.mark.thorough
def test_it_anneals():
    # The colder a chain, the lower its robustness.
    _, states = run(Annealing(), Cube((0, 0, 0)), 16, lambda u: 1 + jnp.sum(u, axis=1), 200)
    energy = np.asarray(states.energy)[50:]
    mean = np.mean(np.where(np.isinf(energy), np.nan, energy), axis=0, where=np.isfinite(energy))
    assert mean[0] < 1.1
    assert np.all(np.diff(mean[:14].reshape(7, 2).mean(1)) > 0)
    assert abs(mean[-1] - 2.5) < 0.2


def test_a_chain_that_stays_starts_again():
    # Where the robustness is least in a single point met by chance, no proposal is accepted.
    search, cube = Annealing(patience=3), Cube((0,))
    state = search.init(jax.random.key(0), cube, 8)
    held = state._replace(tells=jnp.uint32(9), energy=jnp.zeros(8), spread=jnp.float32(1))

    @jax.jit
    def step(state):
        u, state = search.ask(state, cube, 8)
        return search.tell(state, cube, Observations(u, jnp.full(8, 1e6), jnp.ones(8, bool)))

    for round in range(3):
        assert np.all(np.isfinite(held.energy)), round
        held = step(held)
    # All but the chain that takes every draw of the prior.
    assert int(np.sum(np.isinf(held.energy))) == 7


@pytest.mark.thorough
def test_warm_starts_at_the_best_points():
    search, cube = Annealing(), Cube((0, 0))
    state = search.init(jax.random.key(0), cube, 16)
    rng = np.random.default_rng(0)
    tables = [rng.random((16, 2)).astype(np.float32) for _ in range(3)]
    for number, u in enumerate(tables):
        valid = jnp.arange(16) != 4
        told = Observations(u, jnp.where(valid, u[:, 0] + 1, -1e9), valid)
        if number == 0:
            kept = np.delete(u[:, 0], 4)
        else:
            kept = np.concatenate([kept, np.delete(u[:, 0], 4)])
        state = search.warm_start(state, cube, told)
    np.testing.assert_allclose(state.u[:, 0], np.sort(kept)[:16])
    np.testing.assert_allclose(state.energy, np.sort(kept)[:16] + 1)


@pytest.mark.thorough
def test_choices_and_neighbours():
    # From a cell to any one, or, of ordered ones, mostly to a neighbour.
    search = Annealing(exploration=0.01)
    cube = Cube((6, 6), ordered=(True, False))
    state = search.init(jax.random.key(0), cube, 4000)
    middle = cube.centres(jnp.full((4000, 2), 2))
    ask = jax.jit(search.ask, static_argnums=(1, 2))
    u, _ = ask(state._replace(u=middle, energy=jnp.zeros(4000)), cube, 4000)
    cells = np.asarray(cube.cells(u))[:3900]
    ordered, choice = (np.bincount(cells[:, j], minlength=6) / 3900 for j in (0, 1))
    assert min(ordered[1], ordered[3]) > 3 * max(ordered[0], ordered[4], ordered[5])
    assert np.ptp(choice[[0, 1, 3, 4, 5]]) < 0.04
    assert np.mean(np.all(cells == 2, axis=1)) < 0.25


@pytest.mark.slow
def test_batches_of_one():
    check_search(Annealing(), Cube((0, 3)), batch=3, rounds=8)
    u, _ = run(Annealing(), Cube((0, 0)), 1, lambda u: jnp.sum(u, axis=1), 300)
    assert float(jnp.median(u[-100:])) < 0.25


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chains": 1}, "chains must be an integer of at least 2; got 1"),
        ({"hottest": 0}, "hottest must be positive and finite; got 0"),
        ({"coldest": -1}, "coldest must be positive and finite; got -1"),
        ({"coldest": 0.5}, "coldest must not be above hottest; got coldest=0.5, hottest=0.3"),
        ({"exploration": 0}, r"exploration must be in \(0, 1\]; got 0"),
        ({"patience": 0}, "patience must be an integer of at least 1; got 0"),
    ],
)
def test_values_out_of_range(options, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        Annealing(**options)
