"""The value of a formula over a range of instants; only needed instants are computed.

Signals are time-major `[time, *lanes]`. Under `hold` a trace continues for ever with its last
sample, so every sub-formula is constant from some instant on (where it *settles*). Later instants
therefore cost nothing, and unbounded windows end there.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from verifai_jax.core.messages.text import format_seconds
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl import windows
from verifai_jax.mtl.expression import Arithmetic, Component, Number, Signal
from verifai_jax.mtl.fitting import fitted, sizes_of
from verifai_jax.mtl.formula import Formula, Interval, Term
from verifai_jax.mtl.sampled import ArrayOperations, Sampled, held
from verifai_jax.mtl.semantics import alone, compared
from verifai_jax.mtl.tree import missing_case

End = Literal["hold", "truncate", "strict"]


class IntervalError(ValueError):
    """An interval that is not a multiple of the trace's sampling period."""


def samples(time: float, dt: float, interval: Interval) -> float:
    """Return `time` in samples. **Raises:** `IntervalError` unless it is a multiple of `dt`."""
    if math.isinf(time):
        return math.inf
    n = time / dt
    if math.isinf(n):
        raise IntervalError(
            f"the interval {interval} has more samples of {format_seconds(dt)} than can be counted"
        )
    if abs(n - round(n)) > 1e-6 * max(1.0, abs(n)):
        low, high = math.floor(n), math.ceil(n)
        raise IntervalError(
            f"the interval {interval} does not fit the sampling period of {format_seconds(dt)}: "
            f"{format_seconds(time)} is not a multiple of it; the nearest are "
            f"{format_seconds(low * dt)} and {format_seconds(high * dt)}"
        )
    return round(n)


def span_of(interval: Interval, dt: float, stride: int = 1) -> tuple[int, float]:
    """Return the first and the last sample of an interval, relative to now.

    **Raises:** `IntervalError` for an end that is not a multiple of `dt`, and for no sample.
    """
    first = int(samples(interval.start, dt, interval)) * stride + interval.open_start
    last = samples(interval.end, dt, interval) * stride - interval.open_end
    if last < first:
        raise IntervalError(f"the interval {interval} has no sample every {format_seconds(dt)}")
    return first, last


def check_scalar(e: Term, shape: Sequence[int], lanes: int) -> None:
    """Refuse a vector signal where a number is needed. **Raises:** `TypeError`."""
    if isinstance(e, Signal) and len(shape) != 1 + lanes:
        raise TypeError(
            f"signal {e.name!r} is a vector of {shape[-1]} components and cannot be used as a "
            f"number: take a component, {e}[0], or norm({e})"
        )


def check_vector(name: str, shape: Sequence[int], lanes: int, text: str, index: int = 0) -> None:
    """Refuse a signal without the component that `text` uses. **Raises:** `TypeError`."""
    if len(shape) != 2 + lanes:
        raise TypeError(f"signal {name!r} is a scalar: {text} needs a vector [time, k]")
    if index >= shape[-1]:
        raise TypeError(f"signal {name!r} has {shape[-1]} components, counted from 0; got {text}")


