"""Ranges that a formula demands of linear expressions, at all or some instants of a window.

    Demands.of(parse("always[0, 9] abs(x) <= 2")).parts    # x <= 2 and x >= -2 from 0 s to 9 s

Each is a consequence of the formula; where they are all that it says, `complete` is true. Numbers
are fractions, so that what is compared is exact.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple, TypeAlias

from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import Arithmetic, constant_value, expression
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.rewriting import nnf

Form: TypeAlias = tuple[tuple[Term, Fraction], ...]
"""A sum of expressions with factors, the first of which is 1."""
Clash: TypeAlias = tuple[Formula, Formula, float, tuple[Formula, ...]]
"""Two formulas that exclude each other, the instant, and the conditions under which they do."""


class Range(NamedTuple):
    """The numbers from `low` to `high`, without these ends where they are open; None is no end."""

    low: Fraction | None = None
    high: Fraction | None = None
    open_low: bool = False
    open_high: bool = False

    def apart(self, other: "Range") -> bool:
        """Return whether it has no number of another range."""
        low, high, open_low, open_high = self.met(other)
        return low is not None and high is not None and (
            low > high or (low == high and (open_low or open_high))
        )  # fmt: skip

    def met(self, other: "Range") -> "Range":
        """Return the numbers that are in both ranges."""
        low = max((self, other), key=lambda r: (-math.inf if r.low is None else r.low, r.open_low))
        high = min(
            (self, other), key=lambda r: (math.inf if r.high is None else r.high, not r.open_high)
        )
        return Range(low.low, high.high, low.open_low, high.open_high)

    def times(self, factor: Fraction) -> "Range":
        """Return the range of its numbers multiplied by a factor."""
        low, high = (None if end is None else end * factor for end in self[:2])
        ends = Range(low, high, self.open_low, self.open_high)
        return ends if factor > 0 else Range(high, low, self.open_high, self.open_low)

    def plus(self, other: "Range") -> "Range":
        """Return the range of the sums of its numbers and those of another range."""
        pairs = zip(self[:2], other[:2], strict=True)
        low, high = (None if a is None or b is None else a + b for a, b in pairs)
        opened = (a or b for a, b in zip(self[2:], other[2:], strict=True))
        return Range(low, high, *opened)


class Demand(NamedTuple):
    """A linear expression is within a range at every (or at some) instant of a window, in seconds.

    - `guard`: the condition under which it is asked; None for none.
    - `leaf`: the predicate that asks for it.
    """

    form: Form
    range: Range
    start: float
    end: float
    every: bool
    guard: Formula | None
    leaf: Formula


@dataclass(frozen=True)
class Demands:
    """The demands of a formula, and whether they are all that it says."""

    parts: tuple[Demand, ...]
    complete: bool

    @classmethod
    def of(cls, formula: Formula) -> "Demands":
        """Return the demands of a formula."""
        reading = _Reading()
        reading.read(nnf(formula), 0.0, 0.0, True, None)
        return cls(tuple(reading.found), reading.complete)

    def known(self, form: Form, start: float, end: float, guard: Formula | None) -> Range:
        """Return the range in which an expression is throughout a window, as far as is asked."""
        asked = [
            each
            for each in self.parts
            if each.every and each.start <= start and end <= each.end
            and each.guard in (None, guard)
        ]  # fmt: skip
        sums = [Range(Fraction(0), Fraction(0))]
        for term, factor in form:
            own = Range()
            for each in asked:
                own = own.met(each.range) if each.form == ((term, Fraction(1)),) else own
            sums.append(sums[-1].plus(own.times(factor)))
        known = sums[-1]
        for each in asked:
            known = known.met(each.range) if each.form == form else known
        return known

    def clash(self, other: "Demands") -> Clash | None:
        """Return what these demands exclude of others; None if nothing was found."""
        for theirs in other.parts:
            starts = {theirs.start, *(own.start for own in self.parts if own.every)}
            spans = [(t, t) for t in sorted(starts) if theirs.start <= t <= theirs.end]
            for start, end in spans if theirs.every else [(theirs.start, theirs.end)]:
                guards = {own.guard for own in self.parts} if theirs.every else {None}
                for guard in sorted(guards, key=lambda g: g is not None):
                    known = self.known(theirs.form, start, end, guard)
                    if not known.apart(theirs.range):
                        continue
                    both = tuple(dict.fromkeys(g for g in (guard, theirs.guard) if g is not None))
                    if len(both) == 2 and _exclusive(*both):
                        continue
                    single = [((term, Fraction(1)),) for term, _ in theirs.form]
                    mine = [
                        own
                        for own in self.parts
                        if own.every and own.guard in (None, guard)
                        and own.start <= start <= own.end and own.form in (theirs.form, *single)
                    ]  # fmt: skip
                    alone = [own for own in mine if own.range.apart(theirs.range)][:1]
                    leaves = dict.fromkeys(own.leaf for own in alone or mine)
                    if not leaves:  # The other one excludes itself, such as abs(x) < -1.
                        continue
                    return ast.conjunction(*leaves), theirs.leaf, start, both
        return None

    def implies(self, other: "Demands") -> bool:
        """Return whether another formula holds wherever this one does, as far as is proved."""
        return other.complete and bool(other.parts) and all(map(self._gives, other.parts))

    def _gives(self, theirs: Demand) -> bool:
        if theirs.every:
            known = self.known(theirs.form, theirs.start, theirs.end, theirs.guard)
            return known.met(theirs.range) == known
        some = [
            own.range
            for own in self.parts
            if own.form == theirs.form and own.guard in (None, theirs.guard)
            and theirs.start <= own.start and own.end <= theirs.end
        ]  # fmt: skip
        starts = {theirs.start, *(own.start for own in self.parts if own.every)}
        some += [
            self.known(theirs.form, t, t, theirs.guard)
            for t in starts
            if theirs.start <= t <= theirs.end
        ]
        return any(each.met(theirs.range) == each for each in some)


def _exclusive(one: Formula, other: Formula) -> bool:
    """Return whether two conditions never hold at once, as far as is proved."""
    first, second = Demands.of(one), Demands.of(other)
    return first.clash(second) is not None or second.clash(first) is not None


class _Reading:
    """The demands found so far, and whether nothing else was said."""

    def __init__(self) -> None:
        self.found: list[Demand] = []
        self.complete = True

    def read(
        self, f: Formula, start: float, end: float, every: bool, guard: Formula | None
    ) -> None:  # fmt: skip
        match f:
            case ast.And(parts) if every:
                for part in parts:
                    self.read(part, start, end, every, guard)
            case ast.Or((*others, last)) if every and guard is None and not _looks(others):
                self.read(last, start, end, every, nnf(~ast.disjunction(*others)))
            case ast.Always(part, span) if every and span.closed:
                # A condition is asked when it holds, and not throughout what follows.
                if guard is None or span.end == 0:
                    self.read(part, start + span.start, end + span.end, every, guard)
                else:
                    self.complete = False
            case ast.Eventually(part, span) if every and span.closed and guard is None:
                self.complete &= start == end
                self.read(part, start + span.start, start + span.end, False, guard)
            case ast.Predicate(comparison, left, right):
                self._compare(f, comparison, left, right, (start, end, every, guard))
            case _:
                self.complete = False

    def _compare(
        self, leaf: Formula, comparison: str, left: Term, right: Term,
        asked: tuple[float, float, bool, Formula | None],
    ) -> None:  # fmt: skip
        strict = comparison in ("<", ">")
        if comparison in (">", ">="):
            left, right = right, left
        if comparison == "!=":
            self.complete = False
            return
        factors, number = _linear(Arithmetic("-", (expression(left), expression(right))))
        # It is at most 0, or 0.
        span = Range(None, -number, False, strict)
        if comparison == "==":
            span = span._replace(low=-number)
        for form, own in _forms(factors, span):
            self.found.append(Demand(form, own, *asked, leaf))
        if not factors or (comparison == "==" and not asked[2]):
            self.complete = False


def _looks(parts: Sequence[Formula]) -> bool:
    return any(each.side for part in parts for each in part.subformulas(valued=True))


def _forms(factors: Mapping[Term, Fraction], span: Range) -> Iterator[tuple[Form, Range]]:
    """Yield a sum in a range so that its first factor is 1, or what is in its absolute value."""
    terms = sorted(factors.items(), key=lambda item: str(item[0]))
    if not terms:
        return
    first = terms[0][1]
    form = tuple((term, factor / first) for term, factor in terms)
    span = span.times(1 / first)
    (term, _), *others = form
    if not others and isinstance(term, Arithmetic) and term.name == "abs" and span.high is not None:
        inner, number = _linear(term.arguments[0])
        both = Range(-span.high - number, span.high - number, span.open_high, span.open_high)
        if inner and span.low is None:
            yield from _forms(inner, both)
            return
    yield form, span


def _linear(e: Term) -> tuple[dict[Term, Fraction], Fraction]:
    """Return the factors of the parts of an expression, and the number that is added to them."""
    value = constant_value(expression(e))
    if value is not None:
        return {}, Fraction(repr(value))
    match e:
        case Arithmetic("+" | "-" as word, (left, right)):
            one, other = _linear(left), _scaled(_linear(right), Fraction(1 if word == "+" else -1))
            sums = {t: one[0].get(t, Fraction(0)) + other[0].get(t, Fraction(0))
                    for t in {**one[0], **other[0]}}  # fmt: skip
            return {t: factor for t, factor in sums.items() if factor}, one[1] + other[1]
        case Arithmetic("neg", (inner,)):
            return _scaled(_linear(inner), Fraction(-1))
        case Arithmetic("*", (left, right)):
            for factor, inner in ((left, right), (right, left)):
                if (number := constant_value(factor)) is not None and number:
                    return _scaled(_linear(inner), Fraction(repr(number)))
        case Arithmetic("/", (left, right)) if constant_value(right):
            number = constant_value(right)
            return _scaled(_linear(left), 1 / Fraction(repr(number)))
    return {e: Fraction(1)}, Fraction(0)


def _scaled(
    linear: tuple[dict[Term, Fraction], Fraction], by: Fraction
) -> tuple[dict[Term, Fraction], Fraction]:
    return {term: factor * by for term, factor in linear[0].items()}, linear[1] * by
