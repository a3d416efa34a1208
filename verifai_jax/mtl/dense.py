"""Formulas judged between the samples, too, where signals are held or go straight on.

    dense_robustness("always[0, 4] x <= 2.4", trace)            # straight between samples
    dense_signal("eventually[0, 0.3] x > 0", trace, "hold")     # at every time

Times of intervals are any numbers. A value is the greatest or least that is approached within a
window, whose ends belong to it, so the robustness at the samples alone is no guarantee of it.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from verifai_jax.core.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.expression import Arithmetic, Component, Duration, Number, Signal
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.host_values import FUNCTIONS, numbers
from verifai_jax.mtl.parametric import read_parametric
from verifai_jax.mtl.piecewise import SNAP, Piecewise, aligned, joined, window, witnessed
from verifai_jax.mtl.resampling import Method
from verifai_jax.mtl.setting import check_trace
from verifai_jax.mtl.tree import missing_case, postorder

STEP = 1e-6
"""Share of a parameter by which it is moved for a slope: far above rounding, and far below the
distance of kinks."""


def dense_robustness(formula: Formula | str, trace: Trace, method: Method = "linear") -> float:
    """Compute the robustness at the first sample, with all that is between the samples.

    **Arguments:**

    - `trace`: with samples at any times; its last ones are held for ever.
    - `method`: what a signal is between two samples: `"linear"`, or `"hold"` for its last sample.

    **Raises:** `ValueError` for a NaN, for operators that count samples, and for expressions such
    as `x * y` or `sin(x)` of signals that are not held, which are not straight between samples.
    """
    return float(dense_signal(formula, trace, method).point[0])


def dense_gradient(
    formula: str, trace: Trace, values: Mapping[str, float], method: Method = "linear"
) -> dict[str, float]:
    """Compute the slope of the robustness in each parameter `?name`, ends of intervals included.

    Between samples the robustness is piecewise linear in times, which it is not at the samples, so
    a quotient of differences is the slope; where it has a kink, the mean of both sides.

    **Arguments:**

    - `formula`: its text, as for `mine`.
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
