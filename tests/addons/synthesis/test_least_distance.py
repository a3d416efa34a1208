"""The steps against a general optimiser, and against enumeration."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from verifai_jax.addons.synthesis.linear_steps import max_min_step, smallest_change
from verifai_jax.addons.synthesis.optimize import worst_case
from verifai_jax.addons.synthesis.parametric import Pairs

sizes = st.tuples(st.integers(1, 4), st.integers(1, 6), st.integers(0, 10_000))


def drawn(p, n, seed):
    rng = np.random.default_rng(seed)
    return rng.random(p), rng.random(p), rng.normal(size=n), rng.normal(size=(n, p))


@settings(max_examples=60, deadline=None)
@given(sizes)
def test_least_change_is_the_nearest(size):
    p, n, seed = size
    theta, nominal, rho, slopes = drawn(p, n, seed)
    step = smallest_change(theta, nominal, rho, slopes, 0.3, free=np.ones(p, bool), bounded=True)
    other = minimize(
        lambda z: np.sum((theta + z - nominal) ** 2),
        nominal - theta,
        constraints=[{"type": "ineq", "fun": lambda z: rho + slopes @ z - 0.3}],
        bounds=[(-t, 1 - t) for t in theta],
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 200},
    )
    possible = (rho + slopes @ other.x).min() >= 0.3 - 1e-6
    assert (step is not None) == possible
    if step is not None:
        assert (rho + slopes @ step).min() >= 0.3 - 1e-6
        far = np.linalg.norm(theta + step - nominal)
        assert far == pytest.approx(np.linalg.norm(theta + other.x - nominal), abs=1e-4)


@settings(max_examples=40, deadline=None)
@given(sizes)
def test_uphill_beats_every_corner_and_stays_inside(size):
    p, n, seed = size
    theta, _, rho, slopes = drawn(p, n, seed)
    step = max_min_step(theta, rho, slopes, 0.2, free=np.ones(p, bool), bounded=True)
    assert (abs(step) <= 0.2 + 1e-9).all()
    assert (theta + step >= -1e-9).all()
    assert (theta + step <= 1 + 1e-9).all()
    gained = (rho + slopes @ step).min()
    for corner in itertools.product((-0.2, 0.0, 0.2), repeat=p):
        inside = np.clip(theta + np.array(corner), 0, 1) - theta
        assert gained >= (rho + slopes @ inside).min() - 1e-6


def test_coordinates_that_are_not_free_stay():
    theta, nominal, rho, slopes = drawn(3, 2, 1)
    free = np.array([True, False, True])
    assert max_min_step(theta, rho, slopes, 0.2, free=free, bounded=True)[1] == 0
    step = smallest_change(theta, nominal, rho, slopes, -9.0, free=free, bounded=True)
    np.testing.assert_allclose(step, np.where(free, nominal - theta, 0))


def test_no_slope_no_step():
    flat = np.zeros((2, 3))
    theta = np.full(3, 0.5)
    assert not max_min_step(theta, np.ones(2), flat, 0.2, free=np.ones(3, bool), bounded=True).any()
    found = smallest_change(theta, theta, -np.ones(2), flat, 0, free=np.ones(3, bool), bounded=True)
    assert found is None


def pairs(rho, failing=None, proper=None):
    rho = np.array(rho, float)
    failing = rho < 0 if failing is None else np.array(failing)
    return Pairs(rho, failing, np.ones(rho.shape, bool) if proper is None else np.array(proper))


def test_the_value_of_parameters():
    np.testing.assert_array_equal(worst_case(pairs([[1, 2], [-1, 3]])), [1, -1])
    # A pair that cannot happen says nothing; parameters of which none can are no choice.
    np.testing.assert_array_equal(worst_case(pairs([[np.inf, 2], [np.inf, np.inf]])), [2, -np.inf])
    # A simulation without a verdict is no robust one,
    unknown = pairs([[1, np.nan], [1, 2]], proper=[[True, False], [True, True]])
    assert worst_case(unknown)[0] == -np.inf
    # unless the environment gives none to anybody.
    assert worst_case(pairs([[1, np.nan]], proper=[[True, False]]))[0] == 1
    # Zero that the Boolean semantics call a failure is below zero.
    assert worst_case(pairs([[0.0]], failing=[[True]]))[0] < 0 <= worst_case(pairs([[0.0]]))[0]
