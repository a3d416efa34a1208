"""Independent searches find regions that splitting leaves, and say what they may have missed."""

import numpy as np
import pytest
from closed_forms import closed_form, islands, normal, with_gradient
from scipy.stats import norm

from verifai_jax.addons.estimation.anchors import WeightedFailures, anchors_of, join_explorations
from verifai_jax.addons.estimation.answers import Plan, chains_for
from verifai_jax.addons.estimation.components import Gaussian, Prior
from verifai_jax.addons.estimation.exploration import approach_origin, explore
from verifai_jax.addons.estimation.initial_proposal import compare_explorations
from verifai_jax.addons.estimation.methods import estimate_automatically
from verifai_jax.addons.estimation.mixture import Mixture
from verifai_jax.addons.estimation.normal_space import farthest_first
from verifai_jax.addons.estimation.paths import connected, halve


def metaballs(z):
    a, b = z.T
    first = 30 / ((4 * (a + 2) ** 2 / 9 + b**2 / 25) ** 2 + 1)
    return first + 20 / (((a - 2.5) ** 2 / 4 + (b - 0.5) ** 2 / 25) ** 2 + 1) - 5


def breitung(z):
    """Breitung's discontinuous counterexample for subset simulation (2019)."""
    a, b = z.T
    first = np.where(a > 3.5, 4 - a, 0.85 - 0.1 * a)
    return np.minimum(first, np.where(b > 2, 0.5 - 0.1 * b, 2.3 - b))


def two_sides(z):
    """`z0 > 4` and `z0 < -4.2`; the robustness falls to the second a hundred times as slowly."""
    return np.minimum(4 - z[:, 0], 0.01 * (4.2 + z[:, 0]))


def limit_state(robustness, dim, budget):
    return closed_form(lambda u: robustness(normal(u)), dim, budget)


def test_chains_fail_and_the_nearest_failures_are_those_of_every_region():
    found = explore(limit_state(two_sides, 3, 10_000), np.random.default_rng(0), 3000)
    assert np.all(two_sides(found.points) < 0)
    assert np.all(two_sides(found.nearest) < 0)
    right = found.nearest[found.nearest[:, 0] > 0, 0]
    left = found.nearest[found.nearest[:, 0] < 0, 0]
    assert right.min() == pytest.approx(4.0, abs=0.3)
    assert left.max() == pytest.approx(-4.2, abs=0.3)


def test_gradients_lead_to_the_least_distant_failure_in_many_dimensions():
    a = np.random.default_rng(0).standard_normal(40)
    a /= np.linalg.norm(a)
    known = with_gradient(lambda z: 4.0 - z @ a, lambda z: np.broadcast_to(-a, z.shape), 40, 10_000)
    found = explore(known, np.random.default_rng(1), 1000)
    assert len(found.nearest) >= 8
    assert known.simulations <= 1250
    assert np.linalg.norm(found.nearest, axis=1) == pytest.approx(4.0, rel=0.01)
    far = approach_origin(known, 2.0 * found.nearest)
    assert np.linalg.norm(far, axis=1) == pytest.approx(4.0, rel=0.01)


def test_nothing_is_found_where_nothing_fails():
    found = explore(
        limit_state(lambda z: 1.0 + 0 * z[:, 0], 2, 10_000), np.random.default_rng(0), 1000
    )
    assert len(found.points) == len(found.nearest) == 0


def test_paths_join_points_of_one_region_only():
    known = limit_state(two_sides, 2, 1000)
    a = np.array([[4.5, 0.0], [4.5, 0.0]])
    b = np.array([[5.0, 2.0], [-4.5, 0.0]])
    assert connected(known, a, b).tolist() == [True, False]
    # Around a circle only the arc leads.
    outside = limit_state(lambda z: 4.0 - np.linalg.norm(z, axis=1), 2, 1000)
    assert connected(outside, np.array([[4.1, 0.0]]), np.array([[-1.0, 4.0]])).tolist() == [True]