@dataclass
class Evaluator:
    """Evaluates sub-formulas of one trace (or of many, in lanes) under one semantics.

    `kind` is the kind of semantics, `tau` its temperature (smooth only), `valid` the number of
    valid samples, `[*lanes]` (truncate only; all when None). `lanes` is the number of lane axes;
    `open_right` makes windows half-open, as with `compat="pymtl"`. One period `dt` is `stride`
    samples long (`Trace.finely`), so windows, next and previous are that many times longer.
    `truths` are the signals of truth values, which are numbers 1 and 0, and `units` those that are
    known.
    """

    signals: Mapping[str, Float[Array, "time ..."]]
    length: int
    dt: float
    kind: str = "hard"
    tau: Array | float | None = None
    end: End = "hold"
    valid: Array | None = None
    open_right: bool = False
    lanes: int = 0
    stride: int = 1
    truths: frozenset[str] = frozenset()
    units: Mapping[str, str] = field(default_factory=dict)
    #: Added to the values of leaves, `[time, *lanes]` each; differentiating by it weighs them.
    nudges: Mapping[Formula, Float[Array, "time ..."]] = field(default_factory=dict)
    _memo: dict[Any, Array] = field(default_factory=dict)
    _settled: dict[Formula, int] = field(default_factory=dict)

    @property
    def _last(self) -> int:
        return self.length - 1

    @property
    def _hold(self) -> bool:
        return self.end != "truncate"

    def span(self, interval: Interval) -> tuple[int, float]:
        """Return the first and last sample of an interval, relative to now."""
        a, b = span_of(interval, self.dt, self.stride)
        return a, b - (self.open_right and b > a)

    def settles(self, f: Formula) -> int:
        """Return the instant from which `f` is constant under `hold`; the last sample otherwise."""
        if not self._hold:
            return self._last
        if f not in self._settled:
            self._settled[f] = self._settles(f)
        return self._settled[f]

    def _settles(self, f: Formula) -> int:
        below = [self.settles(part) for part in f.valued()]
        match f:
            case ast.Constant():
                return 0
            case ast.Predicate() | ast.Atom():
                return self._last
            case ast.Next():
                return max(0, below[0] - self.stride)
            case ast.Prev():
                return below[0] + self.stride
            case ast.Window() | ast.Witness() if f.side == "back":
                a, b = self.span(f.interval)
                return max(below) + int(a if math.isinf(b) else b)
            case ast.Window():
                return max(0, below[0] - self.span(f.interval)[0])
            case ast.Not() | ast.Join() | ast.Witness() | ast.Derived():
                return max(below)
        raise missing_case("the instant from which the value is constant", f)

    def value(self, f: Formula, first: int, last: int) -> Float[Array, "instants *lanes"]:
        """Compute the values of `f` at the instants `first` to `last`, both included."""
        key = (f, first, last)
        if key not in self._memo:
            self._memo[key] = self._value(f, first, last)
        return self._memo[key]

    def _value(self, f: Formula, first: int, last: int) -> Array:
        match f:
            case ast.Constant(value):
                return self._full(value, last - first + 1)
            case ast.Predicate() | ast.Atom():
                return self._leaf(f, first, last)
            case ast.Not(operand):
                return -self.value(operand, first, last)
            case ast.Join(parts):
                return self._join([self.value(p, first, last) for p in parts], f.sign)
            case ast.Window(operand, interval):
                window = self._future if f.side == "ahead" else self._past
                return window(operand, f.sign, *self.span(interval), first, last)
            case ast.Next(operand):
                return self._next(operand, first, last)
            case ast.Prev(operand, weak):
                sign = -1 if weak else 1
                return self._past(operand, sign, self.stride, self.stride, first, last)
            case ast.Witness(left, right, interval):
                witness = self._until if f.side == "ahead" else self._since
                return witness(left, right, *self.span(interval), first, last)
            case ast.Derived():
                return self.value(f.meaning, first, last)
        raise missing_case("the robustness", f)

    # Leaves

    def _full(self, value: bool, n: int) -> Array:
        some = next(iter(self.signals.values()), None)
        dtype = jnp.result_type(float) if some is None else some.dtype
        top = {"boolean": 1.0, "smooth": windows.NEVER}.get(self.kind, jnp.inf)
        return jnp.full((n,) + (1,) * self.lanes, top if value else -top, dtype)

    def _leaf(self, f: Formula, first: int, last: int) -> Array:
        start, stop = min(first, self._last), min(last, self._last)
        boolean = self.kind == "boolean"
        match fitted(f, self.units, sizes_of(self.signals, self.lanes)):
            case ast.Predicate(comparison, left, right):
                a, b = (self.expression(e, start, stop) for e in (left, right))
                value = compared(comparison, a, b, boolean, jnp)
            case ast.Atom(e):
                value = alone(self.expression(e, start, stop), e, self.truths)
                value = compared(">", value, 0.0, boolean, jnp)
            case several:
                value = self.value(several, start, stop)
        if f in self.nudges:
            value = value + self.nudges[f][start : stop + 1]
        return self._extended(value, last - first + 1)

    def expression(self, e: Term, start: int, stop: int) -> Array | float:
        """Compute an expression at the samples `start` to `stop` (a float if it is constant)."""
        match e:
            case Number(value):
                return value
            case Sampled():
                return self._sampled(e)[start : stop + 1]
            case Signal(name):
                signal = self.signals[name]
                check_scalar(e, signal.shape, self.lanes)
                return signal[start : stop + 1]
            case Component(Signal(name), index):
                return self._vector(name, f"{e}", index)[start : stop + 1, ..., index]
            case Arithmetic("norm", (argument,)):
                if not isinstance(argument, Signal):
                    raise TypeError(f"norm takes a vector signal; got norm({argument})")
                vector = self._vector(argument.name, f"{e}")[start : stop + 1]
                square = jnp.sum(vector * vector, axis=-1)
                # The gradient of a square root is infinite at 0, where that of the norm is not.
                safe = jnp.where(square == 0, 1.0, square)
                return jnp.where(square == 0, square, jnp.sqrt(safe))
            case Arithmetic():
                return self._arithmetic(e, start, stop)
        raise missing_case("the value", e)

    def _sampled(self, e: Sampled) -> Float[Array, "time *lanes"]:
        if e not in self._memo:
            boolean = replace(self, kind="boolean", nudges={}, _memo={}, _settled={})
            like = next(iter(self.signals.values()))
            like = jnp.ones((self.length,) + (1,) * self.lanes, like.dtype)
            period = self.dt / self.stride
            of = ArrayOperations(period, jnp, _apply, partial(lax.cummax, axis=0), like)
            value = e.computed(
                of, lambda f: held(boolean.value(f, 0, self._last), jnp),
                lambda part: like * self.expression(part, 0, self._last),
                lambda window: span_of(window, self.dt, self.stride),
            )  # fmt: skip
            if self.valid is not None:  # After the end it stays as it is.
                rows = jnp.minimum(self._index(0, value), self.valid - 1)
                shape = jnp.broadcast_shapes(rows.shape, value.shape)
                value = jnp.take_along_axis(
                    jnp.broadcast_to(value, shape), jnp.broadcast_to(rows, shape), axis=0
                )
            self._memo[e] = value
        return self._memo[e]

    def _arithmetic(self, e: Arithmetic, start: int, stop: int) -> Array | float:
        # In a loop: a sum of many terms leans to the left as deep as it is long.
        values: dict[int, Array | float] = {}
        stack: list[tuple[Term, bool]] = [(e, False)]
        while stack:
            part, ready = stack.pop()
            if not isinstance(part, Arithmetic) or part.name == "norm":
                values[id(part)] = self.expression(part, start, stop)
            elif ready:
                values[id(part)] = _apply(part.name, [values[id(a)] for a in part.arguments])
            elif id(part) not in values:
                stack.append((part, True))
                stack.extend((a, False) for a in reversed(part.arguments))
        return values[id(e)]

    def _vector(self, name: str, text: str, index: int = 0) -> Array:
        signal = self.signals[name]
        check_vector(name, signal.shape, self.lanes, text, index)
        return signal

    # Joining values

    def _join(self, values: list[Array], sign: int) -> Array:
        return windows.join(values, sign, self.tau if self.kind == "smooth" else None)

    @property
    def _nothing(self) -> float:
        """The value of a maximum over no sample."""
        return {"boolean": -1.0, "smooth": -windows.NEVER}.get(self.kind, -math.inf)

    def _extended(self, x: Array, n: int, sign: int = 1) -> Array:
        """Extend `x` to `n` instants: the last one repeated under `hold`, nothing otherwise."""
        if x.shape[0] >= n:
            return x
        shape = (n - x.shape[0], *x.shape[1:])
        tail = (
            jnp.broadcast_to(x[-1:], shape) if self._hold else jnp.full(shape, sign * self._nothing)
        )
        return jnp.concatenate([x, tail.astype(x.dtype)])

    def _cut(self, x: Array, first: int, sign: int = 1) -> Array:
        """Replace samples that do not count by nothing."""
        if self._hold or self.valid is None:
            return x
        return jnp.where(self._index(first, x) < self.valid, x, sign * self._nothing)

    # Temporal operators: maxima for sign 1, minima for sign -1

    def _future(self, f: Formula, sign: int, a: int, b: float, first: int, last: int) -> Array:
        end = self.settles(f)
        begin = first + a
        if begin > end and not self._hold:
            return self._blank(f, last - first + 1, sign)
        begin = min(begin, end)
        # Instants beyond this one see nothing but the settled value.
        count = max(1, min(last, end - a) - first + 1)
        stop = end if math.isinf(b) else min(first + count - 1 + int(b), end)
        x = self._cut(self.value(f, begin, stop), begin, sign)
        if count == 1:
            value = windows.extreme(x, sign, self._tau)[None]
        else:
            width = x.shape[0] if math.isinf(b) else int(b) - a + 1
            value = windows.windowed(x, width, sign, self._tau, reverse=True)[:count]
        return self._extended(value, last - first + 1, sign)

    def _past(self, f: Formula, sign: int, a: int, b: float, first: int, last: int) -> Array:
        n = last - first + 1
        if last < a:
            return self._blank(f, n, sign)
        begin = 0 if math.isinf(b) else max(0, first - int(b))
        x = self.value(f, begin, last - a)
        count = last - max(first, a) + 1
        if count == 1:
            start = 0 if math.isinf(b) else max(0, last - int(b)) - begin
            value = windows.extreme(x[start:], sign, self._tau)[None]
        else:
            width = x.shape[0] if math.isinf(b) else int(b) - a + 1
            value = windows.windowed(x, width, sign, self._tau, reverse=False)[-count:]
        if count == n:
            return value
        blank = jnp.full((n - count, *value.shape[1:]), sign * self._nothing, value.dtype)
        return jnp.concatenate([blank, value])

    def _next(self, f: Formula, first: int, last: int) -> Array:
        end = self._last if not self._hold else self.settles(f)
        x = self.value(f, min(first + self.stride, end), min(last + self.stride, end))
        if x.shape[0] < last - first + 1:
            # Repeats the last value, so that next stays its own dual.
            x = jnp.concatenate(
                [x, jnp.broadcast_to(x[-1:], (last - first + 1 - x.shape[0], *x.shape[1:]))]
            )
        if self._hold or self.valid is None:
            return x
        index = self._index(first, x)
        return jnp.where(index < self.valid - self.stride, x, self.value(f, first, last))

    def _index(self, first: int, x: Array) -> Array:
        return (first + jnp.arange(x.shape[0])).reshape((-1,) + (1,) * (x.ndim - 1))

    @property
    def _tau(self) -> Array | float | None:
        return self.tau if self.kind == "smooth" else None

    def _blank(self, f: Formula, n: int, sign: int = 1) -> Array:
        like = self.value(f, 0, 0)
        return jnp.full((n, *like.shape[1:]), sign * self._nothing, like.dtype)

    def _until(
        self, f: Formula, g: Formula, a: int, b: float, first: int, last: int
    ) -> Float[Array, "instants *lanes"]:
        # f U[a,b] g = G[0,a-1] f  &  X^a (F[0,b-a] g  &  f U g), exact for the half-open until
        # (Donze, Ferrere, Maler 2013, eq. 6 for the closed one).
        end = max(self.settles(f), self.settles(g))
        begin = first + a
        n = last - first + 1
        if not self._hold and begin > end:
            return self._blank(g, n)
        begin = min(begin, end)
        count = max(1, min(last, end - a) - first + 1)
        left = self.value(f, begin, end)
        right = self._cut(self.value(g, begin, end), begin)
        left, right = jnp.broadcast_arrays(left, right)
        if count == 1:
            value = windows.until_first(left, right, self._tau)[None]
        else:
            value = windows.until(left, right, self._tau)[:count]
        terms = []
        if math.isfinite(b):
            terms.append(self._extended(self._future(g, 1, a, b, first, first + count - 1), count))
        value = self._extended(value, n)
        terms = [self._extended(term, n) for term in terms]
        if a > 0:
            terms.append(self._future(f, -1, 0, a - 1, first, last))
        return self._join([value, *terms], -1) if terms else value

    def _since(
        self, f: Formula, g: Formula, a: int, b: float, first: int, last: int
    ) -> Float[Array, "instants *lanes"]:
        n = last - first + 1
        if last < a:
            return self._blank(g, n)
        left, right = (self.value(h, 0, last - a) for h in (f, g))
        left, right = jnp.broadcast_arrays(left, right)
        count = last - max(first, a) + 1
        value = windows.until(left, right, self._tau, reverse=False)[-count:]
        terms = [value]
        if math.isfinite(b):
            terms.append(self._past(g, 1, a, b, max(first, a), last))
        if a > 0:
            terms.append(self._past(f, -1, 0, a - 1, max(first, a), last))
        if len(terms) > 1:
            value = self._join(terms, -1)
        if count == n:
            return value
        blank = jnp.full((n - count, *value.shape[1:]), self._nothing, value.dtype)
        return jnp.concatenate([blank, value])


