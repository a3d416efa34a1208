"""Failures belong to their region, where all coordinates count and where few do."""

import numpy as np

from verifai_jax.addons.estimation.failure_modes.regions import Regions


def drawn(rng, n, narrow, at):
    """Points in 20 dimensions, narrow in three of them."""
    z = rng.standard_normal((n, 20))
    z[:, narrow] = at + 0.01 * rng.standard_normal((n, 3))
    return z


def test_regions_narrow_in_other_coordinates_are_told_apart():
    rng = np.random.default_rng(0)
    one, other = ([0, 1, 2], np.array([1.0, -1.0, 0.5])), ([7, 8, 9], np.array([0.2, 0.3, -1.0]))
    points = np.concatenate([drawn(rng, 40, *one), drawn(rng, 40, *other)])
    regions = Regions(points, np.repeat([0, 1], 40))
    z = np.concatenate([drawn(rng, 500, *one), drawn(rng, 500, *other)])
    truth = np.repeat([0, 1], 500)
    assert np.mean(regions.assign(z) == truth) > 0.99
    nearest = np.argmin(np.linalg.norm(z[:, None] - points, axis=2), axis=1) // 40
    assert np.mean(nearest == truth) < 0.95


def test_paths_are_tried_to_the_nearest_point_of_each_region_first():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(k, 0.1, (10, 2)) for k in (0.0, 3.0, 6.0)])
    regions = Regions(points, np.repeat([0, 1, 2], 10))
    tried = regions.candidates(np.array([[3.1, 3.0]]))[0]
    assert regions.region[tried[:3]].tolist()[0] == 1
    assert set(regions.region[tried[:3]]) == {0, 1, 2}
    assert set(regions.region[tried[3:]]) == {1}


def test_a_region_of_one_point_is_as_wide_as_the_prior():
    regions = Regions(np.zeros((0, 2)), np.zeros(0, int))
    regions.add(np.array([[4.0, 0.0]]), 0)
    regions.add(np.array([[-4.0, 0.0], [-4.1, 0.2]]), 1)
    assert regions.count == 2
    assert regions.assign(np.array([[5.0, 1.0], [-3.0, 1.0]])).tolist() == [0, 1]
    assert regions.design_points.tolist() == [[4.0, 0.0], [-4.0, 0.0]]


def test_a_region_of_which_one_point_is_known_keeps_its_failures():
    """Beside two narrow ones, for whose sake distances are in standard deviations."""
    rng = np.random.default_rng(0)
    one, other = ([0, 1, 2], np.array([1.0, -1.0, 0.5])), ([7, 8, 9], np.array([0.2, 0.3, -1.0]))
    alone = np.zeros(20)
    alone[12] = 4.5
    points = np.concatenate([drawn(rng, 40, *one), drawn(rng, 40, *other), alone[None]])
    regions = Regions(points, np.repeat([0, 1, 2], [40, 40, 1]))
    beyond = rng.standard_normal((500, 20))
    beyond[:, 12] = 4.5 + rng.exponential(0.2, 500)
    assert np.all(regions.assign(beyond) == 2)
    assert np.mean(regions.assign(drawn(rng, 500, *one)) == 0) > 0.99


def test_standard_deviations_of_two_points_are_not_too_small_in_the_mean():
    rng = np.random.default_rng(1)
    sizes = np.repeat(np.arange(400), 2)
    regions = Regions(rng.standard_normal((800, 20)), sizes)
    assert abs(np.log(regions.standard_deviations()).mean()) < 0.02
