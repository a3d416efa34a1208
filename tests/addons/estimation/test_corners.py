"""Likeliest failures at corners of failing regions, beside a quadratic program's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from verifai_jax.addons.estimation.corners import approach_corner
from verifai_jax.addons.estimation.normal_space import LimitState


def polytope(normals, offsets, elsewhere=None):
    """Fails where `normals z >= offsets` in all rows; `elsewhere` is a robustness below it."""

    def margins(z):
        return offsets - z @ normals.T

    def rho(z):
        own = margins(z).max(axis=1)
        return own if elsewhere is None else np.minimum(own, elsewhere(z))

    def evaluate(u):
        z = from_cube(u)
        return rho(z), rho(z) < 0, np.isfinite(rho(z))

    def differentiate(u):
        z = from_cube(u)
        slopes = -normals[margins(z).argmax(axis=1)]
        if elsewhere is not None:
            other = elsewhere(z) < margins(z).max(axis=1)
            slopes = np.where(other[:, None], np.ones_like(z), slopes)
        return *evaluate(u), slopes * np.sqrt(2 * np.pi) * np.exp(z * z / 2)

    from scipy.special import ndtri

    def from_cube(u):
        return ndtri(np.clip(u, 1e-15, 1 - 1e-15))

    return LimitState(evaluate, normals.shape[1], 10_000, batch=1000, gradient=differentiate)


@given(st.integers(2, 6), st.integers(2, 3), st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_the_corner_is_that_of_a_quadratic_program(dim, count, seed):
    rng = np.random.default_rng(seed)
    count = min(count, dim)
    normals = rng.standard_normal((count, dim))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = rng.uniform(0.5, 2.0, count)
    start = np.linalg.lstsq(normals, offsets + 0.5, rcond=None)[0]
    start += 0.1 * (np.eye(dim) - np.linalg.pinv(normals) @ normals) @ rng.standard_normal(dim)
    if np.linalg.norm(start) > 5:
        return
    solved = minimize(
        lambda z: z @ z,
        start,
        jac=lambda z: 2 * z,
        constraints={"type": "ineq", "fun": lambda z: normals @ z - offsets},
        options={"ftol": 1e-12},
    )
    known = polytope(normals, offsets)
    found, _ = approach_corner(known, start[None])
    assert known(found).failing.all()
    assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(solved.x), rel=3e-3)


def test_another_region_on_the_way_is_no_limit_of_this_one():
    """Nearer to the origin the robustness of another region is less, and no plane of this one."""
    normals, offsets = np.eye(3)[:2], np.array([2.5, 2.5])
    known = polytope(normals, offsets, lambda z: 0.5 + np.abs(z).sum(axis=1) / 3)
    start = np.array([[3.5, 2.6, 0.7], [2.6, 4.0, -0.5]])
    found, planes = approach_corner(known, start)
    assert known(found).failing.all()
    assert np.linalg.norm(found, axis=1) == pytest.approx(np.hypot(2.5, 2.5), rel=1e-3)
    # The planes that meet there are told, those of the other region among them if any.
    for own in planes:
        assert np.abs(own @ normals.T).max(axis=0) == pytest.approx([1.0, 1.0])


def test_a_failure_without_a_slope_stays():
    known = polytope(np.eye(2), np.array([1.0, 1.0]))
    flat = LimitState(
        known.evaluate,
        2,
        1000,
        batch=100,
        gradient=lambda u: (*known.evaluate(u), np.full_like(u, np.nan)),
    )
    start = np.array([[1.5, 2.0]])
    assert np.array_equal(approach_corner(flat, start)[0], start)
