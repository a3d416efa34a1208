"""Formulas of metric temporal logic: a tree of operators that prints itself.

    x, theta = signal("x"), signal("theta")
    always((abs(x) <= 2.4) & (theta.abs() <= 0.2095), 0, 4)
    (x > 1).until(signal("y") >= 0, 0.2, 0.6)

A formula is a frozen tree, hashable and equal by value, so that `jax.jit` accepts it as static. The
table `OPERATORS` of `words` describes each operator, and its class of node defines its meaning:
`Join`, `Window`, `Witness`, or `Derived`. Implication and weak until are built from these, but
print as written.
"""

import abc
import functools
import html
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias, Union

from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.mtl.tree import EVERYTHING as EVERYTHING
from verifai_jax.mtl.tree import Interval as Interval
from verifai_jax.mtl.tree import Node, Tree
from verifai_jax.mtl.tree import Term as Term
from verifai_jax.mtl.words import COMPARISONS, OPERATORS, Text, operator_text

Formulaic: TypeAlias = Union["Formula", Term]
"""A formula, or an expression that is its own robustness."""
Start: TypeAlias = float | Interval
"""The beginning of a closed interval in seconds, or a whole interval."""


class Formula(Tree):
    """A property of a trace at every instant, true or false, with a margin (its robustness)."""

    children: ClassVar[tuple[str, ...]] = ()
    """Names of the fields that hold operands."""

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

    def until(self, other: Formulaic, a: Start = 0.0, b: float = math.inf) -> "Formula":
        """Require `other` `a` to `b` seconds ahead, and `self` at every earlier instant."""
        return Until(self, formula(other), interval_of(a, b))

    def weak_until(self, other: Formulaic, a: Start = 0.0, b: float = math.inf) -> "Formula":
        """Require `self` until `other` holds, or `self` throughout `[0, b]`."""
        span = interval_of(a, b)
        return Or((Until(self, formula(other), span), Always(self, _from_now(span))))

    def release(self, other: Formulaic, a: Start = 0.0, b: float = math.inf) -> "Formula":
        """Require `other` up to and including the instant at which `self` holds: dual to until."""
        return Not(Until(Not(self), Not(formula(other)), interval_of(a, b)))

    def since(self, other: Formulaic, a: Start = 0.0, b: float = math.inf) -> "Formula":
        """Require `other` at some instant from `a` to `b` seconds ago, and `self` ever since."""
        return Since(self, formula(other), interval_of(a, b))

    def signals(self) -> tuple[str, ...]:
        """Return the names of the signals in it, in order of appearance."""
        terms = (term for part in self.subformulas() for term in part.terms())
        return tuple(dict.fromkeys(name for term in terms for name in term.signals()))

    def terms(self) -> tuple[Term, ...]:
        """Return the expressions compared by a leaf; none for an operator."""
        return ()

    @property
    def compared(self) -> "tuple[Term, str, Term] | None":
        """Both sides of a comparison with its symbol in between; None for any other formula."""
        return None

    @property
    def is_predicate(self) -> bool:
        """True for a leaf with a margin: a comparison, or a bare expression."""
        return bool(self.terms())

    def valued(self) -> tuple["Formula", ...]:
        """Return the formulas whose values determine its own: its operands, except in `Derived`."""
        return self.operands()

    def operands(self) -> tuple["Formula", ...]:
        """Return its operands, left to right."""
        parts: list[Formula] = []
        for name in self.children:
            value = getattr(self, name)
            parts.extend(value if isinstance(value, tuple) else (value,))
        return tuple(parts)

    def subformulas(self, valued: bool = False) -> Iterator["Formula"]:
        """Yield this formula and all below it, parents first, left to right, each part once.

        With `valued`, the meaning of a `Derived` operator follows instead of its operands.
        """
        seen: set[int] = set()
        stack: list[Formula] = [self]
        while stack:
            part = stack.pop()
            if id(part) not in seen:
                seen.add(id(part))
                yield part
                stack.extend(reversed(part.valued() if valued else part.operands()))

    def __bool__(self) -> bool:
        raise TypeError(
            f"a formula has no truth value without a trace: {self}. Combine formulas with "
            "& | ~ instead of and, or, not, and write a < x < b as (a < x) & (x < b)"
        )

    def text(self) -> Text:
        """Return its text and the kind of the text; `parse(str(f)) == f`."""
        word, operands, interval = surface(self)
        span = "" if interval is None or interval.everything else str(interval)
        return operator_text(word, span, [part.text() for part in operands])

    def __str__(self) -> str:
        return self.text().text

    def _repr_latex_(self) -> str:
        return f"${lazy_import('verifai_jax.mtl._latex', 'latex')(self)}$"

    def _repr_html_(self) -> str:
        # Notebooks set mathematics within HTML, and prefer HTML to LaTeX.
        return html.escape(self._repr_latex_())


