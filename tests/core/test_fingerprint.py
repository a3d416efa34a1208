"""The same program has one fingerprint; what computes or differentiates otherwise has another."""

import subprocess
import sys
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax.core.compute.fingerprint import fingerprint, identity, stable_text
from verifai_jax.search import CrossEntropy, Portfolio

X = jax.ShapeDtypeStruct((3,), jnp.float32)


def of(function, *forms):
    return fingerprint(jax.jit(lambda *values: function(*values)).trace(*(forms or (X,))).jaxpr)


def scaled(table, factor=2.0):
    def step(carry, row):
        return factor * carry + row, jnp.where(carry > 0, carry, jnp.sin(row))

    return lambda x: jax.lax.scan(step, x, table)


def with_derivative(slope, value=jnp.sin, reverse=False):
    @(jax.custom_vjp if reverse else jax.custom_jvp)
    def function(x):
        return value(x)

    if reverse:
        function.defvjp(lambda x: (value(x), x), lambda x, g: (slope(x) * g,))
    else:
        function.defjvp(lambda x, t: (value(x[0]), slope(x[0]) * t[0]))
    return lambda x: function(jnp.exp(x))


TABLE = np.arange(12.0, dtype=np.float32).reshape(4, 3)


def test_the_same_function_has_one_fingerprint():
    assert of(scaled(TABLE)) == of(scaled(TABLE.copy())) is not None
    assert of(scaled(jnp.asarray(TABLE))) is not None


@pytest.mark.parametrize(
    "other",
    [
        scaled(TABLE, 2.000001),
        scaled(TABLE + np.float32(1e-7) * (TABLE == 1)),
        lambda x: scaled(TABLE)(-x),
        lambda x: scaled(TABLE)(x)[::-1],
        lambda x: jax.lax.scan(lambda c, r: (2.0 * c + r, c), x, TABLE),
    ],
    ids=["factor", "one number of a table", "sign", "order of results", "less computed"],
)
def test_another_function_has_another(other):
    assert of(other) is not None
    assert of(other) != of(scaled(TABLE))


def test_shapes_and_types_count():
    forms = [jax.ShapeDtypeStruct((3,), jnp.int32), jax.ShapeDtypeStruct((4,), jnp.float32), X]
    assert len({of(lambda x: x + x, form) for form in forms}) == 3


@pytest.mark.parametrize("reverse", [False, True])
def test_a_derivative_of_its_own_counts(reverse):
    own = partial(with_derivative, reverse=reverse)
    assert of(own(jnp.cos)) == of(own(jnp.cos)) is not None
    assert of(own(jnp.cos)) != of(own(lambda x: 2 * jnp.cos(x)))
    assert of(own(jnp.cos)) != of(own(jnp.cos, value=jnp.tanh))
    # Within a loop, too.
    looped = []
    for slope in (jnp.cos, jnp.sin):
        function = own(slope)
        looped.append(of(lambda x, f=function: jax.lax.fori_loop(0, 3, lambda i, y: f(y), x)))
    assert looped[0] != looped[1]
    assert None not in looped


def test_what_is_opaque_has_none():
    def called(x):
        return jax.pure_callback(np.sin, x, x, vmap_method="sequential")

    @jax.custom_batching.custom_vmap
    def one(x):
        return 2 * x

    @one.def_vmap
    def rule(size, batched, x):
        return 3 * x, batched[0]

    assert of(called) is None
    assert of(one) is None
    assert of(lambda x: jnp.sin(one(x))) is None


def test_random_keys_and_policies_are_known():
    key = jax.eval_shape(lambda: jax.random.key(0, impl="threefry2x32"))
    assert of(lambda k: jax.random.normal(jax.random.fold_in(k, 3), (2,)), key) is not None
    assert of(jax.checkpoint(lambda x: jnp.sin(x) ** 2)) is not None


def test_plain_values_have_an_identity():
    @dataclass(frozen=True)
    class Options:
        size: int
        rule: object = None

    assert identity(Options(1)) == identity(Options(1)) != identity(Options(2))
    assert identity(1) != identity(1.0) != identity("1")
    assert identity((1, 2), 3) != identity(1, (2, 3))
    assert identity(np.arange(3)) != identity(np.arange(4))
    assert identity(Options(1, rule=lambda x: x)) is None
    assert identity(Portfolio()) != identity(Portfolio(gradients=False))
    assert identity(CrossEntropy()) == identity(CrossEntropy()) is not None


PRINTED = """
from tests.core.test_fingerprint import TABLE, of, scaled
from verifai_jax.core.compute.fingerprint import identity
from verifai_jax.search import Portfolio
print(of(scaled(TABLE)), identity(Portfolio(), {"b": 1, "a": 2.5}, frozenset("xyz")))
"""


@pytest.mark.slow
def test_another_process_says_the_same():
    said = {
        subprocess.run(
            [sys.executable, "-c", PRINTED], capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    }
    assert len(said) == 1
    assert "None" not in said.pop()


@pytest.mark.parametrize("reverse", [False, True])
def test_a_program_that_is_not_differentiated_does_not_depend_on_derivatives(reverse):
    def alone(function):
        return fingerprint(jax.jit(function).trace(X).jaxpr, derivatives=False)

    one = with_derivative(jnp.cos, reverse=reverse)
    other_slope = with_derivative(jnp.sin, reverse=reverse)
    other_value = with_derivative(jnp.cos, jnp.tan, reverse=reverse)
    assert alone(one) == alone(other_slope) != alone(other_value)
    assert of(one) != of(other_slope)


def test_the_text_of_an_object_is_the_same_in_a_script_and_where_it_is_imported():
    def text(module, name="Cart"):
        return stable_text([type(name, (), {"__module__": module})()])

    assert text("__main__") == text("_target_mine") == text("some.mine") == "[<Cart object>]"
    assert text("mine", "Other") != text("mine")
    assert stable_text("x < b.Cart object") == "'x < b.Cart object'"
    assert (
        stable_text(text) == "<function test_the_text_of_an_object_is_the_same_in_a_script_and_"
        "where_it_is_imported.<locals>.text>"
    )
