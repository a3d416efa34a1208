"""Intervals and bounds against what defines them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, genpareto

from verifai_jax.addons.estimation.intervals import (
    format_probability,
    simulations_until,
    skewed_interval,
    tail_index,
    upper_bound,
    weighted_mean,
)
from verifai_jax.statistics.binomial import simulations_without_failure


@given(st.integers(1, 3000), st.data(), st.sampled_from([0.9, 0.95, 0.99]))
def test_upper_bound_is_where_so_few_failures_get_improbable(n, data, confidence):
    k = data.draw(st.integers(0, n - 1))
    assert binom.cdf(k, n, upper_bound(k, n, confidence)) == pytest.approx(1 - confidence, rel=1e-6)


def test_no_failure_gives_the_rule_of_three():
    assert upper_bound(0, 3000) == pytest.approx(3 / 3000, rel=0.01)


@given(st.floats(1e-7, 0.5), st.integers(0, 3), st.integers(0, 5000))
def test_simulations_until_is_the_least_number(p0, failures, done):
    done = max(done, failures)
    more = simulations_until(p0, failures, done)
    assert upper_bound(failures, done + more) <= p0
    if more:
        assert upper_bound(failures, done + more - 1) > p0


def test_simulations_until_without_a_run_is_that_of_rates():
    for p0 in (0.1, 1e-3, 1e-6):
        assert abs(simulations_until(p0) - simulations_without_failure(p0)) <= 1
    with pytest.raises(ValueError, match=r"p0 must lie between 0 and 1; got 2"):
        simulations_until(2)


def test_interval_of_skewed_means_covers():
    # Lognormal weights of a third of the samples: skewness 8.
    random, truth, covered = np.random.default_rng(0), np.exp(0.72) / 3, 0
    for _ in range(400):
        x = np.exp(1.2 * random.standard_normal(300)) * (random.random(300) < 1 / 3)
        low, high = skewed_interval(x, 0.95)
        covered += low <= truth <= high
    assert covered >= 0.92 * 400


def test_tail_index_is_that_of_the_generalised_pareto_distribution():
    random = np.random.default_rng(0)
    for shape in (0.2, 0.5, 0.9):
        found = [
            tail_index(genpareto.rvs(shape, size=4000, random_state=random)) for _ in range(20)
        ]
        assert np.mean(found) == pytest.approx(shape, abs=0.12)


def test_equal_weights_are_worth_their_number():
    told = weighted_mean(np.append(np.full(50, 0.5), np.zeros(950)))
    assert told.effective == pytest.approx(50)
    assert told.mean == pytest.approx(0.025)
    assert told.tail == -np.inf


@pytest.mark.parametrize(
    ("probability", "text"),
    [(0.0, "0"), (1e-7, "1e-07"), (0.2345678, "0.235"), (0.999, "0.999"), (0.99993, "0.99993"),
     (0.9999, "0.9999"), (0.9999999, "0.9999999"), (1.0, "1")],
)  # fmt: skip
def test_no_probability_below_one_is_written_as_one(probability, text):
    assert format_probability(probability) == text
