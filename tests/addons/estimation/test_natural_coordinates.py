"""Steps in natural coordinates are steps of the features, in normal space."""

import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import normal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr, ndtri
from scipy.stats import norm

import verifai_jax as vj
from verifai_jax.addons.estimation.descents import descend_from_many
from verifai_jax.addons.estimation.double_precision import DoublePrecisionEvaluator
from verifai_jax.addons.estimation.natural_coordinates import (
    NEAREST_FACE,
    WIDTH,
    move_naturally,
    natural_slopes,
)
from verifai_jax.addons.estimation.normal_space import LimitState

UNIFORM = np.array([True, False])


@given(st.floats(-36, 36), st.floats(-4, 4))
@settings(max_examples=200, deadline=None)
def test_a_uniform_feature_moves_in_its_interval_and_another_in_normal_space(z, step):
    moved = move_naturally(np.array([[z, z]]), np.array([[step, step]]), UNIFORM)[0]
    assert moved[1] == z + step
    assert np.isfinite(moved[0])
    begin, end = ndtr(z), ndtr(moved[0])
    wanted = begin + step / WIDTH
    least, most = NEAREST_FACE * begin, 1 - NEAREST_FACE * (1 - begin)
    assert end == pytest.approx(np.clip(wanted, least, most), rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("z", [-30.0, -9.0, 9.0, 30.0])
def test_far_out_a_step_keeps_the_digits_of_the_nearer_end(z):
    """Eight and more standard deviations out the place in the interval is 1 in floating point."""
    moved = move_naturally(np.full((1, 1), z), np.sign([[z]]) * 1.0, np.array([True]))[0, 0]
    assert norm.logsf(abs(moved)) == pytest.approx(norm.logsf(abs(z)) + np.log(NEAREST_FACE))


def test_slopes_are_those_by_finite_differences_of_a_step():
    z = np.array([[0.7, -1.1], [-2.0, 0.3]])

    def robustness(points):
        return np.sin(points[:, 0]) * points[:, 1] ** 2

    gradient = np.stack([np.cos(z[:, 0]) * z[:, 1] ** 2, 2 * np.sin(z[:, 0]) * z[:, 1]], axis=1)
    slopes = natural_slopes(z, gradient, UNIFORM)
    for axis in range(2):
        step = np.zeros((2, 2))
        step[:, axis] = 1e-6
        after, before = (move_naturally(z, sign * step, UNIFORM) for sign in (1, -1))
        differences = (robustness(after) - robustness(before)) / 2e-6
        assert slopes[:, axis] == pytest.approx(differences, rel=1e-6)


def test_the_coordinates_of_uniform_features_are_known():
    space = {
        "box": vj.Box(-3.0, 5.0),
        "normal": vj.Normal(0.0, 2.0),
        "speeds": vj.Array(vj.Box(0.0, 1.0), 2),
        "log": vj.LogUniform(0.1, 10.0),
        "gear": vj.DiscreteBox(1, 6),
    }

    def system(features, key):
        return vj.Trace({"x": features["box"][None]}, dt=1.0)

    problem = vj.Problem("uniform", space, system, "x >= 0")
    evaluator = DoublePrecisionEvaluator(problem, 16, "float32", 0)
    assert evaluator.uniform.tolist() == [True, False, True, True, False, False]
    assert jnp.asarray(evaluator.clamped).shape == (6,)


def ball_in_a_box(known):
    """A ball of probability 5e-5 inside a box of three uniform features."""
    centre, radius = np.array([0.2, 0.7, 0.8]), 0.023

    def both(u):
        away = np.linalg.norm(u - centre, axis=1)
        margin = away - radius
        return margin, (u - centre) / away[:, None]

    def evaluate(u):
        rho, _ = both(u)
        return rho, rho < 0, np.isfinite(rho)

    return LimitState(
        evaluate,
        3,
        10_000,
        batch=10_000,
        gradient=lambda u: (*evaluate(u), both(u)[1]),
        uniform=np.full(3, known),
    )


def test_descents_arrive_sooner_where_uniform_features_are_known():
    counts = {}
    for known in (True, False):
        ends = descend_from_many(ball_in_a_box(known), np.random.default_rng(0), 1000)
        counts[known] = len(ends.points)
    assert counts[True] > 3 * counts[False]


def test_natural_coordinates_of_normal_space_are_itself():
    z = np.random.default_rng(0).standard_normal((5, 2))
    none = np.zeros(2, bool)
    assert np.array_equal(move_naturally(z, 0.1 * z, none), z + 0.1 * z)
    assert np.array_equal(natural_slopes(z, z, none), z)
    assert normal(ndtr(z)) == pytest.approx(ndtri(ndtr(z)))
