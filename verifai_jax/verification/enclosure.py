"""Bounds of the robustness over boxes of a problem's feature space.

    enclosure = Enclosure(problem, "float32")
    least, greatest, accepted = enclosure(low, high)      # of boxes [n, dim] in unit coordinates

The program is the one that simulations run: system, monitor, status and constraint, traced by JAX
and evaluated with sets. What it says holds for each simulation whose features lie between those of
the box's corners, in real arithmetic and in the precision of the simulation.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from verifai_jax.core.cores import available_cores
from verifai_jax.core.fingerprint import without_unused
from verifai_jax.core.precision import in_precision
from verifai_jax.evaluation.verdicts import boolean_semantics, trace_verdict
from verifai_jax.problem.problem import Problem
from verifai_jax.sets import Form, Interpreter, Whole
from verifai_jax.sets.interpreter import Value, as_form, as_whole, constant
from verifai_jax.systems.ode import sin_cos

TOGETHER = 512
"""Boxes that are evaluated at once: the arrays of a step then fit the cache."""
ROUNDINGS = 8
"""Roundings by which the map from coordinates to a feature may fail to rise."""

Corners = Float[np.ndarray, "n dim"]


class Bounds(NamedTuple):
    """Bounds over boxes.

    - `low`, `high`: of the least robustness over the formulas; infinite where nothing is known.
    - `holds`: whether no point of the box breaks a formula.
    - `inside`, `outside`: whether the constraint accepts all points, or none.
    - `moves`: how far each coordinate moves the signals of the formulas, added up.
    """

    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    holds: Bool[np.ndarray, " n"]
    inside: Bool[np.ndarray, " n"]
    outside: Bool[np.ndarray, " n"]
    moves: Float[np.ndarray, "n dim"]


class Enclosure:
    """The program of one simulation of a problem, for sets of features.

    **Arguments:**

    - `problem`: a checked one.
    - `precision`: of simulations, `"float32"` or `"float64"`.
    """

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
            self._known = _known_functions(precision)
            self._values = jax.jit(jax.vmap(space.unflatten))
            # Name by name in the order of the leaves: which coordinates, and the program of domains
            # whose numbers are no monotone functions of one coordinate each.
            self._fields, start = {}, 0
            for name, domain in space.root.fields:
                unit = jax.ShapeDtypeStruct((domain.size,), precision)
                part = None if domain.monotone else _program(domain.from_unit, unit)
                self._fields[name] = slice(start, start + domain.size), part
                start += domain.size
            self._forms = {name: jax.tree.leaves(form[name]) for name in sorted(form)}
        self._edges = [
            None if not count else np.cumsum([0.0, *(weights or (1 / count,) * count)])
            for count, weights in zip(space.levels, space.weights, strict=True)
        ]
        self._symbols, self._scale, self._exact = self._dependence()

    # Boxes and their cells

    def edges(self, coordinate: int) -> Float[np.ndarray, " cells"] | None:
        """Return where the cells of a coordinate begin and end; None if it is continuous."""
        return self._edges[coordinate]

    def ends(self, low: Corners, high: Corners) -> tuple[Corners, Corners]:
        """Return the points of the cube that have the least and the greatest features of boxes."""
        low, high = low.copy(), high.copy()
        for j, edges in enumerate(self._edges):
            if edges is not None:
                first = np.searchsorted(edges[:-1], low[:, j], side="right") - 1
                last = np.searchsorted(edges[1:], high[:, j], side="left")
                last = np.clip(last, first, len(edges) - 2)
                middles = (edges[1:] + edges[:-1]) / 2
                low[:, j], high[:, j] = middles[first], middles[last]
        return low, high

    def _features(self, points: Corners) -> list[np.ndarray]:
        with in_precision(self.precision):
            dtype = np.dtype(self.precision)
            count = max(TOGETHER, -(-len(points) // TOGETHER) * TOGETHER)
            padded = np.resize(points.astype(dtype), (count, self.dim))
            leaves = jax.tree.leaves(self._values(padded))
        return [np.asarray(leaf)[: len(points)].astype(np.float64) for leaf in leaves]

    def _dependence(self) -> tuple[list[np.ndarray], list[np.ndarray], list[bool]]:
        """Return for each leaf on which coordinate its numbers depend, their size, and more.

        The last is whether the map of its domain to its ends is exact.
        """
        levels = [np.full((1, self.dim), level) for level in (0.0, 0.25, 0.75)]
        probes = np.concatenate([levels[0], np.eye(self.dim), *levels[1:]])
        leaves = self._features(self.ends(probes, probes)[0] if self.dim else probes)
        symbols = [(leaf[1:-2] != leaf[0]).astype(float) for leaf in leaves]
        scale = [np.maximum(np.abs(leaf[-2]), np.abs(leaf[-1])) for leaf in leaves]
        exact = [
            self.problem.space.domains[name].uniform
            for name, forms in self._forms.items() for _ in forms
        ]  # fmt: skip
        return symbols, scale, exact

    def shares(self, points: Corners) -> Corners:
        """Return where the features of points lie between their least and greatest, from 0 to 1."""
        shares = points.astype(float).copy()
        leaves = self._features(points)
        ends = self._features(np.array([[0.0] * self.dim, [1.0] * self.dim]))
        for leaf, end, symbols, exact in zip(leaves, ends, self._symbols, self._exact, strict=True):
            if exact or not np.issubdtype(leaf.dtype, np.floating):
                continue
            flat = symbols.reshape(self.dim, -1)
            for j in np.flatnonzero(flat.any(1)):
                if self._edges[j] is None:
                    at = int(np.argmax(flat[j]))
                    value, (low, high) = (
                        leaf.reshape(len(leaf), -1)[:, at],
                        end.reshape(2, -1)[:, at],
                    )
                    shares[:, j] = (value - low) / (high - low)
        return shares

    # Sets

    def __call__(self, low: Corners, high: Corners) -> Bounds:
        """Return bounds over boxes `[n, dim]` between these points of the unit cube.

        **Raises:** `MissingRule` for an operation of the system that sets cannot go through.
        """
        blocks = [slice(i, i + TOGETHER) for i in range(0, len(low), TOGETHER)]
        leaves = self._leaves(low, high)

        def bounds(block: slice) -> Bounds:
            return self._bounds([_rows(leaf, block) for leaf in leaves], len(low[block]))

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
            least = low.min(1)
            holds = least > 0
            if np.any(open_ones := least == 0):
                # At exactly zero the comparison decides, as it does for a simulation.
                (kept,) = self._evaluated(self._truth, leaves, count)
                true = np.broadcast_to(as_whole(kept).low, (count, low.shape[1])) > 0
                holds = holds | (open_ones & np.all((low > 0) | true, axis=1))
            moves = np.zeros((count, self.dim))
            for form in signals:
                if isinstance(form, Form) and form.slopes is not None:
                    slopes = np.abs(form.slopes[: self.dim]).reshape(self.dim, -1, form.slopes[0, 0].size)
                    moves += slopes.max(2).T / max(np.median(slopes.max((0, 2))), 1e-300)
        return Bounds(least, high.min(1), holds, truth, outside, moves)

    def _evaluated(self, program: Any, leaves: Sequence[Value], count: int) -> list[Value]:
        interpreter = Interpreter(count, self.dim, self._known)
        with in_precision(self.precision):
            return interpreter(program, leaves)

    def _leaves(self, low: Corners, high: Corners) -> list[Value]:
        """Return the features of boxes as sets, in the order of the leaves of their tree."""
        first, last = self.ends(low, high)
        begins, ends = self._features(first), self._features(last)
        sets: list[Value] = []
        for name, forms in self._forms.items():
            span, part = self._fields[name]
            if part is None:
                count = len(sets)
                sets += [
                    self._leaf(count + i, each.dtype, begins, ends, low, high)
                    for i, each in enumerate(forms)
                ]
                continue
            symbols = np.eye(self.dim)[:, span]
            unit = Form.leaf(first[:, span], last[:, span], symbols, np.dtype(self.precision))
            sets += self._evaluated(part, [unit], len(low))
        return sets

    def _leaf(
        self, i: int, dtype: np.dtype, begins: Sequence[np.ndarray], ends: Sequence[np.ndarray],
        low: Corners, high: Corners,
    ) -> Value:  # fmt: skip
        begin, end = begins[i], ends[i]
        if not jnp.issubdtype(dtype, jnp.floating):
            return Whole(begin.astype(np.int64), end.astype(np.int64), np.dtype(dtype))
        symbols = self._symbols[i]
        size = np.maximum(np.maximum(np.abs(begin), np.abs(end)), self._scale[i])
        margin = ROUNDINGS * float(jnp.finfo(dtype).eps) * size * symbols.any(0)
        moved = [margin, margin]
        if self._exact[i]:
            # The ends of the whole interval are values themselves, and nothing lies beyond.
            moved = [
                margin * (1 - np.tensordot(1.0 * at_end, symbols, (1, 0)))
                for at_end in (low == 0, high == 1)
            ]
        return Form.leaf(begin - moved[0], end + moved[1], symbols, np.dtype(dtype))


def _rows(value: Value, block: slice) -> Value:
    """Return the sets of some boxes."""

    def cut(array: np.ndarray, lead: int) -> np.ndarray:
        axis = lead - 1
        if array.shape[axis] == 1:
            return array
        return array[block] if lead == 1 else array[:, block]

    return value.moved(cut)


def _program(function: Any, form: PyTree) -> Any:
    """Return the traced program of a function, without what no result depends on."""
    closed = jax.make_jaxpr(function)(form)
    used = without_unused(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    return closed.replace(jaxpr=used)


def _known_functions(precision: str) -> dict[str, Any]:
    """Return rules for functions of this package that sets should not go into, by their program.

    `sin_cos` reduces its argument by a whole number of quarter turns, which boxes have several of.
    """
    number = jax.ShapeDtypeStruct((), precision)
    step = jax.make_jaxpr(sin_cos)(number).jaxpr.eqns
    if len(step) != 1 or "call_jaxpr" not in step[0].params:
        return {}
    sin, cos = (jax.make_jaxpr(function)(number).jaxpr.eqns[0] for function in (jnp.sin, jnp.cos))

    def both(t: Interpreter, inputs: list[Value]) -> list[Value]:
        low, high = as_form(inputs[0]).bounds()
        limit = 1e5
        if np.any((low < -limit) | (high > limit)):
            everything = constant(np.array(np.nan), np.dtype(precision))
            return [everything, everything]
        return [t.step(each, inputs)[0] for each in (sin, cos)]

    return {str(step[0].params["call_jaxpr"]): both}
