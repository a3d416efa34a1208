"""The probability that a simulation fails, with an interval.

result = vj.estimate(problem, budget=50_000)
result = vj.estimate(problem, method="splitting", p0=1e-6)
result.probability, result.interval, result.upper_bound
"""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from verifai_jax._version import __version__
from verifai_jax.addons.estimation import answers
from verifai_jax.addons.estimation.double_precision import DoublePrecisionEvaluator
from verifai_jax.addons.estimation.methods import (
    SHARE_OF_LEVEL,
    SHARE_OF_REPLICATE,
    UNSEARCHED,
    estimate_automatically,
    estimate_by_importance_sampling,
)
from verifai_jax.addons.estimation.monte_carlo import AT_ONCE, Counts
from verifai_jax.addons.estimation.moved_priors import notice_own_chance
from verifai_jax.addons.estimation.normal_space import LimitState
from verifai_jax.addons.estimation.result import METHODS, WEIGHTED, Estimate
from verifai_jax.addons.estimation.surrogate import FITTING, estimate_by_surrogate
from verifai_jax.addons.searches.cheap import check_same_features
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.display.progress import SimulationProgress, shows_progress
from verifai_jax.core.messages.checks import check_fraction, check_options, options_of
from verifai_jax.core.messages.errors import suggests_options, unknown_name
from verifai_jax.core.messages.text import listed
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification.validation import SLOW, can_be_slow
from verifai_jax.problem.dependence import depends_on_key, without_derivative
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.silent_mistakes import formula_notes
from verifai_jax.statistics.binomial import clopper_pearson
from verifai_jax.statistics.stopping import Stop

if TYPE_CHECKING:
    from verifai_jax.addons.verification.rest import Rest
    from verifai_jax.addons.verification.result import Verification
GRADIENTS_FROM = 3
"""Continuous coordinates from which the searches for failing regions take gradients."""
CHEAP_BATCH = 4096
"""Simulations of a cheap model at once."""
WITHIN = 1.5
"""Factor from the estimate to the ends of the interval, at which an estimate with a cheap model
ends."""
SPEEDS = ("auto", "slow", "fast")
"""Values of `simulations_are`."""


