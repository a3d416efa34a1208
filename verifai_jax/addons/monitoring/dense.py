"""Formulas judged also between samples, where signals are held or interpolated linearly.

    dense_robustness("always[0, 4] x <= 2.4", trace)            # straight between samples
    dense_signal("eventually[0, 0.3] x > 0", trace, "hold")     # at every time

Ends of intervals may be any times. A value is the supremum or infimum over a closed window, which
the robustness at the samples alone does not bound.

Values are computed on functions of `piecewise`, exact up to rounding.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from verifai_jax.addons.monitoring import resampling
from verifai_jax.addons.monitoring.parametric import read_parametric
from verifai_jax.addons.monitoring.piecewise import (
    Piecewise,
    Values,
    aligned,
    joined,
    window,
    witnessed,
)
from verifai_jax.addons.monitoring.resampling import Method, gaps, hold_note
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import Arithmetic, Component, Number, Signal
from verifai_jax.mtl.fitting import fitted, sizes_of
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.host_values import FUNCTIONS, numbers
from verifai_jax.mtl.sampled import Sampled
from verifai_jax.mtl.semantics import alone
from verifai_jax.mtl.setting import as_formula, check_trace, resolution_of
from verifai_jax.mtl.tree import missing_case, postorder

SNAP = 1e-9
"""Share of the usual distance of samples within which two times are one: sums of decimals are
off by some units in the last place, and times that differ on purpose by far more."""
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
        low = 0.0 if name in template.times else -math.inf
        sides = max(values[name] - near, low), values[name] + near
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
    values = DenseValues(trace, method)
    for name, signal in values.trace.signals.items():
        if gaps(np.asarray(signal)).any() and name in as_formula(formula).signals():
            raise ValueError(f"no verdict: signal {name!r} is NaN")
    return values(as_formula(formula))


class NotDense(ValueError):
    """An error for a formula that has no meaning between samples."""


class DenseValues:
    """The values of formulas at every time on one trace, common parts computed once.

    With `method="hold"` a signal keeps its last value in gaps; with `"linear"` values are NaN where
    they depend on a gap.
    """

    def __init__(self, trace: Trace, method: Method) -> None:
        self.trace = trace = resampling.recorded_samples(trace)
        self.clock = np.asarray(trace.clock())
        resampling.check_increasing(self.clock)
        self.times = self.clock - self.clock[0]
        self.method = method
        steps = np.diff(self.times)
        self.snap = SNAP
        if len(steps):
            # Stamps are rounded, the more so the longer ago their clock began.
            rounding = 0.0 if trace.times is None else 2 * resolution_of(np.asarray(trace.times))
            near = max(SNAP * float(np.median(steps)), rounding)
            self.snap = min(near, float(steps.min()) / 4)
        self._known: dict[tuple[Formula, bool], Piecewise] = {}

    def __call__(self, formula: Formula, boolean: bool = False) -> Piecewise:
        """Compute the robustness, or above zero where it holds and below where not."""
        for part in postorder(formula):
            if isinstance(part, Formula) and (part, boolean) not in self._known:
                below = [self._known[p, boolean] for p in part.valued()]
                value = self.formula(part, below)
                if boolean and isinstance(part, ast.Leaf):
                    value = self.truth(part, value)
                self._known[part, boolean] = value
        return self._known[formula, boolean]

    def truth(self, f: Formula, margin: Piecewise) -> Piecewise:
        """Return 1 where a predicate holds and -1 where not."""
        at_zero = f.compared is not None and f.compared[1] in (">=", "<=", "==")
        margin, _ = aligned(margin, self.constant(0.0), crossings=True)

        def sign(x: Values) -> Values:
            holds = (x > 0) | (at_zero & (x == 0))
            return np.where(np.isnan(x), x, np.where(holds, 1.0, -1.0))

        with np.errstate(invalid="ignore"):
            steady = margin.right == margin.left
            inside = sign(np.where(steady, margin.right, (margin.right + margin.left) / 2))
        return Piecewise(margin.times, sign(margin.point), inside, inside, self.snap)

    def first(self, formula: Formula, boolean: bool = False) -> float:
        """Compute the value at the first sample."""
        return float(self(formula, boolean)(np.zeros(1))[0])

    def decision(self, formula: Formula) -> tuple[Formula, float, float] | None:
        """Return the predicate that decides the robustness, its margin then, and the sample time.

        A time between samples is returned where signals are straight. None if none decides.
        """
        t = 0.0
        while not isinstance(formula, ast.Leaf):
            wanted = float(self(formula)(np.array([t]))[0])
            wanted = -wanted if isinstance(formula, ast.Not) else wanted
            options = self._operands(formula, t)
            if not math.isfinite(wanted) or not options:
                return None
            found = [(abs(values - wanted), part, times) for part, times, values in options]
            away, part, times = min(found, key=lambda each: float(np.nanmin(each[0])))
            formula, t = part, float(times[int(np.nanargmin(away))])
        if not formula.is_predicate:
            return None
        sample = int(np.searchsorted(self.times, t + self.snap, "right")) - 1
        now = self.times[sample] if self.method == "hold" else min(t, self.times[-1])
        # The sample's own time, without a rounding.
        when = self.clock[sample] + (now - self.times[sample])
        return formula, float(self(formula)(np.array([now]))[0]), float(when)

    def _operands(self, f: Formula, t: float) -> list[tuple[Formula, Values, Values]]:
        """Return operands with the times at which one may decide, and what it gives there."""
        if not isinstance(f, ast.Window | ast.Witness):
            now = np.array([t])
            return [(part, now, self(part)(now)) for part in f.valued()]
        ends = (f.interval.start, f.interval.end)
        low, high = (t + e for e in ends) if f.side == "ahead" else (t - e for e in ends[::-1])
        if isinstance(f, ast.Window):
            times = self._between(low, high, f.operand)
            return [(f.operand, times, self(f.operand)(times))] if len(times) else []
        kept, found = f.valued()
        times = self._between(*((t, high) if f.side == "ahead" else (low, t)), kept, found)
        times = times if f.side == "ahead" else times[::-1]
        left, right = self(kept)(times), self(found)(times)
        # The least of `kept` from now to each time, which does not count itself.
        so_far = np.minimum.accumulate(np.append(np.inf, left[:-1]))
        # Within a piece there are times between a time and the end of the piece.
        so_far[1::2] = np.minimum(so_far, left)[1::2]
        due = (times >= low - self.snap) & (times <= high + self.snap)
        if not due.any():
            return []
        k = int(np.argmax(np.where(due, np.minimum(right, so_far), -np.inf)))
        if right[k] <= so_far[k]:
            return [(found, times[[k]], right[[k]])]
        return [(kept, times[: k + k % 2], left[: k + k % 2])]

    def _between(self, low: float, high: float, *parts: Formula) -> Values:
        """Return breakpoints of formulas in a window, its ends, and a time between each two."""
        last = max(float(self(part).times[-1]) for part in parts) + 1.0
        low, high = max(low, 0.0), min(high, max(last, low))
        own = np.concatenate([[low, high], *(self(part).times for part in parts)])
        own = np.unique(own[(own >= low) & (own <= high)]) if low <= high else own[:0]
        return np.sort(np.concatenate([own, (own[:-1] + own[1:]) / 2]))

    def held(self, formula: Formula) -> list[str]:
        """Return notes on signals of a formula whose values are held in gaps."""
        names = formula.signals() if self.method == "hold" else ()
        missing = {name: gaps(np.asarray(self.trace.signals[name])) for name in names}
        return [hold_note(name, rows) for name, rows in missing.items() if rows.any()]

    def constant(self, value: float) -> Piecewise:
        one = np.full(1, value)
        return Piecewise(self.times[:1], one, one, one, self.snap)

    def formula(self, f: Formula, below: list[Piecewise]) -> Piecewise:
        if f.side and f.operator.timed and not f.interval.closed:
            raise NotDense(
                f"{f} leaves out an end of its interval, which is a sample: judge it by robustness"
            )
        match f:
            case ast.Constant(value):
                return self.constant(math.inf if value else -math.inf)
            case ast.Leaf():
                return self.leaf(f)
            case ast.Not():
                return below[0].map(np.negative)
            case ast.Join():
                return joined(below, f.sign)
            case ast.Window(_, i):
                low, high = (i.start, i.end) if f.side == "ahead" else (-i.end, -i.start)
                return window(below[0], low, high, f.sign)
            case ast.Witness():
                return self.witness(f, *below)
            case ast.Derived():
                return below[0]
            case ast.Next() | ast.Prev():
                raise NotDense(
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
        fit = fitted(f, self.trace.units, sizes_of(self.trace.signals))
        return self.predicate(f) if fit is f else self(fit)

    def predicate(self, f: Formula) -> Piecewise:
        if f.compared is None:
            (e,) = f.terms()
            truths = set(filter(self.trace.is_truth, e.signals()))
            return self.expression(e).map(lambda values: alone(values, e, truths))
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
                case Sampled():
                    raise NotDense(
                        f"{part} is about samples, and between samples there are none: judge it by "
                        "robustness"
                    )
                case Signal(name):
                    if self.trace[name].ndim == 1:  # A vector is read by its component or norm.
                        values[id(part)] = self.samples(name, numbers(self.trace[name]))
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
        # A truth value has no values between.
        hold = hold or self.method == "hold" or self.trace.is_truth(name)
        values = resampling.held(values) if hold else values
        after = values if hold else np.append(values[1:], values[-1:])
        return Piecewise(self.times, values, values, after, self.snap)

    def apply(self, name: str, operands: list[Piecewise], whole: Term | Formula) -> Piecewise:
        if name in ("min", "max"):
            return joined(operands, 1 if name == "max" else -1)
        if name == "abs":
            return joined([operands[0], operands[0].map(np.negative)], 1)
        function: Callable[..., np.ndarray] = FUNCTIONS[name] if name != "norm" else np.positive
        operands = list(aligned(*operands))
        held = [f.steps for f in operands]
        straight = {"+": True, "-": True, "neg": True, "*": any(held), "/": held[-1]}.get(name)
        if not (straight or all(held)) or (name == "norm" and self.method != "hold"):
            raise NotDense(
                f"{whole} is not straight between samples: judge it with method='hold', or record "
                "it as a signal of its own"
            )
        return operands[0].map(function, *operands[1:])
