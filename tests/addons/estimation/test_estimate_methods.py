"""The methods on closed forms, without a simulation: right, and as sure as they say."""

import resource

import numpy as np
import pytest
from closed_forms import CASES, Cells, closed_form, half_space, normal

from verifai_jax.addons.estimation._estimate import one_thread
from verifai_jax.addons.estimation.answers import (
    Answer,
    Plan,
    chains_for,
    check_by_splitting,
    estimate_by_monte_carlo,
    estimate_by_splitting,
)
from verifai_jax.addons.estimation.descents import descend_from_many
from verifai_jax.addons.estimation.methods import (
    SHARE_OF_LEVEL,
    SHARE_OF_REPLICATE,
    estimate_automatically,
)
from verifai_jax.addons.estimation.monte_carlo import Counts
from verifai_jax.addons.estimation.splitting import SplittingRun


def answered(
    robustness, dim, budget, seed=0, method=estimate_automatically, share=SHARE_OF_LEVEL, **options
):
    limit_state = closed_form(robustness, dim, budget, **options)
    plan = Plan(0.95, chains_for(budget, share), np.zeros(dim, bool))
    with one_thread():
        answer = method(limit_state, np.random.default_rng(seed), plan)
    assert limit_state.simulations <= budget
    return answer, limit_state


@pytest.mark.proves
@pytest.mark.parametrize(
    ("name", "dim"),
    [("half-space", 2), ("sphere", 10), ("uneven modes", 5)],
)
def test_one_in_a_million_within_a_factor_of_1_3(name, dim):
    answer, _ = answered(CASES[name](dim, 1e-6), dim, 50_000)
    assert answer.method == "importance"
    assert 1e-6 / 1.3 < answer.probability < 1.3e-6
    assert answer.low / 1.05 < 1e-6 < answer.high * 1.05
    assert answer.effective > 300


@pytest.mark.proves
@pytest.mark.parametrize(
    ("dim", "p", "budget", "seeds", "least"),
    [
        (2, 1e-2, 50_000, 5, 17),
        (2, 1e-7, 50_000, 5, 17),
        (5, 1e-6, 50_000, 5, 17),
        (20, 1e-4, 20_000, 5, 17),
        (50, 1e-6, 50_000, 1, 3),
    ],
)
def test_intervals_cover_and_estimates_are_within_a_factor(dim, p, budget, seeds, least):
    covered = 0
    for case in CASES.values():
        robustness = case(dim, p)
        for seed in range(seeds):
            answer, _ = answered(robustness, dim, budget, seed)
            covered += answer.low <= p <= answer.high
            assert p / 1.3 < answer.probability < 1.3 * p
    # By the binomial distribution: of 20 intervals with a coverage of 0.95, fewer than 17 hold with
    # probability 0.02, and with a coverage of 0.8 with probability 0.6; of 4, fewer than 3 with
    # probabilities 0.014 and 0.2.
    assert covered >= least


def test_frequent_failures_are_counted_in_fresh_samples():
    answer, limit_state = answered(half_space(3, 0.05), 3, 20_000)
    assert answer.method == "monte_carlo"
    assert answer.prior.simulations < limit_state.simulations == 20_000
    assert answer.low < 0.05 < answer.high


@pytest.mark.parametrize("method", [estimate_by_splitting, estimate_automatically])
def test_what_always_fails_gets_the_interval_of_counting(method):
    answer, _ = answered(lambda z: -1.0 - z[:, 0] ** 2, 1, 800, method=method)
    assert answer.method == "monte_carlo"
    assert answer.probability == 1
    assert 0.98 < answer.low < answer.high == 1
    assert method is estimate_automatically or "its samples are counted" in answer.notes[0]


def test_splitting_alone_gives_the_order_of_magnitude_from_several_runs():
    answer, _ = answered(
        half_space(5, 1e-5), 5, 50_000, method=estimate_by_splitting, share=SHARE_OF_REPLICATE
    )
    assert answer.method == "splitting"
    assert answer.diagnostics["runs"] >= 3
    assert answer.low < 1e-5 < answer.high
    assert 5e-6 < answer.probability < 2e-5


def test_what_cannot_fail_gets_a_bound_and_no_estimate():
    answer, limit_state = answered(lambda u: 1.0 + u[:, 0], 2, 5_000)
    assert answer.probability is None
    assert limit_state.failures == 0
    assert any("no failure" in note for note in answer.notes)
    assert answer.high == pytest.approx(1 - 0.05 ** (1 / answer.prior.simulations), rel=1e-6)


@pytest.mark.slow
def test_boolean_robustness_has_no_slope_and_is_counted():
    answer, _ = answered(lambda u: np.where(u[:, 0] < 3e-4, -1.0, 1.0), 1, 30_000, seed=1)
    assert answer.probability is None or answer.low < 3e-4 < answer.high
    assert answer.high > 3e-4


@pytest.mark.slow
def test_discrete_coordinates_are_cells_of_the_cube():
    # One of 10 cells, and in it a tail: p = 1e-5.
    def robustness(u):
        return np.where(u[:, 0] * 10 >= 9, 3.719 - normal(u)[:, 1], 6.0 - normal(u)[:, 1])

    answer, _ = answered(robustness, 2, 50_000)
    assert answer.probability == pytest.approx(1e-5, rel=0.1)


