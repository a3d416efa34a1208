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
from jaxtyping import Bool, Float

from verifai_jax.core.text import format_percent
from verifai_jax.estimation import importance, monte_carlo
from verifai_jax.estimation.anchors import anchors_of, join_explorations
from verifai_jax.estimation.components import Prior
from verifai_jax.estimation.exploration import Exploration, explore
from verifai_jax.estimation.importance import DEFENSIVE, STEADY, FittedProposal
from verifai_jax.estimation.initial_proposal import (
    Agreement,
    compare_explorations,
    mix,
    proposal_from,
)
from verifai_jax.estimation.intervals import log_interval
from verifai_jax.estimation.mixture import Mixture, fit_mixture
from verifai_jax.estimation.monte_carlo import Counts
from verifai_jax.estimation.moved_priors import SURE, moved_priors, share_failing_again, share_out
from verifai_jax.estimation.normal_space import Ended, LimitState
from verifai_jax.estimation.splitting import (
    FirstLevel,
    SplittingRun,
    explore_failures,
    run_splitting,
)

COUNTED = 0.06
"""Relative error at which counting the failures of the prior is good enough."""
MIN_EFFECTIVE = 60
"""Effective failures that importance sampling has to promise."""
MIN_OF_MOVED = 15
"""The same of the moved prior, whose weights have no such tail as those of fitted proposals."""
MIN_COUNTED = 10
"""Failures of the first samples from which on their rate says what counting promises."""
WORST_TAIL = 0.7
"""Tail index beyond which weighted samples are not relied on (Vehtari et al., 2024)."""
SHARE_OF_LEVEL = 0.06
"""Share of the budget for each level of the splitting that makes the proposal."""
SHARE_OF_REPLICATE = 0.02
"""Share of the budget for each level of splitting runs that are the estimate themselves."""
EXPLORATIONS = 2
"""Independent searches for failures in addition to splitting."""
SHARE_OF_EXPLORATION, SHARE_WITH_GRADIENTS = 0.08, 0.12
"""Share of the budget for each of them."""
PRECISE, SHARE_BEYOND = 20_000, 0.25
"""Simulations that make an estimate precise, and the share of those beyond for each search with
gradients: a region that none has found is the greater error then."""
MIN_EXPLORED = 600
"""Simulations of a search, below which it says too little to be worth them."""
SHARE_OF_PATHS = 0.03
"""Share of the budget for paths between the failures of different searches."""
RESERVED = 0.3
"""Share of the budget that splitting leaves over where searches have found failures."""
NOTED_UNSEEN = 0.02
"""Share of the probability from which a disagreement is noted."""
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
    - `probability`: the estimate; None if none is claimed.
    - `low`, `high`: ends of the interval.
    - `method`: the method that gave the estimate.
    - `effective`, `relative_error`: precision of the estimate.
    - `diagnostics`: further numbers of the method.
    - `notes`: sentences on anything surprising.
    - `drawn`: data of the pictures.
    - `samples`: the weighted samples that the estimate rests on; None if there are none.
    - `nearest`: least distant failures `[m, d]` that the searches found.
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
    samples: importance.ImportanceSamples | None = None
    nearest: Float[np.ndarray, "m d"] | None = None


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
    """Estimate by importance sampling; splitting and independent searches make the proposal."""
    first = _first_level(limit_state, rng, plan) if first is None else first
    if first is None:
        return bound_from_pilot(limit_state, plan)
    counts = _counts(first)
    if limit_state.left <= 0:
        return _monte_carlo_answer(counts, plan)
    run, again = SplittingRun(stopped="ended"), 1.0
    try:
        explorations = _explore(limit_state, rng)
        reserve = round(RESERVED * limit_state.budget) if explorations else 0
        if explorations:
            points = np.concatenate([exploration.points for exploration in explorations])
            again = share_failing_again(limit_state, rng, points)
        if again >= SURE:
            run = run_splitting(limit_state, rng, len(first[0]), plan.chains, first, reserve)
            if run.stopped is not None and not explorations:
                return _bound_only(limit_state, rng, plan, run, counts)
            if run.stopped is None:
                again = min(again, share_failing_again(limit_state, rng, run.points))
        by_chance = again < SURE
        if by_chance:
            points = run.points
            ends = [one.nearest for one in explorations] or [points]
            proposals = [moved_priors(each) for each in ends]
            fitted = share_out(limit_state, rng, mix(proposals), limit_state.left)
        else:
            points, chain_ids, proposals = _proposals(limit_state, rng, plan, run, explorations)
            anchors = anchors_of(explorations, DEFENSIVE) if explorations else None
            fitted = importance.fit_proposal(
                limit_state, rng, points, chain_ids, limit_state.left, mix(proposals), anchors
            )
        counted = _promised_by_counting(limit_state, fitted, counts)
        needed = max(counted, MIN_OF_MOVED if by_chance else 0)
        few = not by_chance and fitted.effective * limit_state.left < MIN_EFFECTIVE
        if few or fitted.promise(limit_state.left) < needed:
            answer = _without_proposal(limit_state, rng, plan, run, counts, fitted, counted)
            return _with_chance(answer, again, limit_state.own_chance)
        # A little is left over to see whether the searches agree.
        size = limit_state.left - round(SHARE_OF_PATHS * limit_state.budget)
        samples = importance.sample_proposal(
            limit_state, rng, fitted.proposal, max(size, 1), plan.clamped
        )
        if not samples.x.any():
            return _without_samples(limit_state, rng, plan, run, counts)
        found = [exploration.points for exploration in explorations]
        agreement = compare_explorations(
            limit_state,
            rng,
            samples.failures,
            samples.x[samples.failing],
            proposals,
            [points, *found] if run.stopped is None else found,
        )
    except Ended:
        return _without_samples(limit_state, rng, plan, run, counts)
    answer = _with_chance(
        _importance_answer(samples, run, agreement, counts, plan), again, limit_state.own_chance
    )
    answer.samples = samples
    if explorations:
        answer.nearest = join_explorations(explorations).nearest
    return answer


