"""The precision of simulations, and what JAX says about it."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.precision import in_precision, truncate_silently


def double(features, key):
    """A system that asks for float64 in every way there is, and warns of something itself."""
    warnings.warn("the plant is a toy", stacklevel=2)
    a = jnp.asarray(features["a"], float) * jnp.array([1.0, 2.0], jnp.float64)[0]
    clock = jnp.arange(5, dtype=np.float64)
    return vj.Trace({"x": (a + 0 * clock).astype(np.float64) + jnp.zeros(5, int)}, dt=0.1)


@pytest.mark.thorough
@pytest.mark.addons
def test_jax_does_not_warn_of_the_precision_that_a_run_asks_for():
    problem = vj.Problem("toy", {"a": vj.Box(0.0, 1.0)}, double, "always x < 0.9")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        run = vj.falsify(problem, "uniform", 32, batch=32, progress=False)
        assert problem.draws() is False
        vj.confirm(run, int(run.best.name))
        run.replay(run.best, "float32")
        vj.estimate(problem, "monte_carlo", 32, progress=False)
    assert {str(each.message) for each in told} == {"the plant is a toy"}


def test_all_other_warnings_go_on():
    before = list(warnings.filters)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        for _ in range(3):
            with in_precision("float32"), truncate_silently():
                jnp.zeros(2, np.float64)
                warnings.warn("mine", stacklevel=1)
            jnp.zeros(2, np.float64)
    # Python shows each line's warning once, as if nothing had been filtered.
    assert [str(each.message)[:20] for each in told] == ["mine", "Explicitly requested"]
    assert list(warnings.filters) == before


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("jax_threefry_partitionable", False),
        ("jax_default_prng_impl", "rbg"),
        ("jax_enable_x64", True),
    ],
)
def test_a_persons_own_jax_settings_change_nothing(setting, value):
    def simulate(features, key):
        noise = jax.random.normal(key, (3,))
        return vj.Trace({"x": features["a"] + 0.1 * noise}, dt=0.1)

    def table():
        problem = vj.Problem("noisy", {"a": vj.Box(0, 1)}, simulate, "always x <= 2")
        return vj.falsify(problem, "uniform", budget=4, batch=4, seed=1).table.all

    expected, before = table(), getattr(jax.config, setting)
    jax.config.update(setting, value)
    try:
        found = table()
    finally:
        jax.config.update(setting, before)
    assert found.equals(expected)
