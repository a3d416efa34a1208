"""Formulas over signals with error bars: what holds for all values within, and what for some.

    lower, upper = with_bars(parse("always x < 3"), {"x": 0.1})
    str(lower), str(upper)                 # "always x + 0.1 < 3", "always x - 0.1 < 3"

Both are formulas over the recorded signals, so recordings, monitors and exported C evaluate them as
any other: the robustness of the first is at most, and that of the second at least, that of every
signal within the bars. They are exact where no signal stands in a formula twice; where one does,
as in `x - x`, its values count as independent. This is the interval semantics of signal temporal
logic (Zhong, Jordan and Provost, Extending signal temporal logic with quantitative semantics by
intervals for robust monitoring of cyber-physical systems, ACM Transactions on Embedded Computing
Systems 20, 2021).
"""

import operator
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, TypeAlias

from verifai_jax.addons.monitoring.functions import AtLast, Count, Mean
from verifai_jax.core.messages.checks import is_number
from verifai_jax.core.messages.errors import check_names
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.expression import Arithmetic, Component, Expression, Number, Signal
from verifai_jax.mtl.fitting import is_open
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.rewriting import expand, rebuild
from verifai_jax.mtl.sampled import Duration, Sampled, with_counted
from verifai_jax.mtl.tree import missing_case, postorder

Bar: TypeAlias = float | str | Expression
ErrorBars: TypeAlias = Mapping[str, Bar | tuple[Bar, Bar]]
"""By the name of a signal half the width of its bar (a number, or an expression of signals such as
`"x_error"` or `"0.02 * abs(x)"`), or its two ends."""
HUGE = 1.7e308
"""Almost the largest number: what exceeds it is infinite."""


class Ends(NamedTuple):
    """The least and the greatest value of an expression."""

    low: Expression
    high: Expression

    @property
    def certain(self) -> bool:
        """True if both ends are one expression."""
        return self.low is self.high


class Bounds(NamedTuple):
    """The least and the greatest robustness of all values within the error bars."""

    low: float
    high: float

    @property
    def verdict(self) -> str:
        """`"holds"` (for all values), `"fails"` (for all) or `"depends"`, also at a bound of 0."""
        return "holds" if self.low > 0 else "fails" if self.high < 0 else "depends"


def with_bars(formula: Formula, bars: ErrorBars) -> tuple[Formula, Formula]:
    """Return the formulas whose robustness bounds that of a formula, from below and from above.

    **Raises:** `ValueError` for a bar that is no expression, and for operations without bounds: a
    norm, and a power whose exponent is not a number.
    """
    bounds, meant = _Bounds(bars), expand(formula)
    return bounds.formula(meant, False), bounds.formula(meant, True)


def bounded(
    formulas: Formula | str | Mapping[str, Formula | str], bars: ErrorBars
) -> dict[str, Formula]:
    """Return both bounds of one or several formulas, as `NAME low` and `NAME high`.

    **Raises:** the errors of `with_bars` and `check_bars`.
    """
    named = formulas if isinstance(formulas, Mapping) else {"": formulas}
    parsed = {name: parse(f) if isinstance(f, str) else f for name, f in named.items()}
    check_bars(parsed.values(), bars)
    found = {name: with_bars(formula, bars) for name, formula in parsed.items()}
    ends = ("low", "high")
    return {f"{n} {end}".strip(): f[i] for n, f in found.items() for i, end in enumerate(ends)}


def check_bars(formulas: Iterable[Formula], bars: ErrorBars) -> None:
    """Check error bars, also against formulas that no recording has to complete.

    **Raises:** `UnknownNameError` for a bar of a signal that no formula has; errors of `with_bars`.
    """
    formulas = list(formulas)
    known = [name for f in formulas for part in with_counted(f) for name in part.signals()]
    check_names("signal with an error bar", bars, dict.fromkeys(known))
    for name, bar in bars.items():
        _bar(name, bar)
    for formula in formulas:
        if not is_open(formula):
            with_bars(formula, bars)


