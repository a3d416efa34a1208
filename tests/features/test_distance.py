"""Distances between features: known values, and the axioms of a metric."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from verifai_jax.features import (
    Array,
    Box,
    Categorical,
    Constant,
    DiscreteBox,
    FeatureSpace,
    Normal,
    Signal,
    Struct,
)

SPACE = FeatureSpace(
    {
        "x": Box(0, 10),
        "n": Normal(0, 1),
        "gear": DiscreteBox(1, 5),
        "alg": Categorical("a", "b", "c", weights=[0.5, 0.4, 0.1]),
        "wind": Signal(Box(-1, 1), 2),
        "cars": Array(Box(0, 1), length=(0, 2)),
    }
)
BASE = {"x": 2, "n": 0, "gear": 3, "alg": "a", "wind": [0, 0], "cars": []}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({}, 0),
        ({"x": 7}, 0.5),
        ({"n": 1}, 0.3413447),  # The probability between the two.
        ({"gear": 5}, 0.5),
        ({"gear": 1}, 0.5),
        ({"alg": "b"}, 1),
        ({"alg": "c"}, 1),
        ({"wind": [0, 1]}, 0.5),
        ({"cars": [0.5, 0.5]}, 1),
        ({"cars": [0.5]}, 0.5),
        ({"x": 5, "gear": 4, "alg": "c"}, np.sqrt(0.3**2 + 0.25**2 + 1)),
    ],
)
def test_known_values(changes, wanted):
    one, other = SPACE.coerce(BASE), SPACE.coerce({**BASE, **changes})
    assert float(SPACE.distance(one, other)) == pytest.approx(wanted, abs=1e-6)


@pytest.mark.thorough
def test_values_as_a_person_writes_them():
    cars = {"n": Array(Struct({"lane": Categorical("left", "right"), "v": Box(0, 10)}), 2)}
    space = FeatureSpace(
        {**SPACE.domains, **cars, "g": Constant(9.8), "at": DiscreteBox([0, 0], [2, 4])}
    )
    written = {
        **BASE,
        "n": [{"lane": "left", "v": 2}, {"lane": "right", "v": 5.0}],
        "at": [1, 4],
    }
    changes = {
        "x": np.float64(7),
        "alg": "c",
        "n": {"lane": ["left", "left"], "v": [2, 5]},
        "at": (2, 3),
    }
    one, other = written, {**written, **changes}
    expected = float(space.distance(space.coerce(one), space.coerce(other)))
    assert expected == pytest.approx(np.sqrt(0.5**2 + 1 + 1 + 0.5**2 + 0.25**2))
    assert float(space.distance(one, other)) == expected
    assert float(space.distance(space.coerce(one), other)) == expected
    assert float(space.distance(one, one)) == 0


def test_rows_of_a_table():
    space = FeatureSpace({"x": Box(0, 10), "alg": Categorical("a", "b")})
    table = pd.DataFrame({"x": [2.0, 7.0], "alg": ["a", "b"], "rho": [1.0, -1.0]})
    expected = pytest.approx(np.sqrt(0.5**2 + 1))
    assert float(space.distance(table.loc[0], table.loc[1])) == expected
    assert float(space.distance(table.loc[0], {"x": 7, "alg": "b"})) == expected


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"alg": "d"}, "alg must be one of 'a', 'b', 'c'; got 'd'"),
        ({"x": "far"}, "x must be a number; got 'far'"),
        ({"gear": 2.5}, "gear must be an integer from 1 to 5; got 2.5"),
        ({"cars": [0.1, 2]}, r"cars\[1\] must lie in \[0, 1\]; got 2"),
        ({"speed": 1}, "unknown feature 'speed'"),
    ],
)
def test_values_outside_the_space_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        SPACE.distance(BASE, {**BASE, **changes})
    with pytest.raises(ValueError, match="gear is missing"):
        SPACE.distance({name: BASE[name] for name in BASE if name != "gear"}, BASE)


points = st.lists(st.floats(0, 1, width=32), min_size=SPACE.dim, max_size=SPACE.dim)


@jax.jit
def distances(us):
    a, b, c = (SPACE.unflatten(u) for u in us)
    return [SPACE.distance(*pair) for pair in ((a, b), (b, a), (b, c), (a, c), (a, a))]


@pytest.mark.slow
@given(points, points, points)
@settings(max_examples=100, deadline=None)
def test_is_a_metric(a, b, c):
    us = jnp.array([a, b, c], jnp.float32)
    ab, ba, bc, ac, aa = (float(d) for d in distances(us))
    assert aa == 0
    assert ab == ba >= 0
    assert ac <= ab + bc + 1e-5


@pytest.mark.slow
@given(points, st.integers(0, SPACE.dim - 1))
@settings(max_examples=40, deadline=None)
def test_is_zero_only_between_the_same(u, i):
    one = jnp.array(u, jnp.float32)
    other = one.at[i].set(jnp.mod(one[i] + 0.5, 1.0))
    a, b = SPACE.unflatten(one), SPACE.unflatten(other)
    same = all(np.array_equal(p, q) for p, q in zip(*map(jax.tree.leaves, (a, b)), strict=True))
    assert (float(SPACE.distance(a, b)) == 0) == same


@pytest.mark.slow
def test_derivatives_are_finite_between_the_same():
    u = jnp.full(SPACE.dim, 0.3)
    slope = jax.grad(lambda v: SPACE.distance(SPACE.unflatten(u), SPACE.unflatten(v)))
    assert np.all(np.isfinite(slope(u)))
    np.testing.assert_allclose(slope(u.at[0].set(0.6))[0], 1, rtol=1e-5)
