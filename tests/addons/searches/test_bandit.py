"""The bandit: draws against one-by-one upper confidence bounds, rewards, densities."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.addons.searches.bandit import Bandit, draw_cells, fill_cells
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations


def told(u, rho, valid=None):
    return Observations(u, rho, jnp.ones(len(u), bool) if valid is None else valid)


def learned(search, cube, rho, rounds, batch=16, key=0):
    """The state and the points after some rounds."""

    def step(state, _):
        u, state = search.ask(state, cube, batch)
        return search.tell(state, cube, told(u, rho(u))), u

    state = search.init(jax.random.key(key), cube, batch)
    state, u = jax.jit(lambda state: jax.lax.scan(step, state, None, length=rounds))(state)
    return state, np.asarray(u.reshape(-1, cube.dim))


def one_by_one(mean, count, exists, budget, bonus):
    """Each draw goes to the arm with the highest bound and counts at once, in NumPy."""
    drawn = np.zeros(len(mean))
    for _ in range(budget):
        bound = mean + np.sqrt(bonus / (count + drawn))
        drawn[np.argmax(np.where(exists, bound, -np.inf))] += 1
    return drawn / budget


@pytest.mark.thorough
def test_shares_are_those_of_draws_one_by_one():
    rng = np.random.default_rng(0)
    for budget in (200, 3000):
        mean = rng.random((6, 5)).astype(np.float32)
        count = (1 + rng.integers(0, 60, (6, 5))).astype(np.float32)
        exists = np.array([[True] * 5] * 5 + [[True, False, True, True, False]])
        bonus = np.array([[0.01], [0.1], [0.5], [1], [3], [1]], np.float32)
        shares = fill_cells(mean, count, exists, np.full((6, 1), budget, np.float32), bonus)
        for got, *given in zip(shares, mean, count, exists, bonus[:, 0], strict=True):
            expected = one_by_one(*given[:3], budget, given[3])
            np.testing.assert_allclose(got, expected, atol=1.5 / budget)


@pytest.mark.thorough
def test_rewards_follow_ranks():
    score = jnp.array([3.0, 0.0, jnp.inf, 1.0, 1.0, 8.0, 9.0, 7.0, 6.0, jnp.inf])
    # Eight points, the best half of which is rewarded, in the middle of its rank.
    expected = [1 - 3.5 / 4, 1 - 0.5 / 4, 0, 0.5, 0.5, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(Bandit(best=0.5)._rewards(score), expected, atol=1e-6)
    # Any increasing function of the robustness is as good.
    np.testing.assert_allclose(Bandit(best=0.5)._rewards(jnp.expm1(score)), expected, atol=1e-6)


@pytest.mark.thorough
def test_densities_are_drawn_from_evenly():
    density = jnp.array([[0.1, 0.0, 0.6, 0.3], [0.0, 1.0, 0.0, 0.0]])
    edges = np.array([[0, 0.25, 0.5, 0.75, 1], [0, 0.5, 0.7, 0.7, 1]], np.float32)
    even = jnp.stack([(jnp.arange(1000) + 0.5) / 1000] * 2, axis=1)
    u = np.asarray(draw_cells(density, edges, even))
    np.testing.assert_array_equal(np.histogram(u[:, 0], edges[0])[0], [100, 0, 600, 300])
    np.testing.assert_allclose(np.sort(u[:, 1]), np.linspace(0.5, 0.7, 1000), atol=2e-3)


@pytest.mark.thorough
def test_learns_before_the_first_failure():
    # One coordinate matters, and it is found: no point fails.
    _, u = learned(Bandit(), Cube((0, 0, 0)), lambda u: 5 + jnp.abs(u[:, 1] - 0.33), 12)
    late = u[-64:]
    assert np.mean(np.abs(late[:, 1] - 0.33) < 0.1) > 0.5
    assert np.all(np.abs(late[:, [0, 2]].mean(axis=0) - 0.5) < 0.12)


@pytest.mark.thorough
def test_buckets_split_where_the_search_goes():
    state, u = learned(Bandit(), Cube((0,)), lambda u: 1 + jnp.abs(u[:, 0] - 0.33), 16)
    ((places, edges, branching),) = Bandit()._bandits(Cube((0,)))

    @jax.jit
    def shares(state):
        reward = Bandit()._rewards(state.score)
        return Bandit()._density(state, reward, places, edges, branching, 16)[0]

    density = np.asarray(shares(state))
    assert density.shape == (25,)
    assert abs(density.sum() - 1) < 1e-5
    # The leaf [0.32, 0.36) beats those next to its bucket's ends, and far leaves are alike.
    assert np.argmax(density) == 8
    assert density[8] > 1.5 * density[5]
    assert np.ptp(density[20:]) < 0.02
    assert np.mean((u[-64:] > 0.28) & (u[-64:] < 0.4)) > 0.3


@pytest.mark.thorough
def test_draws_are_even_where_all_points_are_equal():
    cube = Cube((0, 5, 3), ordered=(True, True, False))
    _, u = learned(Bandit(exploration=1e-6), cube, lambda u: jnp.ones(len(u)), 40)
    tenths = np.histogram(u[:, 0], 10, (0, 1))[0] / len(u)
    np.testing.assert_allclose(tenths, 0.1, atol=0.01)
    cells = np.asarray(cube.cells(u))
    for j, n in enumerate((5, 3)):
        np.testing.assert_allclose(np.bincount(cells[:, j], minlength=n) / len(u), 1 / n, atol=0.02)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("ordered", "weights"), [(False, None), (True, (0.05, 0.4, 0.05, 0.2, 0.1, 0.1, 0.1))]
)
def test_finds_the_best_cell(ordered, weights):
    # Also where the prior of the best cell is small.
    cube = Cube((7, 0), weights=(weights, None), ordered=(ordered, True))
    _, u = learned(Bandit(), cube, lambda u: 1.0 + (cube.cells(u)[:, 0] != 2), 16)
    cells = np.asarray(cube.cells(u[-96:])[:, 0])
    # Less and less is to be gained from it, the more of the points remembered are in it.
    assert np.mean(cells == 2) > 0.3


def test_cells_are_arms_and_many_cells_are_groups():
    cube = Cube((3, 60, 4, 0), weights=((0.2, 0.3, 0.5), None, None, None), ordered=(True,) * 4)
    ((places, edges, branching),) = Bandit()._bandits(cube)
    assert branching == (5, 5)
    assert places.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(np.unique(edges[0]), [0, 0.2, 0.5, 1], atol=1e-6)
    # Sixty cells in 25 buckets of two or three.
    widths = np.diff(edges[1]) * 60
    assert set(np.round(widths).tolist()) == {2, 3}
    np.testing.assert_allclose(np.unique(edges[3]), np.arange(26) / 25, atol=1e-6)
    # Each of three cells is in a bucket of its own from the first split on.
    assert np.all(np.sum(np.diff(edges[0]).reshape(5, 5) > 0, axis=1) <= 1)

    choices = Cube((7, 0, 3), ordered=(False, True, False))
    _, (places, edges, branching) = Bandit()._bandits(choices)
    assert places.tolist() == [0, 2]
    assert branching == (7,)
    np.testing.assert_allclose(edges[1], [0, 1 / 3, 2 / 3, 1, 1, 1, 1, 1], atol=1e-6)


@pytest.mark.thorough
def test_points_without_a_verdict_push_none_out():
    search, cube = Bandit(window=32), Cube((0,))
    state = search.init(jax.random.key(0), cube, 16)
    u = jnp.linspace(0, 1, 16)[:, None]
    state = search.tell(state, cube, told(u, 1 + u[:, 0]))
    after = search.tell(state, cube, told(u, jnp.full(16, jnp.nan), jnp.zeros(16, bool)))
    np.testing.assert_array_equal(after.score, state.score)
    np.testing.assert_array_equal(after.u, state.u)
    # The newest come first, the oldest are forgotten.
    for shift in (2.0, 3.0):
        after = search.tell(after, cube, told(u, shift + u[:, 0]))
    assert float(after.score.min()) == 2.0


@pytest.mark.thorough
def test_batches_of_one():
    _, u = learned(Bandit(), Cube((0, 0)), lambda u: jnp.sum(u, axis=1), 200, batch=1)
    assert np.median(u[-64:]) < 0.25


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"buckets": 1}, "buckets must be an integer of at least 2; got 1"),
        ({"depth": 0}, "depth must be an integer of at least 1; got 0"),
        ({"optimism": -1}, "optimism must be positive and finite; got -1"),
        ({"best": 0}, r"best must be in \(0, 1\]; got 0"),
        ({"window": 0}, "window must be an integer of at least 1; got 0"),
        ({"exploration": math.nan}, r"exploration must be in \(0, 1\]; got nan"),
        ({"buckets": 101, "depth": 2}, r"must be at most 10000; got buckets=101, depth=2"),
    ],
)
def test_values_out_of_range(options, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        Bandit(**options)
