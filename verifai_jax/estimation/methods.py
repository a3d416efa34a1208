"""The methods within a budget: Monte Carlo first, then splitting, then importance sampling.

    answer = estimate_automatically(limit_state, rng, plan)
    answer.probability, answer.low, answer.high, answer.method

A first level of prior samples decides. Failures that are frequent enough are counted in fresh
samples. Rarer ones are reached by splitting, whose failures make a proposal for importance
sampling, whose fresh samples are the estimate; splitting, which does not depend on the fit,
checks it, and repeats itself where the proposal is no good. Where no failure is reached, what is
left goes to the prior, and only its bound is claimed.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool

from verifai_jax.core.text import format_percent
from verifai_jax.estimation import importance, monte_carlo
from verifai_jax.estimation.intervals import log_interval
from verifai_jax.estimation.monte_carlo import Counts
from verifai_jax.estimation.normal_space import Ended, LimitState
from verifai_jax.estimation.splitting import (
    FirstLevel,
    SplittingRun,
    explore_failures,
    run_splitting,
)

COUNTED = 0.06
"""Relative error at which counting the failures of the prior is good enough."""
LEAST_EFFECTIVE = 60
"""Effective failures that importance sampling has to promise."""
WORST_TAIL = 0.7
"""Tail index beyond which weighted samples are not relied on (Vehtari et al., 2024)."""
SHARE_OF_LEVEL = 0.09
"""Share of the budget for each level of the splitting that makes the proposal."""
SHARE_OF_REPLICATE = 0.02
"""Share of the budget for each level of splitting runs that are the estimate themselves."""
EXPLORED = 0.1
"""Share of the simulations left for more failures before the proposal is fitted."""
CHAIN = 10
"""States of a chain: each level is about a tenth as probable as the previous one."""
UNDERSTATED = 1.6
"""Factor on the relative error of a run: chains start from those of the previous level."""


@dataclass(frozen=True)
class Plan:
    """Requirements of an answer.

    - `confidence`: of the interval and the bound.
    - `chains`: splitting chains of a level.
    - `clamped`: True at coordinates whose domain ends in an outermost value.
    """

    confidence: float
    chains: int
    clamped: Bool[np.ndarray, " d"]


@dataclass
class Answer:
    """An answer of a method; fields are those of `Estimate`.

    - `prior`: counts of the independent samples of the prior that the bound rests on.
    - `probability`: the estimate; None where none is claimed.
    - `low`, `high`: ends of the interval.
    - `method`: the method that gave the estimate.
    - `effective`, `relative_error`: precision of the estimate.
    - `diagnostics`: further numbers of the method.
    - `notes`: surprises, in words.
    - `drawn`: data of the pictures.
    """

    prior: Counts
    probability: float | None = None
    low: float = 0.0
    high: float = 1.0
    method: str | None = None
    effective: float = float("nan")
    relative_error: float = float("nan")
    diagnostics: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    drawn: dict[str, Any] = field(default_factory=dict)


def chains_for(budget: int, share: float) -> int:
    """Return the chains of a level that takes this share of the budget, in multiples of 32."""
    return 32 * max(1, round(budget * share / CHAIN / 32))


def estimate_by_monte_carlo(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan
) -> Answer:
    """Estimate by Monte Carlo with all simulations that are left."""
    return _monte_carlo_answer(monte_carlo.sample_prior(limit_state, rng, limit_state.left), plan)


def _monte_carlo_answer(counts: Counts, plan: Plan) -> Answer:
    answer = Answer(counts)
    if counts.failures:
        answer.probability = counts.failures / counts.simulations
        answer.low, answer.high = counts.interval(plan.confidence)
        answer.method = "monte_carlo"
        answer.effective = float(counts.failures)
        answer.relative_error = float(
            np.sqrt((1 - answer.probability) / max(counts.failures, 1)),
        )
    else:
        answer.high = counts.upper_bound(plan.confidence)
        answer.notes.append(
            f"none of {counts.simulations:,} samples of the prior fails, so there is a bound and "
            "no estimate"
        )
    return answer


def estimate_automatically(limit_state: LimitState, rng: np.random.Generator, plan: Plan) -> Answer:
    """Estimate by the method that suits the first samples."""
    first = _first_level(limit_state, rng, plan)
    if first is None:
        return bound_from_pilot(limit_state, plan)
    counts = _counts(first)
    expected = counts.failures / counts.simulations * limit_state.left
    if counts.failures >= 10 and expected >= COUNTED**-2:
        # The choice was made by the first samples, so only fresh ones count.
        answer = estimate_by_monte_carlo(limit_state, rng, plan)
        if answer.prior.simulations:
            return answer
        return _monte_carlo_answer(counts, plan)
    return estimate_by_importance_sampling(limit_state, rng, plan, first)


def estimate_by_importance_sampling(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, first: FirstLevel | None = None
) -> Answer:
    """Estimate by importance sampling; splitting makes the proposal."""
    first = _first_level(limit_state, rng, plan) if first is None else first
    if first is None:
        return bound_from_pilot(limit_state, plan)
    counts = _counts(first)
    run = run_splitting(limit_state, rng, len(first[0]), plan.chains, first)
    if run.stopped is not None:
        return _bound_only(limit_state, rng, plan, run, counts)
    try:
        steps = max(2, round(EXPLORED * limit_state.left / plan.chains))
        points, chain_ids = explore_failures(limit_state, rng, run, plan.chains, steps)
        fitted = importance.fit_proposal(limit_state, rng, points, chain_ids, limit_state.left)
        promised = fitted.effective * limit_state.left
        if promised < LEAST_EFFECTIVE:
            answer = _splitting_answer(limit_state, rng, plan, [run], counts)
            answer.notes.append(
                "no proposal fits the failures well enough for importance sampling (it promises "
                f"{promised:.0f} effective failures, tail index {fitted.tail:.2f}), so the "
                "estimate is that of multilevel splitting"
            )
            return answer
        samples = importance.sample_proposal(
            limit_state, rng, fitted.proposal, limit_state.left, plan.clamped
        )
    except Ended:
        return _splitting_answer(limit_state, rng, plan, [run], counts)
    if not samples.x.any():
        return _splitting_answer(limit_state, rng, plan, [run], counts)
    return _importance_answer(samples, run, counts, plan)


def _importance_answer(
    samples: importance.ImportanceSamples, run: SplittingRun, counts: Counts, plan: Plan
) -> Answer:
    mean = samples.mean
    low, high = samples.interval(plan.confidence)
    failing, drawn = samples.defensive_counts
    answer = Answer(counts, mean.mean, low, high, "importance", mean.effective, mean.cv)
    answer.diagnostics = {
        "tail_index": mean.tail,
        "largest_share": mean.largest,
        "failing_share": float(samples.failing.mean()),
        "components": len(samples.proposal.shares),
        "defensive_share": float(samples.proposal.shares[0]),
        "failures_by_prior": failing,
        "samples_by_prior": drawn,
        "splitting": run.estimate,
        "unresolved": samples.unresolved,
        "acceptance": samples.acceptance[0],
        "levels": list(run.levels),
        "fractions": list(run.fractions),
    }
    answer.drawn = {"weights": np.sort(samples.x[samples.failing])[::-1] / samples.x.sum()}
    apart = abs(np.log(mean.mean / run.estimate))
    if apart > 3.5 * np.hypot(UNDERSTATED * run.cv, mean.cv):
        other = log_interval(run.estimate, UNDERSTATED * run.cv, plan.confidence, 10)
        answer.low, answer.high = min(low, other[0]), max(high, other[1])
        answer.notes.append(
            f"splitting gave {run.estimate:.2g}, which does not agree; the interval is made to "
            "hold both. More simulations would tell"
        )
    if mean.tail > WORST_TAIL:
        answer.notes.append(
            f"the weights have a heavy tail (index {mean.tail:.2f}): the interval may be too narrow"
        )
    if samples.unresolved > 0.01:
        answer.notes.append(
            f"failures lie where single precision or a distribution's outermost value hides up to "
            f"{format_percent(samples.unresolved)} of them; the interval is wider by that"
        )
    return answer


def estimate_by_splitting(limit_state: LimitState, rng: np.random.Generator, plan: Plan) -> Answer:
    """Estimate by independent splitting runs, as many as the budget allows."""
    run = run_splitting(limit_state, rng, CHAIN * plan.chains, plan.chains)
    counts = Counts(*run.first)
    if run.stopped is not None:
        return _bound_only(limit_state, rng, plan, run, counts)
    return _splitting_answer(limit_state, rng, plan, [run], counts)


def _splitting_answer(
    limit_state: LimitState,
    rng: np.random.Generator,
    plan: Plan,
    runs: list[SplittingRun],
    counts: Counts,
) -> Answer:
    """Answer by the mean of these runs and of as many more as the budget allows."""
    size = runs[0].first[0]
    cost = size + (len(runs[0].fractions) - 1) * (size - size // CHAIN)
    # Half as large, where that gives two instead of one.
    while limit_state.left < 2.2 * cost and size >= 20 * CHAIN and len(runs) == 1:
        size, cost = size // 2 // CHAIN * CHAIN, cost / 2
    while limit_state.left > 1.1 * cost:
        run = run_splitting(limit_state, rng, size, size // CHAIN)
        counts = counts + Counts(*run.first)
        if run.stopped is not None:
            if run.stopped == "stuck":
                continue
            break
        runs.append(run)
    worth = np.array([run.first[0] for run in runs], float)
    worth /= worth.sum()
    values = np.array([run.estimate for run in runs])
    mean = float(worth @ values)
    inner = UNDERSTATED * np.array([run.cv for run in runs])
    by_chains = float(np.sqrt(np.sum((worth * inner) ** 2)))
    count = len(runs)
    cv, freedom = by_chains, 8.0
    if count > 1:
        variance = float(np.sum(worth**2 * (values - mean) ** 2)) * count / (count - 1)
        cv, freedom = max(cv, float(np.sqrt(variance)) / mean), count + 3.0
    low, high = log_interval(mean, cv, plan.confidence, freedom)
    answer = Answer(counts, mean, low, min(high, 1.0), "splitting", float("nan"), cv)
    answer.diagnostics = {
        "runs": count,
        "estimates": [float(value) for value in values],
        "levels": list(runs[0].levels),
        "fractions": list(runs[0].fractions),
        "accepted": list(runs[0].accepted),
    }
    if count == 1:
        answer.notes.append("one splitting run only: its interval rests on its own chains")
    return answer


def _bound_only(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, run: SplittingRun, counts: Counts
) -> Answer:
    """Answer by a bound alone: the simulations that are left sample the prior."""
    reached = float(np.prod(run.fractions)) if run.fractions else 1.0
    level = run.levels[-1] if run.levels else np.inf
    why = {
        "stuck": "the search found no failure: the robustness gets no lower than "
        f"{limit_state.least:.4g}, or has no slope to follow",
        "budget": f"the budget ended at robustness {level:.4g}, which is reached with probability "
        f"{reached:.1e}; failing is rarer, or impossible",
    }.get(run.stopped or "", f"ended ({run.stopped}) at robustness {level:.4g}")
    counts = counts + monte_carlo.sample_prior(limit_state, rng, limit_state.left)
    answer = _monte_carlo_answer(counts, plan)
    answer.diagnostics = {"levels": list(run.levels), "fractions": list(run.fractions)}
    if limit_state.failures == 0:
        answer.notes.insert(0, why)
    elif answer.probability is None:
        answer.notes.insert(
            0, f"{why}; {limit_state.failures:,} failures were met on the way, so it can fail"
        )
    return answer


def bound_from_pilot(limit_state: LimitState, plan: Plan) -> Answer:
    """Answer by the pilot samples of the prior that were finished before an early end."""
    answer = _monte_carlo_answer(Counts(*limit_state.pilot), plan)
    answer.notes.insert(0, f"ended early ({limit_state.ended})")
    return answer


def _first_level(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan
) -> FirstLevel | None:
    """Simulate the first level, samples of the prior; None where time ends before it does."""
    try:
        z = limit_state.sample_prior(rng, min(CHAIN * plan.chains, limit_state.left))
        scores = limit_state(z)
    except Ended:
        limit_state.pilot = (limit_state.simulations, limit_state.failures, limit_state.no_verdict)
        return None
    limit_state.pilot = (len(z), int(scores.failing.sum()), int((~scores.proper).sum()))
    return z, scores.score, scores.failing, scores.proper


def _counts(first: FirstLevel) -> Counts:
    return Counts(len(first[0]), int(first[2].sum()), int((~first[3]).sum()))
