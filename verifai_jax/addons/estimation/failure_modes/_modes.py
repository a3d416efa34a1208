"""Every mode of failure, with its probability.

    found = modes(problem, budget=50_000)
    found = modes(run)                              # begins from the failures of a run as well
    print(found); found.plot("modes.png"); found[0].animate("mode.gif")

Most of the budget goes to the failure probability, estimated by independent searches, splitting and
importance sampling (`estimate`). Its weighted failures are then divided into regions by paths of
failures. So the probabilities of the modes are parts of one estimate and sum to it.
"""

import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation._estimate import one_thread
from verifai_jax.addons.estimation.answers import Answer, Plan, bound_from_pilot, chains_for
from verifai_jax.addons.estimation.double_precision import DoublePrecisionEvaluator
from verifai_jax.addons.estimation.failure_modes.held_keys import Divided, Held, divide_under_keys
from verifai_jax.addons.estimation.failure_modes.naming import name_mode
from verifai_jax.addons.estimation.failure_modes.own_chance import divide_by_chance
from verifai_jax.addons.estimation.failure_modes.region_search import find_regions, share_explained
from verifai_jax.addons.estimation.failure_modes.result import Mode, Modes
from verifai_jax.addons.estimation.importance import ImportanceSamples
from verifai_jax.addons.estimation.methods import SHARE_OF_LEVEL, estimate_by_importance_sampling
from verifai_jax.addons.estimation.moved_priors import notice_lost_failures, notice_own_chance
from verifai_jax.addons.estimation.normal_space import Ended, LimitState, Spent, to_unit_cube
from verifai_jax.core.compute.keys import run_keys, simulation_key
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.display.progress import SimulationProgress, shows_progress
from verifai_jax.core.messages.checks import check_fraction, check_options, options_of
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.counterexamples import confirm
from verifai_jax.counterexamples.description import describe_predicate
from verifai_jax.counterexamples.fixed_key import hold_key
from verifai_jax.counterexamples.selection import problem_of
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.confirmations import REFUSED
from verifai_jax.evaluation.replay import replay
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification import simulate
from verifai_jax.falsification.run import Run
from verifai_jax.features import FeatureSpace
from verifai_jax.problem.dependence import depends_on_key, without_derivative
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.silent_mistakes import formula_notes
from verifai_jax.statistics.binomial import clopper_pearson
from verifai_jax.statistics.stopping import Stop

DIVIDING, MAX_DIVIDING = 0.25, 6500
"""Share of the budget that divides the failures, and most of these simulations; the rest is for the
probability."""
MORE_DIVIDING = 2
"""Factor on that share for a system that draws random numbers."""
SHOWN = 200
"""Number of failures that a mode keeps, and of prior samples from which its name is made."""
OUTWARD = (1.0, 1.005, 1.02, 1.05)
"""Factors on a likeliest failure, of which the first that fails again in a run is its row."""
MAX_RUN_FAILURES = 200
"""Failures of a given run that the search for modes begins from."""


