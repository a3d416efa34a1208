"""Functions of one or two numbers, on sets: their range, and a linear enclosure.

A function f of one number is enclosed by `slope * x + offset +- error`. The slope is that of the
secant, and the range of `f(x) - slope * x` is exact: its extremes are at the ends, or where the
derivative of f equals the slope, for which each function has a formula. Rounding of such a point
causes only a quadratic error, which the widening of results covers.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from verifai_jax.addons.verification.sets import form as affine
from verifai_jax.addons.verification.sets.form import SLACK, Form, Reals, rounded, rounding
from verifai_jax.addons.verification.sets.layers import summed

Criticals = Callable[[Reals, Reals, Reals], Sequence[Reals]]
"""A function `(slope, low, high)` to points between which `f(x) - slope * x` is monotone."""
UNITS = 16.0
"""Error of XLA's elementary functions in units of rounding, relative to their result: twice what
was measured on a CPU at two million numbers of all sizes and with several options of XLA, which is
6.6; 16 of `cbrt`, 25 of `sinh` and `cosh`, 68 of `exp2`."""
TINY = 16.0
"""Absolute error, in smallest normal numbers: twice what was measured, except for `cbrt`."""
PERIODIC = 1e5
"""Greatest argument of sines for which their results are bounded by more than their range: there
the argument itself has a rounding of a hundredth."""


class Function(NamedTuple):
    """A function of one number: its `value` in double precision.

    - `criticals`: where its derivative equals a slope.
    - `domain`: the interval outside of which it is NaN.
    - `units`, `tiny`: its error in units of rounding, and of the smallest normal number.
    - `range`: an interval that contains all results, including rounding.
    - `rises`: whether it rises, so that its extremes are at the ends of intervals.
    """

    value: Callable[[Reals], Reals]
    criticals: Criticals
    domain: tuple[float, float] = (-np.inf, np.inf)
    units: float = UNITS
    tiny: float = TINY
    range: tuple[float, float] = (-np.inf, np.inf)
    rises: bool = False

    def __call__(self, x: Form) -> Form:
        """Return the set of its values on a set."""
        (low, high), (first, last), spread = x.bounds(), self.domain, x.spread
        wide, outside, points = high - low, np.zeros(1, bool), [low, high]
        # Nothing is an exception where all is within the domain, and as wide as some number.
        plain = affine.least(wide) > 0 and affine.greatest(spread) < np.inf
        if np.isfinite(first) or np.isfinite(last):
            plain = plain and affine.least(low) >= first and affine.greatest(high) <= last
            points = points if plain else [np.clip(low, first, last), np.clip(high, first, last)]
        values = [self.value(point) for point in points]
        slope = (values[1] - values[0]) / (wide if plain else points[1] - points[0])
        plain = plain and bool(np.isfinite(np.add.reduce(slope, axis=None)))
        if not plain:
            outside = affine.unknown(low, high) | (low > high) | (low < first) | (high > last)
            slope = np.where(np.isfinite(slope), slope, 0.0)
        lowest, highest = values
        if not self.rises:
            turns = self._points(np.zeros(1), *points)
            lowest, highest = _extremes([*values, *(self.value(point) for point in turns)])
        inner = self._points(slope, *points)
        points, values = points + inner, values + [self.value(point) for point in inner]
        below, above = _extremes([v - slope * p for v, p in zip(values, points, strict=True)])
        size = highest if self.range[0] >= 0 else np.maximum(np.abs(lowest), np.abs(highest))
        offset, error, radius = (below + above) / 2, (above - below) / 2, x.radius
        if not plain:
            usable = np.isfinite(offset) & np.isfinite(spread) & ~outside
            kept, error = (slope, offset, radius, spread), np.where(usable, error, np.inf)
            slope, offset, radius, spread = (np.where(usable, a, 0.0) for a in kept)
        # Numbers of double precision between which the slope and the offset are rounded.
        steep = np.abs(slope)
        margin = np.abs(offset) + steep * (spread + np.abs(x.centre))
        slopes = None if x.slopes is None else x.slopes * slope
        form = rounded(
            slope * x.centre + offset, slopes, steep * radius + error + 4 * SLACK * margin, size,
            x.dtype, (lowest, highest), x.frame, self.units, not self.units, 1 + self.tiny,
        )  # fmt: skip
        if self.units and form.low is not None and form.high is not None:
            lowest, highest = self.range
            form.low, form.high = np.maximum(form.low, lowest), np.minimum(form.high, highest)
        form.common = x.common and summed(form.radius, [(x, slope)])
        return form if plain else _but(form, ~outside)

    def _points(self, slope: Reals, low: Reals, high: Reals) -> list[Reals]:
        # Of a number and NaN `fmax` is the number.
        return [np.minimum(np.fmax(x, low), high) for x in self.criticals(slope, low, high)]


def _extremes(values: Sequence[Reals]) -> tuple[Reals, Reals]:
    lowest, highest = values[0], values[0]
    for value in values[1:]:
        lowest, highest = np.minimum(lowest, value), np.maximum(highest, value)
    return lowest, highest


def _even(magnitude: Callable[[Reals], Reals]) -> Criticals:
    """Return points at both signs of a magnitude that depends on the slope."""
    return lambda slope, low, high: (at := magnitude(slope), -at)


def _single(at: Callable[[Reals], Reals]) -> Criticals:
    return lambda slope, low, high: (at(slope),)


def _periodic(at: Callable[[Reals], Reals], period: float) -> Criticals:
    """Return the points of both signs that an interval of one period may touch."""

    def criticals(slope: Reals, low: Reals, high: Reals) -> Sequence[Reals]:
        base, middle = at(slope), low / 2 + high / 2
        return [each + period * np.round((middle - each) / period) for each in (base, -base)]

    return criticals


def _sine(value: Callable[[Reals], Reals], criticals: Criticals) -> Callable[[Form], Form]:
    function = Function(value, criticals, range=(-1.0, 1.0))

    def enclosed(x: Form) -> Form:
        low, high = x.bounds()
        wide = ~((high - low < np.pi) & (np.abs(low) < PERIODIC) & (np.abs(high) < PERIODIC))
        form = function(x)
        if not np.any(wide):
            return form
        end = np.where(np.isfinite(low) & np.isfinite(high), 1.0, np.inf)
        return affine.chosen([~wide, wide], [form, Form.between(-end, end, x.dtype)])

    return enclosed


def _whole(value: Callable[[Reals], Reals]) -> Callable[[Form], Form]:
    """Return a function that is constant by pieces and does not fall, such as `floor`."""

    def enclosed(x: Form) -> Form:
        low, high = x.bounds()
        nothing = affine.unknown(low, high)
        ends = np.where(nothing, low, value(low)), np.where(nothing, high, value(high))
        return Form.between(*ends, x.dtype)

    return enclosed


def _tangent(x: Form) -> Form:
    low, high = x.bounds()
    branch = np.round((low / 2 + high / 2) / np.pi)
    edge = np.pi / 2 - 1e-6
    whole = (low > branch * np.pi - edge) & (high < branch * np.pi + edge)
    return _but(_TAN(x), whole & (np.maximum(np.abs(low), np.abs(high)) < PERIODIC))


def _but(form: Form, unless: np.ndarray) -> Form:
    """Return a result that is everything, unless its operands are as they should be."""
    form.forget(np.broadcast_to(~unless, form.centre.shape))
    return form


def _reciprocal(x: Form) -> Form:
    """Return `1 / x` of numbers of one sign; everything for those that may be zero."""
    low, high = x.bounds()
    return _but(_RECIPROCAL(x), (low > 0) | (high < 0))


_ROOT_PI = np.sqrt(np.pi)
_TAN = Function(np.tan, _periodic(lambda a: np.arccos(1 / np.sqrt(a)), np.pi))
_RECIPROCAL = Function(lambda x: 1 / x, _even(lambda a: np.sqrt(-1 / a)), units=4.0)
_POSITIVE = (0.0, np.inf)
_RSQRT = Function(
    lambda x: 1 / np.sqrt(x), _single(lambda a: (-2 * a) ** (-2 / 3)), _POSITIVE, range=_POSITIVE
)


@cache
def _of_power(n: int) -> Function:
    criticals = _even(lambda slope: np.abs(slope / n) ** (1 / (n - 1)))
    even = _POSITIVE if n % 2 == 0 else (-np.inf, np.inf)
    # It is computed by multiplications, one after another.
    return Function(lambda x: x**n, criticals, units=2.0 * n, range=even)


FUNCTIONS: dict[str, Callable[[Form], Form]] = {
    "exp": Function(np.exp, _single(np.log), range=_POSITIVE, rises=True),
    "exp2": Function(np.exp2, _single(lambda a: np.log2(a / np.log(2))), units=140.0,
                     range=_POSITIVE),
    "expm1": Function(np.expm1, _single(np.log), range=(-1.0, np.inf)),
    "log": Function(np.log, _single(lambda a: 1 / a), _POSITIVE, rises=True),
    "log1p": Function(np.log1p, _single(lambda a: 1 / a - 1), (-1.0, np.inf)),
    "sqrt": Function(np.sqrt, _single(lambda a: 1 / (4 * a * a)), _POSITIVE, range=_POSITIVE),
    # Of zero, which may be a negative one, it is an infinity of either sign.
    "rsqrt": lambda x: _but(_RSQRT(x), x.bounds()[0] > 0),
    # Of numbers that are not normal it has the size of the root of the smallest that is.
    "cbrt": Function(np.cbrt, _even(lambda a: (3 * a) ** -1.5), units=40.0, tiny=1e26),
    "tanh": Function(np.tanh, _even(lambda a: np.arccosh(1 / np.sqrt(a))), range=(-1.0, 1.0),
                     rises=True),
    "logistic": Function(special.expit, _even(lambda a: special.logit(a / (
        0.5 + np.sqrt(np.maximum(0.25 - a, 0))
    ))), range=(0.0, 1.0), rises=True),
    "sinh": Function(np.sinh, _even(np.arccosh), units=60.0),
    "cosh": Function(np.cosh, _single(np.arcsinh), units=60.0, range=(1.0, np.inf)),
    "asinh": Function(np.arcsinh, _even(lambda a: np.sqrt(1 / a**2 - 1))),
    "acosh": Function(np.arccosh, _single(lambda a: np.sqrt(1 / a**2 + 1)), (1.0, np.inf)),
    "atanh": Function(np.arctanh, _even(lambda a: np.sqrt(1 - 1 / a)), (-1.0, 1.0)),
    "asin": Function(np.arcsin, _even(lambda a: np.sqrt(1 - 1 / a**2)), (-1.0, 1.0)),
    "acos": Function(np.arccos, _even(lambda a: np.sqrt(1 - 1 / a**2)), (-1.0, 1.0)),
    "atan": Function(np.arctan, _even(lambda a: np.sqrt(1 / a - 1)), rises=True),
    "erf": Function(special.erf, _even(lambda a: np.sqrt(-np.log(a * _ROOT_PI / 2))), rises=True),
    "erfc": Function(special.erfc, _even(lambda a: np.sqrt(-np.log(-a * _ROOT_PI / 2)))),
    "abs": Function(np.abs, _single(np.zeros_like), units=0.0, range=_POSITIVE),
    "square": _of_power(2),
    "sin": _sine(np.sin, _periodic(np.arccos, 2 * np.pi)),
    "cos": _sine(np.cos, lambda a, low, high: [
        x - np.pi / 2 for x in _periodic(np.arccos, 2 * np.pi)(a, low + np.pi / 2, high + np.pi / 2)
    ]),
    "tan": _tangent,
    "floor": _whole(np.floor), "ceil": _whole(np.ceil), "sign": _whole(np.sign),
    "neg": affine.negative,
}  # fmt: skip
"""Functions of one number, by the name of JAX's primitive."""


