"""Formulas judged also between samples, where signals are held or interpolated linearly.

    dense_robustness("always[0, 4] x <= 2.4", trace)            # straight between samples
    dense_signal("eventually[0, 0.3] x > 0", trace, "hold")     # at every time

Ends of intervals may be any times. A value is the supremum or infimum over a closed window, which
the robustness at the samples alone does not bound.

Values are computed on `Piecewise` functions of time: linear between breakpoints, where they may
jump. Everything is exact up to rounding: breakpoints are added where two functions cross.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.monitoring.parametric import read_parametric
from verifai_jax.addons.monitoring.resampling import Method
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.expression import Arithmetic, Component, Duration, Number, Signal
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.host_values import FUNCTIONS, numbers
from verifai_jax.mtl.setting import check_trace
from verifai_jax.mtl.tree import missing_case, postorder

Values = Float[np.ndarray, " n"]
SNAP = 1e-9
"""Share of the shortest distance of samples within which two times are one: sums of decimals are
off by some units in the last place, and times that differ on purpose by far more."""


@dataclass(frozen=True)
class Piecewise:
    """A function on `[times[0], inf)`.

    - `times`: breakpoints in seconds.
    - `point`: the value at each breakpoint; `right` and `left`: the limits at the start and at the
      end of the piece that follows it. The last piece is constant and has no end.
    - `snap`: times that differ by less than this many seconds are equal.
    """

    times: Values
    point: Values
    right: Values
    left: Values
    snap: float = 0.0

    def map(self, function: Callable[..., Values], *others: "Piecewise") -> "Piecewise":
        """Apply a function to several functions with equal times; it must be linear in pieces."""
        with np.errstate(all="ignore"):
            point, right, left = (
                function(*(getattr(f, part) for f in (self, *others)))
                for part in ("point", "right", "left")
            )
        return Piecewise(self.times, point, right, left, self.snap)

    @property
    def steps(self) -> bool:
        """True if every piece is constant."""
        return bool(np.all((self.right == self.left) | np.isnan(self.right)))

    def index(self, times: Values, after: bool = False) -> np.ndarray:
        """Count the breakpoints before each time, including those at it if `after`."""
        return np.searchsorted(self.times, times + (self.snap if after else -self.snap), "right")

    def pieces(self, times: Values, shift: float = 0.0) -> tuple[Values, Values]:
        """Compute the limits at both ends of each piece between times, shifted by `shift`.

        No breakpoint may lie inside such a piece. Before its start the function is -inf.
        """
        gaps = np.append(np.diff(times), 1.0)
        k = self.index(times + gaps / 2 + shift, after=True) - 1
        right, left = (self._on_piece(k, at + shift) for at in (times, times + gaps))
        return np.where(k < 0, -np.inf, right), np.where(k < 0, -np.inf, left)

    def _on_piece(self, k: np.ndarray, at: Values) -> Values:
        k = np.maximum(k, 0)
        start, end = self.times[k], np.append(self.times[1:], np.inf)[k]
        right, left = self.right[k], self.left[k]
        with np.errstate(invalid="ignore"):
            share = np.where(np.isfinite(end), (at - start) / (end - start), 0.0)
            value = np.where(right == left, right, right + (left - right) * share)
            value = np.where(np.abs(at - start) <= self.snap, right, value)
            return np.where(np.abs(end - at) <= self.snap, left, value)

    def inside(self, times: Values) -> Values:
        """Compute the values at times inside pieces."""
        return self._on_piece(self.index(times, after=True) - 1, times)

    def __call__(self, times: Values) -> Values:
        """Compute the values at times that are no earlier than the first."""
        k = self.index(times, after=True) - 1
        at = np.abs(times - self.times[k]) <= self.snap
        return np.where(at, self.point[k], self._on_piece(k, times))

    def at(self, times: Values) -> "Piecewise":
        """Return the same function with more breakpoints, which must include its own."""
        return Piecewise(times, self(times), *self.pieces(times), self.snap)


def merged(times: Sequence[Values], snap: float) -> Values:
    """Return the times of all functions, each once."""
    ordered = np.sort(np.concatenate(times))
    return ordered[np.append(True, np.diff(ordered) > snap)]


def aligned(*functions: Piecewise, crossings: bool = False) -> tuple[Piecewise, ...]:
    """Return the functions on common breakpoints, including those where two of them cross."""
    snap = functions[0].snap
    times = merged([f.times for f in functions], snap)
    made = tuple(f.at(times) for f in functions)
    found = [
        _crossing(f, g) for k, f in enumerate(made) for g in made[:k] if crossings
    ]  # fmt: skip
    if any(len(each) for each in found):
        times = merged([times, *found], snap)
        made = tuple(f.at(times) for f in made)
    return made


def _crossing(f: Piecewise, g: Piecewise) -> Values:
    with np.errstate(all="ignore"):
        begin, end = (f.right - g.right)[:-1], (f.left - g.left)[:-1]
        after = begin / (begin - end) * (gaps := np.diff(f.times))
        # A crossing next to a breakpoint is that breakpoint.
        real = (begin * end < 0) & (after > f.snap) & (gaps - after > f.snap)
    return (f.times[:-1] + after)[real]


def joined(functions: Sequence[Piecewise], sign: int) -> Piecewise:
    """Return the maximum (minimum, for sign -1) of several functions."""
    best = np.maximum if sign > 0 else np.minimum
    result, *others = functions
    for other in others:
        one, two = aligned(result, other, crossings=True)
        result = one.map(best, two)
    return result


def window(
    f: Piecewise, low: float, high: float, sign: int, open_right: bool = False,
    open_left: bool = False,
) -> Piecewise:  # fmt: skip
    """Return the maximum (minimum) of `f` over `[t + low, t + high]`, at every `t`."""
    if sign < 0:
        negated = window(f.map(np.negative), low, high, 1, open_right, open_left)
        return negated.map(np.negative)
    start, snap = f.times[0], f.snap
    edges = [f.times - edge for edge in (low, high) if np.isfinite(edge)]
    times = merged([np.array([start]), *(edge[edge > start + snap] for edge in edges)], snap)
    before = np.append(-np.inf, f.left[:-1])
    highest = _Highest(np.maximum(np.maximum(f.point, f.right), before))
    # At a breakpoint: what is strictly inside, and what each edge sees.
    one, two = times + low, times + high
    first, last = f.index(one), f.index(two, after=True) - 1
    inside_first, inside_last = f.index(one, after=True), f.index(two) - 1
    point = highest(inside_first, inside_last)
    at_one, at_two = first < inside_first, last > inside_last
    begun = two >= start - snap
    if high > low:
        own = np.where(at_one, f.right[np.minimum(first, len(f.times) - 1)], f.inside(one))
        point = np.maximum(point, np.where(one >= start - snap, own, -np.inf))
        ends = np.where(at_two, f.left[np.maximum(last - 1, 0)], f.inside(two))
        before = np.where(at_two, last > 0, begun)
        point = np.maximum(point, np.where(before & begun, ends, -np.inf))
    for at, where, is_open in ((at_one, first, open_left), (at_two, last, open_right)):
        if not is_open:
            own = f.point[np.clip(where, 0, len(f.times) - 1)]
            point = np.where(at, np.maximum(point, own), point)
    if high == low:
        point = np.where(begun, np.where(at_one, point, f.inside(one)), -np.inf)
    # Between breakpoints: two edges that move along pieces, and what is between them.
    middle = times + np.append(np.diff(times), 1.0) / 2
    ends = [f.pieces(times, edge) for edge in (low, high) if np.isfinite(edge)]
    parts = [Piecewise(times, right, right, left, snap) for right, left in ends]
    still = highest(f.index(middle + low, after=True), f.index(middle + high) - 1)
    between = joined([*parts, Piecewise(times, still, still, still, snap)], 1)
    return _with_points(between, times, point)


class _Highest:
    """The greatest of the values from one index to another, both included; -inf for no values.

    A table of the extremes of 1, 2, 4, 8 ... neighbours.
    """

    def __init__(self, values: Values) -> None:
        self.rows = [values]
        while 2 ** len(self.rows) <= len(values):
            row, half = self.rows[-1], 2 ** (len(self.rows) - 1)
            self.rows.append(np.maximum(row[:-half], row[half:]))

    def __call__(self, first: np.ndarray, last: np.ndarray) -> Values:
        count = len(self.rows[0])
        first, last = np.clip(first, 0, count), np.clip(last, -1, count - 1)
        size = np.maximum(last - first + 1, 1)
        level = np.log2(size).astype(int)
        out = np.full(len(first), -np.inf)
        for k, row in enumerate(self.rows):
            mine = (level == k) & (last >= first)
            begin, end = first[mine], last[mine] - 2**k + 1
            out[mine] = np.maximum(row[begin], row[end])
        return out


def witnessed(f: Piecewise, g: Piecewise, ahead: bool) -> Piecewise:
    """Return `f` until `g` over the whole future (`ahead`), or `f` since `g` over the whole past.

    `f` must hold between now and the witness, but not at the witness.
    """
    f, g = aligned(f, g, crossings=True)
    n = len(f.times)
    far_g, near_g, near_f = (g.left, g.right, f.right) if ahead else (g.right, g.left, f.left)
    # The least of f between a time within a piece and its far end, and the best from there on.
    lowest = np.minimum(f.right, f.left)
    best, point = np.empty(n), np.empty(n)
    now = -np.inf
    for k in range(n - 1, -1, -1) if ahead else range(n):
        if not ahead:
            now = point[k] = max(g.point[k], min(f.point[k], now))
        best[k] = max(far_g[k], now)
        now = max(min(near_g[k], near_f[k]), min(lowest[k], best[k]))
        if ahead:
            now = point[k] = max(g.point[k], min(f.point[k], now))
    sides = (lowest, f.left) if ahead else (f.right, lowest)
    kept = Piecewise(f.times, point, *sides, f.snap)
    far = joined([kept, Piecewise(g.times, best, best, best, g.snap)], -1)
    return _with_points(joined([g, far], 1), g.times, point)


def _with_points(f: Piecewise, times: Values, point: Values) -> Piecewise:
    values = np.array(f.right)
    values[np.searchsorted(f.times, times)] = point
    return Piecewise(f.times, values, f.right, f.left, f.snap)


STEP = 1e-6
"""Share of a parameter by which it is moved for a slope: far above rounding, and far below the
distance of kinks."""


def dense_robustness(formula: Formula | str, trace: Trace, method: Method = "linear") -> float:
    """Compute the robustness at the first sample, including the time between samples.

    **Arguments:**
    - `trace`: a trace with any sample times; its last sample is held for ever.
    - `method`: how signals continue between samples: `"linear"`, or `"hold"` for the earlier value.
    **Raises:** `ValueError` for a NaN, for operators that count samples, and for expressions of
    linearly interpolated signals that are not piecewise linear, such as `x * y` or `sin(x)`.
    """
    return float(dense_signal(formula, trace, method).point[0])


def dense_gradient(
    formula: str, trace: Trace, values: Mapping[str, float], method: Method = "linear"
) -> dict[str, float]:
    """Compute the derivative of the robustness by each parameter `?name`, also in interval ends.

    Between samples the robustness is piecewise linear in the ends of intervals, so a difference
    quotient is the derivative; at a kink it is the mean of both sides.

    **Arguments:**
    - `formula`: its text, as in `mine`.
    - `values`: the values of all parameters.
    """
    template = read_parametric(formula)
    slopes: dict[str, float] = {}
    for name in template.names:
        near = STEP * max(1.0, abs(values[name]))
        low = values[name] - near
        if name in template.times:
            low = max(low, 0.0)
        sides = low, values[name] + near
        first, last = (
            dense_robustness(template.formula({**values, name: side}), trace, method)
            for side in sides
        )
        slopes[name] = (last - first) / (sides[1] - sides[0])
    return slopes


def dense_signal(formula: Formula | str, trace: Trace, method: Method = "linear") -> Piecewise:
    """Compute the robustness at every time; see `dense_robustness`.

    **Returns:** a function of the seconds since the first sample, with its breakpoints.
    """
    check_trace(trace)
    formula = parse(formula) if isinstance(formula, str) else formula
    trace = trace.trim()
    if trace.times is None:
        assert trace.dt is not None
        times = np.arange(trace.length) * trace.dt
    else:
        clock = np.asarray(trace.times, float)
        times = clock - clock[0]
    snap = SNAP * float(np.min(np.diff(times), initial=math.inf)) if len(times) > 1 else SNAP
    values = _Dense(trace, times, method, snap)
    made: dict[int, Piecewise] = {}
    for part in postorder(formula):
        if isinstance(part, Formula):
            made[id(part)] = values.formula(part, [made[id(p)] for p in part.valued()])
    return made[id(formula)]


class _Dense:
    def __init__(self, trace: Trace, times: np.ndarray, method: Method, snap: float) -> None:
        self.trace = trace
        self.times = times
        self.method = method
        self.snap = snap

    def constant(self, value: float) -> Piecewise:
        one = np.full(1, value)
        return Piecewise(self.times[:1], one, one, one, self.snap)

    def formula(self, f: Formula, below: list[Piecewise]) -> Piecewise:
        match f:
            case ast.Constant(value):
                return self.constant(math.inf if value else -math.inf)
            case ast.Leaf():
                return self.leaf(f)
            case ast.Not():
                return below[0].map(np.negative)
            case ast.Join():
                return joined(below, f.sign)
            case ast.Window(_, i) if f.side == "ahead":
                return window(below[0], i.start, i.end, f.sign)
            case ast.Window(_, i):
                return window(below[0], -i.end, -i.start, f.sign)
            case ast.Witness():
                return self.witness(f, *below)
            case ast.Derived():
                return below[0]
            case ast.Next() | ast.Prev():
                raise ValueError(
                    f"{f} counts samples, and between samples there are none: give a time, as in "
                    "eventually[0, 0.1] or once[0, 0.1]"
                )
        raise missing_case("the robustness in dense time", f)

    def witness(self, f: ast.Witness, left: Piecewise, right: Piecewise) -> Piecewise:
        # p U[a,b] q = p throughout [0,a), and at a (F[0,b-a] q & p U q); since is its mirror image.
        ahead, i = f.side == "ahead", f.interval
        value = witnessed(left, right, ahead)
        width = i.end - i.start
        if math.isfinite(width):
            near = window(right, 0.0 if ahead else -width, width if ahead else 0.0, 1)
            value = joined([value, near], -1)
        if i.start == 0:
            return value
        shift = i.start if ahead else -i.start
        later = window(value, shift, shift, 1)
        span = min(0.0, shift), max(0.0, shift)
        kept = window(left, *span, -1, open_right=ahead, open_left=not ahead)
        return joined([kept, later], -1)

    def leaf(self, f: Formula) -> Piecewise:
        if f.compared is None:
            return self.expression(f.terms()[0])
        left, comparison, right = f.compared
        if comparison in ("<", "<="):
            left, right = right, left
        margin = self.apply("-", [self.expression(left), self.expression(right)], f)
        if comparison not in ("==", "!="):
            return margin
        distance = self.apply("abs", [margin], f)
        return distance.map(np.negative) if comparison == "==" else distance

    def expression(self, e: Term) -> Piecewise:
        values: dict[int, Piecewise] = {}
        for part in postorder(e):
            match part:
                case Number(value):
                    values[id(part)] = self.constant(value)
                case Duration():
                    raise ValueError(
                        f"{part} counts samples, and between samples there are none: judge it by "
                        "robustness"
                    )
                case Signal(name):
                    own = self.trace[name]
                    if own.ndim == 1:  # A vector is read by its component or norm.
                        truth = own.dtype == bool  # It has no values between.
                        values[id(part)] = self.samples(name, numbers(own), hold=truth)
                case Component(Signal(name), index):
                    values[id(part)] = self.samples(name, numbers(self.trace[name])[:, index])
                case Arithmetic("norm", (Signal(name),)):
                    square = np.sum(numbers(self.trace[name]) ** 2, axis=-1)
                    held = self.samples(name, np.sqrt(square), hold=True)
                    values[id(part)] = self.apply("norm", [held], part)
                case Arithmetic(name, arguments):
                    values[id(part)] = self.apply(name, [values[id(a)] for a in arguments], part)
                case _:
                    raise missing_case("the value in dense time", part)
        return values[id(e)]

    def samples(self, name: str, values: np.ndarray, hold: bool = False) -> Piecewise:
        if np.isnan(values).any():
            raise ValueError(f"no verdict: signal {name!r} is NaN")
        after = values if hold or self.method == "hold" else np.append(values[1:], values[-1:])
        return Piecewise(self.times, values, values, after, self.snap)

    def apply(self, name: str, operands: list[Piecewise], whole: Term | Formula) -> Piecewise:
        if name in ("min", "max"):
            return joined(operands, 1 if name == "max" else -1)
        if name == "abs":
            return joined([operands[0], operands[0].map(np.negative)], 1)
        function: Callable[..., np.ndarray] = FUNCTIONS[name] if name != "norm" else np.positive
        operands = list(aligned(*operands))
        held = [f.steps for f in operands]
        straight = name in ("+", "-", "neg") or (name == "*" and any(held))
        straight = straight or (name == "/" and held[-1])
        if not (straight or all(held)) or (name == "norm" and self.method != "hold"):
            raise ValueError(
                f"{whole} is not straight between samples: judge it with method='hold', or record "
                "it as a signal of its own"
            )
        return operands[0].map(function, *operands[1:])