@suggests_options
@shows_progress("finding the modes of")
def modes(
    source: Problem | Run,
    budget: int = 50_000,
    *,
    batch: int | None = None,
    seed: int = 0,
    confidence: float = 0.95,
    min_share: float = 0.001,
    stop: Stop | None = None,
    precision: str = "float32",
    run_on: RunOn | None = None,
    progress: bool | None = None,
) -> Modes:
    """Find every mode of failure, with its probability under the prior of the features.

    **Arguments:**
    - `source`: a problem, or a run of one; failures of the run are then used too.
    - `budget`: maximum number of simulations; one with its gradient counts as 2.
    - `confidence`: the confidence of all intervals, between 0 and 1.
    - `min_share`: regions with a smaller share of the failure probability are not listed.
    - `stop`: the seconds after which the finished simulations are divided into modes.
    - `run_on`: the backend of the simulations.
    - all other arguments: as in `falsify`.
    **Returns:** the modes, the most probable first. If no failure was found, or failures could not
    be weighted, the result is empty and a note says why. If the system draws random numbers,
    probabilities cover these too, and each mode holds a random key under which its likeliest
    failure fails.
    **Raises:** `TypeError` for a source that is not a problem or run; `ValueError` for options out
    of range, or a run that was loaded without its problem.
    """
    started = time.perf_counter()
    if not isinstance(source, Problem | Run):
        raise TypeError(f"modes needs a Problem or a run of one; got {type(source).__name__}")
    problem = problem_of(source) if isinstance(source, Run) else source
    sources = problem.sources()
    changed = source.changed_since() if isinstance(source, Run) else ""
    check_options(budget, 1 if batch is None else batch, seed)
    max_seconds = options_of("modes", Stop, stop, "seconds").seconds
    backend = options_of("modes", RunOn, run_on, "backend").backend
    check_fraction("confidence", confidence)
    check_fraction("min_share", min_share)
    in_precision(precision)
    problem.space.check_where()
    for_probability = int(budget) - min(round(DIVIDING * budget), MAX_DIVIDING)
    chains = chains_for(for_probability, SHARE_OF_LEVEL)
    batch = min(chains if batch is None else batch, budget)
    chosen = resolved(problem, batch=batch, budget=budget, precision=precision, wanted=backend)
    chosen.problem.check()
    draws = depends_on_key(chosen.problem)
    # Under each of several keys the failures are divided.
    estimated = int(budget) - (MORE_DIVIDING if draws else 1) * (int(budget) - for_probability)
    simulated = DoublePrecisionEvaluator(chosen.problem, batch, precision, seed)
    simulated.compile()
    rng = np.random.default_rng(seed)
    with SimulationProgress(problem.name, budget, progress) as bar, one_thread():
        limit_state = LimitState(
            simulated, problem.space.dim, estimated, batch, constraint=_constraint(problem.space),
            deadline=None if max_seconds is None else started + max_seconds, report=bar.update,
            gradient=simulated.gradient if _has_slopes(chosen.problem) else None,
            uniform=simulated.uniform, draws=draws,
        )  # fmt: skip
        plan = Plan(confidence, chains, simulated.clamped)
        if chosen.problem.black_box:
            notice_own_chance(limit_state, np.random.default_rng((seed, 1)))
        try:
            answer = estimate_by_importance_sampling(limit_state, rng, plan)
        except KeyboardInterrupt:
            limit_state.ended = "interrupted"
            answer = bound_from_pilot(limit_state, plan)
        limit_state.budget = int(budget)
        limit_state.draws = draws  # Chance that is not of the key is under no key that is held.
        held = _under_keys(simulated, limit_state)
        divided = _divide(limit_state, held, rng, answer, _failures_of(source), problem.black_box)
    bound = answer.prior.upper_bound(confidence)
    listed, rest, run, unexplained, notes = (), 0.0, None, (0.0, 1.0), list(answer.notes)
    notes[:0] = formula_notes(problem)
    if limit_state.own_chance:
        notes.insert(
            0,
            f"{limit_state.own_chance}; so each point fails with a probability, and each mode says "
            "how many simulations of its likeliest failure fail",
        )
    if divided is not None and answer.samples is not None:
        numbers = _Numbers(chosen.problem, seed, precision, backend, confidence, min_share)
        listed, rest, run = _list_modes(numbers, rng, answer, divided)
        if divided.tried:
            missed = clopper_pearson(divided.tried - divided.joined, divided.tried, confidence)
            unexplained = (missed.low, missed.high)
        if divided.held:
            notes.append(divided.note)
        notes = [*numbers.notes, *notes]
    if answer.probability is not None and not listed:
        notes.append(
            "the failures could not be weighted one by one, so the probability is not divided "
            "into modes; a larger budget may find a proposal that fits them"
        )
    known = answer.probability is not None
    return Modes(
        name=problem.name, modes=listed, probability=answer.probability,
        low=answer.low if known else 0.0, high=answer.high if known else bound,
        confidence=confidence, unexplained=unexplained, rest=rest,
        simulations=limit_state.simulations, budget=int(budget), upper_bound=bound,
        notes=tuple(dict.fromkeys(notes)), run=run, seconds=time.perf_counter() - started,
        sources=sources.to_json(), changed=changed, stopped=limit_state.ended,
    )  # fmt: skip


@dataclass(frozen=True)
class _Numbers:
    """Settings of one call that the listing of modes needs."""

    problem: Problem
    seed: int
    precision: str
    backend: str | None
    confidence: float
    min_share: float
    notes: list[str] = field(default_factory=list)
    """On failures that did not come again."""


def _has_slopes(problem: Problem) -> bool:
    slopes = not problem.black_box and 0 in problem.space.levels
    return slopes and without_derivative(problem) is None


def _constraint(space: FeatureSpace) -> Any:
    if space.where is None:
        return None
    accepts = space.accepts_points
    return lambda u: np.asarray(accepts(np.asarray(u, np.float32)))


