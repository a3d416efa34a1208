"""Predicates in units of their own scale, and the annealing schedule."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import anneal, normalize, parse, robustness, satisfied

FORMULA = parse("G (abs(x) <= 2.4 & abs(theta) <= 0.2) & F (x > 0)")


def test_scales_divide_both_sides():
    scaled = normalize(FORMULA, {"x": 2.4, "theta": 0.2})
    expected = "G (abs(x) / 2.4 <= 1 & abs(theta) / 0.2 <= 1) & F (x / 2.4 > 0)"
    assert scaled == parse(expected)


def test_a_scale_keeps_the_truth_and_makes_the_margin_relative():
    trace = Trace({"x": np.array([0.0, 1.2, 0.6]), "theta": np.array([0.1, 0.0, -0.19])}, dt=0.1)
    scaled = normalize(FORMULA, {"x": 2.4, "theta": 0.2})
    assert bool(satisfied(scaled, trace)) == bool(satisfied(FORMULA, trace))
    np.testing.assert_allclose(robustness(scaled, trace), 0.05, rtol=1e-5)


def test_scales_from_a_trace_are_the_ranges_of_the_margins():
    trace = Trace({"x": np.array([0.0, 1.0, 4.0]), "theta": np.array([0.0, 0.1, 0.0])}, dt=0.1)
    scaled = normalize(parse("G (x < 8 & theta < 0.3)"), trace)
    np.testing.assert_allclose(robustness(scaled, trace), 1.0, rtol=1e-6)
    assert str(scaled).startswith("always (x / 4 < 2 & theta / 0.1 < ")


def test_wrong_scales():
    with pytest.raises(UnknownNameError, match="unknown signal 'theta2'; did you mean 'theta'"):
        normalize(FORMULA, {"x": 1.0, "theta2": 1.0})
    with pytest.raises(ValueError, match="these signals need a scale: theta"):
        normalize(FORMULA, {"x": 1.0})
    with (
        unchecked(),
        pytest.raises(ValueError, match="scale of 'x' must be positive and finite; got 0"),
    ):
        normalize(FORMULA, {"x": 0.0, "theta": 1.0})


@pytest.mark.thorough
def test_annealing_is_geometric_and_may_be_traced():
    taus = jax.vmap(lambda k: anneal(k, 11, 0.4, 0.1))(jnp.arange(13))
    np.testing.assert_allclose(taus[np.array([0, 5, 10, 12])], [0.4, 0.2, 0.1, 0.1], rtol=1e-5)
    ratios = np.asarray(taus[1:11] / taus[:10])
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-5)
    assert float(anneal(0, 1)) == pytest.approx(0.3)
    with unchecked(), pytest.raises(ValueError, match="at least one step; got 0"):
        anneal(0, 0)
    with unchecked(), pytest.raises(ValueError, match="temperatures must be positive"):
        anneal(0, 5, end=0.0)
