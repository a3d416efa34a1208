"""Where the descents of a portfolio start: the middle, new points, and the best ones, once each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from playing import tell_of

from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Portfolio
from verifai_jax.search.descent import APART
from verifai_jax.search.portfolio import OPENING, TAKEN

CUBE = Cube((0,) * 4)


@pytest.mark.slow
def test_no_descent_starts_twice_from_one_of_the_best_points():
    def hilly(u):  # Many hollows, and no failure.
        return 2 + jnp.sum(jnp.cos(23 * u) + (u - 0.4) ** 2)

    search = Portfolio()

    @jax.jit
    def step(state):
        u, state = search.ask(state, CUBE, 1)
        plan = search.plan(state, CUBE, 1)
        slope = jax.vmap(jax.grad(hilly))(u)
        told = tell_of(search, state, CUBE, u, jax.vmap(hilly)(u), slope)
        begins = plan.differentiate & state.gradient.fresh[0] & (state.rows[0] > 0)
        seen = begins, state.gradient.given[0], state.gradient.number[0], u[0]
        return search.tell(state, CUBE, told), seen

    state = search.init(jax.random.key(0), CUBE, 1)
    starts = []
    for _ in range(600):
        state, (begins, given, number, u) = step(state)
        if begins:
            starts.append((int(number), bool(given), np.asarray(u)))
    assert starts[0][:2] == (0, False)
    np.testing.assert_array_equal(starts[0][2], 0.5)
    assert not any(given for number, given, _ in starts if number < OPENING)
    best = np.array([u for number, given, u in starts if given])[-TAKEN // 2 :]
    assert len(best) >= 5
    # Every second start at most, and far from each other as long as they are remembered.
    assert 2 * sum(given for _, given, _ in starts) <= len(starts)
    distance = np.abs(best[:, None] - best).max(axis=2)
    assert distance[~np.eye(len(best), dtype=bool)].min() > APART
