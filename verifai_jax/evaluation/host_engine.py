"""Evaluation of systems that JAX cannot trace: batches as for the engine, simulated on the host.

    engine = HostEngine(problem)
    engine.evaluate(u, key, first=0)                    # Verdicts, as of `engine.Engine`

A simulation that raises, hangs or kills its process becomes a row with a status and a message; the
others continue. Traces are evaluated in blocks of one shape, so that few monitors compile.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer, Key, PyTree

from verifai_jax.core.compute.compilation import pad_rows, power_of_two
from verifai_jax.core.compute.keys import simulation_key
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.messages.text import storable
from verifai_jax.core.user_code.user_errors import format_user_error
from verifai_jax.core.values.trace import Status, Trace, without_wrapping
from verifai_jax.evaluation.guidance import NOTHING, Guidance
from verifai_jax.evaluation.host_monitor import MONITORS, HostMonitor
from verifai_jax.evaluation.journal import Journal
from verifai_jax.evaluation.remarks import Remarks
from verifai_jax.evaluation.verdicts import RowVerdict, Verdicts, violations
from verifai_jax.mtl.setting import period
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.silent_mistakes import formula_notes
from verifai_jax.systems.base import Outcome, System, outcome_of
from verifai_jax.systems.blackbox._blackbox import plain_leaves

BLOCK = 32
"""Traces evaluated together, unless patience ends before there are so many: one program of one
shape for all."""
PATIENCE = 0.5
"""Seconds after which traces are evaluated in smaller blocks, so that they are safe on disk: at
most so much work is lost with the process."""


class HostEngine:
    """Evaluates batches of a black-box problem; the counterpart of `engine.Engine`.

    **Arguments:**
    - `problem`: a checked `Problem`.
    - `precision`: the precision of features and monitor, `"float32"` or `"float64"`.
    - `journal`: a journal that stores rows with a verdict until their batch is finished.
    - `system`: a system that replaces the problem's own, such as one with a finer step.
    - `monitor`: a compiled monitor of the same formulas.
    - `guidance`: additional results for a search; by default those of the given monitor.
    - `keep_traces`: whether verdicts include the traces, with the monitor's sampling period.
    - `given`: whether points are rows of given features, as in `CubePoints`.

    `simulation_seconds` is the time of the last simulations, including their verdicts.
    """

    def __init__(
        self, problem: Problem, precision: str = "float32", journal: Journal | None = None, *,
        system: System | None = None, monitor: HostMonitor | None = None,
        guidance: Guidance = NOTHING, keep_traces: bool = False, given: bool = False,
    ) -> None:  # fmt: skip
        self.given = given
        self.problem, self.precision, self.journal = problem, precision, journal
        self.keep_traces = keep_traces
        self.system = problem.system if system is None else system
        if monitor is None and not guidance.size:
            # The one of all engines of the problem, so that it compiles once.
            monitor = problem.programs.get(MONITORS, "", lambda: HostMonitor(problem))
        self.monitor = HostMonitor(problem, guidance) if monitor is None else monitor
        self.compile_seconds = 0.0
        self.simulation_seconds = 0.0
        self.remarks = Remarks()
        self.formula_notes: tuple[str, ...] = ()
        self._prepare = jax.jit(self._prepared)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the simulations so far, with their counts."""
        return (*self.formula_notes, *self.remarks.texts)

    def begin_compiling(self) -> None:
        """Do nothing; see `compile`."""

    def compile(self) -> None:
        """Do nothing, because monitors compile when the first trace shows its length."""

    def evaluate(
        self,
        rows: Float[np.ndarray, "n d"] | Float[Array, "n d"],
        key: Key[Array, ""],
        first: int = 0,
        temperature: Float[np.ndarray, " n"] | Float[Array, ""] | float = 1.0,
        *,
        padded_to: int = 1,
        keep_traces: bool | None = None,
        journals: bool = True,
    ) -> Verdicts:
        """Simulate `n` points of the unit cube and decide which violate the property.

        **Arguments:** those of `engine.Engine.evaluate`; nothing is differentiated.
        - `padded_to`: a power of two, the minimum number of rows whose features are computed
          together, so that few rows get the same bits as in a large batch.
        - `keep_traces`: as for the engine, but for this call.
        - `journals`: whether rows are written to the journal, and read from it.
        """
        with in_precision(self.precision):
            u = np.asarray(rows)
            points = pad_rows(u, max(padded_to, power_of_two(len(u))))
            features, keys, seeds = self._prepare(points, key, np.int32(first))
            features = jax.tree.map(lambda leaf: np.asarray(leaf)[: len(u)], features)
            keep = self.keep_traces if keep_traces is None else keep_traces
            seeds, known = np.asarray(seeds)[: len(u)], u if journals else None
            return self._verdicts(features, keys[: len(u)], seeds, known, first, keep)

    def evaluate_features(
        self, features: PyTree, seeds: Integer[np.ndarray, " n"], keys: Key[Array, " n"] | None
    ) -> Verdicts:
        """Simulate `n` rows of features, each with its own seed, and decide their verdicts.

        **Arguments:**
        - `features`: the features, `[n, ...]` each.
        - `keys`: the keys of the seeds; needed by a system that simulates batches.
        """
        with in_precision(self.precision):
            return self._verdicts(features, keys, seeds, None, 0, self.keep_traces)

    def _verdicts(
        self, features: PyTree, keys: Key[Array, " n"] | None, seeds: Integer[np.ndarray, " n"],
        u: Float[np.ndarray, "n d"] | None, first: int, keep_traces: bool,
    ) -> Verdicts:  # fmt: skip
        behaviour = self.problem.behaviour
        width = None if behaviour is None else behaviour.size
        formulas = len(self.problem.formulas)
        rows = _Rows(len(seeds), formulas, self.precision, width, self.monitor.guidance.size)
        if keep_traces:
            rows.traces = [None for _ in seeds]
        if self.system.can_simulate_batch:
            assert keys is not None
            self._together(features, keys, rows)
        else:
            self._one_by_one(features, seeds, u, first, rows)
        violated = violations(rows.rho, rows.status, lambda: rows.holds)
        return Verdicts(
            rows.rho,
            rows.status,
            violated,
            features,
            messages=rows.messages,
            coverage_ids=rows.coverage_ids,
            guidance=rows.guidance if self.monitor.guidance.size else None,
            traces=rows.traces,
        )

    def _prepared(self, u: Array, key: Array, first: Array) -> tuple[PyTree, Array, Array]:
        keys = jax.vmap(lambda i: simulation_key(key, first + i))(jnp.arange(len(u)))
        u, space = u.astype(self.precision), self.problem.space
        if self.given:
            features = jax.vmap(space.unflatten_given)(u[:, : space.dim], u[:, space.dim :])
        else:
            features = jax.vmap(space.unflatten)(u)
        return features, keys, jax.vmap(jax.random.bits)(keys)

    def _together(self, features: PyTree, keys: Key[Array, " n"], rows: "_Rows") -> None:
        count = len(rows.messages)
        outcome = outcome_of(partial(self.system.simulate_batch, features, keys))
        if outcome.status != Status.OK:
            rows.messages[:] = [outcome.message] * count
            return
        try:
            trace = _checked(outcome.trace, count)
            self.remarks.add(trace.notes, count)
            if _is_plain(trace):
                rows.rho[:], rows.status[:], rows.holds[:], coverage_ids, rows.guidance[:] = (
                    self.monitor(trace, count, features)
                )
                if rows.coverage_ids is not None:
                    rows.coverage_ids[:] = coverage_ids
                for i in range(count if rows.traces is not None else 0):
                    each = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], trace)
                    rows.show(i, on_host_clock(each))
                return
        except Exception as error:
            rows.messages[:] = [format_user_error(error)] * count
            return
        # Row by row, so that one with a wrong code, or a clock of its own, costs no other.
        waiting = _Waiting(partial(self._block_verdicts, features), rows.put, rows.show)
        for i in range(count):
            row = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], trace)
            waiting.add(i, Outcome(row))
        waiting.settle_all()

    def _one_by_one(
        self, features: PyTree, seeds: Integer[np.ndarray, " n"],
        u: Float[np.ndarray, "n d"] | None, first: int, rows: "_Rows",
    ) -> None:  # fmt: skip
        journal = None if u is None else self.journal
        known = {} if journal is None or u is None else journal.recall(first, u)

        def keep(i: int, row: RowVerdict) -> None:
            rows.put(i, row)
            if journal is not None and u is not None:
                journal.add(first + i, u[i], row)

        for i, row in known.items():
            rows.put(i, row)
        todo = [i for i in range(len(seeds)) if i not in known]
        each = [plain_leaves(jax.tree.map(lambda leaf, i=i: leaf[i], features)) for i in todo]
        waiting = _Waiting(partial(self._block_verdicts, features), keep, rows.show)
        started = time.perf_counter()
        try:
            for index, outcome in self._outcomes(each, [int(seeds[i]) for i in todo]):
                self.simulation_seconds = time.perf_counter() - started
                if isinstance(outcome.trace, Trace):
                    if not self.remarks.simulations and self.problem.form() is None:
                        self.formula_notes = formula_notes(self.problem, outcome.trace)
                    self.remarks.add(outcome.trace.notes)
                else:
                    self.remarks.add({})
                waiting.add(todo[index], outcome)
        finally:
            # Also when interrupted: what has been simulated goes into the journal.
            waiting.settle_all()

    def _outcomes(self, features: list[Any], seeds: list[int]) -> Iterator[tuple[int, Outcome]]:
        if self.system.can_simulate_each:
            if features:
                yield from self.system.simulate_each(features, seeds)
            return
        for i, (each, seed) in enumerate(zip(features, seeds, strict=True)):
            yield i, outcome_of(partial(self.system, each, seed))

    def _block_verdicts(
        self, features: PyTree, rows: Sequence[int], traces: Sequence[Trace]
    ) -> list[RowVerdict]:
        filled = [*traces, *[traces[-1]] * (BLOCK - len(traces))]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *filled)
        index = np.array([*rows, *[rows[-1]] * (BLOCK - len(rows))])
        own = jax.tree.map(lambda leaf: np.asarray(leaf)[index], features)
        try:
            rho, status, holds, coverage_ids, guidance = self.monitor(stacked, BLOCK, own)
        except Exception as error:
            # The monitor refuses traces of this form: their signals, or their clock.
            return [_without_verdict(Status.ERROR, format_user_error(error))] * len(traces)
        each = range(len(traces))
        return [
            RowVerdict(rho[i], int(status[i]), holds[i], "", coverage_ids[i], guidance[i])
            for i in each
        ]


