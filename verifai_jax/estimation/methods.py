"""Which method answers, within a budget: Monte Carlo first, then splitting, then its proposal.

    answer = automatic(judge, rng, plan)
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

from verifai_jax.estimation import importance, monte_carlo
from verifai_jax.estimation.intervals import log_interval
from verifai_jax.estimation.monte_carlo import Counts
from verifai_jax.estimation.normal_space import Ended, Judge
from verifai_jax.estimation.splitting import Climb, explore, split

COUNTED = 0.06
"""Relative error at which counting the failures of the prior is good enough."""
LEAST_EFFECTIVE = 60
"""Effective failures that importance sampling has to promise."""
WORST_TAIL = 0.7
"""Tail index beyond which weighted samples are not relied on (Vehtari et al., 2024)."""
SHARE_OF_LEVEL = 0.09
"""Of the budget, for each level of the splitting that makes the proposal,"""
SHARE_OF_REPLICATE = 0.02
"""and of those that are the estimate themselves: several, which tell how much they differ."""
EXPLORED = 0.1
"""Of what is left then, for more failures before the proposal is fitted."""
CHAIN = 10
"""States of a chain: as many levels are a tenth as probable as the one before."""
UNDERSTATED = 1.6
"""Chains of one level start from those of the one before, so that their errors add up to more."""


@dataclass(frozen=True)
class Plan:
    """What an answer is to be like.

    - `chains`: of a level; `clamped`: coordinates with an outermost value.
    """

    confidence: float
    chains: int
    clamped: Bool[np.ndarray, " d"]


@dataclass
class Answer:
    """What a method says; `probability` is None where it says nothing.

    `prior` are the independent samples of the prior that the bound stands on.
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
    """Chains of a level that takes this share of the budget, in multiples of 32."""
    return 32 * max(1, round(budget * share / CHAIN / 32))


def by_counting(judge: Judge, rng: np.random.Generator, plan: Plan) -> Answer:
    """Monte Carlo with all that is left."""
    return _counted(monte_carlo.sample(judge, rng, judge.left), plan)


def _counted(counts: Counts, plan: Plan) -> Answer:
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


def automatic(judge: Judge, rng: np.random.Generator, plan: Plan) -> Answer:
    """The method that suits what the first samples show."""
    first = _first_level(judge, rng, plan)
    if first is None:
        return cut_off(judge, plan)
    counts = _counts(first)
    expected = counts.failures / counts.simulations * judge.left
    if counts.failures >= 10 and expected >= COUNTED**-2:
        # The choice was made by the first samples, so only fresh ones count.
        answer = by_counting(judge, rng, plan)
        if answer.prior.simulations:
            return answer
        return _counted(counts, plan)
    return by_importance(judge, rng, plan, first)


def by_importance(judge: Judge, rng: np.random.Generator, plan: Plan, first: Any = None) -> Answer:
    """Splitting for a proposal, importance sampling for the estimate."""
    first = _first_level(judge, rng, plan) if first is None else first
    if first is None:
        return cut_off(judge, plan)
    counts = _counts(first)
    climb = split(judge, rng, len(first[0]), plan.chains, first)
    if climb.stopped is not None:
        return _not_reached(judge, rng, plan, climb, counts)
    try:
        steps = max(2, round(EXPLORED * judge.left / plan.chains))
        points, family = explore(judge, rng, climb, plan.chains, steps)
        made = importance.fit(judge, rng, points, family, judge.left)
        promised = made.effective * judge.left
        if promised < LEAST_EFFECTIVE:
            answer = _replicated(judge, rng, plan, [climb], counts)
            answer.notes.append(
                "no proposal fits the failures well enough for importance sampling (it promises "
                f"{promised:.0f} effective failures, tail index {made.tail:.2f}), so the estimate "
                "is that of multilevel splitting"
            )
            return answer
        found = importance.sample(judge, rng, made.proposal, judge.left, plan.clamped)
    except Ended:
        return _replicated(judge, rng, plan, [climb], counts)
    if not found.x.any():
        return _replicated(judge, rng, plan, [climb], counts)
    return _weighed(found, climb, counts, plan)


def _weighed(found: importance.Sampled, climb: Climb, counts: Counts, plan: Plan) -> Answer:
    told = found.told
    low, high = found.interval(plan.confidence)
    failing, drawn = found.by_prior
    answer = Answer(counts, told.mean, low, high, "importance", told.effective, told.cv)
    answer.diagnostics = {
        "tail_index": told.tail,
        "largest_share": told.largest,
        "failing_share": float(found.failing.mean()),
        "components": len(found.proposal.shares),
        "defensive_share": float(found.proposal.shares[0]),
        "failures_by_prior": failing,
        "samples_by_prior": drawn,
        "splitting": climb.estimate,
        "unresolved": found.unresolved,
        "acceptance": found.acceptance[0],
        "levels": list(climb.levels),
        "fractions": list(climb.fractions),
    }
    answer.drawn = {"weights": np.sort(found.x[found.failing])[::-1] / found.x.sum()}
    apart = abs(np.log(told.mean / climb.estimate))
    if apart > 3.5 * np.hypot(UNDERSTATED * climb.cv, told.cv):
        other = log_interval(climb.estimate, UNDERSTATED * climb.cv, plan.confidence, 10)
        answer.low, answer.high = min(low, other[0]), max(high, other[1])
        answer.notes.append(
            f"splitting gave {climb.estimate:.2g}, which does not agree; the interval is made to "
            "hold both. More simulations would tell"
        )
    if told.tail > WORST_TAIL:
        answer.notes.append(
            f"the weights have a heavy tail (index {told.tail:.2f}): the interval may be too narrow"
        )
    if found.unresolved > 0.01:
        answer.notes.append(
            f"failures lie where single precision or a distribution's outermost value hides up to "
            f"{100 * found.unresolved:.0f} % of them; the interval is wider by that"
        )
    return answer


