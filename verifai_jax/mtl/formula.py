"""Formulas of metric temporal logic: a tree of operators that prints itself.

    x, theta = signal("x"), signal("theta")
    always((abs(x) <= 2.4) & (theta.abs() <= 0.2095), 0, 4)
    (x > 1).until(signal("y") >= 0, 0.2, 0.6)
    ~(x > 1) >> eventually(x < 0, 0, 2)

A formula is a frozen tree, hashable and equal by value, so it is a static argument under `jax.jit`.
Sugar (implication, equivalence, weak until, release) is rewritten into the few nodes below when it
is written, and restored when it is printed; their meaning lives in `evaluate`.
"""

import abc
import html
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias, Union

from verifai_jax.core.lazy import late
from verifai_jax.mtl.node import Node, missing_case, postorder
from verifai_jax.mtl.words import Text, number_text, operator_text


class Term(Node, abc.ABC):
    """A number at every instant, which predicates compare; made as an `Expression`."""

    @abc.abstractmethod
    def text(self, outer: int = 0) -> str:
        """Return the text, in parentheses if its operator binds weaker than `outer`."""

    @property
    def is_signal(self) -> bool:
        """True for a signal or one component of it."""
        return False

    def signals(self) -> tuple[str, ...]:
        """Return the names of the signals in it, in order of appearance."""
        return ()

    def __str__(self) -> str:
        return self.text()


Formulaic: TypeAlias = Union["Formula", Term]
"""What stands for a formula: a formula, or an expression that is its own robustness."""


@dataclass(frozen=True)
class Interval:
    """A closed interval of time in seconds; `end` may be infinite."""

    start: float = 0.0
    end: float = math.inf

    def __post_init__(self) -> None:
        start, end = float(self.start), float(self.end)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "end", end)
        if not (start >= 0 and math.isfinite(start)):
            raise ValueError(f"an interval starts at a finite time, at least 0; got {self}")
        if not end >= start:
            raise ValueError(f"an interval ends no earlier than it starts; got {self}")

    @property
    def everything(self) -> bool:
        """True for `[0, inf]`, which the text leaves out."""
        return self.start == 0 and self.end == math.inf

    def __str__(self) -> str:
        return f"[{number_text(self.start)},{number_text(self.end)}]"


EVERYTHING = Interval()
"""The interval of an operator that is written without one."""