class _Waiting:
    """Traces that wait for others of their form, to be evaluated in one block."""

    def __init__(
        self, decide: Callable[[Sequence[int], Sequence[Trace]], list[RowVerdict]],
        keep: Callable[[int, RowVerdict], None], show: Callable[[int, Trace], None],
    ) -> None:  # fmt: skip
        self._decide, self.keep, self._show = decide, keep, show
        self._blocks: dict[Any, list[tuple[int, Trace, str]]] = {}
        self._since = time.monotonic()

    def add(self, row: int, outcome: Outcome) -> None:
        trace, without = _trace(outcome)
        if trace is None:
            self.keep(row, without)
            return
        self._show(row, trace)
        form = _form(trace)
        self._blocks.setdefault(form, []).append((row, trace, outcome.message))
        if len(self._blocks[form]) == BLOCK:
            self._settle(form)
        if time.monotonic() - self._since > PATIENCE:
            self.settle_all()
            self._since = time.monotonic()

    def settle_all(self) -> None:
        for form in list(self._blocks):
            self._settle(form)

    def _settle(self, form: Any) -> None:
        block = self._blocks.pop(form)
        verdicts = self._decide([row for row, _, _ in block], [trace for _, trace, _ in block])
        for (row, _, message), verdict in zip(block, verdicts, strict=True):
            self.keep(row, verdict._replace(message=verdict.message or storable(message)))


