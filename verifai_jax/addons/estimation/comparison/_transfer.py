"""The same policy in two engines: differences of verdicts and traces, and their causes.

    result = transfer(policy, in_mujoco, in_brax)       # functions policy -> Problem, or Problems
    print(result); result.plot(); result.table

A pair simulates both with the same features and random key. First pairs are sampled, then a search
looks for the greatest difference.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from verifai_jax import search as searches
from verifai_jax.addons.estimation.comparison.result import Transfer
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count, check_positive
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.falsification.validation import check_search
from verifai_jax.problem.problem import Problem, ProblemError
from verifai_jax.problem.silent_mistakes import formula_notes
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals
from verifai_jax.search.uniform import Uniform

Made: TypeAlias = Problem | Callable[[Any], Problem]
NUDGE = 2.0**-22
"""Part of the cube by which a sample is moved to see how rounding grows: the rounding of a feature
in single precision. Simulations run in double precision, whose own rounding is far smaller."""
GROWTH = 3.0
"""Times that growth which a gap must exceed: moves in other directions may grow more."""
STILL, TINY = 1e-3, 1e-9
"""Least unit of a signal, as a part of its greatest value and by itself."""
MAX_CONSTANTS = 8
"""Constants of the models that are named at most."""
USUAL = 0.9
"""Quantile of the traces' greatest values that counts as the end of a signal's range."""


@suggests_options
@reproducible_settings()
@shows_progress("comparing engines")
def transfer(
    policy: object,
    problem_a: Made,
    problem_b: Made,
    *,
    samples: int = 128,
    simulations: int = 256,
    search: str | Search = "cross_entropy",
    tolerance: float = 1e-6,
    seed: int = 0,
    batch: int = 64,
    precision: str = "float64",
    progress: bool | None = None,
) -> Transfer:
    """Simulate the same policy in two engines, and find where they differ.

    Traces are compared in the signals that the formulas of both problems read, each in units of its
    range. A gap counts if it exceeds both `tolerance` and several times the effect of rounding,
    which is the gap in one engine when the features change by one rounding error of single
    precision.

    **Arguments:**
    - `policy`: the policy passed to both problems; None if they contain it already.
    - `problem_a`, `problem_b`: a function from the policy to a `Problem`, or a `Problem`. Features
      that both have, with the same domains, vary; all others keep their nominal values.
    - `samples`: number of sampled pairs; rates and the influence of features come from these alone.
    - `simulations`: number of further pairs, in which a search looks for the greatest difference.
    - `search`: that search, which must not need gradients.
    - `tolerance`: the largest gap that does not count, in units of a signal's range; choose it
      above the tolerance of the engines' solvers.
    - all other arguments: as in `falsify`.
    **Returns:** a `Transfer` with the table of all pairs.
    **Raises:** before anything is simulated, `ProblemError` for problems without a common feature
    or signal; `TypeError` for anything but a `Problem`; `ValueError` for numbers out of range
    and a search that needs gradients.
    """
    started = time.perf_counter()
    check_count("samples", samples, 8)
    check_count("simulations", simulations, 0)
    check_count("batch", batch)
    check_count("seed", seed, 0)
    check_positive("tolerance", tolerance)
    problems, notes = _common(
        _made(problem_a, policy, "problem_a"), _made(problem_b, policy, "problem_b")
    )
    space = problems[0].space
    found = searches.named(search) if isinstance(search, str) else search
    if isinstance(found, Search) and found.wants.derivatives:
        raise ValueError(f"search {search!r} follows gradients, which a difference does not have")
    found = check_search(problems[0], found)
    pairs = _Pairs(problems, batch, precision, seed, tolerance)
    key = run_keys(seed)[0]
    stopped = "budget"
    try:
        for count, one in ((samples, Uniform()), (simulations, found)):
            proposals = Proposals(one, space.cube, batch, key, space.constraint)
            left = count
            while left > 0 and not proposals.exhausted:
                u = np.asarray(proposals.next(min(batch, left)), np.float32)
                if not len(u):
                    proposals.tell_refused()
                    continue
                gaps, proper = pairs.add(u, searched=one is found)
                proposals.tell(np.where(proper, -gaps, np.nan), proper, None)
                left -= len(u)
    except KeyboardInterrupt:
        stopped = "interrupted"
        if not pairs.rows:
            raise
    return Transfer(
        names=_names(problems),
        table=pairs.table(),
        space=space,
        influence=pairs.influence(),
        worst=pairs.worst,
        tolerance=tolerance,
        stopped=stopped,
        seconds=time.perf_counter() - started,
        seed=seed,
        notes=(*formula_notes(problems[0]), *notes, *pairs.notes),
        sources={n: p.sources().to_json() for n, p in zip("ab", problems, strict=True)},
    )


def _made(given: object, policy: object, name: str) -> Problem:
    made = given if isinstance(given, Problem) or not callable(given) else given(policy)
    if not isinstance(made, Problem):
        raise TypeError(
            f"{name} must be a Problem, or a function from the policy to one; got "
            f"{type(made).__name__}"
        )
    return made


def _names(problems: Sequence[Problem]) -> tuple[str, str]:
    one, other = (problem.name for problem in problems)
    return (one, other) if one != other else (f"{one} (a)", f"{other} (b)")


def _common(a: Problem, b: Problem) -> tuple[tuple[Problem, Problem], list[str]]:
    """Return the problems with only their common features, and notes on the others."""
    for problem in (a, b):
        problem.check()
    spaces = [dict(p.space.root.fields) for p in (a, b)]
    both = [n for n, d in spaces[0].items() if d.size and n in spaces[1] and spaces[1][n].size]
    if not both:
        raise ProblemError(
            "the problems have no varying feature in common: "
            f"{', '.join(spaces[0])} in a; {', '.join(spaces[1])} in b"
        )
    for name in both:
        if spaces[0][name] != spaces[1][name]:
            raise ProblemError(
                f"{name} is {spaces[0][name]!r} in a and {spaces[1][name]!r} in b: both sides of "
                "a pair have the same features, so give it the same domain in both"
            )
    notes, held = [], []
    for letter, problem, space in zip("ab", (a, b), spaces, strict=True):
        others = [n for n, d in space.items() if d.size and n not in both]
        if others:
            notes.append(f"{', '.join(others)} of {letter} is fixed at its nominal value")
        held.append(problem.only(*both) if others else problem)
    notes += _other_constants(a, b)
    order = [[n for n, d in p.space.root.fields if d.size] for p in held]
    if order[0] != order[1]:
        raise ProblemError(f"the common features are in another order: {order[0]} and {order[1]}")
    return (held[0], held[1]), notes


def _other_constants(a: Problem, b: Problem) -> list[str]:
    """Describe the constants in which the models of two systems differ, if comparable."""
    one, other = (problem.system.constants for problem in (a, b))
    said = []
    for name in one:
        x, y = one[name], other.get(name)
        if y is None or np.array_equal(x, y):
            continue
        if isinstance(x, str) or np.size(x) == 1 == np.size(y):
            said.append(f"{name} is {x} in a and {y} in b")
        elif np.shape(x) == np.shape(y):
            said.append(f"{name} differs by up to {np.max(np.abs(np.subtract(x, y))):z.3g}")
    return ["the models differ: " + "; ".join(said[:MAX_CONSTANTS])] if said else []


class _Pairs:
    """Pairs of simulations, and their results so far."""

    def __init__(
        self, problems: tuple[Problem, Problem], batch: int, precision: str, seed: int,
        tolerance: float,
    ) -> None:  # fmt: skip
        self.tolerance, self.space = tolerance, problems[0].space
        chosen = [resolved(p, batch=batch, budget=batch, precision=precision) for p in problems]
        self._evaluators = [
            Evaluator(c.problem, batch, precision=precision, seed=seed, keep_traces=True)
            for c in chosen
        ]
        self._rng = np.random.default_rng(seed)
        self._scales: dict[str, float] = {}
        self._count = 0
        self.rows: list[dict[str, Any]] = []
        self._points: list[Float[np.ndarray, "n d"]] = []
        self.worst: tuple[int, Trace, Trace] | None = None
        self._worst_gap = -np.inf
        self.notes: list[str] = []

    def add(
        self, u: Float[np.ndarray, "n d"], searched: bool
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Simulate pairs; return their gaps in units of what rounding can do, and which count."""
        sides = [evaluate(u, first=self._count) for evaluate in self._evaluators]
        if not self._scales:
            self._scales = _scales(sides)
            self._say_signals(sides)
        nudged = self._nudged(u)
        again = [evaluate(nudged, first=self._count) for evaluate in self._evaluators]
        columns = self.space.rows(self.space.features_at(u))
        gaps = np.full(len(u), np.nan)
        for i in range(len(u)):
            proper = all(bool(v.proper[i]) for v in sides)
            row = {name: values[i] for name, values in columns.items()}
            row |= {"searched": searched, "proper": proper}
            for letter, verdicts in zip("ab", sides, strict=True):
                row[f"robustness_{letter}"] = float(verdicts.lowest[i])
                row[f"violated_{letter}"] = bool(verdicts.violated[i])
            traces = [_trace(v, i) for v in sides]
            if proper and traces[0] is not None and traces[1] is not None:
                noise = [_trace(v, i) for v in again]
                row |= self._parting(traces[0], traces[1], noise)
                gaps[i] = row["gap"]
                if row["differs"] and row["gap"] > self._worst_gap:
                    self._worst_gap = row["gap"]
                    self.worst = len(self.rows), traces[0], traces[1]
            self.rows.append(row)
        self._points.append(u)
        self._count += len(u)
        return gaps, np.isfinite(gaps)

    def _say_signals(self, sides: list[Verdicts]) -> None:
        known = [next((_trace(v, i) for i in range(len(v.status))), None) for v in sides]
        for letter, trace in zip("ab", known, strict=True):
            alone = sorted({_plain(n) for n in _columns(trace)} - {_plain(n) for n in self._scales})
            if alone:
                self.notes.append(f"{', '.join(alone)} is a signal of {letter} only")

    def _nudged(self, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Move real coordinates by one rounding of single precision, to either side."""
        moves = np.where(u > 0.5, -1.0, 1.0) * NUDGE
        moves *= np.where(self._rng.random(u.shape) < 0.5, 1.0, 0.5)
        return np.asarray(u + moves * (np.asarray(self.space.levels) == 0), np.float32)

    def _parting(self, a: Trace, b: Trace, again: Sequence[Trace | None]) -> dict[str, Any]:
        """Return the largest gap of two traces, its time, and its signal."""
        times, gaps = _gaps(a, b, self._scales)
        grown = np.zeros(len(times))
        for trace, other in zip((a, b), again, strict=True):
            if other is None:
                continue
            at, growth = _gaps(trace, other, self._scales)
            whole = np.maximum.accumulate(np.max(list(growth.values()), axis=0))
            grown = np.maximum(grown, np.interp(times, at, whole))
        bound = self.tolerance + GROWTH * grown
        each = {name: float(np.max(values)) for name, values in gaps.items()}
        signal = max(each, key=each.__getitem__)
        beyond = np.max(list(gaps.values()), axis=0) > bound
        part = float(times[np.argmax(beyond)]) if np.any(beyond) else np.nan
        return {
            "gap": each[signal],
            "signal": signal,
            "parted": part,
            "rounding": float(bound[-1]),
            "differs": bool(np.any(beyond)),
        }

    def table(self) -> "pd.DataFrame":
        """Return the pairs, a row each."""
        table = pd.DataFrame(self.rows)
        table["differs"] = table["differs"].eq(True)
        return table

    def influence(self) -> dict[str, float]:
        """Return the share of the gap's variance that each coordinate explains, in the samples.

        The share is the correlation ratio over eight equal parts of the samples, less what chance
        gives; the gap by its logarithm.
        """
        table = self.table()
        chosen = (~table["searched"] & table["differs"]).to_numpy()
        u, gap = np.concatenate(self._points)[chosen], table["gap"].to_numpy(float)[chosen]
        n, parts = len(u), 8
        if n < 2 * parts or np.ptp(gap) == 0:
            return {}
        y = np.log(gap)
        shares = {}
        for label, values in zip(self.space.coordinates, u.T, strict=True):
            bins = np.argsort(np.argsort(values, kind="stable")) * parts // n
            means = np.array([np.mean(y[bins == k]) for k in range(parts)])
            share = float(np.var(means[bins]) / np.var(y))
            chance = (parts - 1) / (n - 1)
            shares[str(label)] = max(0.0, (share - chance) / (1 - chance))
        return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _trace(verdicts: Verdicts, i: int) -> Trace | None:
    return None if verdicts.traces is None else verdicts.traces[i]


def _plain(name: str) -> str:
    return name.partition("[")[0]


def _columns(trace: Trace | None) -> dict[str, Float[np.ndarray, " time"]]:
    """Return the valid samples of each signal of numbers; entries of a vector have names."""
    if trace is None:
        return {}
    valid = None if trace.valid is None else int(np.asarray(trace.valid))
    found = {}
    for name, values in jax.device_get(dict(trace.signals)).items():
        array = np.asarray(values, float)[:valid]
        if array.ndim == 1:
            found[name] = array
        else:
            flat = array.reshape(len(array), -1)
            found |= {f"{name}[{k}]": flat[:, k] for k in range(flat.shape[1])}
    return found


def _scales(sides: Sequence[Verdicts]) -> dict[str, float]:
    """Return the range of each common signal, over most traces of both engines."""
    known = [[_columns(t) for t in v.traces or () if t is not None] for v in sides]
    first = [next(iter(each), {}) for each in known]
    if not all(first):
        return {}
    names = [name for name in first[0] if name in first[1]]
    if not names:
        raise ProblemError(
            "the formulas of both problems have no signal in common: "
            f"{', '.join(first[0])} in a; {', '.join(first[1])} in b"
        )
    scales = {}
    for name in names:
        traces = [v[np.isfinite(v)] for one in known for each in one if len(v := each[name])]
        low, high, size = np.array(
            [(np.min(v), np.max(v), np.max(np.abs(v))) for v in traces if len(v)] or [(0, 0, 0)]
        ).T
        # Some traces that diverge must not hide what the others do.
        whole = np.quantile(high, USUAL) - np.quantile(low, 1 - USUAL)
        whole = whole or np.max(high) - np.min(low)
        # What hardly moves is in units of its size, lest its rounding look like a motion.
        scales[name] = float(max(whole, STILL * np.quantile(size, USUAL), TINY))
    return scales


def _gaps(
    a: Trace, b: Trace, scales: Mapping[str, float]
) -> tuple[Float[np.ndarray, " time"], dict[str, Float[np.ndarray, " time"]]]:
    """Return times, and how far each signal is apart there in units of its range.

    Where one trace ends before the other, they are at least one range apart at its end.
    """
    one, other = _columns(a), _columns(b)
    counts = [len(next(iter(each.values()))) for each in (one, other)]
    t, s = (np.asarray(x.clock())[:n] for x, n in zip((a, b), counts, strict=True))
    ends = t[-1], s[-1]
    times = t[t <= min(ends) + 1e-9]
    period = max(np.max(np.diff(each), initial=0.0) for each in (t, s))
    gaps = {}
    for name, scale in scales.items():
        x, y = one[name][: len(times)], np.interp(times, s, other[name])
        gaps[name] = np.nan_to_num(np.abs(x - y) / scale, nan=np.inf)
        if abs(ends[0] - ends[1]) > period * (1 + 1e-6):
            gaps[name][-1] = max(gaps[name][-1], 1.0)
    return times, gaps