class _Bounds:
    """Both bounds of expressions and formulas."""

    def __init__(self, bars: ErrorBars) -> None:
        self.bars = {name: _bar(name, bar) for name, bar in bars.items()}
        self.known: dict[tuple[Formula, bool], Formula] = {}

    def formula(self, f: Formula, upper: bool) -> Formula:
        """Return a formula whose robustness is the greatest possible, or else the least."""
        if (f, upper) not in self.known:
            self.known[f, upper] = self._formula(f, upper)
        return self.known[f, upper]

    def _formula(self, f: Formula, upper: bool) -> Formula:
        match f:
            case ast.Constant():
                return f
            case ast.Not(operand):
                return ast.Not(self.formula(operand, not upper))
            case ast.Atom(e):
                ends = self.ends(e)
                return f if ends.certain else ast.Atom(ends.high if upper else ends.low)
            case ast.Predicate(comparison, left, right):
                return self._predicate(f, comparison, self.ends(left), self.ends(right), upper)
        return rebuild(f, tuple(self.formula(part, upper) for part in f.operands()))

    def _predicate(self, f: Formula, comparison: str, a: Ends, b: Ends, upper: bool) -> Formula:
        if a.certain and b.certain:
            return f
        if comparison in ("==", "!="):
            # The least and the greatest distance of both.
            far = (b.high - a.low).max(a.high - b.low)
            near = (a.low - b.high).max(b.low - a.high, 0.0)
            equal = comparison == "=="
            distance = near if equal == upper else far
            return ast.Predicate("<=" if equal else ">", distance, Number(0.0))
        more = (comparison in (">", ">=")) == upper
        left, right = (a.high, b.low) if more else (a.low, b.high)
        return ast.Predicate(comparison, left, right)

    def ends(self, e: Term) -> Ends:
        """Return both ends of an expression."""
        found: dict[int, Ends] = {}
        for part in postorder(e):
            found[id(part)] = self._ends(part, found)
        return found[id(e)]

    def _ends(self, e: Term, found: Mapping[int, Ends]) -> Ends:
        match e:
            case Sampled():
                return self._sampled(e)
            case Signal(name):
                return self._bar_of(e, name, lambda end: end)
            case Component(Signal(name), index):
                return self._bar_of(e, name, lambda end: end[index] if _is_signal(end) else end)
            case Number():
                return Ends(e, e)
            case Arithmetic(name, arguments):
                ends = [found[id(argument)] for argument in arguments]
                if all(end.certain for end in ends):
                    return Ends(e, e)
                return _arithmetic(e, name, ends)
        raise missing_case("the error bar", e)

    def _sampled(self, e: Sampled) -> Ends:
        pairs = [self._pair(operand) for operand in e.operands]
        certain = [low is high for low, high in pairs]
        if all(certain):
            return Ends(e, e)
        if isinstance(e, Duration | Count | Mean) or (isinstance(e, AtLast) and certain[0]):
            return Ends(*(e.of(each, e.window) for each in zip(*pairs, strict=True)))
        raise _without_bounds(e)

    def _pair(self, operand: Formula | Expression) -> tuple[Formula | Term, Formula | Term]:
        if not isinstance(operand, Formula):
            return self.ends(operand)
        low, high = (self.formula(expand(operand), upper) for upper in (False, True))
        return (low, low) if low == high else (low, high)

    def _bar_of(self, e: Expression, name: str, part: Callable[[Expression], Expression]) -> Ends:
        bar = self.bars.get(name)
        if bar is None:
            return Ends(e, e)
        if isinstance(bar, tuple):
            return Ends(*map(part, bar))
        return Ends(e - part(bar), e + part(bar))


def _is_signal(e: Expression) -> bool:
    return isinstance(e, Signal) and e.is_signal


def _bar(name: str, given: "Bar | tuple[Bar, Bar]") -> "Expression | tuple[Expression, Expression]":
    if isinstance(given, tuple):
        if len(given) != 2:
            raise ValueError(f"the error bar of {name} has two ends; got {given!r}")
        return _end(name, given[0]), _end(name, given[1])
    if is_number(given) and not given >= 0:
        raise ValueError(f"the error bar of {name} must be a width of 0 or more; got {given!r}")
    return _end(name, given)


def _end(name: str, given: Bar) -> Expression:
    if isinstance(given, Expression):
        return given
    if is_number(given):
        return Number(given)
    read = parse(given) if isinstance(given, str) else None
    if not isinstance(read, ast.Atom) or not isinstance(read.expression, Expression):
        raise ValueError(
            f"the error bar of {name} must be a number, an expression of signals, or two ends; got "
            f"{given!r}"
        )
    return read.expression


def _arithmetic(e: Arithmetic, name: str, ends: list[Ends]) -> Ends:
    """Return both ends of an operation on uncertain values."""
    a, b = ends[0], ends[-1]
    match name:
        case "+":
            return Ends(a.low + b.low, a.high + b.high)
        case "-":
            return Ends(a.low - b.high, a.high - b.low)
        case "neg":
            return Ends(-a.high, -a.low)
        case "*" if e.arguments[0] == e.arguments[1]:
            return _power(a, 2.0)
        case "*":
            return _of_corners(operator.mul, a, b)
        case "/":
            return _quotient(a, b)
        case "**" if isinstance(exponent := e.arguments[1], Number):
            return _power(a, exponent.value)
        case "abs":
            return _absolute(a)
        case "sqrt" | "exp" | "min" | "max":
            return Ends(*(Arithmetic(name, each) for each in zip(*ends, strict=True)))
        case "sin" | "cos":
            middle, half = (a.low + a.high) / 2, (a.high - a.low) / 2
            wave = Arithmetic(name, (middle,))
            return Ends((wave - half).max(-1.0), (wave + half).min(1.0))
    raise _without_bounds(e)


def _without_bounds(e: Term) -> ValueError:
    return ValueError(
        f"{e} has no bounds for signals with error bars; write a norm as the root of a sum of "
        "squares, and a power with a number for its exponent; rate and peak_to_peak have none"
    )


def _of_corners(operation: Callable[..., Expression], a: Ends, b: Ends) -> Ends:
    """Return the extremes of an operation that is monotone in each argument on its own."""
    ones, others = (ends[: 1 if ends.certain else 2] for ends in (a, b))
    first, *rest = [operation(x, y) for x in ones for y in others]
    return Ends(first.min(*rest), first.max(*rest))


def _power(a: Ends, exponent: float) -> Ends:
    if exponent < 0:
        one = Number(1.0)
        return _quotient(Ends(one, one), _power(a, -exponent))
    if exponent % 2 == 0:
        a = _absolute(a)
    return Ends(a.low**exponent, a.high**exponent)


def _absolute(a: Ends) -> Ends:
    return Ends(a.low.max(-a.high, 0.0), a.high.max(-a.low))


def _quotient(a: Ends, b: Ends) -> Ends:
    """Return both ends of a quotient, which is beyond every bound where the divisor may be 0."""
    ratios = _of_corners(operator.truediv, a, b)
    if b.certain:
        return ratios
    beyond = (1.0 / (b.low * b.high).max(0.0) - HUGE).max(0.0)
    return Ends(ratios.low - beyond, ratios.high + beyond)
