"""The methods within a budget: Monte Carlo first, then splitting, then importance sampling.

    answer = estimate_automatically(limit_state, rng, plan)
    answer.probability, answer.low, answer.high, answer.method

A first level of prior samples decides. Frequent failures are counted in fresh samples. Rare ones
are reached by splitting; a proposal for importance sampling is fitted to its failures, and fresh
samples of the proposal give the estimate. Splitting, which does not depend on the fit, checks it,
and replaces it if the proposal is poor. If no failure is reached, the remaining simulations sample
the prior, and only their bound is claimed.
"""

import numpy as np

from verifai_jax.addons.estimation import importance
from verifai_jax.addons.estimation.anchors import anchors_of, join_explorations
from verifai_jax.addons.estimation.answers import (
    CHAIN,
    UNDERSTATED,
    Answer,
    Plan,
    bound_answer,
    bound_from_pilot,
    estimate_by_monte_carlo,
    importance_answer,
    monte_carlo_answer,
    splitting_answer,
    splitting_cost,
)
from verifai_jax.addons.estimation.components import Prior
from verifai_jax.addons.estimation.exploration import Exploration, explore
from verifai_jax.addons.estimation.importance import DEFENSIVE, FittedProposal
from verifai_jax.addons.estimation.initial_proposal import compare_explorations, mix, proposal_from
from verifai_jax.addons.estimation.mixture import Mixture, fit_mixture
from verifai_jax.addons.estimation.monte_carlo import Counts
from verifai_jax.addons.estimation.moved_priors import (
    SURE,
    moved_priors,
    share_failing_again,
    share_out,
)
from verifai_jax.addons.estimation.normal_space import Ended, LimitState
from verifai_jax.addons.estimation.splitting import (
    FirstLevel,
    SplittingRun,
    explore_failures,
    run_splitting,
)
from verifai_jax.core.messages.text import format_percent

COUNTED = 0.06
"""Relative error at which counting the failures of the prior is good enough."""
MIN_EFFECTIVE = 60
"""Effective failures that importance sampling has to promise."""
MIN_OF_MOVED = 15
"""The same of the moved prior, whose weights have no such tail as those of fitted proposals."""
MIN_COUNTED = 10
"""Failures of the first samples from which on their rate says what counting promises."""
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
UNSEARCHED = (
    "splitting alone found the failures: of several separate regions it may have missed some, and "
    "the estimate with them. The default method searches independently with budget="
    f"{round(MIN_EXPLORED / SHARE_OF_EXPLORATION):,} or more"
)
"""Caution of an estimate without independent searches."""
SHARE_OF_PATHS = 0.03
"""Share of the budget for paths between the failures of different searches."""
RESERVED = 0.3
"""Share of the budget that splitting leaves over where searches have found failures."""
EXPLORED = 0.1
"""Share of the simulations left for more failures before the proposal is fitted."""


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
        return monte_carlo_answer(counts, plan)
    return estimate_by_importance_sampling(limit_state, rng, plan, first)


def estimate_by_importance_sampling(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, first: FirstLevel | None = None
) -> Answer:
    """Estimate by importance sampling, with a proposal from splitting and independent searches."""
    first = _first_level(limit_state, rng, plan) if first is None else first
    if first is None:
        return bound_from_pilot(limit_state, plan)
    counts = _counts(first)
    if limit_state.left <= 0:
        return monte_carlo_answer(counts, plan)
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
                return bound_answer(limit_state, rng, plan, run, counts)
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
            limit_state, rng, samples.failures, samples.x[samples.failing], proposals,
            [points, *found] if run.stopped is None else found,
        )  # fmt: skip
    except Ended:
        return _without_samples(limit_state, rng, plan, run, counts)
    answer = _with_chance(
        importance_answer(samples, run, agreement, counts, plan), again, limit_state.own_chance
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
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, run: SplittingRun,
    counts: Counts, fitted: FittedProposal, counted: float,
) -> Answer:  # fmt: skip
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
        answer = splitting_answer(limit_state, rng, plan, [run], counts)
        answer.notes.append(f"{why}, so the estimate is that of multilevel splitting")
        return answer
    prior = Mixture((Prior(limit_state.dim),), np.ones(1))
    samples = importance.sample_proposal(limit_state, rng, prior, limit_state.left, plan.clamped)
    answer = bound_answer(limit_state, rng, plan, run, counts + samples.counts)
    answer.samples = samples
    if answer.probability is not None:
        answer.notes.append(f"{why}, so failures are counted in samples of the prior")
    return answer


def _promised_by(run: SplittingRun, limit_state: LimitState) -> float:
    """Return the effective failures of splitting with the remaining simulations."""
    more = limit_state.left / splitting_cost(run, run.first[0])
    return (1 + more) / max(UNDERSTATED * run.cv, 1e-6) ** 2


def _with_chance(answer: Answer, again: float, own_chance: str) -> Answer:
    """Say of an answer how far the system's own draws decide, where they do."""
    if again < 1:
        answer.diagnostics["failing_again"] = again
    if again < SURE:
        what = "the system draws random numbers, which decide"
        keys = " with other random keys"
        if own_chance:
            what, keys = "random numbers or memory of the system decide", ""
        answer.notes.append(
            f"{what} together with the features whether a simulation fails: of the failures found "
            f"{format_percent(again)} fail again{keys}. The probability is over both"
        )
    return answer


def _without_samples(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, run: SplittingRun, counts: Counts
) -> Answer:
    """Answer by splitting where it is complete, else by a bound."""
    if run.stopped is None:
        return splitting_answer(limit_state, rng, plan, [run], counts)
    return bound_answer(limit_state, rng, plan, run, counts)


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
    found = [exploration for exploration in found if len(exploration.points)]
    limit_state.searches = EXPLORATIONS, len(found)
    return found


def _proposals(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, run: SplittingRun,
    explorations: list[Exploration],
) -> tuple[np.ndarray, np.ndarray, list[Mixture]]:  # fmt: skip
    """Return failures, their chains, and a proposal of splitting and of each exploration."""
    proposals = [proposal_from(exploration, rng, DEFENSIVE) for exploration in explorations]
    if run.stopped is not None:
        # The chains of one exploration stand for the failures, until samples of its proposal do.
        return explorations[0].points, explorations[0].chain_ids, proposals
    steps = max(2, round(EXPLORED * limit_state.left / plan.chains))
    points, chain_ids = explore_failures(limit_state, rng, run, plan.chains, steps)
    fitted = fit_mixture(points, np.ones(len(points)), chain_ids, rng, DEFENSIVE)
    return points, chain_ids, [fitted, *proposals]


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