def _above(knot: Any) -> Function:
    """Return the maximum with a number."""
    return Function(lambda x: np.maximum(x, knot), lambda *_: [knot], units=0.0, rises=True)


_RAMP = _above(0.0)._replace(range=_POSITIVE)


def nearest(x: Form, to_even: bool) -> Form:
    """Return numbers rounded to integers, halves to even integers or away from zero."""
    if to_even:
        return _whole(np.round)(x)
    return _whole(lambda a: np.sign(a) * np.floor(np.abs(a) + 0.5))(x)


def integer_power(x: Form, n: int) -> Form:
    """Return `x ** n`."""
    if n == 0:
        return Form.constant(np.ones(x.shape), x.dtype)
    if n < 0:
        return _reciprocal(integer_power(x, -n))
    return x.of_type(x.dtype) if n == 1 else _of_power(n)(x)


def quotient(a: Form, b: Form) -> Form:
    """Return `a / b`; unbounded if `b` may be zero."""
    if affine.is_point(b) and np.all((b.centre != 0) & np.isfinite(b.centre)):
        inverse = 1 / b.centre
        if np.isfinite(inverse).all():
            return _widened(affine.scaled(a, inverse), 3.0)
    return _widened(affine.product(a, _reciprocal(b)), 3.0)


def _widened(x: Form, units: float) -> Form:
    """Widen a result by more units of rounding: XLA may divide by multiplying."""
    margin = rounding(x.dtype).unit * units
    x.radius = x.radius + margin * x.size
    if x.common is not None:
        x.common = x.common._replace(own=x.common.own + margin * x.size)
    if x.low is not None and x.high is not None:
        x.low, x.high = x.low - margin * np.abs(x.low), x.high + margin * np.abs(x.high)
    return x