def test_a_way_is_followed_to_where_failures_end():
    known = limit_state(lambda z: 2.0 - z[:, 0], 2, 1000)
    begin, end = np.array([[4.0, 1.0], [3.0, -5.0]]), np.array([[0.0, 0.0], [1.0, 5.0]])
    last, beyond = halve(known, begin, end, 12)
    assert known(last).failing.all()
    assert not known(beyond).failing.any()
    assert last == pytest.approx(np.array([[2.0, 0.5], [2.0, 0.0]]), abs=0.01)
    assert beyond == pytest.approx(last, abs=0.01)


def gaussian(*mean):
    return Mixture(
        (Prior(2), Gaussian(np.array(mean), np.eye(2), np.ones(2))), np.array([0.1, 0.9])
    )


def test_what_one_exploration_alone_has_reached_widens_the_interval():
    rng = np.random.default_rng(0)
    right, left = np.array([[4.5, 0.0]]), np.array([[-4.5, 0.0]])
    z = np.concatenate([np.repeat(right, 60, axis=0), np.repeat(left, 40, axis=0)])
    z += 0.1 * rng.standard_normal(z.shape)
    z = z[two_sides(z) < 0]
    x = np.full(len(z), 1e-5)
    known = limit_state(two_sides, 2, 20_000)
    one, whole = gaussian(4.5, 0), gaussian(4.5, 0).join(gaussian(-4.5, 0), 0.5)
    points = np.concatenate([right, left])
    agree = compare_explorations(known, rng, z, x, [whole, whole], [points, points])
    assert agree.unseen == 0.0
    assert agree.reached.tolist() == [1.0, 1.0]
    apart = compare_explorations(known, rng, z, x, [whole, one], [points, right])
    missed = np.mean(z[:, 0] < 0)
    assert apart.alone == pytest.approx(missed, abs=0.02)
    assert apart.unseen == pytest.approx(missed / 2, abs=0.02)
    assert apart.reached[1] == pytest.approx(1 - missed, abs=0.02)


def test_every_region_keeps_a_part_of_the_anchors():
    known, rng = limit_state(two_sides, 2, 20_000), np.random.default_rng(0)
    explorations = [explore(known, rng, 2000), explore(known, rng, 2000)]
    joined = join_explorations(explorations)
    assert len(np.unique(joined.chain_ids)) == len(joined.nearest)
    z, _ = anchors_of(explorations, 0.1).fit().sample(rng, 2000)
    fails = two_sides(z) < 0
    assert np.sum(fails & (z[:, 0] > 0)) > 50
    assert np.sum(fails & (z[:, 0] < 0)) > 50


CENTRES = np.array([[3.5, 0, 0], [-3.6, 0, 0], [0, 3.7, 0], [0, -3.8, 0], [0, 0, 4.0]])
RADII = np.array([0.6, 0.3, 0.4, 0.5, 0.3])
SPEEDS = np.array([0.5, 4.0, 1.0, 3.0, 0.8])


def test_islands_that_little_leads_to_are_found_and_each_has_chains():
    robustness, gradient = islands(CENTRES, RADII, SPEEDS)
    for seed in range(5):
        known = with_gradient(robustness, gradient, 3, 10_000)
        found = explore(known, np.random.default_rng(seed), 4000)
        gaps = np.linalg.norm(found.nearest[:, None] - CENTRES, axis=2) - RADII
        chains = np.bincount(gaps.argmin(axis=1), minlength=5)
        assert np.all(chains >= 2)
        # A region has chains of one island only.
        of_region = [np.unique(gaps.argmin(axis=1)[found.regions == k]) for k in range(5)]
        assert all(len(own) <= 1 for own in of_region)
        assert known.simulations <= 4500


def test_small_islands_beside_one_another_are_two_regions():
    centres = np.array([[3.0, 0.0], [3.0, 0.5]])
    robustness, gradient = islands(centres, np.array([0.1, 0.05]), np.array([1.0, 1.0]))
    known = with_gradient(robustness, gradient, 2, 10_000)
    found = explore(known, np.random.default_rng(0), 4000)
    gaps = np.linalg.norm(found.nearest[:, None] - centres, axis=2).argmin(axis=1)
    assert set(gaps) == {0, 1}
    assert not set(found.regions[gaps == 0]) & set(found.regions[gaps == 1])


