import numpy as np
import pytest

from verifai_jax.addons.training.sweeps.pareto import fronts


def dominates(one, other):
    return all(a <= b for a, b in zip(one, other, strict=True)) and any(
        a < b for a, b in zip(one, other, strict=True)
    )


def brute_force(points):
    """By the definition: peel off what nobody among the rest dominates."""
    found = [-1] * len(points)
    left = {i for i, point in enumerate(points) if not any(np.isnan(point))}
    front = 0
    while left:
        best = {i for i in left if not any(dominates(points[j], points[i]) for j in left)}
        for i in best:
            found[i] = front
        left, front = left - best, front + 1
    return found


@pytest.mark.parametrize("objectives", [1, 2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_fronts_are_those_of_the_definition(objectives, seed):
    rng = np.random.default_rng(seed)
    # Few distinct values: ties in some objectives, and points that come twice.
    points = rng.integers(0, 6, (60, objectives)).astype(float)
    points[rng.random(points.shape) < 0.03] = np.nan
    points[rng.random(points.shape) < 0.03] = np.inf
    assert fronts(points).tolist() == brute_force(points.tolist())


def test_continuous_points():
    points = np.random.default_rng(0).normal(size=(150, 3))
    assert fronts(points).tolist() == brute_force(points.tolist())


def test_many_points_are_compared_in_parts(monkeypatch):
    points = np.random.default_rng(1).normal(size=(80, 2))
    monkeypatch.setattr("verifai_jax.addons.training.sweeps.pareto._MAX_PAIRS", 500)
    assert fronts(points).tolist() == brute_force(points.tolist())


def test_nothing_at_all():
    assert fronts(np.zeros((0, 3))).tolist() == []
    assert fronts(np.full((2, 3), np.nan)).tolist() == [-1, -1]


def test_a_list_of_numbers_is_no_set_of_points():
    with pytest.raises(ValueError, match=r"points must have shape \[n, objectives\]; got \[2\]"):
        fronts(np.zeros(2))
