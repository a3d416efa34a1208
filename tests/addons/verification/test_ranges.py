"""The range of each feature over a box of the unit cube contains its value at each point of it."""

import jax
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.verification.ranges import FeatureRanges

SPACE = vj.FeatureSpace(
    {
        "box": vj.Box([-1, 0.1], [1, 0.3]), "open": vj.Box(0, 61.2, closed="neither"),
        "normal": vj.Normal(1, 0.3), "cut": vj.TruncatedNormal(0, 1, -0.5, 3),
        "scale": vj.LogUniform(0.05, 5), "wait": vj.Exponential(2.0), "gamma": vj.Gamma(2, 1),
        "beta": vj.Beta(2, 5), "wear": vj.Weibull(1.5, 2), "size": vj.LogNormal(0, 0.5),
        "shape": vj.Triangular(0, 1, 3), "seen": vj.Empirical([0.1, 0.2, 0.5, 0.9, 1.0]),
        "count": vj.DiscreteBox(-2, 5), "gain": vj.Categorical(0.5, 1.5, 2.5),
        "wind": vj.Signal(vj.Box(-1, 1), knots=3, hold="linear", duration=1.0),
        "fixed": vj.Constant(0.3),
    }
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_ranges_contain_the_values_and_are_not_wide(precision):
    ranges, random = FeatureRanges(SPACE, precision), np.random.default_rng(0)
    width = 2.0 ** -random.integers(0, 20, (60, SPACE.dim))
    low = np.floor(random.random((60, SPACE.dim)) / width) * width
    for j, edges in enumerate(ranges.edges):
        if edges is not None:
            cell = random.integers(0, len(edges) - 1, 60)
            low[:, j], width[:, j] = edges[cell], edges[cell + 1] - edges[cell]
    high = low + width
    found = ranges(low, high)
    for share in (0.0, 1.0, *random.random(20)):
        points = np.clip((low + share * width).astype(np.float32), low, high)
        inside = [edges is not None for edges in ranges.edges]
        points[:, inside] = ((low + high) / 2)[:, inside]
        with jax.enable_x64(precision == "float64"):
            values = jax.vmap(SPACE.unflatten)(points.astype(precision))
        for (least, greatest, _), leaf in zip(found, jax.tree.leaves(values), strict=True):
            leaf = np.asarray(leaf, np.float64)
            assert np.all(least <= leaf)
            assert np.all(leaf <= greatest)
    narrow = ranges(low, low)
    for least, greatest, _ in narrow[:2]:
        assert np.all(greatest - least <= 1e-4)


def test_boxes_of_the_whole_range_end_where_their_values_do():
    ranges = FeatureRanges(
        vj.FeatureSpace({"x": vj.Box(0, 1), "n": vj.DiscreteBox(1, 4)}), "float32"
    )
    (count, last, _), (low, high, _) = ranges(np.zeros((1, 2)), np.ones((1, 2)))
    assert (count.item(), last.item(), low.item(), high.item()) == (1, 4, 0.0, 1.0)
    assert ranges.shares(np.array([[0.25, 0.5]])).tolist() == [[0.25, 0.5]]
