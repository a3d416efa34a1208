"""Lookup tables against NumPy and SciPy, their derivatives, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from scipy.interpolate import RegularGridInterpolator

from verifai_jax.addons.simulators.blocks import LookupTable

X, Y = [1.0, 2.0, 4.0, 7.0], [0.1, 0.2, 0.4]
NUMBERS = np.random.default_rng(0).normal(size=(4, 3))
RANDOM = np.random.default_rng(1)
POINTS = np.stack([RANDOM.uniform(-1, 9, 200), RANDOM.uniform(-0.1, 0.6, 200)], 1)


def test_clipped_in_one_dimension_is_that_of_numpy():
    table = LookupTable(X, NUMBERS[:, 0])
    places = np.concatenate([POINTS[:, 0], X])
    values = jax.jit(jax.vmap(table))(places)
    np.testing.assert_allclose(values, np.interp(places, X, NUMBERS[:, 0]), atol=1e-5)


@pytest.mark.parametrize(
    "beyond", ["extrapolate", pytest.param("clip", marks=pytest.mark.thorough)]
)
def test_two_dimensions_are_those_of_scipy(beyond):
    table = LookupTable(X, Y, NUMBERS, beyond=beyond)
    oracle = RegularGridInterpolator((X, Y), NUMBERS, bounds_error=False, fill_value=None)
    points = POINTS if beyond == "extrapolate" else np.clip(POINTS, [1, 0.1], [7, 0.4])
    values = jax.jit(jax.vmap(table))(*POINTS.T)
    np.testing.assert_allclose(values, oracle(points), atol=3e-5)
    # All at once is the same as one by one.
    np.testing.assert_allclose(table(*POINTS.T.astype(np.float32)), values, atol=1e-5)


@pytest.mark.thorough
def test_derivatives_in_place_and_values():
    values = jnp.asarray(NUMBERS[:, 0], jnp.float32)

    def at(values, x):
        return LookupTable(X, values)(x)

    slopes = jax.jit(jax.vmap(jax.grad(at, argnums=(0, 1)), in_axes=(None, 0)))
    shares, lines = slopes(values, jnp.asarray([3.0, 4.0, 0.5, 8.0]))
    rise = np.diff(NUMBERS[:, 0]) / np.diff(X)
    np.testing.assert_allclose(lines, [rise[1], rise[2], 0, 0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(shares[0], [0, 0.5, 0.5, 0], atol=1e-6)
    np.testing.assert_allclose(shares[3], [0, 0, 0, 1], atol=1e-6)


@pytest.mark.thorough
def test_tables_of_vectors():
    table = LookupTable(X, NUMBERS)
    np.testing.assert_allclose(table(3.0), NUMBERS[1:3].mean(0), atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LookupTable([1, 2]), "needs the breakpoints of each argument and then the values"),
        (lambda: LookupTable([1, 1], [0, 0]), "argument 0 must be two or more numbers that incr"),
        (lambda: LookupTable([1], [0]), "two or more numbers"),
        (
            lambda: LookupTable([1, 2], [0, 1, 2]),
            r"breakpoints \[2\] must have this shape; got \[3",
        ),
        (lambda: LookupTable([1, 2], [0, float("nan")]), "values .* must be finite; got nan"),
        (lambda: LookupTable(["a", "b"], [0, 1]), r"argument 0 must be real numbers; got \['a'"),
        (
            lambda: LookupTable([0, 1], np.ma.masked_array([0.0, 9e9], mask=[0, 1])),
            "values of a LookupTable must be numbers; one of 2 is",
        ),
        (lambda: LookupTable([1, 2], [0, "x"]), r"values of a LookupTable must be real numbers"),
        (lambda: LookupTable([1, 2], [0, 1], beyond="clap"), "unknown beyond 'clap'; did you mean"),
    ],
)
def test_what_is_wrong_is_refused_where_it_is_made(make, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        make()
    with pytest.raises(TypeError, match="a function of 1 numbers; got 2"):
        LookupTable(X, NUMBERS[:, 0])(1.0, 2.0)