class Formula(Node):
    """A property of a trace at every instant, true or false, with a margin (its robustness)."""

    children: ClassVar[tuple[str, ...]] = ()

    def __and__(self, other: Formulaic) -> "Formula":
        return conjunction(self, other)

    def __rand__(self, other: Formulaic) -> "Formula":
        return conjunction(other, self)

    def __or__(self, other: Formulaic) -> "Formula":
        return disjunction(self, other)

    def __ror__(self, other: Formulaic) -> "Formula":
        return disjunction(other, self)

    def __invert__(self) -> "Formula":
        return Not(self)

    def __rshift__(self, other: Formulaic) -> "Formula":
        return Or((Not(self), formula(other)))

    def __rrshift__(self, other: Formulaic) -> "Formula":
        return Or((Not(formula(other)), self))

    def __xor__(self, other: Formulaic) -> "Formula":
        return Not(self.iff(other))

    def implies(self, other: Formulaic) -> "Formula":
        """Return `self -> other`, also written `self >> other`."""
        return self >> other

    def iff(self, other: Formulaic) -> "Formula":
        """Return `self <-> other`; its negation is `self ^ other`, in text `self xor other`."""
        other = formula(other)
        return Or((And((self, other)), And((Not(self), Not(other)))))

    def until(self, other: Formulaic, a: float = 0.0, b: float = math.inf) -> "Formula":
        """Require `self` until `other` holds, `a` to `b` seconds ahead, not at the witness."""
        return Until(self, formula(other), Interval(a, b))

    def weak_until(self, other: Formulaic, a: float = 0.0, b: float = math.inf) -> "Formula":
        """Require `self` until `other` holds, or `self` throughout `[0, b]`."""
        return Or((self.until(other, a, b), Always(self, Interval(0.0, b))))

    def release(self, other: Formulaic, a: float = 0.0, b: float = math.inf) -> "Formula":
        """Require `other` up to and including the instant where `self` holds: the dual of until."""
        return Not(Until(Not(self), Not(formula(other)), Interval(a, b)))

    def since(self, other: Formulaic, a: float = 0.0, b: float = math.inf) -> "Formula":
        """Require `other` at some instant from `a` to `b` seconds ago, and `self` ever since."""
        return Since(self, formula(other), Interval(a, b))

    def signals(self) -> tuple[str, ...]:
        """Return the names of the signals that it speaks of, in order of appearance."""
        return tuple(
            dict.fromkeys(
                name
                for part in self.subformulas()
                for term in part.terms()
                for name in term.signals()
            )
        )

    def terms(self) -> tuple[Term, ...]:
        """Return the expressions that a leaf compares; none for an operator."""
        return ()

    def horizon(self, dt: float = 0.0) -> float:
        """Return the seconds of trace beyond an instant on which its truth there depends.

        Infinite for an unbounded future operator. Past operators look back, so they never add (and
        are not subtracted, which keeps the bound simple).

        **Arguments:**

        - `dt`: sampling period in seconds, by which `next` looks ahead.
        """
        return self._total_reach(dt, 1)

    def history(self, dt: float = 0.0) -> float:
        """Return the seconds of trace before an instant on which its truth there depends.

        **Arguments:**

        - `dt`: sampling period in seconds, by which `prev` looks back.
        """
        return self._total_reach(dt, 0)

    def _total_reach(self, dt: float, side: int) -> float:
        reach: dict[int, float] = {}
        for part in postorder(self):
            if isinstance(part, Formula):
                below = max((reach[id(p)] for p in part.operands()), default=0.0)
                reach[id(part)] = below + part._reach(dt)[side]
        return reach[id(self)]

    @property
    def depth(self) -> int:
        """Operators that stand within each other; 0 for a leaf."""
        for part in postorder(self, "_depth"):
            if isinstance(part, Formula):
                below = [p.__dict__["_depth"] + 1 for p in part.operands()]
                object.__setattr__(part, "_depth", max(below, default=0))
        return self.__dict__["_depth"]

    @property
    def temporal_depth(self) -> int:
        """Temporal operators that stand within each other."""
        for part in postorder(self, "_temporal_depth"):
            if isinstance(part, Formula):
                below = max((p.__dict__["_temporal_depth"] for p in part.operands()), default=0)
                own = bool(part.operands()) and not isinstance(part, Not | And | Or)
                object.__setattr__(part, "_temporal_depth", below + own)
        return self.__dict__["_temporal_depth"]

    def _reach(self, dt: float) -> tuple[float, float]:
        """Return how many seconds the operator itself looks back and ahead."""
        if isinstance(self, Constant | Predicate | Atom | Not | And | Or):
            return 0.0, 0.0
        raise missing_case("the horizon, or the history,", self)

    def operands(self) -> tuple["Formula", ...]:
        """Return the formulas that it is made of, left to right."""
        parts: list[Formula] = []
        for name in self.children:
            value = getattr(self, name)
            parts.extend(value if isinstance(value, tuple) else (value,))
        return tuple(parts)

    def subformulas(self) -> Iterator["Formula"]:
        """Yield itself and everything below, parents first, left to right, each part once."""
        seen: set[int] = set()
        stack: list[Formula] = [self]
        while stack:
            part = stack.pop()
            if id(part) not in seen:
                seen.add(id(part))
                yield part
                stack.extend(reversed(part.operands()))

    def __bool__(self) -> bool:
        raise TypeError(
            f"a formula has no truth value without a trace: {self}. Combine formulas with "
            "& | ~ instead of and, or, not, and write a < x < b as (a < x) & (x < b)"
        )

    def text(self) -> Text:
        """Return its text and what kind of text that is; `parse(str(f)) == f`."""
        word, operands, interval = surface(self)
        span = "" if interval is None or interval.everything else str(interval)
        return operator_text(word, span, [part.text() for part in operands])

    def __str__(self) -> str:
        return self.text().text

    def _repr_latex_(self) -> str:
        return f"${late('verifai_jax.mtl._latex', 'latex')(self)}$"

    def _repr_html_(self) -> str:
        # Notebooks set mathematics within HTML, and prefer HTML to LaTeX.
        return html.escape(self._repr_latex_())


