"""Comparison of two or more problems on common random samples until the result is decided.

    result = compare(old, new)                          # Problems of one feature space
    result = compare(old, {"wide": wide, "deep": deep}, margin=0.002)
    print(result); result.regression; result["wide"].rules()

A pair simulates both problems with the same features and random key. The intervals hold at any
time, so sampling may stop as soon as they decide (`statistics.paired_rates`).
"""

import functools
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any, overload

import jax
import numpy as np
import pandas as pd
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.addons.estimation.comparison._compare_scores import ScoreComparison, compare_scores
from verifai_jax.addons.estimation.comparison.result import UNDECIDED, Compared, Comparison, judge
from verifai_jax.addons.estimation.comparison.score_tables import Scores, is_scores
from verifai_jax.addons.estimation.paired_rates import PairedRates, paired_rates
from verifai_jax.addons.estimation.revisions import load_at_revision, split_revision
from verifai_jax.core.compute.executors import Executor
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count, check_fraction, options_of
from verifai_jax.core.messages.errors import end_if_interrupted, suggests_options
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.features import Domain, FeatureSpace
from verifai_jax.problem.problem import Problem, ProblemError
from verifai_jax.problem.silent_mistakes import formula_notes
from verifai_jax.statistics.stopping import Stop

BLOCK = 1024
"""Points of the cube that are drawn at once."""
FIRST, MAX_SAMPLES = 64, 4096
"""Pairs between two looks, at first and at most; each time twice as many."""
BATCH = 512
"""Simulations at once."""


@overload
def compare(
    baseline: Problem | str, candidates: Problem | str | Mapping[str, Problem | str], **options: Any
) -> Comparison: ...
@overload
def compare(baseline: Scores, candidates: Scores, **options: Any) -> ScoreComparison: ...
@suggests_options
@reproducible_settings()
@shows_progress("comparing")
def compare(
    baseline: Any,
    candidates: Any,
    *,
    margin: float = 0.0,
    confidence: float = 0.95,
    budget: int = 100_000,
    seed: int = 0,
    stop: Stop | None = None,
    precision: str = "float32",
    run_on: RunOn | None = None,
    undisturbed: bool = True,
    cluster: str | None = None,
    in_order: bool = False,
    progress: bool | None = None,
) -> Comparison | ScoreComparison:
    """Compare failure rates of problems on common random samples, until the result is decided.

    Each pair of simulations has the same features and the same random key. A candidate is *worse*
    if its failure rate exceeds that of the baseline by more than `margin`, *better* if it is lower
    by more than `margin`, and *the same* if the two differ by at most `margin`. These verdicts hold
    with `confidence`, whenever sampling stops, for all candidates together.

    **Arguments:**
    - `baseline`: the problem to compare with: itself, `FILE.py:NAME`, or `FILE.py:NAME@REVISION`
      for the problem as it was at a revision of git.
    - `candidates`: another problem with the same varying features, or several by name. Features
      with fixed values, such as the parameters of a `repair`, may have other values or be missing.
    - `margin`: the largest difference of failure probabilities that does not matter, at least 0.
    - `confidence`: the probability that all verdicts hold.
    - `budget`: maximum number of simulations of all problems together.
    - `stop`: the seconds after which the verdict is made from finished pairs.
    - `run_on`: the workers of the simulations; with them the comparison is the same.
    - `undisturbed`: whether each pair is also simulated without its disturbances, such as faults
      and events, which says whether they make the difference.
    - `cluster`, `in_order`: of tables of scores, see below.
    - all other arguments: as in `falsify`.

    Both sides may be tables of scores that another evaluator wrote, of which more is better: an
    `eval_info.json` of LeRobot, a CSV or Parquet file or a DataFrame with a column `success`,
    `score` or `failed` (or `successes` and `episodes`) and any of `run`, `seed`, `task` and
    `episode`, a matrix of scores `[runs, tasks]` (JSON, `.npz`, an array), or a list of such files,
    one of each run. Then only `margin`, `confidence`, `cluster` and `in_order` count.
    `cluster` names the column whose values are independent; by default runs, otherwise seeds,
    otherwise each episode, if there are two of each side. With `in_order` the rows are in the
    order of the trials, and the interval holds after any number of them, in which one may stop.

    **Returns:** a `Comparison`, after Ctrl-C that of the finished pairs; of tables a
    `ScoreComparison`.
    **Raises:** before anything is simulated, `TypeError` for anything but a `Problem`;
    `ProblemError` if other features vary; `ValueError` for numbers out of range, and for targets
    that cannot be loaded.
    """
    if is_scores(baseline) and is_scores(candidates):
        one, other = (each if isinstance(each, str) else "" for each in (baseline, candidates))
        named = one or "the baseline", other or "the candidate"
        return compare_scores((baseline, candidates), named, margin, confidence, cluster, in_order)
    if cluster is not None or in_order:
        raise ValueError("cluster and in_order are for tables of scores on both sides")
    seconds = options_of("compare", Stop, stop, "seconds").seconds
    executor = options_of("compare", RunOn, run_on, "executor").executor
    with ExitStack() as loaded:

        def problem(given: Problem | str) -> Problem:
            if not isinstance(given, str):
                return given
            if executor is not None and split_revision(given)[1] is not None:
                raise ValueError(
                    f"{given} cannot be simulated by workers, which import the modules of the "
                    "project as they are today; compare revisions on this machine, without executor"
                )
            return loaded.enter_context(load_at_revision(given, Problem))

        target = baseline if isinstance(baseline, str) else None
        first = problem(baseline)
        given: Mapping[str, Problem | str]
        if isinstance(candidates, str):
            given = {candidates: candidates}
        elif isinstance(candidates, Problem):
            other = getattr(first, "name", "") != candidates.name
            given = {candidates.name if other else "candidate": candidates}
        else:
            given = candidates
        named = {name: problem(candidate) for name, candidate in given.items()}
        return _compare(
            first, named, target, margin, confidence, budget, seed, seconds, precision, executor,
            undisturbed,
        )  # fmt: skip


