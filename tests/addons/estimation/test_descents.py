"""Descents arrive in every failing region, in few simulations, and ends tell regions apart."""

import numpy as np
import pytest
from closed_forms import Cells, with_gradient

from verifai_jax.addons.estimation.descents import (
    Ends,
    begin_descents,
    descend_from_many,
    points_ahead,
)
from verifai_jax.addons.estimation.exploration import spread_out
from verifai_jax.addons.estimation.normal_space import LimitState


def test_few_descents_go_on_to_a_plane_that_many_have_come_to():
    """Four half-spaces; the robustness falls to the first over most of the space."""
    normals, distances = np.eye(30)[:4], np.array([4.0, 4.1, 4.2, 4.3])
    speeds = np.array([0.1, 1.0, 3.0, 4.0])

    def robustness(z):
        return np.min((distances - z @ normals.T) * speeds, axis=1)

    def gradient(z):
        own = np.argmin((distances - z @ normals.T) * speeds, axis=1)
        return -normals[own] * speeds[own][:, None]

    known = with_gradient(robustness, gradient, 30, 10_000)
    ends = descend_from_many(known, np.random.default_rng(0), 2000)
    planes = np.bincount(np.argmin(distances - ends.points @ normals.T, axis=1), minlength=4)
    assert planes.min() >= 3
    assert planes[0] < 100
    # Ends of a plane share its foot, starts that fail themselves too; not those of random steps.
    gaps = np.linalg.norm(ends.feet[:, None] - distances[:, None] * normals, axis=2)
    assert np.mean(gaps.min(axis=1) < 1e-6) > 0.9


def test_planes_near_the_origin_are_told_apart_by_their_directions():
    feet = np.array([[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 3.0], [0.0, 0.0, 3.0]])
    points = np.array([[0.01, 3.5, 0.0], [3.5, 0.01, 0.0], [1.0, 0.0, 3.0], [0.0, 1.0, 3.0]])
    ends = Ends(points, feet)
    gaps = np.linalg.norm(ends.planes[:, None] - ends.planes, axis=2)
    assert gaps[0, 1] > 4.0
    # Parallel planes are as far apart as they are, and one plane is one.
    far = Ends(points, feet * [[1.0], [1.0], [1.0], [1.5]])
    assert np.linalg.norm(far.planes[2] - far.planes[3]) == pytest.approx(1.5)
    assert gaps[2, 3] == 0.0
    assert sorted(spread_out(ends, 4)) in ([0, 1, 2], [0, 1, 3])


def test_a_start_is_where_its_slope_leads():
    normals = np.array([0.6, 0.8, 0.0])
    known = with_gradient(
        lambda z: 2.0 - z @ normals, lambda z: np.broadcast_to(-normals, z.shape), 3, 1000
    )
    z = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, -2.0], [-3.0, -4.0, 0.5]])
    ahead = points_ahead(known, begin_descents(known, z))
    assert ahead[:2] @ normals == pytest.approx(2.0)
    assert ahead[:2, 2] == pytest.approx(z[:2, 2])
    # No farther than one step, and nowhere without a slope.
    assert np.linalg.norm(ahead[2] - z[2]) == pytest.approx(3.0)
    flat = with_gradient(lambda z: np.ones(len(z)), np.zeros_like, 3, 1000)
    assert np.array_equal(points_ahead(flat, begin_descents(flat, z)), z)


def warped(cells, power):
    """The cells, their robustness to a power, which leaves failures as they are."""

    def differentiate(u):
        rho, fails, proper, slope = cells.differentiate(u)
        size = np.abs(rho) ** (power - 1)
        return np.sign(rho) * np.abs(rho) ** power, fails, proper, power * size[:, None] * slope

    dim = cells.centres.shape[1]
    return LimitState(
        lambda u: differentiate(u)[:3],
        dim,
        10_000,
        batch=10_000,
        gradient=differentiate,
        uniform=np.ones(dim, bool),
    )


@pytest.mark.parametrize("power", [1.0, 2.0, 3.0])
def test_descents_arrive_where_the_slope_vanishes_towards_the_limit_state(power):
    """Each step lowers one of three coordinates, so hardly two steps go the same way."""
    cells = Cells(10, 4, 3)
    ends = descend_from_many(warped(cells, power), np.random.default_rng(0), 2000)
    counts = np.bincount(cells.of(ends.points), minlength=4)
    assert counts.min() >= 3
