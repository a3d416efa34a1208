"""Coverage of samples whose holes are known."""

import itertools

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm, qmc

import verifai_jax as vj
from verifai_jax.addons.analysis._coverage import coverage
from verifai_jax.addons.analysis.data.cells import pair_counts
from verifai_jax.addons.analysis.data.marginals import marginals
from verifai_jax.addons.analysis.data.samples import Samples


def judged(**columns):
    return pd.DataFrame(columns).assign(violated=False, status="ok")


@pytest.mark.slow
def test_discrepancy_is_relative_to_uniform_samples():
    ratios = []
    for seed in range(30):
        g = np.random.default_rng(seed)
        ratios.append(coverage(judged(x=g.random(256), y=g.random(256))).discrepancy)
    # One in the mean, as the formula for its expectation says.
    assert np.mean(ratios) == pytest.approx(1, abs=0.2)
    even = qmc.Sobol(2, rng=0).random(256)
    found = coverage(judged(x=even[:, 0], y=even[:, 1]))
    assert found.discrepancy < 0.1
    assert "more evenly than uniform samples" in str(found)
    g = np.random.default_rng(0)
    found = coverage(judged(x=g.random(256) ** 4, y=g.random(256)))
    assert found.discrepancy > 5
    assert "more crowded than uniform samples" in str(found)


def test_the_largest_hole_is_found():
    g = np.random.default_rng(1)
    points = g.random((20000, 2))
    kept = points[np.hypot(*(points - [0.3, 0.6]).T) > 0.2]
    found = coverage(judged(x=10 * kept[:, 0], y=kept[:, 1] - 1))
    assert found.dispersion == pytest.approx(0.2, abs=0.02)
    assert found.uniform_dispersion < 0.05
    assert found.hole["x"] == pytest.approx(3, abs=0.2)
    assert found.hole["y"] == pytest.approx(-0.4, abs=0.02)
    assert "largest hole: nothing within 0.2" in str(found)
    assert found.table["occupied"].tolist() == [1, 1]
    assert found.table["pairs"].max() < 1


def test_holes_in_many_dimensions_are_those_of_brute_force():
    g = np.random.default_rng(2)
    points = np.round(g.random((300, 9)), 3)
    found = coverage(judged(**{f"f{i}": points[:, i] for i in range(9)}))
    unit = (points - points.min(axis=0)) / np.ptp(points, axis=0)
    probes = qmc.Sobol(9, rng=0).random(1024)
    distances = np.linalg.norm(probes[:, None] - unit, axis=2).min(axis=1)
    assert found.dispersion == pytest.approx(distances.max(), abs=1e-4)


def test_what_was_never_tried_is_listed():
    rows = [
        (c, k) for c, k in itertools.product("abc", range(3)) if (c, k) not in {("b", 1), ("c", 2)}
    ]
    space = vj.FeatureSpace({"c": vj.Categorical(*"abcd"), "k": vj.DiscreteBox(0, 2)})
    table = judged(c=[r[0] for r in rows] * 9, k=[r[1] for r in rows] * 9)
    found = coverage(Samples.of(table, "all", space=space))
    assert found.untried.to_numpy().tolist() == [
        ["c", "d", "", ""],
        ["k", 1, "c", "b"],
        ["k", 2, "c", "c"],
    ]
    assert found.untried_count == 3
    assert str(found).endswith("never tried: c=d; k=1 with c=b; k=2 with c=c")
    assert found.table.loc["c", "occupied"] == 0.75
    assert found.table.loc["c", "pairs"] == pytest.approx(7 / 12)
    assert found.table.loc["k", "expected_pairs"] == pytest.approx(1 - (11 / 12) ** 63)


def test_pairs_are_counted():
    g = np.random.default_rng(0)
    ids = np.stack([g.integers(-1, 3, 5000), g.integers(0, 2, 5000)], axis=1)
    together = pair_counts(ids, np.array([3, 2]))
    for a, b in itertools.product(range(3), range(2)):
        assert together[a, 3 + b] == np.sum((ids[:, 0] == a) & (ids[:, 1] == b))


def test_the_prior_is_what_counts_where_the_space_is_known():
    space = vj.FeatureSpace({"x": vj.Box(-2, 6), "k": vj.DiscreteBox(3, 6)})
    table = judged(x=np.array([-2, 0, 2, 6.0]), k=[3, 4, 5, 6])
    samples = Samples.of(table, "all", space=space)
    x, k = marginals(samples)
    np.testing.assert_allclose(x.unit(samples), [0, 0.25, 0.5, 1], atol=1e-3)
    assert x.value(0.25) == pytest.approx(0, abs=0.01)
    np.testing.assert_allclose(k.unit(samples), [0.125, 0.375, 0.625, 0.875])
    assert k.value(0.3) == 4
    np.testing.assert_allclose(k.snap(np.array([0, 0.3, 1])), [0.125, 0.375, 0.875])
    # A quarter of the range is never reached, which the table alone could not tell.
    g = np.random.default_rng(0)
    part = judged(x=g.uniform(-2, 4, 5000), k=g.integers(3, 7, 5000))
    assert coverage(part).table.loc["x", "occupied"] == 1
    found = coverage(Samples.of(part, "all", space=space))
    assert found.table.loc["x", "occupied"] == pytest.approx(0.8)
    assert found.hole["x"] == pytest.approx(6, abs=0.1)


