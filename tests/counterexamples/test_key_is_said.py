"""Studies of a row of a system that draws say that they hold the random key of the row."""

import jax
import jax.numpy as jnp
import pytest

import verifai_jax as vj


@pytest.mark.slow
def test_a_study_says_that_it_holds_the_random_key():
    def system(features, key):
        return vj.Trace({"x": features["a"] + 0.8 * jax.random.normal(key) * jnp.ones(2)}, dt=1.0)

    space = {"a": vj.Box(0.0, 1.0)}
    problem = vj.Problem("noisy", space, system, "x < 1.5", nominal={"a": 0.0})
    run = vj.falsify(problem, "uniform", 64, progress=False, confirm=False)
    small = vj.shrink(run, budget=20)
    assert small.replay().violated
    for found in (small, vj.explain(run)):
        assert f"all simulations had the random key of row {found.row}, and with" in str(found)