def _failures_of(source: Problem | Run) -> Float[np.ndarray, "n d"] | None:
    """Return failures of a given run in normal space; None for a problem."""
    from scipy.special import ndtri

    if not isinstance(source, Run) or source.problem is None:
        return None
    rows = source.table.counterexamples
    if not len(rows):
        return None
    rows = rows.sort_values("rho").head(MAX_RUN_FAILURES)
    points = np.asarray(source.problem.space.points(rows), np.float64)
    return ndtri(np.clip(points, 1e-8, 1 - 1e-8))


def _under_keys(simulated: DoublePrecisionEvaluator, limit_state: LimitState) -> Held:
    """Return what makes the limit state under one random key."""

    def held(key: int, budget: int) -> LimitState:
        def numbers(u: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
            return np.full(len(u), key)

        slopes = None
        if limit_state.gradient is not None:
            slopes = lambda u: simulated.gradient_held(u, numbers(u))  # noqa: E731
        under = LimitState(
            lambda u: simulated.held(u, numbers(u)), limit_state.dim, budget, limit_state.batch,
            constraint=limit_state.constraint, deadline=limit_state.deadline, gradient=slopes,
            uniform=limit_state.uniform,
        )  # fmt: skip
        under.strict = True
        return under

    return held


def _divide(
    limit_state: LimitState, held: Held, rng: np.random.Generator, answer: Answer,
    more: Float[np.ndarray, "n d"] | None, black_box: bool,
) -> Divided | None:  # fmt: skip
    """Divide the weighted failures into regions; return None without any, or when time ends."""
    if answer.samples is None or not answer.samples.x.any():
        return None
    samples = answer.samples
    x = samples.x[samples.failing]
    share = x / x.sum()
    z = samples.failures
    nearest = [part for part in (answer.nearest, more) if part is not None]
    starts = np.concatenate(nearest) if nearest else z[:0]
    if black_box and not limit_state.draws and not limit_state.own_chance:
        notice_lost_failures(limit_state, rng, z)
    if limit_state.own_chance:
        return divide_by_chance(limit_state, rng, samples)
    limit_state.strict, joined, tried = True, 0, 0
    try:
        if limit_state.draws:
            return divide_under_keys(limit_state, held, rng, samples, starts)
        starts = starts[: limit_state.left // 4]
        regions = find_regions(limit_state, rng, z, share, _failing(limit_state, starts))
        with suppress(Spent):
            joined, tried = share_explained(limit_state, rng, regions, z, share)
    except (Ended, KeyboardInterrupt):
        return None
    return Divided(regions, np.zeros(len(regions.points), int), joined, tried, 1.0, 0)


def _failing(limit_state: LimitState, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "_ d"]:
    return z[limit_state(z).failing] if len(z) else z


def _list_modes(
    numbers: _Numbers, rng: np.random.Generator, answer: Answer, divided: Divided
) -> tuple[tuple[Mode, ...], float, Run | None]:
    """Return the modes in the order of their probability, what is left, and their simulations."""
    samples, regions = answer.samples, divided.regions
    assert samples is not None
    problem, whole = numbers.problem, answer.probability or min(samples.mean.mean, 1.0)
    of_sample = np.full(len(samples.x), -1)
    of_sample[samples.failing] = regions.assign(samples.failures)
    parts = [_part_of(samples, of_sample == k) for k in range(regions.count)]
    masses = np.array([float(part.x.sum()) for part in parts]) / float(samples.x.sum())
    order = [int(k) for k in np.argsort(-masses, kind="stable") if masses[k] >= numbers.min_share]
    rest = whole * max(0.0, float(1 - masses[order].sum()))
    if not order:
        return (), rest, None
    rows_of_design = divided.design_rows[order]
    design = regions.points[rows_of_design]
    likeliest = _columns(problem.space, design)
    prior = _columns(problem.space, rng.standard_normal((5 * SHOWN, problem.space.dim)))
    keys = divided.keys[rows_of_design]
    if divided.held:
        found = _simulate_under(numbers, design, keys)
    else:
        found = _simulate(numbers, design, OUTWARD[:1] if divided.times else OUTWARD)
    key = run_keys(numbers.seed)[1]
    listed = []
    of_failure = of_sample[samples.failing]
    for number, k in enumerate(order):
        weight = np.where(of_failure == k, samples.x[samples.failing], 0.0)
        drawn = rng.choice(len(weight), SHOWN, p=weight / weight.sum())
        failures = _columns(problem.space, samples.failures[drawn])
        low, high = parts[k].interval(numbers.confidence)
        run, row = found[number]
        features = {str(name): value for name, value in likeliest.iloc[number].items()}
        if divided.held and row is not None:
            # What is handed out is what fails.
            simulated = run.table.all.loc[row]
            features = {name: simulated[name] for name in features}
        rho, cause = _cause(numbers, features, key, int(keys[number]))
        chance = None
        if divided.times:
            chance = divided.failing[k] / divided.times
            why = f"; in one that failed {cause}" if rho < 0 and cause else ""
            cause = (
                f"its likeliest failure fails in {divided.failing[k]} of {divided.times} "
                f"simulations{why}"
            )
        listed.append(
            Mode(
                number=number, name=name_mode(failures, prior),
                probability=whole * float(masses[k]), low=low, high=high, share=float(masses[k]),
                features=features, distance=float(np.linalg.norm(design[number])), rho=rho,
                cause=cause, failures=failures, row=row, problem=problem, run=run, key=key,
                precision=numbers.precision, key_number=int(keys[number]), chance=chance,
            )
        )  # fmt: skip
    return tuple(listed), rest, found[0][0]


def _part_of(samples: ImportanceSamples, own: Bool[np.ndarray, " n"]) -> ImportanceSamples:
    """Return the samples with the weights of one region only."""
    return replace(
        samples, x=np.where(own, samples.x, 0.0), edge=np.where(own, samples.edge, 0.0),
        without=np.zeros_like(samples.without),
    )  # fmt: skip


def _columns(space: FeatureSpace, z: Float[np.ndarray, "n d"]) -> pd.DataFrame:
    """Return the features at points of normal space as columns of a table."""
    with in_precision("float64"):
        features = jax.tree.map(np.asarray, jax.vmap(space.unflatten)(to_unit_cube(z)))
    return pd.DataFrame(space.rows(features))


def _simulate(
    numbers: _Numbers, design: Float[np.ndarray, "k d"], outward: tuple[float, ...] = OUTWARD
) -> list[tuple[Run, int | None]]:
    """Simulate likeliest failures and points just beyond; return run and failing row of each."""
    count = len(design)
    points = np.concatenate([factor * design for factor in outward])
    frame = _columns(numbers.problem.space, points)
    run = simulate(
        numbers.problem, frame, seed=numbers.seed, precision=numbers.precision,
        run_on=RunOn(backend=numbers.backend), progress=False,
    )  # fmt: skip
    failing = set(run.table.counterexamples.index)
    if numbers.problem.black_box and failing and len(outward) > 1:
        # What it claims has been simulated at least once more.
        checked = confirm(run)
        lost = np.isin(checked.table["verdict"].to_numpy(), REFUSED)
        failing -= set(checked.table.index.to_numpy()[lost])
        numbers.notes.extend(checked.wavering)
    rows: list[tuple[Run, int | None]] = []
    for k in range(count):
        tried: Int[np.ndarray, " n"] = np.arange(k, len(points), count)
        rows.append((run, next((int(row) for row in tried if row in failing), None)))
    return rows


def _simulate_under(
    numbers: _Numbers, design: Float[np.ndarray, "k d"], keys: Int[np.ndarray, " k"]
) -> list[tuple[Run, int | None]]:
    """Simulate the same, each under the random key with that number, which its run holds."""
    found: dict[int, tuple[Run, int | None]] = {}
    for key in np.unique(keys).tolist():
        own = np.flatnonzero(keys == key)
        problem = hold_key(numbers.problem, simulation_key(run_keys(numbers.seed)[1], key))
        under = replace(numbers, problem=problem)
        found |= dict(zip(own.tolist(), _simulate(under, design[own]), strict=True))
    return [found[k] for k in range(len(design))]


def _cause(numbers: _Numbers, features: dict[str, Any], key: Any, number: int) -> tuple[float, str]:
    """Return the robustness at features, and the formula and predicate that decide, as text."""
    replayed = replay(numbers.problem, features, key, number, numbers.precision)
    rho = min(replayed.rho.values())
    if not replayed.violated and replayed.rho:
        return rho, f"simulated again it keeps the property, with robustness {rho:z.4g}"
    try:
        why = replayed.explain()
    except ValueError:
        return rho, ""
    at = format_seconds(why.time, 4)
    predicate = why.predicate
    if predicate.compared:
        return rho, describe_predicate(predicate, why, at)
    return rho, f"at {at} {predicate} decides"