def _compare(
    baseline: Problem, named: Mapping[str, Problem], target: str | None, margin: float,
    confidence: float, budget: int, seed: int, max_seconds: float | None, precision: str,
    executor: Executor | None, undisturbed: bool,
) -> Comparison:  # fmt: skip
    """Compare problems; see `compare`."""
    started = time.perf_counter()
    _check(baseline, named, margin, confidence, budget)
    check_count("seed", seed, 0)
    problems = {None: baseline, **named}
    evaluators = {}
    for name, problem in problems.items():
        chosen = resolved(problem, batch=BATCH, budget=budget, precision=precision).problem
        evaluators[name] = Evaluator(
            chosen, BATCH, precision=precision, seed=seed, executor=executor, ends_raising=True
        )
    notes = _notes(baseline, named)
    sides = {"baseline": baseline, **named}
    sources = {name: side.sources() for name, side in sides.items()}
    each = 1 - (1 - confidence) / len(named)
    tallies = {name: _Tally() for name in named}
    open_ones, stopped, size, first = set(named), "budget", FIRST, 0
    prior = _Prior(baseline.space, run_keys(seed)[0])
    spent, calm = 0, _without_disturbances(baseline.space) if undisturbed else None
    arms = 2 if calm else 1
    try:
        while open_ones:
            size = min(size, (budget - spent) // (arms * (1 + len(open_ones))))
            if size < 1:
                break
            if max_seconds is not None and time.perf_counter() - started > max_seconds:
                stopped = "max_seconds"
                break
            u = prior.take(size)
            known = _failing(evaluators[None], u, first)
            still = _failing(evaluators[None], calm(u), first) if calm else ()
            spent += arms * size
            for name in [name for name in named if name in open_ones]:
                tallies[name].add(u, known, _failing(evaluators[name], u, first))
                if calm:
                    tallies[name].still.add(u, still, _failing(evaluators[name], calm(u), first))
                spent += arms * size
                if judge(tallies[name].rates(each), margin) != UNDECIDED:
                    open_ones.discard(name)
            first += size
            size = min(2 * size, MAX_SAMPLES)
        else:
            stopped = "decided"
    except KeyboardInterrupt:
        stopped = "interrupted"
    if not any(tally.pairs for tally in tallies.values()):
        end_if_interrupted(stopped)
        raise ProblemError("no pair was simulated, so that nothing can be compared")
    return Comparison(
        target or baseline.name,
        tuple(_compared(baseline.space, n, t, each, margin) for n, t in tallies.items()),
        spent,
        stopped,
        time.perf_counter() - started,
        seed,
        notes,
        {name: made.to_json() for name, made in sources.items()},
    )


class _Tally:
    """The pairs of one candidate so far."""

    def __init__(self) -> None:
        self.points: list[Float[np.ndarray, "n d"]] = []
        self.failing: list[tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]] = []
        self.proper: list[Bool[np.ndarray, " n"]] = []
        self.pairs = 0

    @functools.cached_property
    def still(self) -> "_Tally":
        """The same pairs without disturbances."""
        return _Tally()

    def undisturbed(self, confidence: float) -> tuple[PairedRates, int, int] | None:
        if not self.still.pairs:
            return None
        one, other, proper = self.still.columns()
        return self.still.rates(confidence), int(np.sum(one & proper)), int(np.sum(other & proper))

    def add(self, u: Any, one: tuple[Any, ...], other: tuple[Any, ...]) -> None:
        self.points.append(u)
        self.failing.append((one[0], other[0]))
        self.proper.append(one[1] & other[1])
        self.pairs += len(u)

    def columns(self) -> tuple[Any, Any, Any]:
        """Return whether the baseline fails, whether the candidate does, and whether both ended."""
        return (
            np.concatenate([one for one, _ in self.failing]),
            np.concatenate([other for _, other in self.failing]),
            np.concatenate(self.proper),
        )

    def rates(self, confidence: float) -> PairedRates:
        one, other, proper = self.columns()
        return paired_rates(
            int(np.sum(one & ~other & proper)), int(np.sum(other & ~one & proper)), self.pairs,
            confidence, int(np.sum(~proper)),
        )  # fmt: skip