@pytest.mark.parametrize("rows", [1, 2, 7])
def test_few_rows(rows):
    g = np.random.default_rng(0)
    table = judged(x=g.random(rows), c=g.choice(["a", "b"], rows), k=g.integers(0, 3, rows))
    space = {"x": vj.Box(0, 1), "c": vj.Categorical("a", "b"), "k": vj.DiscreteBox(0, 2)}
    found = coverage(Samples.of(table, "all", space=vj.FeatureSpace(space)))
    assert 0 < found.occupied < 1
    assert str(found)


def test_absent_entries_and_only_unordered_features():
    table = judged(x=[0.1, np.nan, 0.9, 0.4], c=["a", "b", None, "a"])
    found = coverage(table)
    assert found.untried[["feature", "other"]].to_numpy().tolist() == []
    assert np.isfinite(found.discrepancy)
    found = coverage(table[["c", "violated", "status"]])
    assert found.hole is None
    assert found.table.loc["c", "occupied"] == 1


def test_what_cannot_work_is_refused_with_the_reason():
    table = judged(x=[1.0, 1.0])
    with pytest.raises(ValueError, match="nothing varies among 2 rows of 'table': x has one value"):
        coverage(table)
    with pytest.raises(ValueError, match="cells must be an integer of at least 2; got 1"):
        coverage(judged(x=[1.0, 2.0]), cells=1)


@pytest.mark.slow
def test_pictures_are_drawn_and_written(tmp_path):
    from PIL import Image

    g = np.random.default_rng(0)
    table = judged(x=g.random(300) ** 3, y=g.random(300), c=g.choice(list("abc"), 300))
    for columns in (["x", "y", "c"], ["x"], ["c"]):
        coverage(table[[*columns, "violated", "status"]]).plot(tmp_path / "it.png")
        with Image.open(tmp_path / "it.png") as image:
            assert image.size[0] > 300


@pytest.mark.thorough
def test_distributions_are_uniform_in_their_own_coordinates():
    space = vj.FeatureSpace(
        {
            "x": vj.Normal(10, 2),
            "y": vj.LogUniform(0.01, 100),
            "c": vj.Categorical("often", "seldom", weights=[0.9, 0.1]),
        }
    )
    g = np.random.default_rng(0)
    table = judged(
        x=g.normal(10, 2, 2000),
        y=10 ** g.uniform(-2, 2, 2000),
        c=g.choice(["often", "seldom"], 2000, p=[0.9, 0.1]),
    )
    found = coverage(Samples.of(table, "all", space=space))
    assert 0.2 < found.discrepancy < 3
    assert found.table["occupied"].tolist() == [1, 1, 1]
    x, y, c = marginals(found.samples)
    np.testing.assert_allclose(x.unit(found.samples), norm(10, 2).cdf(table.x), atol=2e-3)
    np.testing.assert_allclose(y.unit(found.samples), (np.log10(table.y) + 2) / 4, atol=2e-3)
    assert y.value(0.5) == pytest.approx(1, rel=0.01)
    np.testing.assert_allclose(c.edges, [0, 0.9, 1], atol=1e-3)
    # By its range alone the logarithmic feature would seem to crowd at its lower end.
    assert coverage(table).discrepancy > 20


@pytest.mark.slow
def test_what_a_constraint_forbids_is_no_hole():
    space = vj.FeatureSpace(
        {
            "x": vj.Box(0, 1),
            "y": vj.Box(0, 1),
            "k": vj.DiscreteBox(0, 2),
            "c": vj.Categorical(*"ab"),
        },
        where=lambda f: (f["x"] + f["y"] < 1) & ~((f["k"] == 2) & (f["c"] == 1)),
    )
    g = np.random.default_rng(0)
    n = 20000
    table = judged(x=g.random(n), y=g.random(n), k=g.integers(0, 3, n), c=g.choice(["a", "b"], n))
    table = table[(table.x + table.y < 1) & ~((table.k == 2) & (table.c == "b"))]
    found = coverage(Samples.of(table, "all", space=space))
    assert found.untried_count == 0
    assert found.table["pairs"].min() > 0.98
    assert found.dispersion < 0.08
    assert 0.5 < found.discrepancy < 2
    assert "fulfil the space's constraint" in str(found)
    # Half of what is allowed was never tried: the hole is there, and not beyond the constraint.
    half = table[(table.x < 0.5) & ~((table.k == 1) & (table.c == "a"))]
    found = coverage(Samples.of(half, "all", space=space))
    assert found.hole["x"] > 0.7
    assert found.hole["x"] + found.hole["y"] < 1
    assert found.untried.to_numpy().tolist() == [["k", 1, "c", "a"]]
    assert found.table.loc["x", "occupied"] == 0.5