def _promised_by_counting(limit_state: LimitState, fitted: FittedProposal, counts: Counts) -> float:
    """Return the failures that are likely counted, if all that is left samples the prior."""
    many = counts.failures >= MIN_COUNTED
    rate = counts.failures / counts.simulations if many else fitted.probability
    return rate * (limit_state.left + counts.simulations)


def _without_proposal(
    limit_state: LimitState,
    rng: np.random.Generator,
    plan: Plan,
    run: SplittingRun,
    counts: Counts,
    fitted: FittedProposal,
    counted: float,
) -> Answer:
    """Answer by splitting or by counting, whichever promises more.

    Chains of a system that draws keep the failures that were lucky, and splitting is far too low
    then: it is no alternative.
    """
    why = (
        "no proposal fits the failures well enough for importance sampling (it promises "
        f"{fitted.effective * limit_state.left:z.0f} effective failures, tail index "
        f"{fitted.tail:z.2f}; counting {counted:z.0f})"
    )
    if run.stopped is None and not limit_state.draws and _promised_by(run, limit_state) > counted:
        answer = _splitting_answer(limit_state, rng, plan, [run], counts)
        answer.notes.append(f"{why}, so the estimate is that of multilevel splitting")
        return answer
    prior = Mixture((Prior(limit_state.dim),), np.ones(1))
    samples = importance.sample_proposal(limit_state, rng, prior, limit_state.left, plan.clamped)
    answer = _bound_only(limit_state, rng, plan, run, counts + samples.counts)
    answer.samples = samples
    if answer.probability is not None:
        answer.notes.append(f"{why}, so failures are counted in samples of the prior")
    return answer


def _promised_by(run: SplittingRun, limit_state: LimitState) -> float:
    """Return the failures that splitting is worth, with as many more runs as what is left."""
    more = limit_state.left / _cost(run, run.first[0])
    return (1 + more) / max(UNDERSTATED * run.cv, 1e-6) ** 2


