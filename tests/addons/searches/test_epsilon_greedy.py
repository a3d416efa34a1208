"""Epsilon-greedy: its share of the prior, what greed finds, and when it gives up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.addons.searches.epsilon_greedy import EpsilonGreedy
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations


def learned(search, cube, rho, rounds, batch=16, key=0):
    """The states after each round, and the points."""

    def step(state, _):
        u, state = search.ask(state, cube, batch)
        state = search.tell(state, cube, Observations(u, rho(u), jnp.ones(batch, bool)))
        return state, (state, u)

    state = search.init(jax.random.key(key), cube, batch)
    states, u = jax.jit(lambda state: jax.lax.scan(step, state, None, length=rounds))(state)[1]
    return states, np.asarray(u.reshape(-1, cube.dim))


def noise(u):
    """Without any structure, but the same for the same point."""
    bits = jnp.zeros(len(u), jnp.uint32)
    for j in range(u.shape[1]):
        bits ^= jax.lax.bitcast_convert_type(u[:, j], jnp.uint32)
        bits = (bits ^ (bits >> 15)) * jnp.uint32(0x85EBCA6B)
    return 1 + (bits >> 8).astype(jnp.float32) * 2.0**-24


@pytest.mark.thorough
@pytest.mark.parametrize("epsilon", [0.1, 0.37, 1.0])
def test_the_share_of_the_prior(epsilon):
    search = EpsilonGreedy(epsilon=epsilon)
    state = search.init(jax.random.key(0), Cube((0,)), 7)
    # The first draws are all from the prior,
    assert np.all(search._exploring(state, 7))
    # and later every tenth is, whatever the batch; also as the count wraps around.
    for tells in (0, 2**32 - 100):
        rows = [
            search._exploring(
                state._replace(tells=jnp.uint32((tells + i) % 2**32), begun=jnp.int32(16)), 7
            )
            for i in range(200)
        ]
        assert abs(np.mean(rows) - epsilon) < 0.01


@pytest.mark.thorough
def test_learns_before_the_first_failure():
    cube = Cube((0, 0, 0))
    target = jnp.array([0.3, 0.9, 0.0])
    _, u = learned(EpsilonGreedy(), cube, lambda u: 5 + jnp.sum((u - target) ** 2, axis=1), 12)
    distance = np.linalg.norm(u - np.asarray(target), axis=1)
    assert np.median(distance[-48:]) < 0.15
    assert np.median(distance[:16]) > 0.5
    # A share of prior draws stays.
    assert np.mean(distance[-48:] > 0.5) > 0.02


@pytest.mark.thorough
@pytest.mark.parametrize("ordered", [True, False])
def test_finds_the_best_cells(ordered):
    cube = Cube((6, 40, 3), ordered=(ordered, True, False))

    def rho(u):
        cells = cube.cells(u)
        return 1.0 + (cells[:, 0] != 4) + jnp.abs(cells[:, 1] - 31) / 20 + (cells[:, 2] != 1)

    _, u = learned(EpsilonGreedy(), cube, rho, 12)
    cells = np.asarray(cube.cells(u[-48:]))
    assert np.mean(cells[:, 0] == 4) > 0.5
    assert np.mean(cells[:, 2] == 1) > 0.5
    assert np.median(np.abs(cells[:, 1] - 31)) <= 3


@pytest.mark.slow
def test_gives_up_greed_that_does_not_pay():
    def share_of_starts(rho):
        states, _ = learned(EpsilonGreedy(patience=10**4), Cube((0, 0)), rho, 100)
        return np.mean(np.asarray(states.begun) < 16)

    # Of a cycle of a few rounds one is for the prior alone.
    assert share_of_starts(noise) > 0.2
    assert share_of_starts(lambda u: jnp.ones(len(u))) > 0.2
    assert share_of_starts(lambda u: 1 + jnp.sum(u, axis=1)) < 0.02


@pytest.mark.thorough
def test_draws_the_prior_where_all_points_are_equal():
    _, u = learned(EpsilonGreedy(), Cube((0, 0)), lambda u: jnp.ones(len(u)), 60)
    for j in (0, 1):
        np.testing.assert_allclose(np.histogram(u[:, j], 5, (0, 1))[0] / 960, 0.2, atol=0.05)
    # Points are as far from their nearest neighbours as uniform ones.
    distance = np.linalg.norm(u[:, None] - u[None], axis=2) + 9 * np.eye(960)
    assert abs(np.mean(distance.min(axis=1)) * np.sqrt(960) - 0.5) < 0.05


@pytest.mark.thorough
def test_starts_again_after_patience():
    # All points around the best one fail alike: after a while it looks elsewhere.
    def rho(u):
        return jnp.max(jnp.abs(u - 0.3), axis=1) - 0.1

    states, u = learned(EpsilonGreedy(), Cube((0, 0)), rho, 60)
    begun = np.asarray(states.begun)
    assert np.sum((begun[1:] == 0) & (begun[:-1] > 0)) >= 3
    fails = np.asarray(rho(jnp.asarray(u))) < 0
    # At random it would be one in 25.
    assert np.mean(fails) > 0.3


@pytest.mark.thorough
def test_rows_of_any_magnitude():
    # Only the order of the robustness matters.
    def rho(u):
        return jnp.sum((u - 0.2) ** 2, axis=1)

    _, one = learned(EpsilonGreedy(), Cube((0, 0)), lambda u: 1 + rho(u), 10)
    _, two = learned(EpsilonGreedy(), Cube((0, 0)), lambda u: 1024 * (1 + rho(u)), 10)
    np.testing.assert_array_equal(one, two)


@pytest.mark.thorough
def test_warm_start():
    search, cube = EpsilonGreedy(), Cube((0, 0))
    state = search.init(jax.random.key(0), cube, 16)
    u = jnp.linspace(0, 1, 16)[:, None] * jnp.ones(2)
    rho = jnp.abs(u[:, 0] - 0.5)
    state = search.warm_start(state, cube, Observations(u, rho, jnp.arange(16) != 7))
    np.testing.assert_allclose(state.best[0], u[8])
    assert not np.any(np.all(np.isclose(state.best, u[7]), axis=1))
    # The prior's draws of the first round are not of the table.
    assert np.all(search._exploring(state, 16))
    assert np.all(np.isinf(state.prior))


def test_batches_of_one():
    _, u = learned(EpsilonGreedy(), Cube((0, 0)), lambda u: jnp.sum(u, axis=1), 200, batch=1)
    assert np.median(u[-64:]) < 0.2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"epsilon": 0}, r"epsilon must be in \(0, 1\]; got 0"),
        ({"epsilon": 1.5}, r"epsilon must be in \(0, 1\]; got 1.5"),
        ({"best": "all"}, r"best must be in \(0, 1\]; got 'all'"),
        ({"min_best": 1}, "min_best must be an integer of at least 2; got 1"),
        ({"reach": 0}, "reach must be positive and finite; got 0"),
        ({"min_std": 0}, r"min_std must be in \(0, 1\]; got 0"),
        ({"begin": 0}, "begin must be an integer of at least 1; got 0"),
        ({"patience": 0}, "patience must be an integer of at least 1; got 0"),
        ({"doubt": -1}, "doubt must be positive and finite; got -1"),
    ],
)
def test_values_out_of_range(options, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        EpsilonGreedy(**options)
