"""Goals and clauses: broken where the formula is, comparable whatever the units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from verifai_jax.core.values.clauses import CLAUSES
from verifai_jax.core.values.clauses import CLAUSES as TOLD
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import parse, robustness, smooth
from verifai_jax.mtl.clauses import ABSENT, GOALS, goals_of
from verifai_jax.search.clause_values import NOTHING

FORMULAS = (
    "x < 1",
    "(always[0, 0.3] x < 1) & (eventually[0, 0.3] y > 0)",
    "(always[0, 0.3] x < 1) -> (always[0, 0.2] y < 0.5)",
    "always[0, 0.3] (x < 1 & y < 1)",
    "eventually[0, 0.3] (x > 1 | y > 1)",
    "!(x < 1 & (y > 0 | x > 0.5))",
    "(x < 1) until[0, 0.3] (y > 0)",
    "(once[0, 0.2] x > 0) | (historically y < 1) | x == 2 | y != 0 | x > 3 | y > 3",
    "(x > 0 -> y > 0) & (y > 0.2 -> x > -0.2)",
    "true",
)


def trace(values):
    values = np.asarray(values, np.float32)
    return Trace({"x": values[:6], "y": values[6:]}, dt=0.1)


@pytest.mark.thorough
@pytest.mark.parametrize("text", FORMULAS)
@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(-2, 2, width=32), min_size=12, max_size=12))
def test_some_goal_is_broken_exactly_where_the_formula_is(text, values):
    formula, seen = parse(text), trace(values)
    goals = goals_of([formula]).values(seen)
    rho, least = float(robustness(formula, seen)), float(jnp.min(jnp.max(goals, axis=1)))
    if abs(rho) > 1e-5:
        assert (least < 0) == (rho < 0)


def test_what_the_parts_are():
    two = goals_of([parse("(always[0, 30] a < 3) -> (always[0, 8] b < 50)")])
    assert [len(goal) for goal in two.goals] == [2]
    assert str(two.goals[0][0]) == 'eventually[0,30] ("leaf 0" > 0)'
    # Always distributes over a conjunction, and several formulas are one.
    many = goals_of([parse("always (a < 1 & b < 2)"), parse("c > 0")])
    assert [len(goal) for goal in many.goals] == [1, 1, 1]
    long = goals_of([parse(" | ".join(f"s{i} > 0" for i in range(9)))])
    assert [len(goal) for goal in long.goals] == [CLAUSES]
    wide = goals_of([parse(" & ".join(f"s{i} > 0" for i in range(40)))])
    assert len(wide.goals) == GOALS
    assert len(wide.leaves) == 40


def test_units_do_not_matter():
    seen = trace(np.linspace(-1, 1.5, 12))
    big = Trace({"x": 1000 * seen["x"], "y": seen["y"]}, dt=0.1)
    one = goals_of([parse("(always x < 1) | (always y < 0.5)")]).values(seen)
    other = goals_of([parse("(always x < 1000) | (always y < 0.5)")]).values(big)
    np.testing.assert_allclose(one, other, rtol=1e-5)


@pytest.mark.slow
def test_absent_clauses_and_their_slopes():
    goals = goals_of([parse("x < 1 & (x < 2 | y < 1)")])

    def values(shift):
        seen = Trace({"x": jnp.linspace(0, 1, 4) + shift, "y": jnp.ones(4) * shift}, dt=0.1)
        return goals.values(seen, smooth(0.05))

    found = values(0.3)
    assert found.shape == (2, 2)
    assert found[0, 1] == ABSENT < NOTHING
    slopes = jax.jacobian(values)(0.3)
    assert np.all(np.isfinite(slopes))
    assert slopes[0, 1] == 0
    # The scale is not differentiated: y / sqrt(0 + (0.1 (0.3 + 1))^2), against 1.
    np.testing.assert_allclose(slopes[1, 1], -1 / 0.13, rtol=1e-4)


def test_searches_are_told_of_as_many():
    assert TOLD == CLAUSES
