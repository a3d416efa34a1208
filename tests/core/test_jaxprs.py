"""Steps of newer versions of JAX are read as the older ones that they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Primitive

from verifai_jax.core.compute.jaxprs import called

X = np.linspace(0.5, 2, 7, dtype=np.float32)


@pytest.mark.parametrize(
    ("name", "operands", "expected"),
    [
        ("log2", (X,), np.log2(X)),
        ("one_minus_square", (X,), 1 - X**2),
        ("polynomial", (X, 1.0, 5.0, 2 * X), 1 + 5 * X + 2 * X**3),
    ],
)
def test_a_step_of_a_newer_version_is_several_older_ones(name, operands, expected):
    newer = Primitive(name)
    newer.def_abstract_eval(lambda x, *others, **params: x)
    (step,) = jax.make_jaxpr(lambda *values: newer.bind(*values, unroll=None))(*operands).eqns
    program = called(step)
    (found,) = jax.core.eval_jaxpr(program.jaxpr, program.consts, *operands)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("function", [jnp.log2, lambda x: jnp.polyval(jnp.array([2.0, 5, 1]), x)])
def test_the_functions_that_use_them_are_known(function):
    """Which version of JAX has such steps is not said here: all have the functions."""
    names = set()
    todo = list(jax.make_jaxpr(function)(X).eqns)
    while todo:
        step = todo.pop()
        inner = called(step)
        todo += [] if inner is None else inner.eqns
        names |= {step.primitive.name} if inner is None else set()
    assert names.isdisjoint({"log2", "polynomial"})
