"""The probability that a simulation fails, with an interval; by the method that suits it.

found = vj.estimate(problem, budget=50_000)
found = vj.estimate(problem, method="splitting", p0=1e-6)
found.probability, found.interval, found.upper_bound
"""

import math
import time
from contextlib import nullcontext
from typing import Any

import numpy as np

from verifai_jax._version import __version__
from verifai_jax.core.errors import suggests_options, unknown_name
from verifai_jax.core.precision import in_precision
from verifai_jax.core.progress import Progress
from verifai_jax.estimation.double_precision import Simulated
from verifai_jax.estimation.methods import (
    SHARE_OF_LEVEL,
    SHARE_OF_REPLICATE,
    Answer,
    Plan,
    automatic,
    by_counting,
    by_importance,
    by_splitting,
    chains_for,
    cut_off,
)
from verifai_jax.estimation.normal_space import Judge
from verifai_jax.estimation.result import METHODS, Estimate
from verifai_jax.evaluation.backends import resolved
from verifai_jax.falsification.validation import check_options
from verifai_jax.problem.problem import Problem


@suggests_options
def estimate(
    problem: Problem,
    method: str | None = None,
    budget: int = 50_000,
    *,
    batch: int | None = None,
    seed: int = 0,
    confidence: float = 0.95,
    p0: float | None = None,
    precision: str = "float32",
    backend: str | None = None,
    max_seconds: float | None = None,
    progress: bool | None = None,
) -> Estimate:
    """The probability, under the prior of the feature space, that a simulation breaks a formula.

    The prior is uniform on the unit cube, that is, the distributions of the features, given that
    the constraint holds; a system's own randomness counts as well.

    **Arguments:**

    - `method`: `"monte_carlo"`, `"importance"` or `"splitting"`; chosen by what the first samples
      show when left out.
    - `budget`: simulations at most, pilot and fitting included.
    - `batch`: simulations at once; by default as many as the method asks for at a time.
    - `seed`: the same seed gives the same estimate on the same machine.
    - `confidence`: of the interval and of the bound.
    - `p0`: a probability that it should be below; the result says whether that is shown, and how
      many simulations without a failure would show it.
    - `precision`, `backend`, `progress`: as in `falsify`.
    - `max_seconds`: wall-clock seconds after which the estimate is made from what there is.

    Ctrl-C ends it and gives what can be said from what is finished. A simulation without a verdict
    (not finite, raised, out of time) is counted, is no failure in the estimate, and is one at the
    upper ends of the interval and of the bound.

    **Raises:** `ValueError` before anything compiles for options out of range, unknown names, a
    problem whose parts do not fit or a constraint that refuses every sample.
    """
    started = time.perf_counter()
    if not isinstance(problem, Problem):
        raise TypeError(f"estimate needs a Problem; got {type(problem).__name__}")
    if method is not None and method not in METHODS:
        raise unknown_name("method", method, METHODS)
    check_options(budget, 1 if batch is None else batch, seed, max_seconds, None)
    _check_share("confidence", confidence)
    if p0 is not None:
        _check_share("p0", p0)
    in_precision(precision)
    problem.space.check_where()
    share = SHARE_OF_REPLICATE if method == "splitting" else SHARE_OF_LEVEL
    chains = chains_for(budget, share)
    batch = min(chains if batch is None else batch, budget)
    choice = resolved(problem, batch=batch, budget=budget, precision=precision, wanted=backend)
    choice.problem.check()
    simulated = Simulated(choice.problem, batch, precision, seed)
    simulated.compile()
    with Progress(problem.name, budget, progress) as bar, _one_thread():
        judge = Judge(
            simulated,
            problem.space.dim,
            int(budget),
            batch,
            accepts=None if problem.space.where is None else _accepting(problem),
            deadline=None if max_seconds is None else started + max_seconds,
            told=bar.update,
        )
        plan = Plan(confidence, chains, simulated.clamped)
        try:
            answer = _METHODS[method](judge, np.random.default_rng(seed), plan)
        except KeyboardInterrupt:
            # Between simulations, while a proposal is fitted: the first level still counts.
            judge.ended = "interrupted"
            answer = cut_off(judge, plan)
    seconds = time.perf_counter() - started
    return _result(problem, choice.backend, answer, judge, plan, seed, precision, p0, seconds)


_METHODS = {
    None: automatic,
    "monte_carlo": by_counting,
    "importance": by_importance,
    "splitting": by_splitting,
}


def _result(
    problem: Problem,
    backend: str | None,
    answer: Answer,
    judge: Judge,
    plan: Plan,
    seed: int,
    precision: str,
    p0: float | None,
    seconds: float,
) -> Estimate:
    notes = list(answer.notes)
    bound = answer.prior.upper_bound(plan.confidence)
    high = answer.high
    if answer.prior.no_verdict and answer.method in ("importance", "splitting"):
        # What the weighted samples do not see of simulations without a verdict.
        from verifai_jax.statistics.binomial import clopper_pearson

        none = clopper_pearson(answer.prior.no_verdict, answer.prior.simulations, plan.confidence)
        high = min(1.0, high + none.high)
    elif judge.no_verdict and answer.method in ("importance", "splitting"):
        notes.append(
            f"{judge.no_verdict:,} simulations near the failures gave no verdict; should they be "
            "failures, the probability is higher"
        )
    if judge.no_verdict == judge.simulations > 0:
        notes.append(
            "no simulation gave a verdict at all; falsify(problem, 'uniform', 10).table.all has "
            "their status and what they raised"
        )
    if judge.ended:
        notes.append(f"ended early: {judge.ended}")
    if answer.method in ("importance", "splitting"):
        notes.append(
            "a part of the failures that no search has come near is not in the interval, only in "
            "the guaranteed bound"
        )
    return Estimate(
        name=problem.name,
        probability=answer.probability,
        low=answer.low,
        high=high if answer.probability is not None else bound,
        confidence=plan.confidence,
        method=answer.method,
        simulations=judge.simulations,
        budget=judge.budget,
        failures=judge.failures,
        no_verdict=judge.no_verdict,
        upper_bound=bound,
        prior_simulations=answer.prior.simulations,
        prior_failures=answer.prior.failures,
        prior_no_verdict=answer.prior.no_verdict,
        effective=answer.effective,
        relative_error=answer.relative_error,
        diagnostics=answer.diagnostics,
        notes=tuple(dict.fromkeys(notes)),
        p0=p0,
        seed=seed,
        version=__version__,
        precision=precision,
        backend=backend,
        seconds=seconds,
        drawn=answer.drawn,
    )


def _accepting(problem: Problem) -> Any:
    accepts = problem.space.accepts_points
    return lambda u: accepts(np.asarray(u, np.float32))


def _check_share(name: str, value: Any) -> None:
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not (number and 0 < value < 1 and math.isfinite(value)):
        raise ValueError(f"{name} must lie between 0 and 1; got {value!r}")


def _one_thread() -> Any:
    """Small matrices take ten times as long on threads that other work keeps waiting."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return nullcontext()
    return threadpool_limits(1, user_api="blas")
