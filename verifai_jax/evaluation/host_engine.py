"""Evaluation of what JAX cannot see into: the same batches as the engine's, simulated on the host.

A simulation that raises, hangs or takes its process with it becomes a row with a status and a
message; the others go on. Traces are judged in blocks of one shape, so that few monitors compile.
"""

import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.core.keys import simulation_key
from verifai_jax.core.precision import in_precision
from verifai_jax.core.trace import Status, Trace
from verifai_jax.evaluation.engine import Evaluation, judge, verdict
from verifai_jax.evaluation.journal import Journal, Judged
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import Outcome
from verifai_jax.systems.blackbox._blackbox import plain_leaves

BLOCK = 32  # Traces judged together,
PATIENCE = 0.5  # or as many as there are after so many seconds, so that they are safe on disk.


class HostEngine:
    """Evaluates batches of a black-box problem; the counterpart of `engine.Engine`.

    - `journal`: where rows are kept as soon as they are judged, until their batch is.
    """

    def __init__(
        self, problem: Problem, precision: str = "float32", journal: Journal | None = None
    ) -> None:
        self.problem, self.precision, self.journal = problem, precision, journal
        self.compile_seconds = 0.0
        self.notes: tuple[str, ...] = ()
        self._prepare = jax.jit(self._prepared)
        self._judge = jax.jit(jax.vmap(lambda trace: judge(problem, trace)))
        self._verdict = jax.jit(jax.vmap(lambda trace: verdict(problem, trace)))

    def compile(self) -> None:
        """Nothing to do: monitors compile when the first trace shows its length."""

    def evaluate(
        self,
        u: Float[Array, "n d"],
        key: Key[Array, ""],
        first: int,
        temperature: Float[Array, ""] | float = 1.0,
    ) -> Evaluation:
        """Simulate and judge `n` points of the unit cube; see `engine.Engine`."""
        with in_precision(self.precision):
            return self._evaluate(np.asarray(u), key, first)

    def _evaluate(self, u: np.ndarray, key: Key[Array, ""], first: int) -> Evaluation:
        n = len(u)
        features, keys, seeds = self._prepare(_power_of_two(u), key, np.int32(first))
        features = jax.tree.map(lambda leaf: np.asarray(leaf)[:n], features)
        rows = _Rows(n, len(self.problem.formulas), self.precision)
        if self.problem.system.can_simulate_batch:
            self._together(features, keys[:n], rows)
        else:
            self._one_by_one(features, np.asarray(seeds)[:n], u, first, rows)
        return Evaluation(rows.rho, rows.status, features, None, rows.messages, rows.holds)

    def _prepared(self, u: Array, key: Array, first: Array) -> Any:
        keys = jax.vmap(lambda i: simulation_key(key, first + i))(jnp.arange(len(u)))
        u = u.astype(self.precision)
        return jax.vmap(self.problem.space.unflatten)(u), keys, jax.vmap(jax.random.bits)(keys)

    def _together(self, features: Any, keys: Key[Array, " n"], rows: "_Rows") -> None:
        system, n = self.problem.system, len(rows.messages)
        try:
            trace = _checked(system.simulate_batch(features, keys), n)
            rows.rho[:], rows.status[:], rows.holds[:] = self._judged(trace, n)
        except Exception as error:
            rows.messages[:] = [_told(error)] * n

    def _one_by_one(
        self, features: Any, seeds: np.ndarray, u: np.ndarray, first: int, rows: "_Rows"
    ) -> None:
        def keep(i: int, row: Judged) -> None:
            rows.put(i, row)
            if self.journal is not None:
                self.journal.add(first + i, u[i], row)

        known = {} if self.journal is None else self.journal.recall(first, u)
        for i, judged in known.items():
            rows.put(i, judged)
        todo = [i for i in range(len(u)) if i not in known]
        each = [plain_leaves(jax.tree.map(lambda leaf, i=i: leaf[i], features)) for i in todo]
        waiting: dict[Any, list[tuple[int, Trace]]] = {}

        def settle(form: Any) -> None:
            block = waiting.pop(form)
            judged = self._judged_block([trace for _, trace in block])
            for (i, _), row in zip(block, judged, strict=False):
                keep(i, row)

        since = time.monotonic()
        for place, outcome in self._outcomes(each, [int(seeds[i]) for i in todo]):
            i = todo[place]
            trace, problem = _trace(outcome)
            if trace is None:
                keep(i, problem)
                continue
            form = _form(trace)
            waiting.setdefault(form, []).append((i, trace))
            if len(waiting[form]) == BLOCK:
                settle(form)
            if time.monotonic() - since > PATIENCE:
                for form in list(waiting):
                    settle(form)
                since = time.monotonic()
        for form in list(waiting):
            settle(form)

    def _outcomes(self, features: list[Any], seeds: list[int]) -> Iterator[tuple[int, Outcome]]:
        system = self.problem.system
        if system.can_simulate_each:
            if features:
                yield from system.simulate_each(features, seeds)
            return
        for i, (each, seed) in enumerate(zip(features, seeds, strict=True)):
            try:
                yield i, Outcome(system(each, seed))
            except Exception as error:
                yield i, Outcome(None, Status.ERROR, _told(error))

    def _judged_block(self, traces: list[Trace]) -> list[Judged]:
        filled = traces + [traces[-1]] * (BLOCK - len(traces))
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *filled)
        try:
            rho, status, holds = self._judged(stacked, BLOCK)
        except Exception as error:
            # The monitor refuses traces of this form: their signals, or their clock.
            return [_without_verdict(Status.ERROR, _told(error))] * len(traces)
        return [Judged(rho[i], int(status[i]), holds[i], "") for i in range(len(traces))]

    def _judged(self, traces: Trace, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Robustness, status and Boolean verdicts of a batch of traces, one shape for many `n`."""
        padded = jax.tree.map(_power_of_two, traces)
        rho, status = (np.asarray(leaf)[:n] for leaf in self._judge(padded))
        holds = np.ones(rho.shape, bool)
        if np.any(rho == 0):
            # Now, while the traces are here: simulating again may be dear.
            holds = np.asarray(self._verdict(padded))[:n]
        return rho, status, holds


class _Rows:
    """The rows of a batch while they are filled, in any order."""

    def __init__(self, n: int, formulas: int, precision: str) -> None:
        self.rho = np.full((n, formulas), np.nan, precision)
        self.status = np.full(n, Status.ERROR, np.int32)
        self.holds = np.ones((n, formulas), bool)
        self.messages = [""] * n

    def put(self, i: int, row: Judged) -> None:
        self.rho[i], self.status[i], self.holds[i], self.messages[i] = row


def _without_verdict(status: Status, message: str) -> Judged:
    return Judged(np.array(np.nan), int(status), np.array(True), message)


def _trace(outcome: Outcome) -> tuple[Trace | None, Judged]:
    """The trace to judge; or none, and what its row says instead."""
    trace, status, message = outcome
    if not isinstance(trace, Trace) and (trace is not None or status == Status.OK):
        given = type(trace).__name__
        message = f"TypeError: the system must return a Trace; it returned {given}"
        trace, status = None, Status.ERROR
    try:
        return None if trace is None else pad_trace(trace), _without_verdict(status, message)
    except Exception as error:
        return None, _without_verdict(Status.ERROR, _told(error))


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _checked(trace: Any, n: int) -> Trace:
    if not isinstance(trace, Trace):
        raise TypeError(f"the system must return a Trace; it returned {type(trace).__name__}")
    for name, signal in trace.signals.items():
        if np.ndim(signal) < 2 or np.shape(signal)[0] != n:
            raise ValueError(
                f"a batch of {n} simulations must give signals [{n}, time]; {name!r} has shape "
                f"{list(np.shape(signal))}"
            )
    return trace


def _form(trace: Trace) -> Any:
    shapes = tuple((np.shape(leaf), np.result_type(leaf).str) for leaf in jax.tree.leaves(trace))
    return jax.tree.structure(trace), shapes


def _power_of_two(leaf: Any) -> np.ndarray:
    """The rows, the last one repeated until their number is a power of two."""
    leaf = np.asarray(leaf)
    missing = (1 << (len(leaf) - 1).bit_length()) - len(leaf)
    return np.concatenate([leaf, np.repeat(leaf[-1:], missing, axis=0)]) if missing else leaf


def pad_trace(trace: Trace) -> Trace:
    """The same trace, held to a length that is a power of two.

    Holding the last sample changes no verdict, and traces of all lengths share a few compiled
    monitors.
    """
    valid = trace.length if trace.valid is None else int(trace.valid)
    length = 1 << (trace.length - 1).bit_length()
    index = np.minimum(np.arange(length), valid - 1)
    signals = {name: np.asarray(signal)[index] for name, signal in trace.signals.items()}
    times = trace.times
    if times is not None:
        times, extra = np.asarray(times), length - trace.length
        step = times[-1] - times[-2] if len(times) > 1 else 1.0
        times = np.concatenate([times, times[-1] + step * np.arange(1, extra + 1)])
    status = int(Status.OK if trace.status is None else trace.status)
    return Trace(signals, trace.dt, times, valid, status, held=True)