class Leaf(Formula):
    """A formula without operands."""

    timeless = True


@dataclass(frozen=True, eq=False, repr=False)
class Constant(Leaf):
    """`TRUE` (robustness +inf) or `FALSE` (-inf)."""

    value: bool

    def text(self) -> Text:
        return Text("TRUE" if self.value else "FALSE", "name")


@dataclass(frozen=True, eq=False, repr=False)
class Predicate(Leaf):
    """A comparison; its robustness is the margin by which it holds."""

    comparison: str
    left: Term
    right: Term

    def __post_init__(self) -> None:
        if self.comparison not in COMPARISONS:
            raise unknown_name("comparison", self.comparison, COMPARISONS)
        if not (self.left.signals() or self.right.signals()):
            raise ValueError(
                f"{self} compares numbers but no signal, so its truth is the same on all traces: "
                f"compare a signal, as in x {self.comparison} {self.right}, or write TRUE or FALSE"
            )

    def terms(self) -> tuple[Term, ...]:
        return self.left, self.right

    @property
    def compared(self) -> tuple[Term, str, Term]:
        return self.left, self.comparison, self.right

    def text(self) -> Text:
        return Text(f"{self.left} {self.comparison} {self.right}", "leaf")


@dataclass(frozen=True, eq=False, repr=False)
class Atom(Leaf):
    """A bare expression that is its own robustness; it holds where it is positive."""

    expression: Term

    def __post_init__(self) -> None:
        if not self.expression.signals():
            raise ValueError(
                f"a formula is needed here, not the number {self.expression}: compare a signal "
                f"with it, as in x > {self.expression}, or write TRUE or FALSE"
            )

    def terms(self) -> tuple[Term, ...]:
        return (self.expression,)

    def text(self) -> Text:
        text = str(self.expression)
        # A signal or one of its components ends where it ends, whatever comes after it.
        return Text(text, "name" if self.expression.is_signal else "leaf")


@dataclass(frozen=True, eq=False, repr=False)
class Not(Formula):
    """`!f`."""

    operand: Formula
    children = ("operand",)
    word = "not"


@dataclass(frozen=True, eq=False, repr=False)
class Join(Formula):
    """The minimum (`sign` -1) or maximum (1) of two or more operands."""

    parts: tuple[Formula, ...]
    children: ClassVar[tuple[str, ...]] = ("parts",)
    sign: ClassVar[int]


class And(Join):
    """`f & g & ...`, with two or more operands."""

    word, sign = "and", -1


class Or(Join):
    """`f | g | ...`, with two or more operands."""

    word, sign = "or", 1


@dataclass(frozen=True, eq=False, repr=False)
class Window(Formula):
    """The minimum (`sign` -1) or maximum (1) over an interval, ahead or back."""

    operand: Formula
    children = ("operand",)
    interval: Interval = field(default=EVERYTHING)
    sign: ClassVar[int]


class Always(Window):
    """`f` at every instant of the interval ahead."""

    word, sign = "always", -1


class Eventually(Window):
    """`f` at some instant of the interval ahead."""

    word, sign = "eventually", 1


class Historically(Window):
    """`f` at every instant of the interval before now."""

    word, sign = "historically", -1


class Once(Window):
    """`f` at some instant of the interval before now."""

    word, sign = "once", 1


@dataclass(frozen=True, eq=False, repr=False)
class Next(Formula):
    """`f` at the next sample; at the last sample the value of `f` there, for any end of trace."""

    operand: Formula
    children = ("operand",)
    word = "next"