def _cost(run: SplittingRun, size: int) -> float:
    """Return the simulations of a splitting run with levels of this size."""
    return size + (len(run.fractions) - 1) * (size - size // CHAIN)


def _with_chance(answer: Answer, again: float, own_chance: str) -> Answer:
    """Say of an answer how far the system's own draws decide, where they do."""
    if again < 1:
        answer.diagnostics["failing_again"] = again
    if again < SURE:
        what = "the system draws random numbers, and they decide"
        keys = " with other random keys"
        if own_chance:
            what, keys = "what the system has of its own decides", ""
        answer.notes.append(
            f"{what} with the features whether a simulation fails: of the failures found "
            f"{format_percent(again)} fail again{keys}. The probability is over both"
        )
    return answer


def _without_samples(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, run: SplittingRun, counts: Counts
) -> Answer:
    """Answer by splitting where it is complete, else by a bound."""
    if run.stopped is None:
        return _splitting_answer(limit_state, rng, plan, [run], counts)
    return _bound_only(limit_state, rng, plan, run, counts)


def _explore(limit_state: LimitState, rng: np.random.Generator) -> list[Exploration]:
    """Search for failures independently; return the searches that found some."""
    budget = limit_state.budget
    simulations = round(SHARE_OF_EXPLORATION * budget)
    if limit_state.gradient is not None:
        beyond = SHARE_BEYOND * max(0, budget - PRECISE)
        simulations = round(SHARE_WITH_GRADIENTS * min(budget, PRECISE) + beyond)
    if simulations < MIN_EXPLORED:
        return []
    found = [explore(limit_state, rng, simulations) for _ in range(EXPLORATIONS)]
    return [exploration for exploration in found if len(exploration.points)]


def _proposals(
    limit_state: LimitState,
    rng: np.random.Generator,
    plan: Plan,
    run: SplittingRun,
    explorations: list[Exploration],
) -> tuple[np.ndarray, np.ndarray, list[Mixture]]:
    """Return failures, their chains, and a proposal of splitting and of each exploration."""
    proposals = [proposal_from(exploration, rng, DEFENSIVE) for exploration in explorations]
    if run.stopped is not None:
        # The chains of one exploration stand for the failures, until samples of its proposal do.
        return explorations[0].points, explorations[0].chain_ids, proposals
    steps = max(2, round(EXPLORED * limit_state.left / plan.chains))
    points, chain_ids = explore_failures(limit_state, rng, run, plan.chains, steps)
    fitted = fit_mixture(points, np.ones(len(points)), chain_ids, rng, DEFENSIVE)
    return points, chain_ids, [fitted, *proposals]


def _importance_answer(
    samples: importance.ImportanceSamples,
    run: SplittingRun,
    agreement: Agreement,
    counts: Counts,
    plan: Plan,
) -> Answer:
    mean = samples.mean
    low, high = samples.interval(plan.confidence)
    failing, drawn = samples.defensive_counts
    high = min(1.0, high / (1 - agreement.unseen))
    answer = Answer(counts, min(mean.mean, 1.0), low, high, "importance", mean.effective, mean.cv)
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
        "reached": [float(share) for share in agreement.reached],
        "unseen": agreement.unseen,
    }
    answer.drawn = {"weights": np.sort(samples.x[samples.failing])[::-1] / samples.x.sum()}
    if run.stopped is None:
        check_by_splitting(answer, run, float(agreement.reached[0]), (low, high), plan)
    elif run.levels:
        answer.notes.append(
            "splitting reached no failure; the estimate rests on the failures that independent "
            "searches found"
        )
    if agreement.unseen > NOTED_UNSEEN:
        answer.notes.append(
            f"independent searches do not agree: {format_percent(agreement.alone)} of the "
            "probability lies where no more than one of them found failures, so there may be "
            f"more that none found; the interval allows for {format_percent(agreement.unseen)}. "
            "A larger budget searches more, and falsify(problem, diverse=...) lists more failures"
        )
    if mean.tail > WORST_TAIL:
        answer.notes.append(
            f"the weights have a heavy tail (index {mean.tail:z.2f}): "
            "the interval may be too narrow"
        )
    if samples.unresolved > 0.01:
        answer.notes.append(
            f"failures lie where single precision or a distribution's outermost value hides up to "
            f"{format_percent(samples.unresolved)} of them; the interval is wider by that"
        )
    return answer


def check_by_splitting(
    answer: Answer,
    run: SplittingRun,
    reached: float,
    interval: tuple[float, float],
    plan: Plan,
) -> None:
    """Compare an answer with splitting, as far as splitting reached the same failures."""
    assert answer.probability is not None
    if reached < 1 - NOTED_UNSEEN:
        answer.notes.append(
            f"splitting alone reached {format_percent(reached)} of the probability; independent "
            "searches found the rest"
        )
    # What splitting is known to have reached may be less than what it has, which steady weights
    # leave open: then anything up to the whole agrees.
    steady = answer.diagnostics["tail_index"] < STEADY
    known = answer.probability * max(reached, 1e-6)
    nearest = np.clip(run.estimate, known, answer.probability if steady else known)
    apart = np.log(nearest / run.estimate)
    if abs(apart) <= 3.5 * np.hypot(UNDERSTATED * run.cv, answer.relative_error):
        return
    if apart > 0 and steady:
        # Weighted samples are as likely to be too high as too low; chains that few of them lead to
        # a region, or none, are too low. So steady weights need no wider interval below.
        return
    other = log_interval(run.estimate, UNDERSTATED * run.cv, plan.confidence, 10)
    answer.low, answer.high = min(interval[0], other[0]), max(interval[1], other[1])
    answer.notes.append(
        f"splitting gave {run.estimate:z.2g}, which does not agree; the interval is made to "
        "hold both. More simulations would tell"
    )


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
    cost = _cost(runs[0], size)
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
        f"{limit_state.lowest:z.4g}, or has no slope to follow",
        "budget": f"the budget ended at robustness {level:z.4g}, which is reached with probability "
        f"{reached:z.1e}; failing is rarer, or impossible",
    }.get(run.stopped or "", f"ended ({run.stopped}) at robustness {level:z.4g}")
    counts = counts + monte_carlo.sample_prior(limit_state, rng, limit_state.left)
    answer = _monte_carlo_answer(counts, plan)
    answer.diagnostics = {"levels": list(run.levels), "fractions": list(run.fractions)}
    if not np.isfinite(limit_state.lowest):
        pass  # No simulation had a verdict, of which there is a note.
    elif limit_state.failures == 0:
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
    """Simulate the first level, samples of the prior; None if time ends before it does."""
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