@dataclass(frozen=True, eq=False, repr=False)
class Constant(Formula):
    """`TRUE` (robustness +inf) or `FALSE` (-inf)."""

    value: bool

    def text(self) -> Text:
        """Return `TRUE` or `FALSE`."""
        return Text("TRUE" if self.value else "FALSE", "name")


@dataclass(frozen=True, eq=False, repr=False)
class Predicate(Formula):
    """A comparison; its robustness is the margin by which it holds."""

    comparison: str
    left: Term
    right: Term

    def __post_init__(self) -> None:
        if not (self.left.signals() or self.right.signals()):
            raise ValueError(
                f"{self} compares numbers and no signal, so that all traces are alike: compare a "
                f"signal, as in x {self.comparison} {self.right}, or write TRUE or FALSE"
            )

    def terms(self) -> tuple[Term, ...]:
        """Return both sides."""
        return self.left, self.right

    def text(self) -> Text:
        """Return both sides with the comparison between them."""
        return Text(f"{self.left} {self.comparison} {self.right}", "leaf")


@dataclass(frozen=True, eq=False, repr=False)
class Atom(Formula):
    """A bare expression that is its own robustness; it holds where it is positive."""

    expression: Term

    def __post_init__(self) -> None:
        if not self.expression.signals():
            raise ValueError(
                f"a formula is needed here, not the number {self.expression}: compare a signal "
                f"with it, as in x > {self.expression}, or write TRUE or FALSE"
            )

    def terms(self) -> tuple[Term, ...]:
        """Return the expression."""
        return (self.expression,)

    def text(self) -> Text:
        """Return the text of the expression."""
        text = str(self.expression)
        # A signal or one of its components ends where it ends, whatever comes behind.
        return Text(text, "name" if self.expression.is_signal else "leaf")


@dataclass(frozen=True, eq=False, repr=False)
class Not(Formula):
    """`!f`."""

    operand: Formula
    children: ClassVar[tuple[str, ...]] = ("operand",)


@dataclass(frozen=True, eq=False, repr=False)
class And(Formula):
    """`f & g & ...`, two operands or more."""

    parts: tuple[Formula, ...]
    children: ClassVar[tuple[str, ...]] = ("parts",)


@dataclass(frozen=True, eq=False, repr=False)
class Or(Formula):
    """`f | g | ...`, two operands or more."""

    parts: tuple[Formula, ...]
    children: ClassVar[tuple[str, ...]] = ("parts",)


@dataclass(frozen=True, eq=False, repr=False)
class Always(Formula):
    """`f` at every instant of the interval ahead."""

    operand: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("operand",)

    def _reach(self, dt: float) -> tuple[float, float]:
        return 0.0, self.interval.end


@dataclass(frozen=True, eq=False, repr=False)
class Eventually(Formula):
    """`f` at some instant of the interval ahead."""

    operand: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("operand",)

    def _reach(self, dt: float) -> tuple[float, float]:
        return 0.0, self.interval.end