def _failing(evaluate: Evaluator, u: Any, first: int) -> tuple[Any, Any]:
    """Return which simulations fail, and which have a verdict."""
    verdicts = evaluate(u, first=first)
    return np.asarray(verdicts.violated, bool), np.asarray(verdicts.status) == Status.OK


def _without_disturbances(space: FeatureSpace) -> Callable[[Any], Any] | None:
    """Return a function that takes from points what has a nominal value for any system.

    These are faults and events. None if a space has none, or if its constraint may refuse this.
    """
    calm, found = np.full(space.dim, np.nan, np.float32), 0
    for _, domain in space.root.fields:
        if domain.size and domain.nominal is not None:
            calm[found : found + domain.size] = domain.to_unit(domain.coerce(domain.nominal))
        found += domain.size
    if np.isnan(calm).all() or space.constraint is not None:
        return None
    return lambda u: np.where(np.isnan(calm), u, calm)


class _Prior:
    """Points of the prior in one order, however many are taken at a time."""

    def __init__(self, space: FeatureSpace, key: Key[Array, ""]) -> None:
        space.check_where()
        self.space, self._block = space, 0
        self._left = np.zeros((0, space.dim), np.float32)
        shape = (BLOCK, space.dim)
        self._draw = jax.jit(lambda i: jax.random.uniform(jax.random.fold_in(key, i), shape))

    def take(self, count: int) -> Float[np.ndarray, "n d"]:
        """Return the next `count` points that the constraint accepts."""
        while len(self._left) < count:
            u = np.asarray(self._draw(self._block), np.float32)
            if self.space.constraint is not None:
                u = u[np.asarray(self.space.constraint(u))]
            self._left, self._block = np.concatenate([self._left, u]), self._block + 1
        taken, self._left = self._left[:count], self._left[count:]
        return taken


