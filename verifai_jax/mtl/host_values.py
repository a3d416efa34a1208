"""The value of a formula at every instant in NumPy and double precision, where nothing compiles.

    values = HostValues.of(trace)
    values(formula)                 # [time], the robustness at every sample
    values.truth(formula)           # [time], +1 where it holds, -1 where not, NaN where unknown

For many formulas on few recordings, as in mining: JAX would compile each formula. Values equal
those of `Evaluator` (tests compare them). Arrays are time-major, `[time, *lanes]`.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.values.trace import Trace, without_wrapping
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.evaluate import End, check_scalar, check_vector, span_of
from verifai_jax.mtl.expression import Arithmetic, Component, Number, Signal
from verifai_jax.mtl.fitting import fitted, sizes_of
from verifai_jax.mtl.formula import Formula, Interval, Term
from verifai_jax.mtl.sampled import ArrayOperations, Sampled, held
from verifai_jax.mtl.semantics import alone, compared
from verifai_jax.mtl.setting import check_trace, period
from verifai_jax.mtl.tree import missing_case, postorder
from verifai_jax.mtl.walk import Walk

Values = Float[np.ndarray, "time *lanes"]
FUNCTIONS: dict[str, Callable[..., Values]] = {
    "neg": np.negative, "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide,
    "**": np.power, "abs": np.abs, "sqrt": np.sqrt, "sin": np.sin, "cos": np.cos, "exp": np.exp,
    "min": lambda *values: _joined(values, -1), "max": lambda *values: _joined(values, 1),
}  # fmt: skip
"""The functions of expressions on the host, except `norm`."""


@dataclass
class HostValues:
    """The values of formulas on signals `[time, *lanes]`, or `[time, *lanes, k]` for vectors.

    - `dt`: sampling period in seconds, which is `stride` samples long.
    - `end`: how the trace continues after the last sample, `"hold"` or `"truncate"`.
    - `lanes`: number of lane axes.
    - `truths`: names of the signals of truth values, which are numbers 1 and 0.
    - `units`: the units of signals, as far as they are known.
    - `blend`: share of the sum of all operands that `&` and `|` add to the deciding one, so that a
      search notices when another operand improves. 0 for the robustness.
    """

    signals: Mapping[str, Values]
    dt: float
    end: End = "hold"
    stride: int = 1
    lanes: int = 0
    blend: float = 0.0
    truths: frozenset[str] = frozenset()
    units: Mapping[str, str] = field(default_factory=dict)
    _padded: dict[int, dict[str, Values]] = field(default_factory=dict)
    _known: dict[tuple[Formula, bool, int], Values] = field(default_factory=dict)

    @classmethod
    def of(cls, trace: Trace, end: End = "hold") -> "HostValues":
        """Return the values on a trace.

        **Raises:** `TypeError` for another type; `ValueError` for unevenly spaced sample times.
        """
        check_trace(trace)
        dt, trace = period(trace), trace.trim()
        signals = {name: numbers(signal) for name, signal in trace.signals.items()}
        if trace.between is not None:
            for name, own in signals.items():
                inner = numbers(trace.between.signals[name])
                rows = inner.reshape(trace.length, -1, *own.shape[1:])
                joined = np.concatenate([own[:, None], rows], axis=1)
                signals[name] = joined.reshape(-1, *own.shape[1:])
        truths = frozenset(filter(trace.is_truth, signals))
        return cls(signals, dt, end, trace.stride, truths=truths, units=trace.units)

    @classmethod
    def for_verdict(cls, trace: Trace, end: End) -> "HostValues":
        """Return the values that a verdict has: a strict one needs no sample after the last."""
        return cls.of(trace, "truncate" if end == "truncate" else "hold")

    @functools.cached_property
    def _sizes(self) -> dict[str, int]:
        return sizes_of(self.signals, self.lanes)

    @property
    def length(self) -> int:
        """Number of samples, including those between the periods."""
        return len(next(iter(self.signals.values())))

    def __call__(self, formula: Formula) -> Values:
        """Compute the robustness at every sample."""
        return self._everywhere(formula, False)

    def truth(self, formula: Formula) -> Values:
        """Compute +1 where it holds, -1 where not; at robustness 0 the comparator decides."""
        return self._everywhere(formula, True)

    def first(self, formula: Formula, boolean: bool = False) -> Float[np.ndarray, "*lanes"]:
        """Compute the robustness (or the truth) only at the first sample, which is faster.

        Missing signals raise no readable error here.
        """
        with np.errstate(all="ignore"):
            return self._first(formula, boolean, self._pad(formula))

    def _first(self, f: Formula, boolean: bool, pad: int) -> Float[np.ndarray, "*lanes"]:
        match f:
            case ast.Not(part):
                return -self._first(part, boolean, pad)
            case ast.Join(parts):
                if not self.blend:
                    return _joined([self._first(part, boolean, pad) for part in parts], f.sign)
            case ast.Window(part) if f.side == "ahead":
                x = self._value(part, boolean, pad)
                a, b = self._span(f.interval)
                if self.end == "hold":
                    a = min(a, len(x) - 1)
                if a < len(x):
                    seen = x[a : len(x) if math.isinf(b) else int(b) + 1]
                    return seen.max(axis=0) if f.sign > 0 else seen.min(axis=0)
        return self._value(f, boolean, pad)[0]

    def holds(self, formula: Formula) -> bool:
        """Return whether it holds at the first sample. **Raises:** `ValueError` for a NaN there."""
        self._check_signals(formula)
        value = float(self.first(formula, boolean=True))
        if math.isnan(value):
            raise ValueError(f"no verdict: a signal of {formula} is NaN where it matters")
        return value > 0

    def forget(self) -> None:
        """Clear the cache of formulas' values, for callers that evaluate thousands of formulas."""
        self._known.clear()

    def walk(self, formula: Formula) -> Walk:
        """Return a walk to the part that decides a formula at the first sample."""
        pad = self._pad(formula)

        def values_of(part: Formula) -> Values:
            known = self._known.get((part, False, pad))
            if known is not None:
                return known
            with np.errstate(all="ignore"):
                return self._value(part, False, pad)

        return Walk(values_of, self._span, self.length, self.end, self.stride)

    def _check_signals(self, formula: Formula) -> None:
        for name in formula.signals():
            if name not in self.signals:
                raise missing_name("the trace", "signal", name, self.signals)

    def _everywhere(self, formula: Formula, boolean: bool) -> Values:
        self._check_signals(formula)
        with np.errstate(all="ignore"):
            return self._value(formula, boolean, self._pad(formula))[: self.length]

    def _pad(self, formula: Formula) -> int:
        """Return the number of samples after the last one that past operators tell apart."""
        # Under hold the last sample goes on for ever, and past operators see it for a while.
        return _look_back(formula, self.dt, self.stride) if self.end == "hold" else 0

    def _span(self, interval: Interval) -> tuple[int, float]:
        return _span(interval, self.dt, self.stride)

    def _value(self, f: Formula, boolean: bool, pad: int) -> Values:
        key = (f, boolean, pad)
        if key not in self._known:
            self._known[key] = self._computed(f, boolean, pad)
        return self._known[key]

    def _computed(self, f: Formula, boolean: bool, pad: int) -> Values:
        top = 1.0 if boolean else math.inf
        below = [self._value(part, boolean, pad) for part in f.valued()]
        hold = self.end == "hold"
        if isinstance(f, ast.Leaf) and (own := fitted(f, self.units, self._sizes)) is not f:
            return self._value(own, boolean, pad)
        match f:
            case ast.Constant(value):
                return np.full((self.length + pad, *(1,) * self.lanes), top if value else -top)
            case ast.Predicate(comparison, left, right):
                a, b = (self._expression(e, pad) for e in (left, right))
                return compared(comparison, a, b, boolean, np)
            case ast.Atom(e):
                value = alone(self._expression(e, pad), e, self.truths)
                return compared(">", value, np.zeros(1), boolean, np)
            case ast.Not():
                return -below[0]
            case ast.Join():
                joined = _joined(below, f.sign)
                if self.blend and not boolean:
                    joined = joined + self.blend * sum(np.clip(v, -1e9, 1e9) for v in below)
                return joined
            case ast.Window():
                a, b = self._span(f.interval)
                return _window(below[0], a, b, f.sign, top, hold, f.side == "back")
            case ast.Next():
                return _window(below[0], self.stride, self.stride, 1, top, True)
            case ast.Prev(_, weak):
                sign = -1 if weak else 1
                return _window(below[0], self.stride, self.stride, sign, top, hold, True)
            case ast.Witness():
                left, right = below
                return _witness(left, right, *self._span(f.interval), top, hold, f.side == "back")
            case ast.Derived():
                return below[0]
        raise missing_case("the value", f)

    def _expression(self, e: Term, pad: int) -> Values:
        values: dict[int, Values] = {}
        order = _in_order(e)
        for part in order:
            match part:
                case Number(value):
                    values[id(part)] = np.full((1,), value)
                case Sampled():
                    values[id(part)] = _held(self._sampled(part), pad)
                case Signal(name):
                    values[id(part)] = self._signal(name, pad)
                case Component(Signal(name) as vector, index):
                    check_vector(name, values[id(vector)].shape, self.lanes, f"{part}", index)
                    values[id(part)] = values[id(vector)][..., index]
                case Arithmetic("norm", (vector,)):
                    if not isinstance(vector, Signal):
                        raise TypeError(f"norm takes a vector signal; got norm({vector})")
                    check_vector(vector.name, values[id(vector)].shape, self.lanes, f"{part}")
                    values[id(part)] = np.sqrt(np.sum(values[id(vector)] ** 2, axis=-1))
                case Arithmetic(name, arguments):
                    for argument in arguments:
                        check_scalar(argument, values[id(argument)].shape, self.lanes)
                    values[id(part)] = FUNCTIONS[name](*(values[id(a)] for a in arguments))
                case _:
                    raise missing_case("the value", part)
        value = values[id(order[-1])]
        check_scalar(e, value.shape, self.lanes)
        return value

    def _signal(self, name: str, pad: int) -> Values:
        padded = self._padded.setdefault(pad, {})
        if name not in padded:
            padded[name] = _held(self.signals[name], pad)
        return padded[name]

    def _sampled(self, e: Sampled) -> Values:
        like = np.ones((self.length, *(1,) * self.lanes))
        functions: Callable[[str, list[Values]], Values] = lambda name, v: FUNCTIONS[name](*v)  # noqa: E731
        of = ArrayOperations(self.dt / self.stride, np, functions, np.maximum.accumulate, like)
        return e.computed(
            of, lambda f: held(self._value(f, True, 0), np),
            lambda part: self._expression(part, 0) * like, self._span,
        )  # fmt: skip