def by_splitting(judge: Judge, rng: np.random.Generator, plan: Plan) -> Answer:
    """Independent splitting runs, as many as the budget holds."""
    climb = split(judge, rng, CHAIN * plan.chains, plan.chains)
    counts = Counts(*climb.first)
    if climb.stopped is not None:
        return _not_reached(judge, rng, plan, climb, counts)
    return _replicated(judge, rng, plan, [climb], counts)


def _replicated(
    judge: Judge, rng: np.random.Generator, plan: Plan, climbs: list[Climb], counts: Counts
) -> Answer:
    """The mean of these runs and of as many more as the budget holds."""
    size = climbs[0].first[0]
    cost = size + (len(climbs[0].fractions) - 1) * (size - size // CHAIN)
    # Half as large, where that gives two instead of one.
    while judge.left < 2.2 * cost and size >= 20 * CHAIN and len(climbs) == 1:
        size, cost = size // 2 // CHAIN * CHAIN, cost / 2
    while judge.left > 1.1 * cost:
        climb = split(judge, rng, size, size // CHAIN)
        counts = counts + Counts(*climb.first)
        if climb.stopped is not None:
            if climb.stopped == "stuck":
                continue
            break
        climbs.append(climb)
    worth = np.array([climb.first[0] for climb in climbs], float)
    worth /= worth.sum()
    values = np.array([climb.estimate for climb in climbs])
    mean = float(worth @ values)
    inner = UNDERSTATED * np.array([climb.cv for climb in climbs])
    by_chains = float(np.sqrt(np.sum((worth * inner) ** 2)))
    runs = len(climbs)
    cv, freedom = by_chains, 8.0
    if runs > 1:
        variance = float(np.sum(worth**2 * (values - mean) ** 2)) * runs / (runs - 1)
        cv, freedom = max(cv, float(np.sqrt(variance)) / mean), runs + 3.0
    low, high = log_interval(mean, cv, plan.confidence, freedom)
    answer = Answer(counts, mean, low, min(high, 1.0), "splitting", float("nan"), cv)
    answer.diagnostics = {
        "runs": runs,
        "estimates": [float(value) for value in values],
        "levels": list(climbs[0].levels),
        "fractions": list(climbs[0].fractions),
        "accepted": list(climbs[0].accepted),
    }
    if runs == 1:
        answer.notes.append("one splitting run only: its interval rests on its own chains")
    return answer


def _not_reached(
    judge: Judge, rng: np.random.Generator, plan: Plan, climb: Climb, counts: Counts
) -> Answer:
    """What is left goes to the prior; the bound is what remains."""
    reached = float(np.prod(climb.fractions)) if climb.fractions else 1.0
    level = climb.levels[-1] if climb.levels else np.inf
    why = {
        "stuck": "the search found no failure: the robustness gets no lower than "
        f"{judge.least:.4g}, or has no slope to follow",
        "budget": f"the budget ended at robustness {level:.4g}, which is reached with probability "
        f"{reached:.1e}; failing is rarer, or impossible",
    }.get(climb.stopped or "", f"ended ({climb.stopped}) at robustness {level:.4g}")
    counts = counts + monte_carlo.sample(judge, rng, judge.left)
    answer = _counted(counts, plan)
    answer.diagnostics = {"levels": list(climb.levels), "fractions": list(climb.fractions)}
    if judge.failures == 0:
        answer.notes.insert(0, why)
    elif answer.probability is None:
        answer.notes.insert(
            0, f"{why}; {judge.failures:,} failures were found on the way, so it can fail"
        )
    return answer


def cut_off(judge: Judge, plan: Plan) -> Answer:
    """What the samples of the prior say that were finished before an early end."""
    answer = _counted(Counts(*judge.first), plan)
    answer.notes.insert(0, f"ended early ({judge.ended})")
    return answer


def _first_level(judge: Judge, rng: np.random.Generator, plan: Plan) -> Any:
    try:
        z = judge.prior(rng, min(CHAIN * plan.chains, judge.left))
        seen = judge(z)
    except Ended:
        judge.first = (judge.simulations, judge.failures, judge.no_verdict)
        return None
    judge.first = (len(z), int(seen.failing.sum()), int((~seen.proper).sum()))
    return (z, *seen)


def _counts(first: Any) -> Counts:
    return Counts(len(first[0]), int(first[2].sum()), int((~first[3]).sum()))
