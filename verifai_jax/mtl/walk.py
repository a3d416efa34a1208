"""The walk from a formula to the predicate and the instant that decide its robustness.

    walk = Walk(values_of, span, length, end="hold", stride=1)
    walk.operands(formula, 0)                         # The operands at the instants that matter
    walk.decision(formula)                            # The deciding predicate, and its sample

The hard robustness is the value of one predicate at one instant: the operand that decides each
minimum and maximum leads to it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.formula import Formula, Interval
from verifai_jax.mtl.tree import missing_case

Operands = list[tuple[Formula, int]]
"""Formulas, each at a sample."""


@dataclass(frozen=True)
class Walk:
    """A walk that follows the deciding operand of each minimum and maximum.

    - `values_of(formula)`: its robustness at every sample, `[time]`; the last value holds for ever.
    - `span(interval)`: the first and the last sample of an interval, relative to now.
    - `length`: number of samples of the trace.
    - `end`: how the trace continues after the last sample.
    - `stride`: number of samples in one period.
    """

    values_of: Callable[[Formula], Float[np.ndarray, " time"]]
    span: Callable[[Interval], tuple[int, float]]
    length: int
    end: End = "hold"
    stride: int = 1

    def at(self, f: Formula, i: int) -> float:
        """Return the robustness of a formula at a sample."""
        values = self.values_of(f)
        return float(values[min(i, len(values) - 1)])

    def decision(self, f: Formula) -> tuple[Formula, int] | None:
        """Return the predicate and the sample that decide a formula; None if no sample does."""
        i = 0
        while not isinstance(f, ast.Leaf):
            operands = self.operands(f, i)
            deciding = self.deciding(f, i, operands)
            if deciding is None:
                return None
            f, i = operands[deciding]
        return (f, i) if f.is_predicate else None

    def operands(self, f: Formula, i: int) -> Operands:
        """Return the operands of `f` at the relevant instants, seen from `i`; none if vacuous."""
        match f:
            case ast.Not(p):
                return [(p, i)]
            case ast.Join(parts):
                return [(p, i) for p in parts]
            case ast.Derived():
                return [(f.meaning, i)]
            case ast.Next(p):
                later = i + self.stride
                return [(p, later if self.end != "truncate" else min(later, self.length - 1))]
            case ast.Prev(p):
                earlier = i - self.stride
                return [(p, earlier)] if earlier >= 0 else []
            case ast.Window(p):
                return self._extreme(p, self._window(f, i), f.sign < 0)
            case ast.Witness(p, q):
                return self._witness(p, q, self._window(f, i), i, 1 if f.side == "ahead" else -1)
            case ast.Leaf():
                return []
        raise missing_case("the explanation", f)

    def deciding(self, f: Formula, i: int, operands: Operands) -> int | None:
        """Return the index of the operand that has the value of `f`."""
        if not operands:
            return None
        values = [self.at(p, j) for p, j in operands]
        if isinstance(f, ast.Join) and f.sign > 0:
            return int(np.argmax(values))
        return int(np.argmin(values)) if len(values) > 1 else 0

    def _window(self, f: Formula, i: int) -> range:
        """Return the samples at which an operator with an interval looks from sample `i` on."""
        a, b = self.span(f.interval)
        if f.side == "back":
            return range(0 if math.isinf(b) else max(0, i - int(b)), i - a + 1)
        if self.end == "truncate":
            stop = self.length - 1
        else:
            stop = max(i + a, *(len(self.values_of(p)) - 1 for p in f.operands()))
        return range(i + a, (stop if math.isinf(b) else min(i + int(b), stop)) + 1)

    def _extreme(self, p: Formula, window: range, lowest: bool) -> Operands:
        """Return the first sample of a window at which `p` is lowest, or highest."""
        if not window:
            return []
        values = self.values_of(p)[window.start : window.stop]
        if not len(values):
            return [(p, window.start)]
        return [(p, window.start + int(np.argmin(values) if lowest else np.argmax(values)))]

    def _witness(self, p: Formula, q: Formula, window: range, i: int, step: int) -> Operands:
        """Find where until (since) is most nearly fulfilled: the witness and the weakest link."""
        if not window:
            return []
        left, right = self.values_of(p), self.values_of(q)
        # Later than both series nothing changes any more.
        last = min(window[-1], max(len(left), len(right), window[0] + 1) - 1)
        instants = np.arange(window[0], last + 1)[::step]
        before = np.arange(i, int(instants[-1]), step)
        lowest = np.minimum.accumulate(left[np.minimum(before, len(left) - 1)])
        lowest = np.concatenate([[math.inf], lowest])[np.abs(instants - i)]
        values = np.minimum(right[np.minimum(instants, len(right) - 1)], lowest)
        witness = int(instants[np.argmax(values)])
        if witness == i:
            return [(q, i)]
        before = np.arange(i, witness, step)
        link = int(before[np.argmin(left[np.minimum(before, len(left) - 1)])])
        return [(p, link), (q, witness)]