def greater(a: Form, b: Form) -> Form:
    """Return the maximum: `b + max(a - b, 0)`, which preserves common dependencies."""
    for one, other in ((a, b), (b, a)):
        if affine.is_point(other) and one.slopes is not None and np.isfinite(other.centre).all():
            return _above(other.centre)(one)
    (low, high), (first, last) = a.bounds(), b.bounds()
    nothing = affine.unknown(low, high) | affine.unknown(first, last)
    ours, theirs = (low >= last) & ~nothing, (first >= high) & ~nothing
    lowest, top = np.maximum(low, first), np.maximum(high, last)
    ends = np.where(nothing, -np.inf, lowest), np.where(nothing, np.inf, top)
    if a.slopes is None and b.slopes is None:
        return Form.between(*ends, a.dtype)
    ramp = affine.add(b, _RAMP(difference(a, b)))
    size = np.maximum(np.abs(ends[0]), np.abs(ends[1]))
    both = rounded(
        ramp.centre, ramp.slopes, ramp.radius, np.broadcast_to(size, ramp.size.shape),
        a.dtype, ends, ramp.frame, exact=True,
    )  # fmt: skip
    return affine.chosen([ours, theirs, ~(ours | theirs)], [a, b, both])


def lesser(a: Form, b: Form) -> Form:
    """Return the minimum."""
    return affine.negative(greater(affine.negative(a), affine.negative(b)))


