"""Formulas of metric temporal logic: what they say, not what they mean.

    x, theta = signal("x"), signal("theta")
    always((abs(x) <= 2.4) & (theta.abs() <= 0.2095), 0, 4)
    (x > 1).until(signal("y") >= 0, 0.2, 0.6)
    ~(x > 1) >> eventually(x < 0, 0, 2)

A formula is a frozen tree, hashable and equal by value, so it is a static argument under `jax.jit`.
Sugar (implication, equivalence, weak until, release) is rewritten into the few nodes below when it
is written; their meaning lives in `robustness.py`, their text in `printing.py`.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias, Union

Formulaic: TypeAlias = Union["Formula", "Expression"]

COMPARISONS = (">=", ">", "<=", "<", "==", "!=")
FUNCTIONS = {"abs": 1, "sqrt": 1, "sin": 1, "cos": 1, "norm": 1, "min": 2, "max": 2}


class Expression:
    """A number at every instant: arithmetic over signals. Comparing one gives a `Formula`.

    `==` compares expressions as trees; the predicate "equal" is `x.equals(3)`, "unequal"
    `x.differs(3)`.
    """

    def __add__(self, other: "Expression | float") -> "Expression":
        return Arithmetic("+", (self, expression(other)))

    def __radd__(self, other: float) -> "Expression":
        return Arithmetic("+", (expression(other), self))

    def __sub__(self, other: "Expression | float") -> "Expression":
        return Arithmetic("-", (self, expression(other)))

    def __rsub__(self, other: float) -> "Expression":
        return Arithmetic("-", (expression(other), self))

    def __mul__(self, other: "Expression | float") -> "Expression":
        return Arithmetic("*", (self, expression(other)))

    def __rmul__(self, other: float) -> "Expression":
        return Arithmetic("*", (expression(other), self))

    def __truediv__(self, other: "Expression | float") -> "Expression":
        return Arithmetic("/", (self, expression(other)))

    def __rtruediv__(self, other: float) -> "Expression":
        return Arithmetic("/", (expression(other), self))

    def __neg__(self) -> "Expression":
        return Arithmetic("neg", (self,))

    def __abs__(self) -> "Expression":
        return Arithmetic("abs", (self,))

    def __getitem__(self, index: int) -> "Expression":
        return Component(self, index)

    def abs(self) -> "Expression":
        """Absolute value."""
        return abs(self)

    def sqrt(self) -> "Expression":
        """Square root; NaN where negative."""
        return Arithmetic("sqrt", (self,))

    def sin(self) -> "Expression":
        """Sine of an angle in radians."""
        return Arithmetic("sin", (self,))

    def cos(self) -> "Expression":
        """Cosine of an angle in radians."""
        return Arithmetic("cos", (self,))

    def norm(self) -> "Expression":
        """Euclidean norm of a vector signal `[time, k]` at every instant."""
        return Arithmetic("norm", (self,))

    def min(self, *others: "Expression | float") -> "Expression":
        """The least of this and the others, at every instant."""
        return Arithmetic("min", (self, *map(expression, others)))

    def max(self, *others: "Expression | float") -> "Expression":
        """The greatest of this and the others, at every instant."""
        return Arithmetic("max", (self, *map(expression, others)))

    def __ge__(self, other: "Expression | float") -> "Formula":
        return Predicate(">=", self, expression(other))

    def __gt__(self, other: "Expression | float") -> "Formula":
        return Predicate(">", self, expression(other))

    def __le__(self, other: "Expression | float") -> "Formula":
        return Predicate("<=", self, expression(other))

    def __lt__(self, other: "Expression | float") -> "Formula":
        return Predicate("<", self, expression(other))

    def equals(self, other: "Expression | float") -> "Formula":
        """The predicate `self == other`, of robustness `-|self - other|`."""
        return Predicate("==", self, expression(other))

    def differs(self, other: "Expression | float") -> "Formula":
        """The predicate `self != other`, of robustness `|self - other|`."""
        return Predicate("!=", self, expression(other))

    def __and__(self, other: Formulaic) -> "Formula":
        return formula(self) & other

    def __or__(self, other: Formulaic) -> "Formula":
        return formula(self) | other

    def __rshift__(self, other: Formulaic) -> "Formula":
        return formula(self) >> other

    def __invert__(self) -> "Formula":
        return ~formula(self)

    def __str__(self) -> str:
        from verifai_jax.mtl.printing import show_expression

        return show_expression(self)


@dataclass(frozen=True)
class Number(Expression):
    """A constant."""

    value: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", float(self.value))
        if not math.isfinite(self.value):
            raise ValueError(f"a number in a formula must be finite; got {self.value}")

    def __neg__(self) -> "Expression":
        return Number(-self.value)


@dataclass(frozen=True)
class Signal(Expression):
    """A signal of the trace, by name. A boolean signal counts as +1 (true) and -1 (false)."""

    name: str

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(r'[^"\n]+', self.name):
            raise ValueError(
                f"a signal's name is a non-empty text without quotes or line breaks; "
                f"got {self.name!r}"
            )


@dataclass(frozen=True)
class Component(Expression):
    """One component of a vector signal `[time, k]`, counted from 0."""

    vector: Expression
    index: int

    def __post_init__(self) -> None:
        if not isinstance(self.vector, Signal):
            raise ValueError(f"only a signal has components; got ({self.vector})[{self.index}]")
        if not isinstance(self.index, int) or self.index < 0:
            raise ValueError(
                f"a component's index is an integer, at least 0; got {self.vector}[{self.index}]"
            )


@dataclass(frozen=True)
class Arithmetic(Expression):
    """An operator (`+ - * / neg`) or a function (see `FUNCTIONS`) of expressions."""

    name: str
    arguments: tuple[Expression, ...]

    def __post_init__(self) -> None:
        n, least = len(self.arguments), FUNCTIONS.get(self.name)
        if least is not None and (n != 1 if least == 1 else n < least):
            wanted = "one argument" if least == 1 else "two arguments or more"
            raise ValueError(f"{self.name} takes {wanted}; got {n}")


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
        """Whether this is `[0, inf]`, which the text leaves out."""
        return self.start == 0 and self.end == math.inf

    def __str__(self) -> str:
        from verifai_jax.mtl.printing import show_number

        return f"[{show_number(self.start)},{show_number(self.end)}]"


EVERYTHING = Interval()


class Formula:
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
        """`self -> other`, also written `self >> other`."""
        return self >> other

    def iff(self, other: Formulaic) -> "Formula":
        """`self <-> other`; its negation is `self ^ other`."""
        other = formula(other)
        return Or((And((self, other)), And((Not(self), Not(other)))))

    def until(self, other: Formulaic, a: float = 0.0, b: float = math.inf) -> "Formula":
        """`self` holds until `other` does, `a` to `b` seconds ahead; not needed at the witness."""
        return Until(self, formula(other), Interval(a, b))

    def weak_until(self, other: Formulaic, a: float = 0.0, b: float = math.inf) -> "Formula":
        """`self` until `other`, or `self` throughout `[0, b]`."""
        return Or((self.until(other, a, b), Always(self, Interval(0.0, b))))

    def release(self, other: Formulaic, a: float = 0.0, b: float = math.inf) -> "Formula":
        """`other` holds up to and including the instant where `self` does: the dual of until."""
        return Not(Until(Not(self), Not(formula(other)), Interval(a, b)))

    def since(self, other: Formulaic, a: float = 0.0, b: float = math.inf) -> "Formula":
        """`other` held, `a` to `b` seconds ago, and `self` ever since."""
        return Since(self, formula(other), Interval(a, b))

    def signals(self) -> tuple[str, ...]:
        """Names of the signals it speaks of, in order of appearance."""
        from verifai_jax.mtl.rewriting import signals

        return signals(self)

    def horizon(self, dt: float = 0.0) -> float:
        """Seconds of trace beyond an instant on which its truth there depends; may be infinite.

        `next` reaches one sampling period `dt` ahead.
        """
        from verifai_jax.mtl.rewriting import horizon

        return horizon(self, dt)

    def operands(self) -> tuple["Formula", ...]:
        """The formulas it is made of, left to right."""
        parts: list[Formula] = []
        for name in self.children:
            value = getattr(self, name)
            parts.extend(value if isinstance(value, tuple) else (value,))
        return tuple(parts)

    def subformulas(self) -> Iterator["Formula"]:
        """Itself and everything below, parents first, left to right, with repetitions."""
        yield self
        for part in self.operands():
            yield from part.subformulas()

    def __bool__(self) -> bool:
        raise TypeError(
            f"a formula has no truth value without a trace: {self}. Combine formulas with "
            "& | ~ instead of and, or, not, and write a < x < b as (a < x) & (x < b)"
        )

    def __str__(self) -> str:
        from verifai_jax.mtl.printing import show

        return show(self)


@dataclass(frozen=True)
class Constant(Formula):
    """`TRUE` (robustness +inf) or `FALSE` (-inf)."""

    value: bool


@dataclass(frozen=True)
class Predicate(Formula):
    """A comparison; its robustness is the margin by which it holds."""

    comparison: str
    left: Expression
    right: Expression


@dataclass(frozen=True)
class Atom(Formula):
    """A bare expression that is its own robustness; it holds where it is positive."""

    expression: Expression


@dataclass(frozen=True)
class Not(Formula):
    """`!f`."""

    operand: Formula
    children: ClassVar[tuple[str, ...]] = ("operand",)


@dataclass(frozen=True)
class And(Formula):
    """`f & g & ...`, two operands or more."""

    parts: tuple[Formula, ...]
    children: ClassVar[tuple[str, ...]] = ("parts",)


@dataclass(frozen=True)
class Or(Formula):
    """`f | g | ...`, two operands or more."""

    parts: tuple[Formula, ...]
    children: ClassVar[tuple[str, ...]] = ("parts",)


@dataclass(frozen=True)
class Always(Formula):
    """`f` at every instant of the interval ahead."""

    operand: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("operand",)


@dataclass(frozen=True)
class Eventually(Formula):
    """`f` at some instant of the interval ahead."""

    operand: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("operand",)


@dataclass(frozen=True)
class Historically(Formula):
    """`f` at every instant of the interval behind."""

    operand: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("operand",)


@dataclass(frozen=True)
class Once(Formula):
    """`f` at some instant of the interval behind."""

    operand: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("operand",)


@dataclass(frozen=True)
class Next(Formula):
    """`f` at the next sample; at the last one, `f` there, whatever the end of trace."""

    operand: Formula
    children: ClassVar[tuple[str, ...]] = ("operand",)


@dataclass(frozen=True)
class Prev(Formula):
    """`f` at the previous sample; where there is none, false (or true, if `weak`)."""

    operand: Formula
    weak: bool = False
    children: ClassVar[tuple[str, ...]] = ("operand",)


@dataclass(frozen=True)
class Until(Formula):
    """`right` at some instant of the interval ahead, and `left` at every one before it."""

    left: Formula
    right: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("left", "right")


@dataclass(frozen=True)
class Since(Formula):
    """`right` at some instant of the interval behind, and `left` at every one after it."""

    left: Formula
    right: Formula
    interval: Interval = field(default=EVERYTHING)
    children: ClassVar[tuple[str, ...]] = ("left", "right")


TRUE = Constant(True)
FALSE = Constant(False)


def expression(value: "Expression | float") -> Expression:
    """`value` as an expression. **Raises:** `TypeError` if it is neither one nor a number."""
    if isinstance(value, Expression):
        return value
    if isinstance(value, Formula):
        raise TypeError(f"a number or a signal is needed here, not the formula {value}")
    if isinstance(value, bool) or not hasattr(value, "__float__"):
        raise TypeError(f"a number or a signal is needed here; got {value!r}")
    return Number(float(value))


def formula(value: Formulaic) -> Formula:
    """`value` as a formula; an expression is its own robustness.

    **Raises:** `TypeError` if it is neither.
    """
    if isinstance(value, Formula):
        return value
    if isinstance(value, Expression):
        return Atom(value)
    raise TypeError(f"a formula is needed here; got {value!r}")


def signal(name: str) -> Signal:
    """The signal called `name`, to build expressions and predicates from."""
    return Signal(name)


def conjunction(*parts: Formulaic) -> Formula:
    """`f & g & ...`; one part alone is itself."""
    return _joined(And, "and", parts)


def disjunction(*parts: Formulaic) -> Formula:
    """`f | g | ...`; one part alone is itself."""
    return _joined(Or, "or", parts)


def _joined(kind: type[And] | type[Or], word: str, parts: tuple[Formulaic, ...]) -> Formula:
    from verifai_jax.mtl.printing import sugared

    first, *rest = map(formula, parts)
    if not rest:
        return first
    # `a & b & c` is one node, but an implication within `|` must stay readable as one.
    if isinstance(first, And | Or) and isinstance(first, kind) and sugared(first)[0] == word:
        return kind((*first.parts, *rest))
    return kind((first, *rest))


def always(operand: Formulaic, a: float = 0.0, b: float = math.inf) -> Formula:
    """`operand` holds at every instant from `a` to `b` seconds ahead, both included."""
    return Always(formula(operand), Interval(a, b))


def eventually(operand: Formulaic, a: float = 0.0, b: float = math.inf) -> Formula:
    """`operand` holds at some instant from `a` to `b` seconds ahead, both included."""
    return Eventually(formula(operand), Interval(a, b))


def historically(operand: Formulaic, a: float = 0.0, b: float = math.inf) -> Formula:
    """`operand` held at every instant from `a` to `b` seconds ago, both included."""
    return Historically(formula(operand), Interval(a, b))


def once(operand: Formulaic, a: float = 0.0, b: float = math.inf) -> Formula:
    """`operand` held at some instant from `a` to `b` seconds ago, both included."""
    return Once(formula(operand), Interval(a, b))


def until(left: Formulaic, right: Formulaic, a: float = 0.0, b: float = math.inf) -> Formula:
    """`left` holds until `right` does, `a` to `b` seconds ahead; not needed at the witness."""
    return formula(left).until(right, a, b)


def since(left: Formulaic, right: Formulaic, a: float = 0.0, b: float = math.inf) -> Formula:
    """`right` held, `a` to `b` seconds ago, and `left` ever since."""
    return formula(left).since(right, a, b)


def next_(operand: Formulaic) -> Formula:
    """`operand` holds at the next sample."""
    return Next(formula(operand))


def prev(operand: Formulaic, weak: bool = False) -> Formula:
    """`operand` held at the previous sample; false at the first one (true, if `weak`)."""
    return Prev(formula(operand), weak)
