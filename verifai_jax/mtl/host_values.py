"""The value of a formula at every instant in NumPy and double precision, where nothing compiles.

    values = HostValues.of(trace)
    values(formula)                 # [time], the robustness at every sample
    values.truth(formula)           # [time], +1 where it holds, -1 where not, NaN where unknown

For many formulas on few recordings, as mining and mutants ask: JAX would compile each formula. The
meaning is that of `Evaluator` (tests compare them). Arrays are time-major, `[time, *lanes]`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from verifai_jax.core.errors import missing_name
from verifai_jax.core.trace import Trace, without_wrapping
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.evaluate import End, samples
from verifai_jax.mtl.expression import Arithmetic, Component, Number, Signal
from verifai_jax.mtl.formula import Formula, Interval, Term
from verifai_jax.mtl.semantics import compared
from verifai_jax.mtl.setting import check_trace, period
from verifai_jax.mtl.tree import missing_case, postorder

Values = Float[np.ndarray, "time *lanes"]

_FUNCTIONS: dict[str, Callable[..., Values]] = {
    "neg": np.negative,
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    "**": np.power,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "sin": np.sin,
    "cos": np.cos,
    "min": lambda *values: _joined(values, -1),
    "max": lambda *values: _joined(values, 1),
}


@dataclass
class HostValues:
    """The values of formulas on signals `[time, *lanes]`, or `[time, *lanes, k]` for vectors.

    - `dt`: sampling period in seconds, for which `stride` samples stand.
    - `end`: what comes after the last sample, `"hold"` or `"truncate"`.
    - `lanes`: number of lane axes.
    """

    signals: Mapping[str, Values]
    dt: float
    end: End = "hold"
    stride: int = 1
    lanes: int = 0
    _padded: dict[int, dict[str, Values]] = field(default_factory=dict)
    _known: dict[tuple[Formula, bool, int], Values] = field(default_factory=dict)

    @classmethod
    def of(cls, trace: Trace, end: End = "hold") -> "HostValues":
        """Return the values on a trace.

        **Raises:** `TypeError` for anything else; `ValueError` for sample times that are not even.
        """
        check_trace(trace)
        dt, trace = period(trace), trace.trim()
        signals = {name: _numbers(signal) for name, signal in trace.signals.items()}
        if trace.between is not None:
            for name, own in signals.items():
                inner = _numbers(trace.between.signals[name])
                rows = inner.reshape(trace.length, -1, *own.shape[1:])
                joined = np.concatenate([own[:, None], rows], axis=1)
                signals[name] = joined.reshape(-1, *own.shape[1:])
        return cls(signals, dt, end, trace.stride)

    @property
    def length(self) -> int:
        """Number of samples, those between the others included."""
        return len(next(iter(self.signals.values())))

    def __call__(self, formula: Formula) -> Values:
        """Compute the robustness at every sample."""
        return self._everywhere(formula, False)

    def truth(self, formula: Formula) -> Values:
        """Compute +1 where it holds, -1 where not; a comparison decides at robustness 0."""
        return self._everywhere(formula, True)

    def holds(self, formula: Formula) -> bool:
        """Return whether it holds at the first sample. **Raises:** `ValueError` for a NaN there."""
        value = float(self.truth(formula)[0])
        if math.isnan(value):
            raise ValueError(f"no verdict: a signal of {formula} is NaN where it matters")
        return value > 0

    def _everywhere(self, formula: Formula, boolean: bool) -> Values:
        for name in formula.signals():
            if name not in self.signals:
                raise missing_name("the trace", "signal", name, self.signals)
        # Under hold the last sample goes on for ever, and past operators see it for a while.
        pad = self._look_back(formula) if self.end == "hold" else 0
        with np.errstate(all="ignore"):
            return self._value(formula, boolean, pad)[: self.length]

    def _look_back(self, formula: Formula) -> int:
        backs = [f for f in postorder(formula) if isinstance(f, Formula) and f.side == "back"]
        spans = [
            self._span(f.interval) if f.operator.timed else (self.stride, self.stride)
            for f in backs
        ]
        return sum(int(a if math.isinf(b) else b) for a, b in spans)

    def _span(self, interval: Interval) -> tuple[int, float]:
        first, last = (
            samples(t, self.dt, interval) * self.stride for t in (interval.start, interval.end)
        )
        return int(first), last

    def _value(self, f: Formula, boolean: bool, pad: int) -> Values:
        key = (f, boolean, pad)
        if key not in self._known:
            self._known[key] = self._computed(f, boolean, pad)
        return self._known[key]

    def _computed(self, f: Formula, boolean: bool, pad: int) -> Values:
        top = 1.0 if boolean else math.inf
        below = [self._value(part, boolean, pad) for part in f.valued()]
        hold = self.end == "hold"
        match f:
            case ast.Constant(value):
                return np.full((self.length + pad, *(1,) * self.lanes), top if value else -top)
            case ast.Predicate(comparison, left, right):
                return self._compared(comparison, left, right, boolean, pad)
            case ast.Atom(e):
                return self._compared(">", e, Number(0.0), boolean, pad)
            case ast.Not():
                return -below[0]
            case ast.Join():
                return _joined(below, f.sign)
            case ast.Window():
                return _window(
                    below[0], *self._span(f.interval), f.sign, top, hold, f.side == "back"
                )
            case ast.Next():
                return _window(below[0], self.stride, self.stride, 1, top, True)
            case ast.Prev(_, weak):
                sign = -1 if weak else 1
                return _window(below[0], self.stride, self.stride, sign, top, hold, True)
            case ast.Witness():
                left, right = below
                a, b = self._span(f.interval)
                return _witness(left, right, a, b, top, hold, f.side == "back")
            case ast.Derived():
                return below[0]
        raise missing_case("the value", f)

    def _compared(
        self, comparison: str, left: Term, right: Term, boolean: bool, pad: int
    ) -> Values:
        a, b = (self._expression(e, pad) for e in (left, right))
        return compared(comparison, a, b, boolean, np)

    def _expression(self, e: Term, pad: int) -> Values:
        values: dict[int, Values] = {}
        for part in postorder(e):
            match part:
                case Number(value):
                    values[id(part)] = np.full((1,), value)
                case Signal(name):
                    values[id(part)] = self._signal(name, pad)
                case Component(vector, index):
                    values[id(part)] = values[id(vector)][..., index]
                case Arithmetic("norm", (vector,)):
                    values[id(part)] = np.sqrt(np.sum(values[id(vector)] ** 2, axis=-1))
                case Arithmetic(name, arguments):
                    values[id(part)] = _FUNCTIONS[name](*(values[id(a)] for a in arguments))
                case _:
                    raise missing_case("the value", part)
        return values[id(e)]

    def _signal(self, name: str, pad: int) -> Values:
        padded = self._padded.setdefault(pad, {})
        if name not in padded:
            signal = self.signals[name]
            tail = np.repeat(signal[-1:], pad, axis=0)
            padded[name] = np.concatenate([signal, tail]) if pad else signal
        return padded[name]


def _numbers(signal: object) -> Values:
    array = np.asarray(without_wrapping(signal))  # pyright: ignore[reportArgumentType]
    return np.where(array, 1.0, -1.0) if array.dtype == bool else array.astype(float)


def _joined(values: Sequence[Values], sign: int) -> Values:
    joined = values[0]
    for value in values[1:]:
        joined = np.maximum(joined, value) if sign > 0 else np.minimum(joined, value)
    return joined


def _extended(x: Values, count: int, fill: float | None) -> Values:
    """Return `x` with more samples: those of its last one, or of a fill value."""
    tail = np.repeat(x[-1:], count, axis=0)
    return np.concatenate([x, tail if fill is None else np.full_like(tail, fill)])


def _window(
    x: Values, a: int, b: float, sign: int, top: float, hold: bool, back: bool = False
) -> Values:
    """Compute the extreme over the samples `a` to `b` ahead of each, or back."""
    if back:
        return _window(x[::-1], a, b, sign, top, False)[::-1]
    n = len(x)
    # Beyond the whole trace there is only what comes after it.
    a = min(a, n)
    b = int(min(b, a + n))
    x = _extended(x, b, None if hold else -sign * top)
    size, width = 1, b - a + 1
    extreme = np.maximum if sign > 0 else np.minimum
    while 2 * size <= width:
        x = extreme(x[:-size], x[size:])
        size *= 2
    if width > size:
        more = width - size
        x = extreme(x[:-more], x[more:])
    return x[a : a + n]


def _witness(f: Values, g: Values, a: int, b: float, top: float, hold: bool, back: bool) -> Values:
    """Compute until over the samples `a` to `b` ahead, and since over those back."""
    f, g = np.broadcast_arrays(f, g)
    found = _witness_anywhere(*((f[::-1], g[::-1]) if back else (f, g)), top)
    terms = [_window(found[::-1] if back else found, a, a, 1, top, hold, back)]
    if math.isfinite(b):
        terms.append(_window(g, a, b, 1, top, hold, back))
    if a > 0:
        terms.append(_window(f, 0, a - 1, -1, top, hold, back))
    return _joined(terms, -1)


def _witness_anywhere(f: Values, g: Values, top: float) -> Values:
    """Compute `u[t] = max(g[t], min(f[t], u[t+1]))` by doubling."""
    shift = 1
    while shift < len(g):
        later_g = _extended(g, shift, -top)[shift:]
        later_f = _extended(f, shift, top)[shift:]
        g, f = np.maximum(g, np.minimum(f, later_g)), np.minimum(f, later_f)
        shift *= 2
    return g