def _apply(name: str, values: list[Array | float]) -> Array | float:
    first, *others = values
    match name:
        case "neg":
            return -first
        case "+":
            return first + others[0]
        case "-":
            return first - others[0]
        case "*":
            return first * others[0]
        case "/":
            if isinstance(first, float) and isinstance(others[0], float):
                with np.errstate(all="ignore"):  # Python's own raises.
                    return float(np.divide(first, others[0]))
            return first / others[0]
        case "**":
            return _power(first, others[0])
        case "min" | "max":
            operation = jnp.minimum if name == "min" else jnp.maximum
            for other in others:
                first = operation(first, other)
            return first
    functions = {"abs": jnp.abs, "sqrt": jnp.sqrt, "sin": jnp.sin, "cos": jnp.cos, "exp": jnp.exp}
    return functions[name](first)


def _power(base: Array | float, exponent: Array | float) -> Array | float:
    """Compute a power; NaN for a fractional one of a negative number, like `sqrt`."""
    if not isinstance(exponent, float):
        return jnp.power(base, exponent)
    if isinstance(base, float):
        with np.errstate(all="ignore"):  # Python's own raises, or leaves the real numbers.
            return float(np.power(base, exponent))
    # By multiplication, whose derivative is finite for negative numbers and at zero too.
    return base ** int(exponent) if exponent.is_integer() else jnp.power(base, exponent)
