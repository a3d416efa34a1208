"""The instants at which the predicates of a violated formula break it, and when that is certain.

    broken_at(parse("always[70, 100] x > 0"), trace)    # {x > 0: only instants from 70 s on}
    certain_from(parse("eventually[0, 5] x > 0"), trace)    # the sample at 5 s

A walk from the formula down follows the operands that are false (or true, below a negation).
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.expression import Signal
from verifai_jax.mtl.formula import Formula, surface
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.rewriting import expand, replaced

Mask = Bool[np.ndarray, " time"]


def broken_at(formula: Formula, trace: Trace, end: End = "hold") -> dict[Formula, Mask]:
    """Return the samples at which predicates have the truth value that breaks a formula.

    The condition of an implication is not to blame. Empty if the formula holds.

    **Arguments:** as in `robustness`; the trace is evenly spaced.
    **Returns:** by predicate the samples of the trace, without those after its last valid one.
    """
    return _Blame(HostValues.for_verdict(trace, end)).of(formula)


def certain_from(formula: Formula, trace: Trace, end: End = "hold") -> int | None:
    """Return the sample from which on a formula is broken whatever follows, None if it holds.

    What a predicate says of a sample is known from that sample on. So the earlier one that is false
    decides `always`, and the last one of its window `eventually`: the formula has this instant as
    its robustness if predicates have values whose size falls with time.

    **Arguments:** as in `broken_at`.
    """
    values, formula = HostValues.for_verdict(trace, end), expand(formula)
    leaves = [part for part in dict.fromkeys(formula.subformulas(True)) if part.is_predicate]
    left = values.length - np.arange(values.length)
    signals = {f"p{i}": left * values.truth(part) for i, part in enumerate(leaves)}
    marks = {part: ast.Atom(Signal(name)) for part, name in zip(leaves, signals, strict=True)}
    timed = replace(values, signals=signals, truths=frozenset(), _padded={}, _known={})
    rho = float(timed.first(replaced(formula, marks))) if leaves else 0.0
    return int(values.length + rho) // values.stride if -np.inf < rho < 0 else None


class _Blame:
    def __init__(self, values: HostValues) -> None:
        self.values, self.now = values, np.arange(values.length)

    def of(self, formula: Formula) -> dict[Formula, Mask]:
        known: dict[tuple[Formula, bool], Mask] = {}
        todo = [(formula, False, self.now == 0)]
        while todo:
            part, truth, asked = todo.pop()
            value = np.broadcast_to(self.values.truth(part), self.now.shape)
            before = known.setdefault((part, truth), np.zeros_like(asked))
            new = asked & (value > 0 if truth else value < 0) & ~before
            if new.any():
                before |= new
                todo += self._below(part, truth, new)
        blamed: dict[Formula, Mask] = {}
        for (part, _), at in known.items():
            if part.is_predicate and at.any():
                blamed[part] = blamed.get(part, False) | at
        return blamed

    def _below(self, f: Formula, truth: bool, at: Mask) -> list[tuple[Formula, bool, Mask]]:
        """Return the operands whose truth at some instants gives `f` its own at others."""
        if isinstance(f, ast.Not):
            return [(f.operand, not truth, at)]
        parts = f.valued()
        if isinstance(f, ast.Join) and surface(f)[0] == "implies":
            parts = parts[1:]
        if not f.side:
            return [(part, truth, at) for part in parts]
        step = self.values.stride
        first, last = self.values._span(f.interval) if f.operator.timed else (step, step)
        back = f.side == "back"
        at = at[::-1] if back else at
        i = self.now[at]
        stops = i + last
        *left, right = parts
        found = []
        for part in left:
            # A witness is sought up to the first instant at which the left side does not hold.
            fails = np.broadcast_to(self.values.truth(part), self.now.shape) < 0
            fails = np.where(fails[::-1] if back else fails, self.now, len(self.now))
            ends = np.minimum.accumulate(fails[::-1])[::-1][i]
            broken = np.isin(self.now, ends[ends < stops])
            stops = np.minimum(stops, ends)
            found.append((part, truth, self._within(i, stops - 1, back) if truth else broken))
        seen = self._within(i + first, stops, back)
        found.append((right, truth, seen))
        return [(part, each, mask[::-1] if back else mask) for part, each, mask in found]

    def _within(self, starts: Int[np.ndarray, " k"], stops: np.ndarray, back: bool) -> Mask:
        """Return the samples within closed intervals, of which some may reach beyond the end."""
        end = len(self.now) - 1
        if self.values.end == "hold" and not back:
            starts = np.minimum(starts, end)
        stops = np.minimum(stops, end).astype(int)
        kept = starts <= stops
        edges = np.zeros(end + 2, int)
        np.add.at(edges, starts[kept], 1)
        np.add.at(edges, stops[kept] + 1, -1)
        return np.cumsum(edges)[:-1] > 0