@suggests_options
@shows_progress("estimating")
def estimate(
    problem: Problem,
    method: str | None = None,
    budget: int = 50_000,
    *,
    batch: int | None = None,
    seed: int = 0,
    confidence: float = 0.95,
    p0: float | None = None,
    stop: Stop | None = None,
    precision: str = "float32",
    run_on: RunOn | None = None,
    progress: bool | None = None,
    simulations_are: Literal["auto", "slow", "fast"] = "auto",
    within: float | None = None,
    cheap: Problem | None = None,
    proved: "Verification | str | Path | None" = None,
) -> Estimate:
    """Estimate the probability, under the prior of the features, that a simulation fails.

    A failure is a simulation that breaks a formula of the problem.

    The prior is the distribution of the features, given that the constraint holds. If the system
    draws random numbers, the probability covers these too.

    **Arguments:**
    - `problem`: the system with its feature space and formulas.
    - `method`: `"monte_carlo"`, `"importance"`, `"splitting"` or `"surrogate"`; when left out, it
      is chosen from the first samples.
    - `budget`: maximum number of simulations, including those of pilot runs and fits.
    - `confidence`: the confidence of the interval and of the bound, between 0 and 1.
    - `p0`: an upper limit between 0 and 1. The result says whether the probability is shown to lie
      below it, and if not, how many more simulations without a failure would show that.
    - `stop`: the seconds after which the estimate is made from finished simulations.
    - `run_on`: backend and workers of the simulations; with workers the estimate is the same.
    - `simulations_are`: `"slow"` if only a few hundred simulations are affordable: the method is
      then `"surrogate"`, which computes more to simulate less. `"auto"` assumes this for a black
      box whose simulation takes at least half a second, if the budget is 200 or more.
    - `within`: for slow simulations: stop before the budget is spent once the ends of the interval
      lie within this factor of the estimate, such as 1.5.
    - `cheap`: a cheap model of the same features, which shows where failures may be. It is
      simulated some 100 000 times; every claim rests on simulations of `problem` alone.
      `simulations_are` is then `"slow"`, and `within` 1.5 by default.
    - `proved`: the result of `verify` for this problem, or its file. Proved parts of the space,
      safe or failing, are not simulated; all simulations are in the rest.
    - all other arguments: as in `falsify`.
    **Returns:** the estimate with its interval and a guaranteed bound. Ctrl-C gives the estimate
    from the finished simulations. A simulation without a verdict (not finite, raised, out of time)
    counts as safe in the estimate, and as a failure at the upper ends of interval and bound.
    **Raises:** before anything compiles, `TypeError` for an argument that is no `Problem`, and
    `ValueError` for options out of range, unknown names, a problem whose parts do not fit, a
    constraint that refuses every sample, or a verification of another problem.
    """
    started = time.perf_counter()
    if not isinstance(problem, Problem):
        raise TypeError(f"estimate needs a Problem; got {type(problem).__name__}")
    if method is not None and method not in METHODS:
        raise unknown_name("method", method, METHODS)
    check_options(budget, 1 if batch is None else batch, seed)
    max_seconds = options_of("estimate", Stop, stop, "seconds").seconds
    where = options_of("estimate", RunOn, run_on, "backend", "executor")
    executor = where.executor
    check_fraction("confidence", confidence)
    if p0 is not None:
        check_fraction("p0", p0)
    if simulations_are not in SPEEDS:
        raise unknown_name("simulations_are", simulations_are, SPEEDS)
    if within is not None and not within > 1:
        raise ValueError(f"within must be a factor above 1, such as 1.5; got {within}")
    if cheap is not None:
        check_same_features(problem, cheap)
    in_precision(precision)
    problem.space.check_where()
    share = SHARE_OF_REPLICATE if method == "splitting" else SHARE_OF_LEVEL
    chains = answers.chains_for(budget, share)
    batch = min(chains if batch is None else batch, budget)
    choice = resolved(
        problem, batch=batch, budget=budget, precision=precision, wanted=where.backend
    )
    choice.problem.check()
    sources = problem.sources()
    rest = None
    if proved is not None:
        from verifai_jax.addons.verification.result import as_verification

        rest = as_verification(proved).left(choice.problem, precision)
    simulated = DoublePrecisionEvaluator(choice.problem, batch, precision, seed, executor)
    simulated.compile()
    with SimulationProgress(problem.name, budget, progress) as bar, one_thread():
        limit_state = LimitState(
            simulated, problem.space.dim, int(budget), batch, constraint=_constraint(problem, rest),
            deadline=None if max_seconds is None else started + max_seconds, report=bar.update,
            together=1 if executor is None else AT_ONCE,
            gradient=simulated.gradient if _differentiates(choice.problem) else None,
            uniform=simulated.uniform, draws=depends_on_key(choice.problem),
            one_by_one=choice.problem.black_box and executor is None,
            workers=choice.problem.system.workers, rest=rest,
        )  # fmt: skip
        slow = simulations_are == "slow" or cheap is not None
        plan = answers.Plan(confidence, chains, simulated.clamped, within)
        if cheap is not None:
            plan = replace(
                plan, within=within or WITHIN, cheap=_robustness_of(cheap, precision, seed)
            )
        if choice.problem.black_box:
            notice_own_chance(limit_state, np.random.default_rng((seed, 1)))
            if simulations_are == "auto" and can_be_slow(choice.problem, executor):
                slow = slow or limit_state.seconds >= SLOW
        if slow and method is None and problem.space.dim:
            method = "surrogate"
        answer_by = _METHODS[method] if rest is None or rest.mass else _nothing_left
        try:
            answer = answer_by(limit_state, np.random.default_rng(seed), plan)
        except KeyboardInterrupt:
            # Interrupted while a proposal is fitted: the pilot samples still count.
            limit_state.ended = "interrupted"
            answer = answers.bound_from_pilot(limit_state, plan)
    seconds = time.perf_counter() - started
    found = _result(
        problem, choice.backend, answer, limit_state, plan, seed, precision, p0, seconds
    )
    if rest is not None:
        found = _with_decided(found, rest, limit_state, seed)
    return replace(found, sources=sources.to_json())


_METHODS = {
    None: estimate_automatically,
    "monte_carlo": answers.estimate_by_monte_carlo,
    "importance": estimate_by_importance_sampling,
    "splitting": answers.estimate_by_splitting,
    "surrogate": estimate_by_surrogate,
}