class _Rows:
    """The rows of a batch while they are filled, in any order."""

    def __init__(
        self, count: int, formulas: int, precision: str, coverage_ids: int | None, guidance: int
    ) -> None:
        self.guidance = np.full((count, guidance), np.nan, np.float32)
        self.rho = np.full((count, formulas), np.nan, precision)
        self.status = np.full(count, Status.ERROR, np.int32)
        self.holds = np.ones((count, formulas), bool)
        self.messages = [""] * count
        self.coverage_ids = (
            None if coverage_ids is None else np.full((count, coverage_ids), -1, np.int32)
        )
        self.traces: list[Trace | None] | None = None  # Where they are to be kept.

    def show(self, i: int, trace: Trace) -> None:
        if self.traces is not None:
            self.traces[i] = trace

    def put(self, i: int, row: RowVerdict) -> None:
        self.rho[i], self.status[i], self.holds[i], self.messages[i], coverage_ids, guidance = row
        if guidance is not None and len(guidance):
            self.guidance[i] = guidance
        if self.coverage_ids is not None and coverage_ids is not None and len(coverage_ids):
            self.coverage_ids[i] = coverage_ids


def _without_verdict(status: Status, message: str) -> RowVerdict:
    return RowVerdict(np.array(np.nan), int(status), np.array(True), message)


