"""Bounds of a space are arguments of the compiled program: an edit of one compiles nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.lifting import CAPACITY, LiftedNumbers, lifted, lifting
from verifai_jax.evaluation.engine import Engine

KEY = run_keys(0)[1]


def line(features, key):
    x = jnp.stack([features["a"] + features["w"].knots[0], features["b"].sum()])
    return vj.Trace({"x": x}, dt=1.0)


def problem(high=2.0, swing=0.6):
    space = {
        "a": vj.Box(-1.0, high),
        "b": vj.Box([0.0, 1.0], [high, 3.0]),
        "w": vj.Signal(vj.Box(-swing, swing), knots=3),
    }
    return vj.Problem("line", space, line, "always x < 4")


def text(engine):
    with jax.enable_x64(engine.precision == "float64"):
        return engine.program.trace("evaluate").lower().as_text()


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_an_edit_of_a_bound_is_the_same_program(precision):
    # 0.6 is rounded outwards in float32 and 2 is not: both are one program all the same.
    engines = [
        Engine(problem(*bounds), 4, gradient=True, precision=precision)
        for bounds in ((2.0, 0.6), (2.1, 0.5))
    ]
    assert text(engines[0]) == text(engines[1])


def test_lifted_bounds_give_the_features_that_the_space_gives():
    mine = problem()
    u = np.random.default_rng(0).random((64, mine.space.dim), np.float32)
    u[0], u[1] = 0.0, 1.0
    verdicts = Engine(mine, 64).evaluate(u, KEY)
    expected = jax.jit(jax.vmap(mine.space.unflatten))(u)

    # A compiler may join a product with its sum, which rounds once and not twice.
    def same(one, other):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)

    jax.tree.map(same, verdicts.features, jax.tree.map(np.array, expected))
    assert verdicts.features["a"].max() == 2.0


def test_numbers_beyond_the_capacity_stay_constants():
    owner, numbers = object(), LiftedNumbers()
    many = np.arange(CAPACITY, dtype=np.float32)

    def read():
        with lifting():
            return lifted(owner, few=many[:3], many=many)

    few, rest = numbers.read_from(jnp.arange(CAPACITY) + 1.0, read)
    np.testing.assert_array_equal(few, [1, 2, 3])
    assert rest is many
    np.testing.assert_array_equal(numbers.vector("float32")[:5], [0, 1, 2, 0, 0])


def test_nothing_is_lifted_outside():
    value = np.ones(2, np.float32)
    assert lifted(object(), value=value)[0] is value
    numbers = LiftedNumbers()
    assert numbers.read_from(jnp.zeros(CAPACITY), lambda: lifted(numbers, v=value))[0] is value