def difference(a: Form, b: Form) -> Form:
    """Return the exact difference `a - b`, which decides a comparison."""
    a, b = a.of_type(np.dtype(np.float64)), b.of_type(np.dtype(np.float64))
    return _but(
        affine.add(a, b, -1.0), ~(affine.unknown(*a.bounds()) | affine.unknown(*b.bounds()))
    )


def remainder(a: Form, b: Form) -> Form:
    """Return the remainder of a division, with the sign of `a`."""
    (low, high), (first, last) = a.bounds(), b.bounds()
    nothing = ~np.isfinite(low) | ~np.isfinite(high) | ~np.isfinite(first) | ~np.isfinite(last)
    nothing = nothing | ~((first > 0) | (last < 0))
    top = np.maximum(np.abs(first), np.abs(last))
    # The remainder is exact, so that only the number of divisors has to be the same.
    ends = [np.trunc(x / y * s) for x in (low, high) for y in (first, last)
            for s in (1 - 1e-14, 1 + 1e-14)]  # fmt: skip
    same = np.logical_and.reduce([end == ends[0] for end in ends]) & ~nothing
    wide = Form.between(
        np.where(nothing, -np.inf, np.where(low >= 0, 0.0, np.maximum(-top, low))),
        np.where(nothing, np.inf, np.where(high <= 0, 0.0, np.minimum(top, high))),
        a.dtype,
    )
    if not np.any(same):
        return wide
    count = np.where(same, ends[0], 0.0)
    times = Form.between(count, count, a.dtype)
    exact = affine.add(a, affine.product(times, b), -1.0)
    exact.low = exact.high = None
    return affine.chosen([same, ~same], [exact, wide])