def _trace(outcome: Outcome) -> tuple[Trace | None, RowVerdict]:
    """Return the trace to evaluate; or None, and the content of its row instead."""
    trace, status, message = outcome
    if not isinstance(trace, Trace) and (trace is not None or status == Status.OK):
        given = type(trace).__name__
        message = f"TypeError: the system must return a Trace; it returned {given}"
        trace, status = None, Status.ERROR
    message = storable(message)
    try:
        return None if trace is None else pad_trace(trace), _without_verdict(status, message)
    except Exception as error:
        return None, _without_verdict(Status.ERROR, format_user_error(error))


def _checked(trace: object, count: int) -> Trace:
    if not isinstance(trace, Trace):
        raise TypeError(f"the system must return a Trace; it returned {type(trace).__name__}")
    for name, signal in trace.signals.items():
        if len(np.shape(signal)) < 2 or np.shape(signal)[0] != count:
            raise ValueError(
                f"a batch of {count} simulations must give signals [{count}, time]; {name!r} has "
                f"shape {list(np.shape(signal))}"
            )
    return trace


def _is_plain(trace: Trace) -> bool:
    """Return whether all rows of a batch have one period, and codes that can be."""
    if trace.times is not None:
        return False
    length = np.shape(next(iter(trace.signals.values())))[1]
    valid = np.asarray(length if trace.valid is None else trace.valid)
    status = np.asarray(Status.OK if trace.status is None else trace.status)
    return bool(np.all((valid >= 1) & (valid <= length)) and np.all(np.isin(status, list(Status))))


def _form(trace: Trace) -> Any:
    shapes = tuple((np.shape(leaf), np.result_type(leaf).str) for leaf in jax.tree.leaves(trace))
    return jax.tree.structure(trace), shapes


def on_host_clock(trace: Trace) -> Trace:
    """Return a host system's trace, checked and in the form that compiled monitors need.

    Its integers are not truncated to 32 bits, and evenly spaced sample times become a period.

    **Raises:** the errors of `Trace` for an invalid `valid` or status, and of `period` for unevenly
    spaced sample times.
    """
    # Made anew, a row of a batch is checked as a trace of its own.
    signals = {name: without_wrapping(signal) for name, signal in trace.signals.items()}
    return replace(trace, signals=signals, dt=period(trace), times=None)


def pad_trace(trace: Trace) -> Trace:
    """Extend a trace to a length that is a power of two.

    Repeating the last sample changes no verdict, and traces of all lengths then share a few
    compiled monitors.

    **Raises:** the errors of `on_host_clock`.
    """
    trace = on_host_clock(trace)
    valid = trace.length if trace.valid is None else int(trace.valid)
    length = power_of_two(trace.length)
    index = np.minimum(np.arange(length), valid - 1)
    signals = {name: np.asarray(signal)[index] for name, signal in trace.signals.items()}
    status = int(Status.OK if trace.status is None else trace.status)
    between = trace.between_until(valid)
    if between is not None:
        between = _longer(between, length * (between.length // trace.length))
    return Trace(signals, trace.dt, valid=valid, status=status, held=True, between=between)


def _longer(between: Trace, length: int) -> Trace:
    """Return what lies between samples, its last repeated to a length."""
    index = np.minimum(np.arange(length), between.length - 1)
    signals = {name: np.asarray(signal)[index] for name, signal in between.signals.items()}
    return Trace(signals, times=np.asarray(between.times)[index])
