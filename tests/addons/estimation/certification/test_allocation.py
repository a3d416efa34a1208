"""The allocation on arms whose rates are known."""

import numpy as np
import pytest
from scipy.stats import beta

from verifai_jax.addons.estimation.certification import race
from verifai_jax.addons.estimation.certification.allocation import Allocation, find_leader
from verifai_jax.addons.estimation.simultaneous_interval import simultaneous_interval, verdict

# Failure rates of 64 policies: the six of `facts` that reached full return, the others worse.
FACTS = np.concatenate([[0, 0, 0.004, 0.035, 0.299, 0.357], np.linspace(0.05, 0.9, 58)])
ONE_CLEAR = np.concatenate([[0.002], np.linspace(0.02, 0.8, 63)])
NEAR_TIES = np.concatenate([[0.01, 0.015, 0.015, 0.02, 0.02], np.linspace(0.03, 0.7, 59)])


def uniform_need(rates, random, runs=2000, target=0.95):
    """Equal samples of each arm with which the least failures name a safest one so often."""

    def success(n):
        counts = random.binomial(n, rates, (runs, len(rates)))
        named = np.argmin(counts + random.random(counts.shape) / 2, axis=1)
        return np.mean(rates[named] == rates.min())

    low, high = 1, 1
    while success(high) < target:
        low, high = high, 2 * high
    while high - low > max(1, low // 20):
        middle = (low + high) // 2
        low, high = (low, middle) if success(middle) >= target else (middle, high)
        low, high = min(low, high), max(low, high)
        if success(high) < target:
            break
    return high * len(rates)


def raced(rates, run):
    random = np.random.default_rng([11, run])
    mixed = random.permutation(rates)
    found = race(lambda arm, n: int(random.binomial(n, mixed[arm])), len(mixed))
    return mixed[found.arm] == mixed.min(), int(found.simulations.sum())


@pytest.mark.thorough
@pytest.mark.parametrize(("rates", "uniform"), [(FACTS, 30_000), (ONE_CLEAR, 11_000)])
def test_names_the_safest_with_a_fifth_of_uniform_samples(rates, uniform):
    runs = [raced(rates, run) for run in range(60)]
    assert np.mean([right for right, _ in runs]) >= 0.95
    assert np.mean([cost for _, cost in runs]) <= uniform / 5


@pytest.mark.proves
@pytest.mark.parametrize("rates", [FACTS, ONE_CLEAR, NEAR_TIES], ids=["facts", "clear", "ties"])
def test_names_the_safest_in_200_runs(rates):
    runs = [raced(rates, run) for run in range(200)]
    assert np.mean([right for right, _ in runs]) >= 0.95
    need = uniform_need(rates, np.random.default_rng(0))
    assert np.mean([cost for _, cost in runs]) <= need / 5


def test_standing_is_the_posterior_probability():
    failures, simulations = np.array([1, 4, 30]), np.array([300, 400, 200])
    found = find_leader(failures, simulations, tie=0.002)
    random = np.random.default_rng(0)
    draws = beta(failures + 0.5, simulations - failures + 0.5).rvs((200_000, 3), random)
    assert found.number == 0
    best = draws[:, 1:].min(axis=1)
    assert found.chance == pytest.approx(np.mean(draws[:, 0] <= best + 0.002), abs=0.01)
    expected = np.mean(draws < draws[:, :1] - 0.002, axis=0)
    np.testing.assert_allclose(found.rivals, expected, atol=0.01)


def test_of_equals_the_larger_margin_leads():
    counts = np.array([0, 0, 0]), np.array([64, 64, 64])
    assert find_leader(*counts, 0.001).number == 0
    assert find_leader(*counts, 0.001, np.array([0.1, 0.3, np.nan])).number == 1


def certified(rates, run, p, budget=40_000):
    """Verdicts of one run of the whole allocation on arms with these rates."""
    random = np.random.default_rng([5, run])
    allocation = Allocation(p=p, samples=256, budget=budget)
    failures, simulations = np.zeros(len(rates), int), np.zeros(len(rates), int)
    while (blocks := allocation.next(failures, simulations)).any():
        counts = blocks * allocation.block
        failures += random.binomial(counts, rates)
        simulations += counts
    assert simulations.sum() <= budget
    assert (simulations >= 256).all()
    pairs = zip(failures, simulations, strict=True)
    return [
        verdict(simultaneous_interval(k, n, 0.95, len(rates)), p) for k, n in pairs
    ], simulations


def wrong(verdicts, rates, p):
    """Whether any verdict of a run is false."""
    return any(
        (found == f"safe@{p:g}" and rate >= p) or (found == "unsafe" and rate <= p)
        for found, rate in zip(verdicts, rates, strict=True)
    )


# As hard as it gets: half of the arms fail with exactly the probability in question.
P = 0.05
HARD = np.concatenate([np.full(8, P), [0.0, 0.01, 0.02, 0.03, 0.08, 0.1, 0.2, 0.9]])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("runs", "budget"), [(15, 12_000), pytest.param(120, 40_000, marks=pytest.mark.proves)]
)
def test_verdicts_are_wrong_in_few_of_many_runs(runs, budget):
    found = [certified(HARD, run, P, budget)[0] for run in range(runs)]
    assert np.mean([wrong(verdicts, HARD, P) for verdicts in found]) <= 0.05
    decided = np.array([[one != "undecided" for one in verdicts] for verdicts in found])
    assert decided[:, [8, 9, 13, 14, 15]].mean() > 0.95


def test_samples_go_where_a_decision_is_within_reach():
    rates = np.array([0.0, 0.003, 0.01, 0.02, 0.3, 0.9])
    verdicts, simulations = certified(rates, 0, p=0.01)
    assert verdicts[0] == "safe@0.01"
    assert verdicts[-2:] == ["unsafe", "unsafe"]
    assert (simulations[-2:] == 256).all()
    assert simulations[1] > 512  # Two thirds below p, which takes thousands.


def test_the_budget_bounds_all_samples():
    allocation = Allocation(samples=64, budget=3 * 64 + 100)
    some = allocation.next(np.array([0, 0, 40]), np.full(3, 64))
    assert 0 <= some.sum() <= 1
    assert not allocation.next(np.array([0, 0, 40]), np.array([128, 64, 64])).any()


def test_only_what_may_be_safe_is_sampled_further():
    rule = Allocation(p=0.01, samples=512, budget=4 * 4 * 512, safest=False)
    failures, simulations = np.zeros(4, int), np.zeros(4, int)
    rates = np.array([0.0, 0.02, 0.5, 0.003])
    while (blocks := rule.next(failures, simulations)).any():
        simulations += 64 * blocks
        failures = np.round(rates * simulations).astype(int)
    # One without failures takes what its certificate needs, one of half takes a block, and one
    # above p takes the minimum, as no more samples make it safe.
    assert simulations[0] == 576
    assert simulations[1] == 512
    assert simulations[2] == 64
    assert 576 < simulations[3] <= 512 + rule.budget // 4
    assert (rule.undecided(failures, simulations) == [False, True, False, False]).all()
