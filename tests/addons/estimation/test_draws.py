"""Estimates where the system draws random numbers: intervals that cover, on closed forms."""

import jax
import numpy as np
import pytest
from closed_forms import normal
from scipy.stats import norm

import verifai_jax as vj
from verifai_jax.addons.estimation._estimate import one_thread
from verifai_jax.addons.estimation.answers import Plan, chains_for
from verifai_jax.addons.estimation.methods import SHARE_OF_LEVEL, estimate_automatically
from verifai_jax.addons.estimation.normal_space import LimitState

DIM = 5


def noisy(threshold, slope, noise, seed, budget):
    """`slope x0 + noise n < threshold`, with `n` drawn anew in each simulation."""
    drawn = np.random.default_rng(seed + 1000)

    def evaluate(u):
        rho = threshold - slope * normal(u)[:, 0] - noise * drawn.standard_normal(len(u))
        return rho, rho < 0, np.isfinite(rho)

    def differentiate(u):
        gradient = np.zeros_like(u)
        gradient[:, 0] = -slope / norm.pdf(normal(u)[:, 0])
        return *evaluate(u), gradient

    return LimitState(evaluate, DIM, budget, batch=256, gradient=differentiate, draws=True)


def answered(threshold, slope, noise, seed, budget=20_000):
    limit_state = noisy(threshold, slope, noise, seed, budget)
    plan = Plan(0.95, chains_for(budget, SHARE_OF_LEVEL), np.zeros(DIM, bool))
    with one_thread():
        answer = estimate_automatically(limit_state, np.random.default_rng(seed), plan)
    assert limit_state.simulations <= budget
    return answer


@pytest.mark.slow
@pytest.mark.parametrize(
    ("threshold", "slope", "noise"),
    [(5.0, 1.0, 0.9), (5.0, 1.0, 0.45), (4.8, 1.0, 0.1), (8.3, 1.0, 2.0), (3.5, 0.1, 1.0)],
    ids=["0.9", "0.45", "0.1", "mostly noise", "noise alone"],
)
def test_intervals_cover_whatever_part_of_the_failures_the_noise_decides(threshold, slope, noise):
    truth = norm.sf(threshold / np.hypot(slope, noise))
    answers = [answered(threshold, slope, noise, seed) for seed in range(20)]
    # Fewer than 17 of 20 hold with probability 0.02 where the coverage is 0.95.
    assert sum(answer.low <= truth <= answer.high for answer in answers) >= 17


def test_noise_that_decides_is_told_and_does_not_keep_a_rare_failure_from_being_weighed():
    answer = answered(5.0, 1.0, 0.45, seed=1)
    assert answer.method == "importance"
    assert answer.low < norm.sf(5.0 / np.hypot(1.0, 0.45)) < answer.high < 1e-5
    assert answer.diagnostics["failing_again"] < 0.8
    assert any("fail again with other random keys" in note for note in answer.notes)


def test_noise_alone_is_counted():
    answer = answered(3.5, 0.1, 1.0, seed=0)
    assert answer.method == "monte_carlo"
    assert any("so failures are counted in samples of the prior" in n for n in answer.notes)
    assert answer.prior.simulations > 8000


@pytest.mark.slow
def test_a_problem_that_draws_is_estimated_as_one():
    def system(features, key):
        margin = 5.0 - features["x0"] - 0.45 * jax.random.normal(key)
        return vj.Trace({"margin": margin[None]}, dt=1.0)

    space = {f"x{i}": vj.Normal(0.0, 1.0) for i in range(5)}
    problem = vj.Problem("noisy", space, system, "margin >= 0")
    result = vj.estimate(problem, budget=20_000, progress=False)
    assert result.low < norm.sf(5.0 / np.hypot(1.0, 0.45)) < result.high
    assert any("other random keys" in note for note in result.notes)
