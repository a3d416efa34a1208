"""The bandit: it learns before the first failure, and draws the prior where there is nothing to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.addons.searches.bandit import Bandit
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations


def learned(cube, rho, rounds):
    """The points of some rounds of 16."""
    search = Bandit()

    def step(state, _):
        u, state = search.ask(state, cube, 16)
        return search.tell(state, cube, Observations(u, rho(u), jnp.ones(16, bool))), u

    state = search.init(jax.random.key(0), cube, 16)
    return np.asarray(jax.lax.scan(step, state, None, length=rounds)[1].reshape(-1, cube.dim))


@pytest.mark.slow
def test_learns_before_the_first_failure():
    cube = Cube((0, 0, 7), ordered=(True, True, False))

    def rho(u):
        return 5 + jnp.abs(u[:, 1] - 0.33) + (cube.cells(u)[:, 0] != 4)

    late = learned(cube, rho, 6)[-48:]
    assert np.mean(np.abs(late[:, 1] - 0.33) < 0.1) > 0.4
    assert np.mean(cube.cells(late)[:, 0] == 4) > 0.7


@pytest.mark.slow
def test_draws_the_prior_where_all_points_are_equal():
    weights = (None, (0.7, 0.2, 0.1))
    cube = Cube((0, 3), weights=weights, ordered=(True, False))
    u = learned(cube, lambda u: jnp.ones(len(u)), 40)
    np.testing.assert_allclose(np.histogram(u[:, 0], 4, (0, 1))[0] / len(u), 0.25, atol=0.07)
    shares = np.bincount(cube.cells(u)[:, 0]) / len(u)
    np.testing.assert_allclose(shares, weights[1], atol=0.07)
