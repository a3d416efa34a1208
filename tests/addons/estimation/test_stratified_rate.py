"""A failure rate from two strata: exact, and hardly ever longer than without them."""

import numpy as np
import pytest

from verifai_jax.addons.estimation.stratified_rate import stratified_rate
from verifai_jax.statistics.binomial import exact_interval
from verifai_jax.statistics.confidence_sequences import anytime_interval


def test_good_predictions_are_worth_as_many_trials_again():
    rate = stratified_rate((0, 38), (12, 12), share=0.25)
    assert rate.low < 0.25 < rate.high
    assert rate.estimate == pytest.approx(0.25)
    assert rate.worth > 2 * rate.trials


def test_one_stratum_is_clopper_and_pearson():
    rate = stratified_rate((2, 30), (0, 0), share=0.0)
    assert (rate.low, rate.high) == exact_interval(2, 2, 30, 0.95)
    always = stratified_rate((2, 30), (0, 0), share=0.0, at_any_time=True)
    expected = anytime_interval(2, 30)
    assert (always.low, always.high) == (expected.low, expected.high)


def test_an_uncertain_share_and_undecided_trials_widen():
    known = stratified_rate((1, 20), (9, 10), share=0.3)
    estimated = stratified_rate((1, 20), (9, 10), share=(300, 1000))
    undecided = stratified_rate((1, 20), (9, 10), share=0.3, undecided=(0, 1))
    assert estimated.low < known.low < known.high < estimated.high
    assert undecided.low == known.low
    assert undecided.high > known.high


def test_no_failure_and_nothing_but_failures_reach_the_ends():
    assert stratified_rate((0, 20), (0, 5), share=0.2).low == 0
    assert stratified_rate((20, 20), (5, 5), share=0.2).high == 1


@pytest.mark.slow
def test_exact_by_enumeration():
    # Of all outcomes of 8 trials, those whose interval misses the rate have 5 % at most.
    from scipy.stats import binom

    share, q0, q1, n = 0.3, 0.1, 0.7, 8
    rate = (1 - share) * q0 + share * q1
    missed = 0.0
    for n1 in range(n + 1):
        for k1 in range(n1 + 1):
            for k0 in range(n - n1 + 1):
                chance = binom.pmf(n1, n, share) * binom.pmf(k1, n1, q1)
                chance *= binom.pmf(k0, n - n1, q0)
                if chance > 1e-4:
                    found = stratified_rate((k0, n - n1), (k1, n1), share)
                    missed += chance * (not found.low <= rate <= found.high)
    assert missed < 0.05


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        (((3, 2), (0, 1)), "got 3, 0 and 2"),
        (((0, 0), (0, 0)), "at least one trial"),
    ],
)
def test_wrong_counts_are_refused(counts, words):
    with pytest.raises(ValueError, match=words):
        stratified_rate(*counts, share=0.2)
    with pytest.raises(ValueError, match=r"share must be a probability; got 1\.5"):
        stratified_rate((0, 1), (0, 1), share=1.5)


KINDS = {
    "good": lambda rng: (rng.uniform(0.05, 0.4), rng.uniform(0, 0.02), rng.uniform(0.85, 1)),
    "useless": lambda rng: (rng.uniform(0.02, 0.6), *[rng.uniform(0.02, 0.4)] * 2),
    "biased": lambda rng: (rng.uniform(0.02, 0.5), rng.uniform(0, 0.3), rng.uniform(0.2, 1)),
    "reversed": lambda rng: (rng.uniform(0.1, 0.5), rng.uniform(0.1, 0.5), rng.uniform(0, 0.1)),
    "never": lambda rng: (rng.uniform(0, 0.01), rng.uniform(0.02, 0.2), rng.uniform(0, 1)),
}
"""Share of trials that are predicted to fail, and how often the others and these fail."""


@pytest.mark.slow
@pytest.mark.proves
def test_a_thousand_worlds():
    # About ten minutes: 1000 intervals, each from all outcomes of its number of trials.
    rng = np.random.default_rng(0)
    covered, ratios = [], {kind: [] for kind in KINDS}
    for number in range(1000):
        kind = [*KINDS][number % len(KINDS)]
        n = int(rng.choice([20, 30, 50, 80, 120]))
        share, q0, q1 = KINDS[kind](rng)
        predicted = rng.random(n) < share
        failed = rng.random(n) < np.where(predicted, q1, q0)
        sides = [(int(np.sum(failed & s)), int(np.sum(s))) for s in (~predicted, predicted)]
        rate = stratified_rate(*sides, share=(int(rng.binomial(10_000, share)), 10_000))
        covered.append(rate.low <= (1 - share) * q0 + share * q1 <= rate.high)
        ratios[kind].append((rate.high - rate.low) / (rate.pooled[1] - rate.pooled[0]))
    assert np.mean(covered) >= 0.95
    trials = {kind: np.mean(values) ** 2 for kind, values in ratios.items()}
    assert trials["good"] < 0.75
    assert max(trials.values()) < 1.05