def _result(
    problem: Problem, backend: str | None, answer: answers.Answer, limit_state: LimitState,
    plan: answers.Plan, seed: int, precision: str, p0: float | None, seconds: float,
) -> Estimate:  # fmt: skip
    notes = [text for text in (limit_state.own_chance, *formula_notes(problem)) if text]
    notes += answer.notes
    bound = answer.prior.upper_bound(plan.confidence)
    high = answer.high
    if answer.prior.no_verdict and answer.method in WEIGHTED:
        # The weighted samples near the failures say nothing of missing verdicts elsewhere.
        none = clopper_pearson(answer.prior.no_verdict, answer.prior.simulations, plan.confidence)
        high = min(1.0, high + none.high)
    elif limit_state.no_verdict and answer.method in WEIGHTED:
        notes.append(
            f"{limit_state.no_verdict:,} simulations near the failures gave no verdict; if they "
            "are failures, the probability is higher"
        )
    if limit_state.no_verdict == limit_state.simulations > 0:
        notes.append(
            "no simulation gave a verdict; falsify(problem, 'uniform', 10).table.all shows their "
            "status and their exceptions"
        )
    if limit_state.ended:
        notes.append(f"ended early: {limit_state.ended}")
    if answer.method in WEIGHTED:
        made, found = limit_state.searches
        searches = ["the surrogate"] if answer.method == "surrogate" else []
        if answer.method == "splitting" or len(answer.diagnostics.get("reached", ())) > found:
            searches.append("splitting")
        if answer.method == "importance" and found:
            searches.append(f"{found} of {made} independent searches")
        notes.append(
            f"the interval does not account for failures far from all that {listed(searches)} "
            "reached; the guaranteed bound does"
        )
        if answer.method != "surrogate":
            answer.diagnostics["independent_searches"] = made
            if not made:
                notes.insert(0, UNSEARCHED)
    return Estimate(
        name=problem.name, probability=answer.probability, low=answer.low,
        high=high if answer.probability is not None else bound, confidence=plan.confidence,
        method=answer.method, simulations=limit_state.simulations, budget=limit_state.budget,
        failures=limit_state.failures, no_verdict=limit_state.no_verdict, upper_bound=bound,
        prior_simulations=answer.prior.simulations, prior_failures=answer.prior.failures,
        prior_no_verdict=answer.prior.no_verdict, effective=answer.effective,
        relative_error=answer.relative_error, diagnostics=answer.diagnostics,
        notes=tuple(dict.fromkeys(notes)), p0=p0, seed=seed, version=__version__,
        precision=precision, backend=backend, seconds=seconds, stopped=limit_state.ended,
        drawn=answer.drawn,
    )  # fmt: skip


def _robustness_of(cheap: Problem, precision: str, seed: int) -> answers.Cheap:
    cheap = resolved(cheap, batch=CHEAP_BATCH, budget=FITTING, precision=precision).problem
    cheap.check()
    simulate = DoublePrecisionEvaluator(cheap, CHEAP_BATCH, precision, seed)
    return lambda u: np.asarray(simulate(u)[0], float)


def _differentiates(problem: Problem) -> bool:
    """Return whether the searches use gradients, which chains do not need in few dimensions."""
    many = not problem.black_box and problem.space.levels.count(0) >= GRADIENTS_FROM
    return many and without_derivative(problem) is None


def _constraint(problem: Problem, rest: "Rest | None") -> Callable[[np.ndarray], np.ndarray] | None:
    accepts = problem.space.accepts_points
    if rest is None and problem.space.where is None:
        return None

    def accepted(u: np.ndarray) -> np.ndarray:
        fits = np.asarray(accepts(np.asarray(u, np.float32)))
        return fits if rest is None else fits & ~rest.is_decided(u)

    return accepted


def _nothing_left(
    limit_state: LimitState, rng: np.random.Generator, plan: answers.Plan
) -> answers.Answer:
    return answers.Answer(Counts(0, 0, 0), 0.0, 0.0, 0.0)


def _with_decided(found: Estimate, rest: "Rest", limit_state: LimitState, seed: int) -> Estimate:
    """Return the estimate for the whole prior from `found`, which covers the rest of a proof.

    Decided boxes satisfy the constraint; samples show the share of the rest that does.
    """
    left, error = rest.mass, 0.0
    if rest.cut:
        left, error = limit_state.acceptance(np.random.default_rng((seed, 2)))

    def whole(inside: float, off: float) -> float:
        part = left * (1 + off * error)
        return (rest.failing + part * inside) / (part + rest.decided)

    def ends(inside: float) -> list[float]:
        return [whole(inside, off) for off in (-4, 4)]

    probability = None if found.probability is None else whole(found.probability, 0)
    estimated = 1 - whole(0.0, 0) / probability if probability else 1.0
    return replace(
        found, probability=probability, relative_error=estimated * found.relative_error,
        low=min(ends(found.low)), high=max(ends(found.high)),
        upper_bound=max(ends(found.upper_bound)), certain=whole(0.0, 0),
        rest=left / (left + rest.decided),
    )  # fmt: skip


def one_thread() -> AbstractContextManager[object]:
    """Limit linear algebra to one thread.

    Small matrices take ten times as long on several threads if other work occupies the cores.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return nullcontext()
    return threadpool_limits(1, user_api="blas")
