"""When descents into the interior join the portfolio, and what they find there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.core.values.clauses import CLAUSES
from verifai_jax.core.values.cube import Cube
from verifai_jax.mtl.clauses import ABSENT
from verifai_jax.search import Descent, Observations, Portfolio, descent

D, WAVES, ROUNDS, SEEDS = 8, 30, 3500, 8
LEVEL = -2.767
"""Reached by 6 % of long descents from random starts, by none of 1e6 random points."""

_rng = np.random.default_rng(0)
WAVE = _rng.normal(0, 5, (WAVES, D)).astype(np.float32)
PHASE = _rng.uniform(0, 2 * np.pi, WAVES).astype(np.float32)
_size = _rng.exponential(1, WAVES).astype(np.float32)
SIZE = _size / np.linalg.norm(_size)


def waves(u):
    """Many hollows away from the faces, some of them below zero."""
    return jnp.sum(SIZE * jnp.sin(WAVE @ u + PHASE)) + 10 * jnp.sum((u - 0.5) ** 4) - LEVEL


def one_clause(search, state, cube, u, value, slope):
    """What a search is told of points of one clause, and what these simulations cost."""
    plan = search.plan(state, cube, len(u))
    slopes = jnp.where(plan.differentiate, slope, 0.0)
    told = Observations(
        u,
        value,
        jnp.arange(len(u)) < plan.rows,
        clauses=jnp.full((len(u), CLAUSES), ABSENT).at[:, 0].set(value),
        clause_gradients=jnp.zeros((len(u), CLAUSES, u.shape[1])).at[:, 0].set(slopes),
    )
    return told, plan.rows * (1 + plan.differentiate)


def play(search):
    """Points, robustness and cost so far of one simulation a round, from several seeds."""
    cube = Cube((0,) * D)

    def step(state, _):
        u, state = search.ask(state, cube, 1)
        value, slope = jax.vmap(jax.value_and_grad(waves))(u)
        told, cost = one_clause(search, state, cube, u, value, slope)
        return search.tell(state, cube, told), (u[0], value[0], cost)

    def run(key):
        return jax.lax.scan(step, search.init(key, cube, 1), None, length=ROUNDS)[1]

    u, value, cost = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), SEEDS))
    return np.asarray(u), np.asarray(value), np.cumsum(np.asarray(cost), axis=1)


@pytest.fixture(scope="module")
def histories():
    """Those of the portfolio, and of one whose descents never begin."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(descent, "BEGINS", np.inf)
        patch.setattr(descent, "EARLY", np.inf)
        without = play(Portfolio())
    return play(Portfolio()), without


@pytest.mark.proves
def test_what_comes_early_is_what_came_without_them(histories):
    (u, _, cost), (same, _, _) = histories
    before = cost < descent.EARLY
    assert before.sum() > 100 * SEEDS
    np.testing.assert_array_equal(u[before], same[before])
    assert all(np.any(u[i] != same[i]) for i in range(SEEDS))


@pytest.mark.proves
def test_failures_inside_the_space_are_found(histories):
    found, without = ((value < 0).any(axis=1).sum() for _, value, _ in histories)
    assert found >= without + 2


@pytest.mark.slow
def test_most_descents_are_given_up_early():
    search, cube = Descent(), Cube((0,) * D)
    ask, tell = jax.jit(search.ask, static_argnums=(1, 2)), jax.jit(search.tell, static_argnums=1)
    state, lengths = search.init(jax.random.key(0), cube, 16), []
    for _ in range(60):
        u, state = ask(state, cube, 16)
        value, slope = jax.vmap(jax.value_and_grad(waves))(u)
        before = np.asarray(state.step)
        state = tell(state, cube, one_clause(search, state, cube, u, value + 10, slope)[0])
        lengths.extend(before[np.asarray(state.step) == 0] + 1)
    counts = np.bincount(lengths, minlength=search.steps + 1)
    assert set(np.flatnonzero(counts[:8])) <= {4}  # Nothing is compared before the first rung.
    assert 0.3 < counts[4] / counts.sum() < 0.7
    assert counts[16:].sum() > 0


def shares(**changes):
    zero = jnp.zeros(())
    state = descent.begin(jax.random.key(0), Cube((0, 0)), 1)
    late = zero + descent.BEGINS
    state = state._replace(
        cost=late, idle=zero + 200, spent=zero + 200, own=zero + 2, theirs=zero + 1
    )
    return float(descent._share(state._replace(**changes)))


@pytest.mark.thorough
def test_shares_follow_the_evidence():
    most, least = descent.MAX_SHARE, descent.MIN_SHARE
    assert shares() == pytest.approx(most / 4)
    assert shares(own=jnp.array(0.5)) == pytest.approx(most)
    assert shares(own=jnp.array(20.0)) == pytest.approx(least)
    # At first they are tried, and while the others get on they wait.
    assert shares(own=jnp.array(20.0), spent=jnp.array(0.0)) == pytest.approx(most)
    assert shares(idle=jnp.array(0.0)) == pytest.approx(least)
    assert shares(theirs=jnp.array(0.0)) == 0.0
    # Early on they go on while they get somewhere, for longer where they have.
    early = {"cost": jnp.array(descent.EARLY)}
    for since, spent, share in ((0.0, 0.0, most), (24.0, 24.0, 0.0), (60.0, 100.0, most)):
        given = {"since": jnp.array(since), "spent": jnp.array(spent)}
        assert shares(**early, **given) == pytest.approx(share)
    dead = descent.begin(jax.random.key(0), Cube((0, 0)), 1).descent._replace(useless=jnp.int32(2))
    assert shares(descent=dead) == pytest.approx(least)
