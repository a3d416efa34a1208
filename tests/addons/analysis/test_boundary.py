"""The boundary between failing and safe: calibrated, and silent where nothing was sampled."""

import numpy as np
import pandas as pd
import pytest
from scipy.special import ndtr

import verifai_jax as vj
from verifai_jax.addons.analysis import boundary, coverage

NAMES = ["a", "b"]


def table(count, noise=0.0, seed=0, within=1.0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (count, 2)) * within
    rho = margin(x) + noise * rng.normal(size=count)
    return pd.DataFrame(x, columns=NAMES).assign(rho=rho, kind=rng.choice(["p", "q"], count))


def margin(x):
    return 0.7 - x[:, 0] ** 2 - 0.8 * x[:, 1]


@pytest.fixture(scope="module")
def space():
    return vj.FeatureSpace(
        {"a": vj.Box(-1.0, 1.0), "b": vj.Box(-1.0, 1.0), "kind": vj.Categorical("p", "q")}
    )


def samples_of(frame, space):
    return vj.analysis.Samples.of(frame, "all", space=space)


@pytest.mark.slow
# Four learners on six parts of 1500 rows.
def test_probabilities_are_those_of_a_noisy_verdict(space):
    found = boundary(samples_of(table(1500, 0.3), space))
    rng = np.random.default_rng(5)
    x = rng.uniform(-0.95, 0.95, (4000, 2))
    truth = ndtr(-margin(x) / 0.3)
    points = pd.DataFrame(x, columns=NAMES).assign(kind="p")
    said = found.probability(points)
    near = found.sampled(points)
    assert np.mean(near) > 0.95
    assert np.mean((said - truth)[near] ** 2) < 0.01
    assert found.brier < found.base
    assert abs(found.share - np.mean(ndtr(-margin(rng.uniform(-1, 1, (4000, 2))) / 0.3))) < 0.03
    table_ = found.calibration
    assert table_.rows.sum() == 1500
    assert np.all(np.abs(table_.failed / table_.rows - (table_.low + 0.05)) < 0.2)
    text = str(found)
    assert "Brier score" in text
    assert "a simulation would say most at" in text


@pytest.mark.slow
# The same, of rows that leave most of the space out.
def test_what_was_never_sampled_is_said(space):
    found = boundary(samples_of(table(600, within=0.7), space))
    assert found.sampled({"a": 0.0, "b": 0.0, "kind": "p"})
    assert 0 <= found.probability({"a": 0.0, "b": 0.0, "kind": "p"}) < 0.05
    assert found.probability({"a": -0.6, "b": 0.65, "kind": "q"}) > 0.9
    corner = {"a": 0.99, "b": -0.99, "kind": "p"}
    assert not found.sampled(corner)
    assert np.isnan(found.probability(corner))
    assert 0.3 < found.unsampled < 0.6
    points = found.next_points(6)
    assert list(points.columns) == ["a", "b", "kind", "probability", "sampled"]
    assert not points.sampled.any()
    assert np.abs(points[NAMES]).max(axis=1).min() > 0.7
    # Far from each other, too.
    gaps = [np.hypot(*(points[NAMES].iloc[i] - points[NAMES].iloc[j]))
            for i in range(6) for j in range(i) if points.kind[i] == points.kind[j]]  # fmt: skip
    assert min(gaps) > 2 * found.reach


def test_too_few_on_one_side_is_refused(space):
    frame = table(40).assign(rho=1.0)
    with pytest.raises(ValueError, match="needs 10 failures and 10 safe rows; table has 0 and 40"):
        boundary(samples_of(frame, space))


def test_shares_of_the_prior_and_of_the_volume():
    # Log-uniform: the lower half of the prior is a small part of the range.
    space = vj.FeatureSpace({"a": vj.LogUniform(1.0, 100.0), "k": vj.Categorical("p", "q", "r")})
    rng = np.random.default_rng(0)
    u = rng.uniform(0.0, 0.5, 4000)
    frame = pd.DataFrame({"a": 100.0**u, "k": rng.choice(["p", "q"], 4000), "rho": 1.0})
    found = coverage(samples_of(frame, space), cells=10)
    assert found.table.mass["a"] == pytest.approx(0.5, abs=0.01)
    assert found.table.volume["a"] == pytest.approx((10 - 1) / 99, rel=0.02)
    assert found.table.mass["k"] == found.table.volume["k"] == pytest.approx(2 / 3)
    assert found.table.pairs_mass["a"] == pytest.approx(1 / 3, abs=0.01)
    assert found.table.pairs_volume["a"] == pytest.approx(9 / 99 * 2 / 3, rel=0.02)
    assert "these take 33" in str(found)