_span = functools.lru_cache(1024)(span_of)


def _in_order(e: Term) -> tuple[Term, ...]:
    """Return an expression and all expressions below it, children first; cached."""
    if "_order" not in e.__dict__:
        object.__setattr__(e, "_order", tuple(postorder(e)))
    return e.__dict__["_order"]


@functools.lru_cache(1024)
def _look_back(formula: Formula, dt: float, stride: int) -> int:
    """Return how many samples the past operators of a formula look back in all."""
    backs = [f for f in postorder(formula) if isinstance(f, Formula) and f.side == "back"]
    spans = [_span(f.interval, dt, stride) if f.operator.timed else (stride, stride) for f in backs]
    return sum(int(a if math.isinf(b) else b) for a, b in spans)


def numbers(signal: object) -> Values:
    """Return a signal in double precision, with 1 or 0 for truth values."""
    return np.asarray(without_wrapping(signal)).astype(float)  # pyright: ignore[reportArgumentType]


def _held(signal: Values, pad: int) -> Values:
    return np.concatenate([signal, np.repeat(signal[-1:], pad, axis=0)]) if pad else signal


def _joined(values: Sequence[Values], sign: int) -> Values:
    joined = values[0]
    for value in values[1:]:
        joined = np.maximum(joined, value) if sign > 0 else np.minimum(joined, value)
    return joined


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
    after = x[-1] if hold else np.full(x.shape[1:], -sign * top)
    x = np.concatenate([x, np.broadcast_to(after, (b, *x.shape[1:]))])
    size, width = 1, b - a + 1
    extreme = np.maximum if sign > 0 else np.minimum
    while 2 * size <= width:
        x = extreme(x[:-size], x[size:])
        size *= 2
    if more := width - size:
        x = extreme(x[:-more], x[more:])
    return x[a : a + n]


def _witness(f: Values, g: Values, a: int, b: float, top: float, hold: bool, back: bool) -> Values:
    """Compute until over the samples `a` to `b` ahead, and since over those back."""
    f, g = np.broadcast_arrays(f, g)
    # A witness beyond the interval does not count below, so none is sought farther away.
    found = _witness_within(b - a + 1, *((f[::-1], g[::-1]) if back else (f, g)))
    terms = [_window(found[::-1] if back else found, a, a, 1, top, hold, back)]
    if math.isfinite(b):
        terms.append(_window(g, a, b, 1, top, hold, back))
    if a > 0:
        terms.append(_window(f, 0, a - 1, -1, top, hold, back))
    return _joined(terms, -1)


def _witness_within(width: float, f: Values, g: Values) -> Values:
    """Compute `u[t] = max(g[t], min(f[t], u[t+1]))` by doubling, over `width` samples or more."""
    g, f = g.copy(), f.copy()
    shift = 1
    while shift < min(len(g), width):
        np.maximum(g[:-shift], np.minimum(f[:-shift], g[shift:]), out=g[:-shift])
        np.minimum(f[:-shift], f[shift:], out=f[:-shift])
        shift *= 2
    return g