def test_the_least_distant_failure_of_a_ball_is_found_though_its_tangent_planes_lie_outside():
    centre, radius = np.zeros(10), 1.5
    centre[0] = 4.0
    robustness, gradient = islands(centre[None], np.array([radius]), np.array([1.0]))
    rng = np.random.default_rng(0)
    z = rng.standard_normal((20, 10))
    z = centre + radius * rng.random((20, 1)) * z / np.linalg.norm(z, axis=1, keepdims=True)
    found = approach_origin(with_gradient(robustness, gradient, 10, 10_000), z, 15)
    assert np.all(robustness(found) < 0)
    assert np.linalg.norm(found, axis=1) == pytest.approx(4.0 - radius, rel=0.01)


def test_anchors_follow_the_failures_of_their_region():
    known, rng = limit_state(two_sides, 2, 20_000), np.random.default_rng(0)
    anchors = anchors_of([explore(known, rng, 2000)], 0.1)
    z = np.array([6.0, 1.0]) + 0.01 * rng.standard_normal((500, 2))
    fitted = anchors.fit(WeightedFailures(z, np.full(500, 1e-300)))
    fits = [c for c in fitted.components if isinstance(c, Gaussian) and np.all(c.stds < 0.3)]
    assert any(np.linalg.norm(c.mean - [6.0, 1.0]) < 0.5 for c in fits)
    gaussians = [c for c in anchors.fit().components if isinstance(c, Gaussian)]
    assert not any(np.all(np.abs(c.mean - [6.0, 1.0]) < 0.5) for c in gaussians)
    # The other region, where none of them lies, keeps its components.
    assert np.sum(two_sides(fitted.sample(rng, 2000)[0]) < 0) > 100


@pytest.mark.proves
@pytest.mark.parametrize(
    ("robustness", "truth"),
    # By a grid of step 0.002; the second is exact.
    [(metaballs, 1.128e-5), (breitung, 3.196e-5), (two_sides, norm.sf(4) + norm.sf(4.2))],
)
def test_intervals_cover_where_splitting_is_led_away(robustness, truth):
    covered = 0
    for seed in range(10):
        known = limit_state(robustness, 2, 50_000)
        plan = Plan(0.95, chains_for(50_000, 0.06), np.zeros(2, bool))
        answer = estimate_automatically(known, np.random.default_rng(seed), plan)
        covered += answer.low <= truth <= answer.high
        assert answer.probability == pytest.approx(truth, rel=0.1)
    # Of 10 intervals with a coverage of 0.95, fewer than 8 hold with probability 0.012.
    assert covered >= 8


def test_points_are_chosen_the_farthest_first():
    points = np.random.default_rng(0).standard_normal((40, 3))
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    rows = farthest_first(7, lambda row: gaps[row], 10)
    assert rows[0] == 7
    for count in range(1, 10):
        left = gaps[:, rows[:count]].min(axis=1)
        assert left[rows[count]] == left.max()
    near = farthest_first(7, lambda row: gaps[row], 40, min_gap=2.0)
    assert gaps[:, near].min(axis=1).max() <= 2.0
    assert gaps[np.ix_(near, near)][np.triu_indices(len(near), 1)].min() > 2.0


def test_each_ball_of_ten_dimensions_has_as_many_chains_as_any_other():
    """The two ends nearest to one of a ball are often of other balls, whose ends are many."""
    far, radii = np.array([3.5, 3.6, 3.7, 3.4]), np.array([1.6, 1.5, 1.7, 1.3])
    centres = far[:, None] * np.eye(10)[:4]
    robustness, gradient = islands(centres, radii, np.array([0.7, 1.0, 1.2, 1.5]))
    known = with_gradient(robustness, gradient, 10, 20_000)
    found = explore(known, np.random.default_rng(0), 6000)
    ball = (np.linalg.norm(found.nearest[:, None] - centres, axis=2) - radii).argmin(axis=1)
    chains = np.bincount(ball, minlength=4)
    assert chains.max() <= chains.min() + 1