@pytest.mark.slow
def test_a_constraint_makes_the_prior_conditional():
    # Given that the first coordinate lies in its upper quarter, failing is four times as probable.
    answer, limit_state = answered(
        half_space_first(1e-5), 2, 30_000, constraint=lambda u: u[:, 0] > 0.75
    )
    assert answer.probability == pytest.approx(4e-5, rel=0.1)
    assert answer.low < 4e-5 < answer.high
    assert limit_state.simulations > 25_000  # What is refused is not simulated.


def half_space_first(p):
    from scipy.stats import norm

    return lambda u: norm.isf(p) - normal(u)[:, 0]


def test_simulations_without_verdict_widen_the_upper_end():
    def robustness(u):
        return np.where(u[:, 1] < 0.02, np.nan, 0.05 - u[:, 0] + 0.8)

    answer, limit_state = answered(robustness, 2, 20_000, method=estimate_by_monte_carlo)
    assert limit_state.no_verdict > 300
    assert answer.probability == pytest.approx(0.15 * 0.98, rel=0.05)
    assert answer.high > 0.15 * 0.98 + 0.02


@pytest.mark.slow
def test_the_same_seed_gives_the_same():
    one, other = (answered(half_space(4, 1e-4), 4, 10_000, seed=3)[0] for _ in range(2))
    assert one.probability == other.probability
    assert (one.low, one.high) == (other.low, other.high)


def test_interruption_keeps_what_is_finished():
    robustness, calls = half_space(2, 1e-2), []

    def evaluate(u):
        calls.append(len(u))
        if len(calls) > 3:
            raise KeyboardInterrupt
        rho = robustness(u)
        return rho, rho < 0, np.ones(len(u), bool)

    from verifai_jax.addons.estimation.normal_space import LimitState

    limit_state = LimitState(evaluate, 2, 50_000, batch=1000)
    plan = Plan(0.95, 32, np.zeros(2, bool))
    answer = estimate_by_monte_carlo(limit_state, np.random.default_rng(0), plan)
    assert limit_state.ended == "interrupted"
    assert answer.prior.simulations == 3000
    assert answer.low < 0.01 < answer.high


def test_few_slow_simulations_are_lost_when_somebody_interrupts(monkeypatch):
    from verifai_jax.addons.estimation import normal_space

    robustness, calls, clock = half_space(2, 1e-2), [], [0.0]
    monkeypatch.setattr(normal_space.time, "perf_counter", lambda: clock[0])

    def evaluate(u):
        calls.append(len(u))
        clock[0] += 0.25 * len(u)
        if sum(calls) > 40:
            raise KeyboardInterrupt
        rho = robustness(u)
        return rho, rho < 0, np.ones(len(u), bool)

    limit_state = normal_space.LimitState(evaluate, 2, 50_000, batch=1000, one_by_one=True)
    plan = Plan(0.95, 32, np.zeros(2, bool))
    answer = estimate_by_monte_carlo(limit_state, np.random.default_rng(0), plan)
    assert calls[:5] == [16, 8, 4, 2, 4]
    assert answer.prior.simulations == sum(calls[:-1]) > 30


def test_each_of_several_workers_has_something_to_simulate(monkeypatch):
    from verifai_jax.addons.estimation import normal_space

    calls, clock = [], [0.0]
    monkeypatch.setattr(normal_space.time, "perf_counter", lambda: clock[0])

    def evaluate(u):
        calls.append(len(u))
        clock[0] += 60.0
        return np.ones(len(u)), np.zeros(len(u), bool), np.ones(len(u), bool)

    limit_state = normal_space.LimitState(evaluate, 1, 200, batch=64, one_by_one=True, workers=3)
    limit_state(np.zeros((100, 1)))
    assert calls[:3] == [16, 12, 12]


@pytest.mark.parametrize(
    ("splitting", "reached", "tail", "widened"),
    [
        (1e-4, 1.0, 0.1, False),
        (2e-4, 1.0, 0.1, True),  # more than there is
        (8e-5, 0.1, 0.1, False),  # it may have reached more than it is known to have
        (8e-5, 0.1, 0.6, True),  # unless the weights are not steady
        (1e-6, 1.0, 0.1, False),  # chains that hardly any lead to a region say too little
        (1e-6, 1.0, 0.6, True),
    ],
)
def test_an_interval_holds_what_splitting_gave_where_they_cannot_both_be_right(
    splitting, reached, tail, widened
):
    interval = (9.6e-5, 1.05e-4)
    answer = Answer(Counts(1000, 0, 0), 1e-4, *interval, "importance", 1000.0, 0.02)
    answer.diagnostics = {"tail_index": tail}
    run = SplittingRun(fractions=[splitting], cv2=[0.05**2])
    plan = Plan(0.95, 32, np.zeros(2, bool))
    check_by_splitting(answer, run, reached, interval, plan)
    assert widened == any("does not agree" in note for note in answer.notes)
    assert ((answer.low, answer.high) != interval) == widened
    assert not widened or answer.low <= splitting <= answer.high


@pytest.mark.slow
def test_many_simulations_need_little_memory():
    """All starts, and all ends, are compared with one another: so there is a limit to them."""
    limit_state = Cells(6, 3, 2).limit_state(2_000_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    ends = descend_from_many(limit_state, np.random.default_rng(0), 60_000)
    assert len(ends.points) > 1000
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kilobytes