def power(a: Form, b: Form) -> Form:
    """Return `a ** b` for positive numbers, or for an integer exponent."""
    if affine.is_point(b) and b.centre.size and (b.centre == b.centre.flat[0]).all():
        exponent = float(b.centre.flat[0])
        if exponent.is_integer() and abs(exponent) <= 64:
            return _widened(integer_power(a, int(exponent)), UNITS)
        if exponent == 0.5:
            return _widened(FUNCTIONS["sqrt"](a), UNITS)
    return _but(FUNCTIONS["exp"](affine.product(b, FUNCTIONS["log"](a))), a.bounds()[0] > 0)


def angle(y: Form, x: Form) -> Form:
    """Return the angle of a point `(x, y)`; the full circle if it may cross the negative x axis."""
    (low, high), (left, right) = y.bounds(), x.bounds()
    nothing = affine.unknown(low, high) | affine.unknown(left, right)
    right_half, above, below = left > 0, low > 0, high < 0
    masks = [right_half, ~right_half & above, ~right_half & ~above & below]
    rest = ~(right_half | above | below)
    # Of numbers that XLA takes for zero the angle may be NaN.
    nothing = nothing | (rest & (low <= 0) & (high >= 0) & (left <= 0) & (right >= 0))
    rest = rest | nothing
    masks = [mask & ~rest for mask in masks]
    end = np.where(nothing, np.inf, np.pi)
    circle = _widened(Form.between(-end, end, y.dtype), 2.0)
    if np.all(rest):
        return circle

    def turned(by: float, ratio: Form) -> Form:
        ends = np.full(ratio.centre.shape, by)
        return affine.add(Form.between(ends, ends, y.dtype), FUNCTIONS["atan"](ratio))

    ratio = affine.negative(quotient(x, y))
    cases = turned(0.0, quotient(y, x)), turned(np.pi / 2, ratio), turned(-np.pi / 2, ratio)
    return _widened(affine.chosen([*masks, rest], [*cases, circle]), UNITS)


def selected(truth: np.ndarray, maybe: np.ndarray, no: Form, yes: Form) -> Form:
    """Select one of two cases where it is certainly true; their hull where it may be."""
    if not np.any(maybe):
        if np.all(truth):
            return yes
        if not np.any(truth):
            return no
        return affine.chosen([truth, ~truth], [yes, no])
    both = affine.joined(no, yes)
    return affine.chosen([truth & ~maybe, maybe, ~truth & ~maybe], [yes, both, no])