@dataclass(frozen=True, eq=False, repr=False)
class Prev(Formula):
    """`f` at the previous sample; at the first sample false (or true, if `weak`)."""

    operand: Formula
    children = ("operand",)
    weak: bool = False

    @property
    def word(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The word of the operator, which depends on `weak`."""
        return "weak_prev" if self.weak else "prev"


@dataclass(frozen=True, eq=False, repr=False)
class Witness(Formula):
    """`right` at some instant of an interval, and `left` at every instant from now to there."""

    left: Formula
    right: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("left", "right")


class Until(Witness):
    """`right` at some instant of the interval ahead, and `left` at every earlier instant."""

    word = "until"


class Since(Witness):
    """`right` at some instant of the interval before now, and `left` at every later instant."""

    word = "since"


class Derived(Formula, abc.ABC):
    """An operator defined by a formula of other operators, which gives its value in all semantics.

    A subclass has its operands and its interval as fields, and defines `meaning`.
    """

    children = ("operand",)
    timeless = True  # Its meaning is what looks ahead or back.

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if isinstance(meaning := vars(cls).get("meaning"), property):
            # Made once, since walks know a part by its identity.
            cls.meaning = functools.cached_property(meaning.fget)  # pyright: ignore
            cls.meaning.__set_name__(cls, "meaning")

    @property
    @abc.abstractmethod
    def meaning(self) -> Formula:
        """The formula of other operators that defines it."""

    def below(self) -> tuple[Node, ...]:
        return *super().below(), self.meaning

    def valued(self) -> tuple[Formula, ...]:
        return (self.meaning,)


NODES: dict[str, Callable[..., Formula]] = {
    "not": Not,
    "and": lambda *parts: And(parts),
    "or": lambda *parts: Or(parts),
    "next": Next,
    "prev": Prev,
    "weak_prev": lambda operand: Prev(operand, weak=True),
    "rise": lambda operand: And((operand, Prev(Not(operand)))),
    "fall": lambda operand: And((Not(operand), Prev(operand))),
    "implies": Formula.implies,
    "iff": Formula.iff,
    "xor": Formula.__xor__,
    "weak_until": lambda left, right, span: left.weak_until(right, span),
    "release": lambda left, right, span: left.release(right, span),
    **{kind.word: kind for kind in (Always, Eventually, Historically, Once, Until, Since)},
}
"""What makes each operator of its operands, and of its interval if it takes one."""


def build(word: str, operands: Iterable[Formula], interval: Interval = EVERYTHING) -> Formula:
    """Return the formula of an operator over operands.

    **Arguments:**
    - `word`: the name of the operator, a key of `OPERATORS`.
    - `operands`: its operands, as many as it takes.
    - `interval`: its interval, for an operator that takes one.
    """
    return NODES[word](*operands, *((interval,) if OPERATORS[word].timed else ()))


def surface(f: Formula) -> tuple[str, tuple[Formula, ...], Interval | None]:
    """Return how a formula is written: its operator's word, the operands, and the interval if any.

    Abbreviations that were expanded, such as `->` or `rise`, are recognised.
    """
    match f:
        case Not(Or((And((p, q)), And((Not(r), Not(s)))))) if p == r and q == s:
            return "xor", (p, q), None
        case Not(Until(Not(p), Not(q), interval)):
            return "release", (p, q), interval
        case Or((And((p, q)), And((Not(r), Not(s))))) if p == r and q == s:
            return "iff", (p, q), None
        case Or((Until(p, q, interval), Always(r, kept))) if p == r and kept == _from_now(interval):
            return "weak_until", (p, q), interval
        case Or((Not(p), q)):
            return "implies", (p, q), None
        case And((p, Prev(Not(q), False))) if p == q:
            return "rise", (p,), None
        case And((Not(p), Prev(q, False))) if p == q:
            return "fall", (p,), None
    return f.operator.word, f.operands(), f.interval if f.operator.timed else None


TRUE = Constant(True)
"""The formula that always holds."""
FALSE = Constant(False)
"""The formula that never holds."""


def interval_of(a: Start, b: float) -> Interval:
    """Return the closed interval from `a` to `b`, or the interval that is given instead of `a`."""
    return a if isinstance(a, Interval) else Interval(a, b)


def _from_now(span: Interval) -> Interval:
    return Interval(0.0, span.end, open_end=span.open_end)


def formula(value: Formulaic) -> Formula:
    """Return `value` as a formula; an expression is its own robustness.

    **Raises:** `TypeError` if it is neither a formula nor an expression.
    """
    if isinstance(value, Formula):
        return value
    if isinstance(value, Term):
        return Atom(value)
    raise TypeError(f"a formula is needed here; got {value!r}")


def conjunction(*parts: Formulaic) -> Formula:
    """Return `f & g & ...`; a single part is returned itself."""
    return _joined(And, parts)


def disjunction(*parts: Formulaic) -> Formula:
    """Return `f | g | ...`; a single part is returned itself."""
    return _joined(Or, parts)


def _joined(kind: type[And] | type[Or], parts: tuple[Formulaic, ...]) -> Formula:
    first, *rest = map(formula, parts)
    if not rest:
        return first
    # `a & b & c` is one node, but an implication within `|` must stay readable as one.
    if isinstance(first, kind) and surface(first)[0] == kind.word:
        return kind((*first.parts, *rest))
    return kind((first, *rest))
