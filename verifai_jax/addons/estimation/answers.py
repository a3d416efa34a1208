"""Answers: probabilities and notes from samples, splitting runs and bounds."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.estimation import importance, monte_carlo
from verifai_jax.addons.estimation.importance import STEADY
from verifai_jax.addons.estimation.initial_proposal import Agreement
from verifai_jax.addons.estimation.intervals import log_interval
from verifai_jax.addons.estimation.monte_carlo import Counts
from verifai_jax.addons.estimation.normal_space import LimitState
from verifai_jax.addons.estimation.splitting import SplittingRun, run_splitting
from verifai_jax.core.messages.text import format_percent

WORST_TAIL = 0.7
"""Tail index beyond which weighted samples are not relied on (Vehtari et al., 2024)."""
NOTED_UNSEEN = 0.02
"""Share of the probability from which a disagreement is noted."""
CHAIN = 10
"""States of a chain: each level is about a tenth as probable as the previous one."""
UNDERSTATED = 1.6
"""Factor on the relative error of a run: chains start from those of the previous level."""
Cheap: TypeAlias = Callable[[Float[np.ndarray, "n d"]], Float[np.ndarray, " n"]]
"""From points of the unit cube to the robustness of a cheap model."""


@dataclass(frozen=True)
class Plan:
    """Requirements on an answer.

    - `confidence`: the confidence of the interval and the bound.
    - `chains`: number of splitting chains in a level.
    - `clamped`: True at coordinates whose domain has an outermost value.
    - `within`: factor from the estimate to the ends of the interval at which to stop; None to spend
      the whole budget.
    - `cheap`: the robustness of a cheap model at points of the unit cube; None without one.
    """

    confidence: float
    chains: int
    clamped: Bool[np.ndarray, " d"]
    within: float | None = None
    cheap: Cheap | None = None


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
    """Return the number of chains for a level with this share of the budget, a multiple of 32."""
    return 32 * max(1, round(budget * share / CHAIN / 32))


def estimate_by_monte_carlo(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan
) -> Answer:
    """Estimate by Monte Carlo with all remaining simulations."""
    return monte_carlo_answer(monte_carlo.sample_prior(limit_state, rng, limit_state.left), plan)


def monte_carlo_answer(counts: Counts, plan: Plan) -> Answer:
    answer = Answer(counts)
    if counts.failures:
        answer.probability = counts.failures / counts.simulations
        answer.low, answer.high = counts.interval(plan.confidence)
        answer.method = "monte_carlo"
        answer.effective = float(counts.failures)
        answer.relative_error = float(np.sqrt((1 - answer.probability) / max(counts.failures, 1)))
    else:
        answer.high = counts.upper_bound(plan.confidence)
        answer.notes.append(
            f"none of {counts.simulations:,} samples of the prior fails, so there is a bound and "
            "no estimate"
        )
    return answer


def splitting_cost(run: SplittingRun, size: int) -> float:
    """Return the simulations of a splitting run with levels of this size."""
    return size + (len(run.fractions) - 1) * (size - size // CHAIN)


def importance_answer(
    samples: importance.ImportanceSamples, run: SplittingRun, agreement: Agreement, counts: Counts,
    plan: Plan,
) -> Answer:  # fmt: skip
    mean = samples.mean
    low, high = samples.interval(plan.confidence)
    failing, drawn = samples.defensive_counts
    high = min(1.0, high / (1 - agreement.unseen))
    answer = Answer(counts, min(mean.mean, 1.0), low, high, "importance", mean.effective, mean.cv)
    answer.diagnostics = {
        "tail_index": mean.tail, "largest_share": mean.largest,
        "failing_share": float(samples.failing.mean()), "components": len(samples.proposal.shares),
        "defensive_share": float(samples.proposal.shares[0]), "failures_by_prior": failing,
        "samples_by_prior": drawn, "splitting": run.estimate, "unresolved": samples.unresolved,
        "acceptance": samples.acceptance[0], "levels": list(run.levels),
        "fractions": list(run.fractions), "reached": [float(share) for share in agreement.reached],
        "unseen": agreement.unseen,
    }  # fmt: skip
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
            "A larger budget searches more, and falsify(problem, 'diverse') lists more failures"
        )
    if mean.tail > WORST_TAIL:
        answer.notes.append(
            f"the weights have a heavy tail (index {mean.tail:z.2f}): "
            "the interval may be too narrow"
        )
    if samples.unresolved > 0.01:
        answer.notes.append(
            "failures lie where single precision or a distribution's outermost value hides up to "
            f"{format_percent(samples.unresolved)} of them; the interval is widened by this"
        )
    return answer


def check_by_splitting(
    answer: Answer, run: SplittingRun, reached: float, interval: tuple[float, float], plan: Plan
) -> None:
    """Compare an answer with the result of splitting, for the failures that splitting reached."""
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
        f"splitting gave {run.estimate:z.2g}, which does not agree; the interval is widened to "
        "contain both. More simulations would decide"
    )


def estimate_by_splitting(limit_state: LimitState, rng: np.random.Generator, plan: Plan) -> Answer:
    """Estimate by independent splitting runs, as many as the budget allows."""
    run = run_splitting(limit_state, rng, CHAIN * plan.chains, plan.chains)
    counts = Counts(*run.first)
    if run.stopped is not None:
        return bound_answer(limit_state, rng, plan, run, counts)
    return splitting_answer(limit_state, rng, plan, [run], counts)


def splitting_answer(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, runs: list[SplittingRun],
    counts: Counts,
) -> Answer:  # fmt: skip
    """Answer with the mean of these runs and of further runs within the budget.

    If the first level of each run already consists of failures, the runs contain only samples of
    the prior. The answer then counts these, which is more precise, and exact if all of them fail.
    """
    if all(run.levels == [-np.inf] for run in runs):
        counts = counts + monte_carlo.sample_prior(limit_state, rng, limit_state.left)
        answer = monte_carlo_answer(counts, plan)
        answer.notes.append(
            "failures are so probable that splitting would have one level; its samples are counted"
        )
        return answer
    size = runs[0].first[0]
    cost = splitting_cost(runs[0], size)
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


def bound_answer(
    limit_state: LimitState, rng: np.random.Generator, plan: Plan, run: SplittingRun, counts: Counts
) -> Answer:
    """Answer with a bound only: the remaining simulations sample the prior."""
    reached = float(np.prod(run.fractions)) if run.fractions else 1.0
    level = run.levels[-1] if run.levels else np.inf
    why = {
        "stuck": "the search found no failure: the robustness gets no lower than "
        f"{limit_state.lowest:z.4g}, or has no slope to follow",
        "budget": f"the budget ended at robustness {level:z.4g}, which is reached with probability "
        f"{reached:z.1e}; a failure is less probable, or impossible",
        None: "splitting reached failures, and no independent sample of the prior failed",
    }.get(run.stopped, "splitting ended early" + f" at robustness {level:z.4g}" * bool(run.levels))
    counts = counts + monte_carlo.sample_prior(limit_state, rng, limit_state.left)
    answer = monte_carlo_answer(counts, plan)
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
    """Answer from the pilot samples of the prior that were finished before an early end."""
    answer = monte_carlo_answer(Counts(*limit_state.pilot), plan)
    answer.notes.insert(0, f"ended early ({limit_state.ended})")
    return answer
