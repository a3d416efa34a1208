"""Bounds that hold at any time, and for many policies at once."""

import bisect

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import beta

from verifai_jax.addons.estimation.simultaneous_interval import (
    ATOM,
    evidence_above,
    evidence_below,
    required_evidence,
    simultaneous_interval,
    verdict,
)
from verifai_jax.statistics.binomial import clopper_pearson
from verifai_jax.statistics.confidence_sequences import anytime_interval


@pytest.mark.parametrize(("k", "n", "q"), [(0, 40, 0.05), (2, 50, 0.2), (7, 30, 0.4), (5, 5, 0.9)])
def test_evidence_is_the_mixture_of_likelihood_ratios(k, n, q):
    def ratio(t):
        return (t / q) ** k * ((1 - t) / (1 - q)) ** (n - k)

    below, _ = quad(lambda t: ratio(t) / (2 * np.sqrt(t * q)), 0, q)
    atom = ATOM * ratio(0.0)
    assert evidence_below(k, n, q) == pytest.approx(np.log(atom + (1 - ATOM) * below), rel=1e-6)
    density = beta(0.5, 0.5)
    above, _ = quad(lambda t: ratio(t) * density.pdf(t) / density.sf(q), q, 1, limit=200)
    assert evidence_above(k, n, q) == pytest.approx(np.log(above), rel=1e-4)


@pytest.mark.parametrize("evidence", [evidence_below, evidence_above])
@pytest.mark.parametrize("q", [0.03, 0.4])
def test_evidence_is_a_martingale_at_the_rate_itself(evidence, q):
    k, n = np.arange(41), 40
    more = q * np.exp(evidence(k + 1, n + 1, q)) + (1 - q) * np.exp(evidence(k, n + 1, q))
    np.testing.assert_allclose(more, np.exp(evidence(k, n, q)), rtol=1e-9)
    assert np.exp(evidence(0, 0, q)) == pytest.approx(1.0)


@pytest.mark.parametrize("evidence", [evidence_below, evidence_above])
def test_evidence_is_monotone_in_the_rate_on_its_side(evidence):
    for k, n in [(0, 64), (1, 64), (3, 500), (60, 64), (64, 64), (200, 512)]:
        rates = np.linspace(k / n, 1, 400) if evidence is evidence_below else np.linspace(0, k / n)
        found = evidence(k, n, np.clip(rates, 1e-9, 1 - 1e-9))
        steps = np.diff(found if evidence is evidence_below else found[::-1])
        assert (steps > -1e-9).all(), (k, n)


def test_the_interval_ends_where_the_evidence_suffices():
    rate = simultaneous_interval(6, 900, 0.9, among=10)
    limit = required_evidence(0.9, 10)
    assert limit == pytest.approx(np.log(200))
    assert evidence_below(6, 900, rate.high) == pytest.approx(limit, abs=1e-6)
    assert evidence_above(6, 900, rate.low) == pytest.approx(limit, abs=1e-6)
    assert rate.low < 6 / 900 < rate.high
    assert rate.at_any_time
    assert rate.confidence == 0.9
    assert simultaneous_interval(0, 10).low == 0.0
    assert simultaneous_interval(10, 10).high == 1.0


def test_the_interval_is_honest_but_not_much_wider_than_needed():
    # No interval for all times can be narrower than the exact one for one time.
    for k, n in [(0, 768), (3, 512), (40, 512)]:
        exact, ours = clopper_pearson(k, n), simultaneous_interval(k, n)
        assert ours.low <= exact.low
        assert exact.high <= ours.high
    # Without a failure: ln(1 / ATOM) / p more samples than the exact bound, and far fewer than
    # with the mixture that serves all rates.
    p = 0.01

    def least(interval):
        return bisect.bisect_left(range(3000), True, lo=300, key=lambda n: interval(n).high < p)

    ours = least(lambda n: simultaneous_interval(0, n, 0.95, among=32))
    exact = int(np.ceil(np.log(0.025 / 32) / np.log1p(-p)))
    assert 0 <= ours - exact <= 1 + np.log(1 / ATOM) / p
    assert ours + 200 < least(lambda n: anytime_interval(0, n, 1 - 0.05 / 32))


@pytest.mark.thorough
@pytest.mark.parametrize("q", [0.0, 0.004, 0.05])
def test_looking_again_and_again_the_intervals_miss_as_rarely_as_they_say(q):
    random = np.random.default_rng(0)
    looks = np.arange(8, 1500, 8)
    failures = np.cumsum(random.binomial(8, q, (1000, len(looks))), axis=1)
    limit = required_evidence(0.9, 1)
    if q == 0:
        assert (evidence_above(0, looks, 1e-12) < limit).all()
        return
    below = evidence_below(failures, looks, q).max(axis=1) >= limit
    above = evidence_above(failures, looks, q).max(axis=1) >= limit
    # 5 % for each side; three standard errors are 2 %.
    assert below.mean() < 0.07
    assert above.mean() < 0.07
    # Nor are they so wide that nothing could ever be wrong.
    assert (below | above).mean() > 0.01


def test_an_interval_decides_whether_a_policy_is_safe():
    assert verdict(simultaneous_interval(0, 2000), 0.01) == "safe@0.01"
    assert verdict(simultaneous_interval(0, 100), 0.01) == "undecided"
    assert verdict(simultaneous_interval(50, 500), 0.01) == "unsafe"
    assert verdict(simultaneous_interval(50, 500), 0.25) == "safe@0.25"
    assert verdict(None, 0.01) == "undecided"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((5, 4), "failures=5, simulations=4"),
        ((0, 0), "at least one simulation"),
        ((0, 4, 1.0), "confidence must lie between 0 and 1; got 1.0"),
        ((0, 4, 0.9, 0), "among must be an integer of at least 1; got 0"),
    ],
)
def test_bounds_refuse(arguments, told):
    with pytest.raises(ValueError, match=told):
        simultaneous_interval(*arguments)
