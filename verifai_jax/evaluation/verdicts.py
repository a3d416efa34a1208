"""The result of every simulation, and the rule that decides which violate the property.

    verdicts = engine.evaluate(u, key, first=0)
    verdicts.rho, verdicts.status                       # [n, formulas], [n]
    verdicts.violated, verdicts.lowest                 # [n], [n]

A simulation violates the property if it ended properly and breaks a formula: with a negative
robustness, or with one of exactly zero where the Boolean semantics say so (`x >= 0` holds at zero,
`x > 0` does not). This file is the only one that decides it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.mtl import hard, robustness, satisfied
from verifai_jax.mtl.semantics import Semantics
from verifai_jax.problem.problem import Problem


class Verdicts(NamedTuple):
    """Verdicts of `n` simulations, on the host, one row each.

    - `rho`: `[n, formulas]`, hard robustness; NaN unless the status is OK.
    - `status`: `[n]`, codes of `Status`.
    - `violated`: `[n]`, whether the simulation ended properly and breaks a formula.
    - `features`: the simulated values, `[n, ...]` each; None if the caller has them already.
    - `gradient`: `[n, d]`, gradient of the least smooth robustness by the coordinates, or None.
    - `clauses`: `[n, clauses]`, scaled values of the clauses of the goal that is nearest to being
      broken (`mtl.clauses`); None unless wanted.
    - `clause_gradients`: `[n, clauses, d]`, gradients of the clauses by the coordinates, or None.
    - `messages`: the error of each row of a host system, empty if there was none; None for systems
      that JAX traces.
    - `coverage_ids`: the ids of the items that each trace covers (`problem.behaviour`), -1 for
      none; None without a `behaviour`.
    - `guidance`: additional results for a search (`evaluation.guidance`); None unless wanted.
    - `traces`: the traces, None for a row without one; None unless they are kept.
    """

    rho: Float[np.ndarray, "n formulas"]
    status: Int[np.ndarray, " n"]
    violated: Bool[np.ndarray, " n"]
    features: dict[str, PyTree] | None = None
    gradient: Float[np.ndarray, "n d"] | None = None
    clauses: Float[np.ndarray, "n clauses"] | None = None
    clause_gradients: Float[np.ndarray, "n clauses d"] | None = None
    messages: list[str] | None = None
    coverage_ids: Int[np.ndarray, "n ids"] | None = None
    guidance: Float[np.ndarray, "n guidance"] | None = None
    traces: list[Trace | None] | None = None

    @property
    def proper(self) -> Bool[np.ndarray, " n"]:
        """Rows whose simulation ended properly and therefore has a verdict."""
        return self.status == Status.OK

    @property
    def lowest(self) -> Float[np.ndarray, " n"]:
        """The least robustness over the formulas; NaN without a verdict."""
        return np.min(self.rho, axis=1)

    @classmethod
    def nothing(cls, formulas: int, dim: int) -> "Verdicts":
        """Return verdicts without rows."""
        rho, no = np.zeros((0, formulas), np.float32), np.zeros(0, bool)
        gradient = np.zeros((0, dim), np.float32)
        return cls(rho, np.zeros(0, np.int32), no, gradient=gradient, messages=[])

    @classmethod
    def concatenate(cls, parts: "Sequence[Verdicts]") -> "Verdicts":
        """Join the rows of several batches that were evaluated alike."""
        if len(parts) == 1:
            return parts[0]
        rows = [part._replace(messages=None, traces=None) for part in parts]
        whole: Verdicts = jax.tree.map(lambda *leaves: np.concatenate(leaves), *rows)
        if any(part.traces is not None for part in parts):
            traces = [t for part in parts for t in part.traces or [None] * len(part.status)]
            whole = whole._replace(traces=traces)
        if all(part.messages is None for part in parts):
            return whole
        messages = [m for part in parts for m in part.messages or [""] * len(part.status)]
        return whole._replace(messages=messages)

    def split(self, parts: int) -> "list[Verdicts]":
        """Split the rows into this many parts of equal length; the inverse of `concatenate`."""
        count = len(self.status) // parts
        return [self.rows(slice(i * count, (i + 1) * count)) for i in range(parts)]

    def rows(self, chosen: slice | Int[np.ndarray, " k"]) -> "Verdicts":
        """Return some of the rows, by their indices."""
        arrays = self._replace(messages=None, traces=None)
        some: Verdicts = jax.tree.map(lambda leaf: leaf[chosen], arrays)
        if self.messages is None and self.traces is None:
            return some
        numbers = np.arange(len(self.status))[chosen].tolist()
        lists = [each and [each[i] for i in numbers] for each in (self.messages, self.traces)]
        return some._replace(messages=lists[0], traces=lists[1])


class RowVerdict(NamedTuple):
    """The verdict of one simulation of a host system, before its batch is complete.

    - `rho`: `[formulas]`, or one number for all; NaN without a verdict.
    - `status`: a code of `Status`.
    - `holds`: `[formulas]`, or one truth value for all: the Boolean semantics.
    - `message`: the error of the system; empty if there was none.
    - `coverage_ids`: the ids that its trace covers, `[ids]`; None without a trace, or without a
      `problem.behaviour`.
    - `guidance`: additional results for a search, `[guidance]`; None unless there is a trace, and
      they are wanted.
    """

    rho: Float[np.ndarray, " formulas"] | Float[np.ndarray, ""]
    status: int
    holds: Bool[np.ndarray, " formulas"] | Bool[np.ndarray, ""]
    message: str
    coverage_ids: Int[np.ndarray, " ids"] | None = None
    guidance: Float[np.ndarray, " guidance"] | None = None


def violations(
    rho: Float[np.ndarray, "n formulas"], status: Int[np.ndarray, " n"],
    holds: Callable[[], Bool[np.ndarray, "n formulas"]],
) -> Bool[np.ndarray, " n"]:  # fmt: skip
    """Decide which simulations violate the property.

    **Arguments:**
    - `rho`: hard robustness; NaN without a verdict.
    - `status`: codes of `Status`.
    - `holds`: a function that returns the Boolean semantics of each formula; called only if some
      robustness is exactly zero, because it may have to simulate again.
    **Returns:** whether each simulation ended properly and breaks a formula.
    """
    proper = status == Status.OK
    # A formula without a verdict leaves it to the others.
    lowest = rho[:, 0] if rho.shape[1] == 1 else np.fmin.reduce(rho, axis=1)
    broken = proper & (lowest < 0)
    undecided = proper & (lowest == 0)
    if undecided.any():
        broken |= undecided & ~np.all(holds(), axis=1)
    return broken


def trace_verdict(
    problem: Problem, trace: Trace, semantics: Semantics = hard
) -> tuple[Float[Array, " formulas"], Int[Array, ""]]:
    """Return the robustness of each formula on one trace, and the status; traced by JAX.

    A simulation whose monitored signals are not finite has status `NONFINITE` and robustness NaN.
    If its `valid` is not a possible number of samples, or its status is not a code, it has status
    `ERROR`.
    """
    counted = _counted(trace)
    trace = trace.hold()
    rho = jnp.stack(
        [
            robustness(formula, trace, semantics, problem.end)
            for formula in problem.formulas.values()
        ]
    )
    finite, every = jnp.array(True), trace.finely()
    for name in problem.monitored:
        signal = jnp.asarray(every.signals[name])
        if name not in trace.finite and jnp.issubdtype(signal.dtype, jnp.inexact):
            finite &= jnp.all(jnp.isfinite(signal))
    status = jnp.asarray(Status.OK if trace.status is None else trace.status, jnp.int32)
    if counted is not None:
        status = jnp.where((status == Status.OK) & ~counted, jnp.int32(Status.ERROR), status)
    return with_status(rho, status, finite)


def trace_coverage_ids(problem: Problem, trace: Trace) -> Int[Array, " ids"]:
    """Return the coverage ids of a trace, for a problem with a `behaviour`; traced by JAX."""
    if problem.behaviour is None:
        return jnp.zeros(0, jnp.int32)
    return problem.behaviour(trace, problem.end)


def _counted(trace: Trace) -> Bool[Array, ""] | None:
    """Return whether `valid` is a number of the trace's samples; None if it is left out."""
    if trace.valid is None:
        return None
    valid = jnp.asarray(trace.valid)
    return (valid >= 1) & (valid <= trace.length)


def boolean_semantics(problem: Problem, trace: Trace) -> Bool[Array, " formulas"]:
    """Return whether each formula holds on one trace; traced by JAX."""
    trace = trace.hold()
    formulas = problem.formulas.values()
    return jnp.stack([satisfied(formula, trace, end=problem.end) for formula in formulas])


def with_status(
    rho: Float[Array, " formulas"], status: Int[Array, ""], finite: Bool[Array, ""]
) -> tuple[Float[Array, " formulas"], Int[Array, ""]]:
    """Return robustness and status, given whether all signals are finite; NaN unless OK.

    A status that is not a code of `Status` becomes an error.
    """
    known = (status >= min(Status)) & (status <= max(Status))
    status = jnp.where(known, status, jnp.int32(Status.ERROR))
    status = jnp.where((status == Status.OK) & ~finite, jnp.int32(Status.NONFINITE), status)
    return jnp.where(status == Status.OK, rho, jnp.nan), status