def _compared(
    space: FeatureSpace, name: str, tally: _Tally, confidence: float, margin: float
) -> Compared:
    one, other, proper = tally.columns()
    u = np.concatenate(tally.points)
    table: Any = pd.DataFrame(space.rows(space.features_at(u)))
    table["worse"], table["better"] = other & ~one & proper, one & ~other & proper
    discordant = table[table["worse"] | table["better"]].drop(columns="better")
    both = int(np.sum(one & other & proper))
    return Compared(
        name, tally.rates(confidence), both, margin, discordant, table[proper], space,
        tally.undisturbed(confidence),
    )  # fmt: skip


def _check(
    baseline: Any, candidates: Mapping[str, Any], margin: float, confidence: float, budget: int
) -> None:
    for name, problem in {"baseline": baseline, **candidates}.items():
        if not isinstance(problem, Problem):
            raise TypeError(f"{name} must be a Problem; got {type(problem).__name__}")
    if not candidates:
        raise ValueError("compare needs at least one candidate; got none")
    if not 0 <= margin < 1:
        raise ValueError(f"margin must be a probability, from 0 to below 1; got {margin}")
    check_fraction("confidence", confidence)
    minimum = 1 + len(candidates)
    if check_count("budget", budget) < minimum:
        raise ValueError(f"budget must be {minimum} at least, one simulation of each; got {budget}")
    baseline.check()
    for name, problem in candidates.items():
        problem.check()
        ours, theirs = baseline.space, problem.space
        if _varying(ours) != _varying(theirs):
            raise ProblemError(
                f"{name!r} varies other features than the baseline, so their samples cannot be the "
                f"same: {_difference(ours, theirs)}"
            )
        if (ours.where is None) != (theirs.where is None):
            raise ProblemError(f"only one of {name!r} and the baseline has a constraint")


def _varying(space: FeatureSpace) -> list[tuple[str, Domain]]:
    """Return the features that vary, in their order: samples of the prior are of these alone."""
    return [(name, domain) for name, domain in space.root.fields if domain.size]


def _difference(one: FeatureSpace, other: FeatureSpace) -> str:
    ours, theirs = dict(_varying(one)), dict(_varying(other))
    for feature in dict.fromkeys((*ours, *theirs)):
        if feature not in theirs or feature not in ours:
            space, where = (other, "there") if feature in ours else (one, "in the baseline")
            if feature not in space.domains:
                return f"{feature} is missing {where}"
            return (
                f"{feature} varies in one and is fixed in the other ({where}): compare what varies "
                f"in both, such as problem.only({', '.join(map(repr, _common(ours, theirs)))})"
            )
        if ours[feature] != theirs[feature]:
            return f"{feature} is {ours[feature]!r}, there {theirs[feature]!r}"
    return "their features are in another order"


def _common(one: Mapping[str, Domain], other: Mapping[str, Domain]) -> list[str]:
    return [name for name in one if name in other]


def _held(space: FeatureSpace) -> dict[str, str]:
    """Return the features that do not vary, as text."""
    return {name: repr(domain) for name, domain in space.root.fields if not domain.size}


def _notes(baseline: Problem, candidates: Mapping[str, Problem]) -> tuple[str, ...]:
    own = {name: str(formula) for name, formula in baseline.formulas.items()}
    notes = [*formula_notes(baseline)]
    held = _held(baseline.space)
    for name, problem in candidates.items():
        for feature, value in _held(problem.space).items():
            if held.get(feature) != value:
                was = f"; in the baseline {held[feature]}" if feature in held else ""
                notes.append(f"{feature} is held in {name}: {value}{was}")
        theirs = {key: str(formula) for key, formula in problem.formulas.items()}
        if theirs != own:
            notes.append(
                f"the formulas of {name} are its own, {', '.join(theirs.values())}, and those of "
                f"the baseline {', '.join(own.values())}"
            )
    return tuple(notes)
