"""Quasi-Newton steps inside the cube: what they reach, and what they never do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from playing import tell_of
from scipy.optimize import lsq_linear

from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Descent, Portfolio
from verifai_jax.search.curvature import advance, begin

D, N = 6, 4
step = jax.jit(advance)


def descend(value, steps, start, radius=0.1):
    """The points of several descents, `[steps, n, d]`, and the last state."""
    measured = jax.jit(jax.vmap(jax.value_and_grad(value)))
    state, u, seen = begin(*start.shape), jnp.asarray(start, jnp.float32), []
    for i in range(steps):
        rho, slope = measured(u)
        seen.append(np.asarray(u))
        first = jnp.full(len(u), i == 0)
        state, u = step(state, u, rho, slope, first, jnp.full(len(u), radius))
    return np.array(seen), state


@pytest.mark.thorough
@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000))
def test_a_quadratic_is_solved_in_few_steps_inside_the_cube(seed):
    rng = np.random.default_rng(seed)
    matrix = np.diag(np.geomspace(1, 10, D)) @ np.linalg.qr(rng.normal(size=(D, D)))[0]
    goal = matrix @ rng.uniform(-0.3, 1.3, D)  # Its solution is often on the faces.
    exact = lsq_linear(matrix, goal, (0, 1))

    def quadratic(u):
        return 0.5 * jnp.sum((matrix @ u - goal) ** 2)

    points, state = descend(quadratic, 40, rng.random((N, D)))
    assert points.min() >= 0
    assert points.max() <= 1
    scale = 0.5 * np.sum(goal**2)
    assert np.all(np.asarray(state.value) <= exact.cost + 1e-3 * scale)


@pytest.mark.thorough
def test_nothing_moves_where_there_is_no_slope():
    start = np.random.default_rng(0).random((N, D)).astype(np.float32)
    points, state = descend(lambda u: 1.0 + jnp.sum((u[:3] - 0.4) ** 2), 12, start)
    # Coordinates that do not matter keep their start's value, the others find the minimum.
    np.testing.assert_array_equal(points[:, :, 3:], np.broadcast_to(start[:, 3:], (12, N, 3)))
    np.testing.assert_allclose(np.asarray(state.point)[:, :3], 0.4, atol=1e-2)


def rosenbrock(u):
    x = 10 * u - 5
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2) - 1


@pytest.mark.slow
def test_rows_without_a_verdict_leave_the_other_descents_alone():
    cube, search = Cube((0,) * D), Descent()
    tell = jax.jit(search.tell, static_argnums=1)
    state = search.init(jax.random.key(0), cube, N)
    u, state = search.ask(state, cube, N)
    rho, slope = jax.vmap(jax.value_and_grad(rosenbrock))(u)
    told = tell_of(search, state, cube, u, rho, slope)
    before = tell(state, cube, told)
    broken = told._replace(
        rho=told.rho.at[1].set(jnp.nan),
        valid=told.valid.at[1].set(False),
        clauses=told.clauses.at[1].set(jnp.nan),
        clause_gradients=told.clause_gradients.at[1].set(jnp.nan),
    )
    after = tell(state, cube, broken)
    others = np.arange(N) != 1
    for name in ("point", "best", "step"):
        np.testing.assert_array_equal(
            np.asarray(getattr(after, name))[others], np.asarray(getattr(before, name))[others]
        )
    assert int(after.step[1]) == 0
    assert bool(jnp.all(jnp.isfinite(after.point)))


@pytest.mark.proves
def test_the_default_search_gets_down_a_curved_valley():
    """Rosenbrock's function in ten dimensions below 1: never before in 5000 simulations."""
    cube, search, budget = Cube((0,) * 10), Portfolio(), 1500

    def play(state, _):
        u, state = search.ask(state, cube, 1)
        rho, slope = jax.vmap(jax.value_and_grad(rosenbrock))(u)
        cost = 1 + search.plan(state, cube, 1).differentiate
        told = tell_of(search, state, cube, u, rho, slope)
        return search.tell(state, cube, told), (rho[0], cost)

    def run(key):
        return jax.lax.scan(play, search.init(key, cube, 1), None, length=budget)[1]

    rho, cost = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(5), 10))
    found = np.any((np.asarray(rho) < 0) & (np.cumsum(np.asarray(cost), axis=1) <= budget), axis=1)
    assert found.sum() >= 9
