"""Bounds of the robustness over boxes of a problem's feature space.

    enclosure = Enclosure(problem, "float32")
    least, greatest, accepted = enclosure(low, high)      # of boxes [n, dim] in unit coordinates

The program is that of simulations: system, monitor, status and constraint, traced by JAX and
evaluated with sets. The bounds hold for each simulation with features between those of the box's
corners, in real arithmetic and in the precision of the simulation.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from verifai_jax.addons.verification.ranges import FeatureRanges
from verifai_jax.addons.verification.sets import Form, Interpreter, Whole
from verifai_jax.addons.verification.sets.values import Value, as_form, as_whole
from verifai_jax.core.compute.cores import available_cores
from verifai_jax.core.compute.fingerprint import without_unused
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.verdicts import boolean_semantics, trace_verdict
from verifai_jax.problem.problem import Problem, ProblemError

TOGETHER = 512
"""Boxes that are evaluated at once: the arrays of a step then fit the cache."""
Corners = Float[np.ndarray, "n dim"]


class Bounds(NamedTuple):
    """Bounds over boxes.

    - `low`, `high`: bounds of the least robustness over the formulas; infinite if unknown.
    - `holds`: whether no point of the box breaks a formula.
    - `inside`, `outside`: whether the constraint accepts all points, or none.
    - `moves`: the total change of the formulas' signals along each coordinate.
    """

    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    holds: Bool[np.ndarray, " n"]
    inside: Bool[np.ndarray, " n"]
    outside: Bool[np.ndarray, " n"]
    moves: Float[np.ndarray, "n dim"]


class Enclosure:
    """The program of one simulation of a checked problem, evaluated with sets of features."""

    def __init__(self, problem: Problem, precision: str) -> None:
        self.problem, self.precision = problem, precision
        space = problem.space
        self.dim = space.dim
        with in_precision(precision):
            form = space.feature_form_in(precision)
            key = jax.random.key(0)
            where = space.where

            def verdict(features: PyTree) -> tuple[Array, Array, list[Array]]:
                accepted = jnp.array(True) if where is None else jnp.asarray(where(features))
                trace = problem.system(features, key)
                signals = [jnp.asarray(trace.signals[name]) for name in problem.monitored]
                return trace_verdict(problem, trace)[0], accepted, signals

            def truth(features: PyTree) -> Array:
                return boolean_semantics(problem, problem.system(features, key))

            self._verdict = _program(verdict, form)
            self._truth = _program(truth, form)
            # Name by name in the order of the leaves: which coordinates, and the program of domains
            # whose numbers are no monotone functions of one coordinate each.
            self._fields, start = {}, 0
            for name, domain in space.root.fields:
                unit = jax.ShapeDtypeStruct((domain.size,), precision)
                part = None if domain.monotone else _program(domain.from_unit, unit)
                self._fields[name] = slice(start, start + domain.size), part
                start += domain.size
            self._forms = {name: jax.tree.leaves(form[name]) for name in sorted(form)}
        self.ranges = FeatureRanges(space, precision)

    def __call__(self, low: Corners, high: Corners) -> Bounds:
        """Return bounds over boxes `[n, dim]` between these points, or raise `MissingRule`."""
        blocks = [slice(i, i + TOGETHER) for i in range(0, len(low), TOGETHER)]

        def bounds(block: slice) -> Bounds:
            return self._bounds(self._leaves(low[block], high[block]), len(low[block]))

        if len(blocks) == 1 or available_cores() == 1:
            parts = [bounds(block) for block in blocks]
        else:
            with ThreadPoolExecutor(available_cores()) as pool:
                parts = list(pool.map(bounds, blocks))
        return Bounds(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def _bounds(self, leaves: Sequence[Value], count: int) -> Bounds:
        with np.errstate(all="ignore"):
            rho, accepted, *signals = self._evaluated(self._verdict, leaves, count)
            ends = as_form(rho).bounds()
            low, high = (np.broadcast_to(end, (count, end.shape[1])) for end in ends)
            truth = np.broadcast_to(as_whole(accepted).low, (count,)) > 0
            outside = np.broadcast_to(as_whole(accepted).high, (count,)) <= 0
            lowest = low.min(1)
            holds = lowest > 0
            if np.any(open_ones := lowest == 0):
                # At exactly zero the comparison decides, as it does for a simulation.
                (kept,) = self._evaluated(self._truth, leaves, count)
                true = np.broadcast_to(as_whole(kept).low, (count, low.shape[1])) > 0
                holds = holds | (open_ones & np.all((low > 0) | true, axis=1))
            moves = np.zeros((count, self.dim))
            for form in signals:
                if isinstance(form, Form) and form.slopes is not None:
                    slopes = np.abs(form.slopes[: self.dim])
                    slopes = slopes.reshape(*slopes.shape[:2], -1).max(2)
                    moves += slopes.T / max(np.median(slopes.max(0)), 1e-300)
        return Bounds(lowest, high.min(1), holds, truth, outside, moves)

    def _evaluated(self, program: Any, leaves: Sequence[Value], count: int) -> list[Value]:
        with in_precision(self.precision):
            return Interpreter(count, self.dim)(program, leaves)

    def _leaves(self, low: Corners, high: Corners) -> list[Value]:
        """Return the features of boxes as sets, in the order of the leaves of their tree."""
        first, last = self.ranges.ends(low, high)
        between = self.ranges(low, high)
        sets: list[Value] = []
        for name, forms in self._forms.items():
            span, part = self._fields[name]
            if part is not None:
                symbols = np.eye(self.dim)[:, span]
                unit = Form.leaf(first[:, span], last[:, span], symbols, np.dtype(self.precision))
                sets += self._evaluated(part, [unit], len(low))
                continue
            for form in forms:
                begin, end, symbols = between[len(sets)]
                kind = np.dtype(form.dtype)
                if jnp.issubdtype(kind, jnp.floating):
                    sets.append(Form.leaf(begin, end, symbols, kind))
                else:
                    sets.append(Whole(begin.astype(np.int64), end.astype(np.int64), kind))
        return sets


def enclosable(problem: Problem, precision: str) -> Problem:
    """Return a problem on the backend that can be evaluated with sets.

    **Raises:** `ProblemError` for a black box, and for a system that draws random numbers; the
    errors of `Problem.check` and, for a constraint, of `FeatureSpace.check_where`.
    """
    problem = resolved(problem, batch=512, budget=512, precision=precision).problem
    problem.check()
    problem.space.check_where()
    if problem.black_box:
        raise ProblemError(
            f"problem {problem.name!r} has a system that JAX does not trace, but verify evaluates "
            "the traced program with sets; vj.estimate bounds the probability of its failures"
        )
    if problem.draws():
        raise ProblemError(
            f"the system of problem {problem.name!r} draws random numbers, but verify needs a "
            "system that depends only on its features; make these numbers features"
        )
    return problem


def _program(function: Any, form: PyTree) -> Any:
    """Return the traced program of a function, without what no result depends on."""
    closed = jax.make_jaxpr(function)(form)
    used = without_unused(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    return closed.replace(jaxpr=used)
