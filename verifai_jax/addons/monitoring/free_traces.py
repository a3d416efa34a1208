"""Search among free signals for a trace that makes formulas true or false.

    free = FreeTraces.of([formula])
    signals = free.drawn(1024, rng)                       # [time, lanes], piecewise constant
    found = free.search(lambda values: values(formula)[0], rng)     # one that maximizes it

A signal moves between few levels: the numbers that predicates compare it with, and others between
and beyond. So the search reaches all points where the formula changes its truth, including
equality.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Float

from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.bounds import predicates_of, signal_bounds
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.expression import (
    Arithmetic,
    Component,
    Number,
    constant_value,
    expression,
)
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.host_values import HostValues, Values
from verifai_jax.mtl.sampled import sampled_in, with_counted
from verifai_jax.mtl.tree import Tree, postorder

LANES = 1024
"""Traces of one drawing."""
BLEND = 0.02
"""Share of the sum of operands that do not decide. Five of `a > 0 & b > 0 & c > 0 & d > 0 & e > 0`
were made true with it, and not without."""
KEPT, GENERATIONS = 32, 12
"""Number of traces kept in each generation of a search, and of generations."""
MAX_SAMPLES = 20_000
"""Samples of a free trace at most: one of more has a clock much finer than its windows."""
Signals = dict[str, Values]


@dataclass(frozen=True)
class FreeTraces:
    """Signals that may take any of their levels at any sample.

    - `levels`: the possible values of each signal.
    - `widths`: number of components of each vector signal; 0 for a scalar one.
    - `instants`: samples at which windows start and end, where changes matter.
    """

    levels: Mapping[str, Float[np.ndarray, " levels"]]
    widths: Mapping[str, int]
    dt: float
    length: int
    instants: tuple[int, ...]
    end: End = "hold"

    @classmethod
    def of(
        cls, formulas: Sequence[Formula], like: Sequence[Trace] = (), dt: float | None = None,
        duration: float | None = None, end: End = "hold",
    ) -> "FreeTraces":  # fmt: skip
        """Return free traces with the levels and instants that formulas distinguish.

        **Arguments:**
        - `like`: recordings whose values are used as levels, too.
        - `dt`, `duration`: period and duration in seconds; by default they follow from the windows.
        **Raises:** `ValueError` for windows that need more than 20 000 samples.
        """
        formulas = with_counted(*formulas)
        dt, length, instants = _clock(formulas, dt, duration)
        names = dict.fromkeys(name for f in formulas for name in f.signals())
        levels = {name: _levels(name, formulas, like) for name in names}
        widths = {name: _width(name, formulas, like) for name in names}
        return cls(levels, widths, dt, length, instants, end)

    @property
    def scales(self) -> dict[str, float]:
        """The median distance between neighbouring levels of each signal."""
        return {name: float(np.median(np.diff(own))) for name, own in self.levels.items()}

    def drawn(self, rng: np.random.Generator, lanes: int = LANES) -> Signals:
        """Draw piecewise constant signals: some never change, others at every third sample."""
        # A long clock has fewer traces, so that the memory is bounded.
        lanes = max(KEPT, min(lanes, 2**19 // self.length))
        shape = (self.length, lanes)
        widths = self.widths
        return {n: self._steps(rng, own, shape, widths[n]) for n, own in self.levels.items()}

    def _steps(
        self, rng: np.random.Generator, levels: np.ndarray, shape: tuple[int, int], width: int
    ) -> Values:
        if width:
            return np.stack([self._steps(rng, levels, shape, 0) for _ in range(width)], axis=-1)
        rate = rng.choice(np.array([0, 1, 2, 4, 8, shape[0] / 3]) / shape[0], shape[1])
        changes = rng.random(shape) < rate
        chosen = rng.random((len(self.instants), shape[1])) < 0.3
        changes[list(self.instants)] |= chosen & (rate > 0)
        changes[0] = True
        since = np.maximum.accumulate(np.where(changes, np.arange(shape[0])[:, None], 0), axis=0)
        return np.take_along_axis(rng.choice(levels, shape), since, axis=0)

    def values(self, signals: Signals) -> HostValues:
        """Return a function that computes formulas on lanes, weighting all operands a little."""
        return HostValues(signals, self.dt, self.end, lanes=1, blend=BLEND)

    def search(
        self, score: Callable[[HostValues], Values], rng: np.random.Generator,
        enough: float = math.inf, generations: int = GENERATIONS,
    ) -> tuple[Signals, float]:  # fmt: skip
        """Find the trace with the highest score by repeatedly changing parts of the best ones.

        **Arguments:**
        - `score`: a function from `[lanes]` traces to their scores.
        - `enough`: a score that ends the search.
        **Returns:** its signals `[time]`, and its score.
        """
        signals = self.drawn(rng)
        for generation in range(generations):
            found = np.nan_to_num(score(self.values(signals)), nan=-math.inf)
            # Those of one score in any order, so that what does not show yet changes too.
            order = rng.permutation(len(found))
            order = order[np.argsort(-found[order], kind="stable")]
            if found[order[0]] >= enough or generation == generations - 1:
                break
            signals = self._changed(signals, order[:KEPT], rng)
        best = int(order[0])
        return {name: signal[:, best] for name, signal in signals.items()}, float(found[best])

    def _changed(self, signals: Signals, best: np.ndarray, rng: np.random.Generator) -> Signals:
        """Return the best traces as they are, and copies that have parts of other traces."""
        lanes, share = next(iter(signals.values())).shape[1], max(0.3, 1.5 / len(signals))
        parents, fresh = np.resize(best, lanes), self.drawn(rng, lanes)
        clock = np.arange(self.length)[:, None]
        changed = {}
        for name, signal in signals.items():
            first, last = np.sort(rng.choice([*self.instants, self.length], (2, lanes)), axis=0)
            anywhere = np.sort(rng.integers(0, self.length + 1, (2, lanes)), axis=0)
            near = rng.random(lanes) < 0.5
            first, last = np.where(near, (first, last), anywhere)
            part = (clock >= first) & (clock < last) & (rng.random(lanes) < share)
            part[:, :KEPT] = False
            part = part.reshape(part.shape + (1,) * (signal.ndim - 2))
            changed[name] = np.where(part, fresh[name], signal[:, parents])
        return changed

    def trace(self, signals: Signals) -> Trace:
        """Return signals `[time]` as a trace."""
        return Trace(signals, dt=self.dt)


def _clock(
    formulas: Sequence[Formula], dt: float | None, duration: float | None
) -> tuple[float, int, tuple[int, ...]]:
    """Return a period that divides all windows, the samples, and the ends of windows."""
    timed = [f for whole in formulas for f in postorder(whole) if isinstance(f, Tree) and f.side]
    intervals = [f.interval for f in timed if f.operator.timed]
    ends = [t for i in intervals for t in (i.start, i.end) if 0 < t < math.inf]
    ends += [each.window.end for each in sampled_in(*formulas) if each.window is not None]
    if dt is None:
        # Seconds that are counted are multiples of the period, too, and so are their limits.
        counts = [
            leaf
            for f in formulas
            for leaf in predicates_of(f)
            if any(e.function == "duration" for e in sampled_in(leaf))
        ]
        limits = [number for leaf in counts for number in _numbers(leaf) if number > 0]
        exact = [Fraction(repr(t)) for t in (*ends, *limits)]
        common = Fraction(1) if not exact else _common(exact)
        if limits and sum(ends) > common * MAX_SAMPLES / 8:
            exact = exact[: len(ends)]
            common = _common(exact)
        # Where windows have few samples there are some between their ends.
        shortest = min(exact, default=Fraction(1))
        dt = float(common / max(1, math.ceil(4 / (shortest / common))))
    reach = sum(ends) + dt * (len(timed) + 6)
    duration = max(1.25 * reach, 12 * dt) if duration is None else duration
    length = math.ceil(duration / dt - 1e-9) + 1
    if length > MAX_SAMPLES:
        raise ValueError(
            f"a free trace of {duration:zg} s every {dt:zg} s has {length} samples, more than "
            f"{MAX_SAMPLES}: give a longer period dt that divides all windows"
        )
    samples = {round(t / dt) + more for t in ends for more in (0, 1)} | {0, 1, length - 1}
    return dt, length, tuple(sorted(k for k in samples if k < length))


def _common(numbers: Sequence[Fraction]) -> Fraction:
    common = numbers[0]
    for number in numbers[1:]:
        while number:
            common, number = number, common % number
    return common


def _levels(
    name: str, formulas: Sequence[Formula], like: Sequence[Trace]
) -> Float[np.ndarray, " levels"]:
    """Return values that a signal is worth having, the numbers that it is compared with first."""
    limits, joint = set[float](), set[float]()
    for formula in formulas:
        for _, solved in signal_bounds(formula, name):
            numbers = [constant_value(limit) for limit in solved]
            limits.update(number for number in numbers if number is not None)
        for leaf in predicates_of(formula):
            if name in leaf.signals():
                joint.update(_numbers(leaf))
                if not any(one == leaf for one, _ in signal_bounds(leaf, name)):
                    # A norm or a square has its bounds on either side, and within.
                    limits.update(s * n for n in _numbers(leaf) for s in (-1, -0.75, 0.75, 1))
                several = [other for other in leaf.signals() if other != name]
                for other in several:
                    own = [constant_value(e) for _, es in signal_bounds(leaf, other) for e in es]
                    joint.update(number for number in own if number is not None)
    for trace in like:
        if name in trace.signals:
            values = np.asarray(trace.trim().signals[name], float)
            finite = values[np.isfinite(values)]
            limits.update(map(float, np.quantile(finite, [0, 0.5, 1]) if finite.size else ()))
    if not limits:
        limits = joint | {-number for number in joint} | {0.0}
    known = np.array(sorted(limits))
    if name in states_of(formulas) and not np.any(known % 1):
        return np.unique([*known - 1, *known, *known + 1])
    spread = float(np.ptp(known)) or 0.2 * float(np.abs(known).max()) or 1.0
    beyond = [known[0] - spread, known[0] - spread / 4, known[-1] + spread / 4, known[-1] + spread]
    return np.unique([*known, *(known[1:] + known[:-1]) / 2, *beyond])


def states_of(formulas: Sequence[Formula]) -> set[str]:
    """Return the signals that are states, such as modes and flags: only equality is tested."""
    leaves = (leaf for f in with_counted(*formulas) for leaf in predicates_of(f))
    equal = (f for f in leaves if f.compared is None or f.compared[1] in ("==", "!="))
    return {name for leaf in equal for name in leaf.signals()}


def _numbers(leaf: Formula) -> list[float]:
    parts = (part for term in leaf.terms() for part in postorder(expression(term)))
    return [part.value for part in parts if isinstance(part, Number)]


def _width(name: str, formulas: Sequence[Formula], like: Sequence[Trace]) -> int:
    shapes = [np.shape(trace.signals[name]) for trace in like if name in trace.signals]
    if shapes:
        return shapes[0][1] if len(shapes[0]) > 1 else 0
    width = 0
    for formula in formulas:
        for leaf in predicates_of(formula):
            for part in (p for term in leaf.terms() for p in postorder(expression(term))):
                if isinstance(part, Component) and part.vector.signals() == (name,):
                    width = max(width, part.index + 1)
                if isinstance(part, Arithmetic) and part.name == "norm" and name in part.signals():
                    width = max(width, 2)
    return width
