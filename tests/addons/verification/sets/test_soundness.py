"""No value leaves its set: random expressions and boxes, in float32 and in real arithmetic."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_expressions import ONE, TWO, Expression, boxes, enclosed, escapes, expression, points

INPUTS = Expression("input", (0,)), Expression("input", (1,))


def random_case(seed):
    random = np.random.default_rng(seed)
    tree = expression(random, int(random.integers(1, 5)))
    low, high = boxes(random, 16)
    return tree, low, high, points(random, low, high)


@pytest.mark.parametrize("name", [*ONE, *TWO])
def test_each_function_contains_its_values(name):
    """Boxes of all sizes: subnormal, huge, around zero, where a function is not defined."""
    random = np.random.default_rng(0)
    low, high = boxes(random, 400)
    tree = Expression(name, INPUTS[: 1 if name in ONE else 2])
    assert escapes(tree, low, high, points(random, low, high)) == []


@pytest.mark.thorough
@pytest.mark.parametrize("block", range(4))
def test_random_expressions_contain_their_values(block):
    found = [text for seed in range(60) for text in escapes(*random_case(1000 * block + seed))]
    assert found == []


@pytest.mark.proves
def test_ten_thousand_expressions_contain_their_values():
    """Measured on 42,000: none escapes."""
    found = [text for seed in range(10_000) for text in escapes(*random_case(100_000 + seed))]
    assert found == []


@pytest.mark.thorough
def test_fused_programs_stay_within_the_same_sets():
    """XLA contracts products and sums, and divides by multiplying; sets allow for that."""
    for seed in range(12):
        tree, low, high, drawn = random_case(500 + seed)
        least, greatest = enclosed(tree, low, high)
        values = np.asarray(jax.jit(lambda *x, tree=tree: tree(x, 0))(*map(jnp.asarray, drawn)))
        values = values.astype(float)
        known = (np.isfinite(least) | np.isfinite(greatest))[:, None]
        assert not np.any(known & np.isnan(values))
        assert np.all((values >= least[:, None]) | np.isnan(values))
        assert np.all((values <= greatest[:, None]) | np.isnan(values))


@pytest.mark.parametrize(
    ("tree", "low", "high"),
    [
        # A division by an interval with zero, at an end and inside.
        (Expression("div", INPUTS), [1.0, 0.0], [2.0, 1.0]),
        (Expression("div", INPUTS), [1.0, -1e-41], [2.0, 1.0]),
        (Expression("inverse square", INPUTS[:1]), [-1e-30, 0.0], [1.0, 1.0]),
        # Beyond the domain, and an overflow followed by a difference.
        (Expression("log", INPUTS[:1]), [-1e-3, 0.0], [1.0, 1.0]),
        (Expression("sub", (Expression("exp", INPUTS[:1]), Expression("exp", INPUTS[1:]))),
         [80.0, 80.0], [90.0, 90.0]),
    ],
)  # fmt: skip
def test_what_may_be_nan_is_unbounded_on_both_sides(tree, low, high):
    low, high = np.array([[*low, 0.0]]), np.array([[*high, 0.0]])
    least, greatest = enclosed(tree, low, high)
    assert least[0] == -np.inf
    assert greatest[0] == np.inf


def test_an_overflow_is_unbounded_above_alone():
    least, greatest = enclosed(
        Expression("exp", INPUTS[:1]), np.array([[1.0, 0, 0]]), np.array([[100.0, 0, 0]])
    )
    assert least[0] == pytest.approx(np.e, rel=1e-5)
    assert greatest[0] == np.inf


@pytest.mark.parametrize(
    ("low", "high", "least", "greatest"),
    [
        (0.1, 0.4, np.sin(0.1), np.sin(0.4)),
        (1.0, 2.0, np.sin(1.0), 1.0),
        (1.0 + 20 * np.pi, 2.0 + 20 * np.pi, np.sin(1.0), 1.0),
        (-2.0, 2.0, -1.0, 1.0),
        (5e6, 5e6 + 0.5, -1.0, 1.0),
    ],
)
def test_sines_of_intervals_have_their_extremes(low, high, least, greatest):
    ends = enclosed(
        Expression("sin", INPUTS[:1]), np.array([[low, 0, 0]]), np.array([[high, 0, 0]])
    )
    np.testing.assert_allclose(np.ravel(ends), [least, greatest], atol=3e-6)


def test_what_depends_on_the_same_feature_cancels():
    """`x * 3 - x - x` is `x`; an interval alone would be nine times as wide."""
    x = INPUTS[0]
    tree = Expression("sub", (
        Expression("sub", (Expression("mul", (x, Expression("constant", (3.0,)))), x)), x
    ))  # fmt: skip
    least, greatest = enclosed(tree, np.array([[1.0, 0, 0]]), np.array([[1.1, 0, 0]]))
    assert greatest[0] - least[0] == pytest.approx(0.1, rel=1e-4)
    assert least[0] == pytest.approx(1.0, abs=1e-5)