@dataclass(frozen=True, eq=False, repr=False)
class Historically(Formula):
    """`f` at every instant of the interval behind."""

    operand: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("operand",)

    def _reach(self, dt: float) -> tuple[float, float]:
        return self.interval.end, 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Once(Formula):
    """`f` at some instant of the interval behind."""

    operand: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("operand",)

    def _reach(self, dt: float) -> tuple[float, float]:
        return self.interval.end, 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Next(Formula):
    """`f` at the next sample; at the last one, `f` there, whatever the end of trace."""

    operand: Formula
    children: ClassVar[tuple[str, ...]] = ("operand",)

    def _reach(self, dt: float) -> tuple[float, float]:
        return 0.0, dt


@dataclass(frozen=True, eq=False, repr=False)
class Prev(Formula):
    """`f` at the previous sample; where there is none, false (or true, if `weak`)."""

    operand: Formula
    weak: bool = False
    children: ClassVar[tuple[str, ...]] = ("operand",)

    def _reach(self, dt: float) -> tuple[float, float]:
        return dt, 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Until(Formula):
    """`right` at some instant of the interval ahead, and `left` at every one before it."""

    left: Formula
    right: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("left", "right")

    def _reach(self, dt: float) -> tuple[float, float]:
        return 0.0, self.interval.end


@dataclass(frozen=True, eq=False, repr=False)
class Since(Formula):
    """`right` at some instant of the interval behind, and `left` at every one after it."""

    left: Formula
    right: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("left", "right")

    def _reach(self, dt: float) -> tuple[float, float]:
        return self.interval.end, 0.0


def surface(f: Formula) -> tuple[str, tuple[Formula, ...], Interval | None]:
    """Return how a formula reads: its operator's word, the operands, and the interval if any.

    Sugar that was rewritten away (`->`, `<->`, `xor`, weak until, release) is recognised.
    """
    match f:
        case Not(Or((And((p, q)), And((Not(r), Not(s)))))) if p == r and q == s:
            return "xor", (p, q), None
        case Not(Until(Not(p), Not(q), interval)):
            return "release", (p, q), interval
        case Or((And((p, q)), And((Not(r), Not(s))))) if p == r and q == s:
            return "iff", (p, q), None
        case Or((Until(p, q, interval), Always(r, Interval(0.0, end)))) if (
            p == r and end == interval.end
        ):
            return "weak_until", (p, q), interval
        case Or((Not(p), q)):
            return "implies", (p, q), None
        case Not(p):
            return "not", (p,), None
        case And(parts):
            return "and", parts, None
        case Or(parts):
            return "or", parts, None
        case Next(p):
            return "next", (p,), None
        case Prev(p, weak):
            return "weak_prev" if weak else "prev", (p,), None
        case Until(p, q, interval):
            return "until", (p, q), interval
        case Since(p, q, interval):
            return "since", (p, q), interval
        case (
            Always(p, interval)
            | Eventually(p, interval)
            | Historically(p, interval)
            | Once(p, interval)
        ):
            return type(f).__name__.lower(), (p,), interval
    raise missing_case("the text", f)


TRUE = Constant(True)
"""The formula that always holds."""

FALSE = Constant(False)
"""The formula that never holds."""


def formula(value: Formulaic) -> Formula:
    """Return `value` as a formula; an expression is its own robustness.

    **Raises:** `TypeError` if it is neither.
    """
    if isinstance(value, Formula):
        return value
    if isinstance(value, Term):
        return Atom(value)
    raise TypeError(f"a formula is needed here; got {value!r}")


def conjunction(*parts: Formulaic) -> Formula:
    """Return `f & g & ...`; one part alone is itself."""
    return _joined(And, "and", parts)


def disjunction(*parts: Formulaic) -> Formula:
    """Return `f | g | ...`; one part alone is itself."""
    return _joined(Or, "or", parts)


def _joined(kind: type[And] | type[Or], word: str, parts: tuple[Formulaic, ...]) -> Formula:
    first, *rest = map(formula, parts)
    if not rest:
        return first
    # `a & b & c` is one node, but an implication within `|` must stay readable as one.
    if isinstance(first, And | Or) and isinstance(first, kind) and surface(first)[0] == word:
        return kind((*first.parts, *rest))
    return kind((first, *rest))
