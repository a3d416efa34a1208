"""Expressions over signals: arithmetic whose comparisons are formulas.

x, theta = signal("x"), signal("theta")
2 * x + theta.abs() <= 2.4                                    # a Formula
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from operator import methodcaller
from typing import Any

from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.mtl.formula import Formula, Predicate, Term, formula
from verifai_jax.mtl.tree import postorder
from verifai_jax.mtl.words import FUNCTIONS, NUMBERS, name_text, number_text

CONSTANT: dict[str, Callable[..., float]] = {
    "neg": lambda a: -a,
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "**": math.pow,
    "abs": math.fabs,
    "sqrt": math.sqrt,
    "sin": math.sin,
    "cos": math.cos,
    "exp": math.exp,
    "min": min,
    "max": max,
}
"""The functions of numbers, which raise where the result is not finite; `norm` is of vectors."""
_NAMED = {sign * v: f"{'-' * (sign < 0)}{word}" for word, v in NUMBERS.items() for sign in (1, -1)}
"""Numbers that are printed by their name, and their opposites."""
PRECEDENCE = {"+": 1, "-": 1, "*": 2, "/": 2, "neg": 3, "**": 4}
"""Binding strength of the operators."""


class Expression(Term):
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

    def __pow__(self, other: "Expression | float") -> "Expression":
        return Arithmetic("**", (self, expression(other)))

    def __rpow__(self, other: float) -> "Expression":
        return Arithmetic("**", (expression(other), self))

    def __neg__(self) -> "Expression":
        return Arithmetic("neg", (self,))

    def __abs__(self) -> "Expression":
        return Arithmetic("abs", (self,))

    def __getitem__(self, index: int) -> "Expression":
        return Component(self, index)

    def abs(self) -> "Expression":
        """Return the absolute value."""
        return abs(self)

    def sqrt(self) -> "Expression":
        """Return the square root; NaN for negative values."""
        return Arithmetic("sqrt", (self,))

    def sin(self) -> "Expression":
        """Return the sine of an angle in radians."""
        return Arithmetic("sin", (self,))

    def cos(self) -> "Expression":
        """Return the cosine of an angle in radians."""
        return Arithmetic("cos", (self,))

    def exp(self) -> "Expression":
        """Return e to this power."""
        return Arithmetic("exp", (self,))

    def norm(self) -> "Expression":
        """Return the Euclidean norm of a vector signal `[time, k]` at every instant."""
        return Arithmetic("norm", (self,))

    def min(self, *others: "Expression | float") -> "Expression":
        """Return the minimum of this and the others, at every instant."""
        return Arithmetic("min", (self, *map(expression, others)))

    def max(self, *others: "Expression | float") -> "Expression":
        """Return the maximum of this and the others, at every instant."""
        return Arithmetic("max", (self, *map(expression, others)))

    def __ge__(self, other: "Expression | float") -> Formula:
        return Predicate(">=", self, expression(other))

    def __gt__(self, other: "Expression | float") -> Formula:
        return Predicate(">", self, expression(other))

    def __le__(self, other: "Expression | float") -> Formula:
        return Predicate("<=", self, expression(other))

    def __lt__(self, other: "Expression | float") -> Formula:
        return Predicate("<", self, expression(other))

    def equals(self, other: "Expression | float") -> Formula:
        """Return the predicate `self == other`, of robustness `-|self - other|`."""
        return Predicate("==", self, expression(other))

    def differs(self, other: "Expression | float") -> Formula:
        """Return the predicate `self != other`, of robustness `|self - other|`."""
        return Predicate("!=", self, expression(other))

    def __and__(self, other: Formula | Term) -> Formula:
        return formula(self) & other

    def __or__(self, other: Formula | Term) -> Formula:
        return formula(self) | other

    def __xor__(self, other: Formula | Term) -> Formula:
        if not isinstance(other, Formula | Term):
            raise _not_a_power(self, other)
        return formula(self) ^ other

    def __rxor__(self, other: object) -> Formula:
        raise _not_a_power(other, self)

    def __rshift__(self, other: Formula | Term) -> Formula:
        return formula(self) >> other

    def __invert__(self) -> Formula:
        return ~formula(self)


@dataclass(frozen=True, eq=False, repr=False)
class Number(Expression):
    """A constant."""

    value: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", float(self.value))
        if not math.isfinite(self.value):
            raise ValueError(f"a number in a formula must be finite; got {self.value}")

    @property
    def number(self) -> float:
        return self.value

    @property
    def seconds(self) -> float:
        """The number as a time in seconds."""
        return self.value

    def __neg__(self) -> "Expression":
        return Number(-self.value)

    def text(self, outer: int = 0) -> str:
        text = _NAMED.get(self.value) or number_text(self.value)
        return f"({text})" if self.value < 0 and outer > 0 else text


@dataclass(frozen=True, eq=False, repr=False)
class Signal(Expression):
    """A signal of the trace, by name. A boolean signal counts as +1 (true) and -1 (false)."""

    name: str

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(r'[^"\n]+', self.name):
            raise ValueError(
                f"a signal's name is a non-empty text without quotes or line breaks; "
                f"got {self.name!r}"
            )

    @property
    def is_signal(self) -> bool:
        return True

    def changed(self, change: Callable[[Any], Any]) -> "Signal":
        """Return the same function of changed operands, for a signal that is computed of others."""
        return self

    def signals(self) -> tuple[str, ...]:
        return (self.name,)

    def text(self, outer: int = 0) -> str:
        """Return its name, in quotes if the grammar needs them."""
        return name_text(self.name)


@dataclass(frozen=True, eq=False, repr=False)
class Component(Expression):
    """One component of a vector signal `[time, k]`, counted from 0."""

    vector: Expression
    index: int

    def __post_init__(self) -> None:
        if not (isinstance(self.vector, Signal) and self.vector.is_signal):
            raise ValueError(f"only a signal has components; got ({self.vector})[{self.index}]")
        if not isinstance(self.index, int) or self.index < 0:
            raise ValueError(
                f"a component's index is an integer, at least 0; got {self.vector}[{self.index}]"
            )

    @property
    def is_signal(self) -> bool:
        return True

    def signals(self) -> tuple[str, ...]:
        return self.vector.signals()

    def text(self, outer: int = 0) -> str:
        return f"{self.vector}[{self.index}]"


@dataclass(frozen=True, eq=False, repr=False)
class Arithmetic(Expression):
    """An operator (`+ - * / ** neg`) or a function (see `FUNCTIONS`) of expressions."""

    name: str
    arguments: tuple[Expression, ...]

    def __post_init__(self) -> None:
        if self.name not in (*PRECEDENCE, *FUNCTIONS):
            raise unknown_name("function", self.name, FUNCTIONS)
        n, minimum = len(self.arguments), FUNCTIONS.get(self.name)
        if minimum is not None and (n != 1 if minimum == 1 else n < minimum):
            wanted = "one argument" if minimum == 1 else "two arguments or more"
            raise ValueError(f"{self.name} takes {wanted}; got {n}")
        argument = self.arguments[0]
        if self.name == "norm" and isinstance(argument, Signal) and not argument.is_signal:
            raise ValueError(f"norm takes a vector signal; got {self}")
        values = [constant_value(argument) for argument in self.arguments]
        if self.name == "/" and values[1] == 0.0:
            raise ValueError(f"a division by zero: {self}")
        if None not in values and self.name in CONSTANT:
            try:
                value = float(CONSTANT[self.name](*values))
            except (ArithmeticError, ValueError):
                value = math.nan
            if not math.isfinite(value):
                raise ValueError(f"a number in a formula must be finite; {self} is not")
            object.__setattr__(self, "_constant", value)

    def signals(self) -> tuple[str, ...]:
        leaves = (part for part in postorder(self) if isinstance(part, Signal))
        return tuple(dict.fromkeys(name for leaf in leaves for name in leaf.signals()))

    def text(self, outer: int = 0) -> str:
        if self.name not in PRECEDENCE:
            # Deep arguments take one level of Python's stack each, as short as it can be.
            return f"{self.name}({', '.join(map(methodcaller('text'), self.arguments))})"
        level = PRECEDENCE[self.name]
        if self.name == "neg":
            text = f"-{self.arguments[0].text(level + 1)}"
        elif self.name == "**":
            # A power of a power needs parentheses on either side, as no two tools read it alike.
            base, exponent = (part.text(level + 1) for part in self.arguments)
            text = f"{base}**{exponent}"
        else:
            # In a loop: a sum of many terms leans to the left as deep as it is long.
            node: Expression = self
            pieces: list[str] = []
            while isinstance(node, Arithmetic) and PRECEDENCE.get(node.name) == level:
                pieces.append(f" {node.name} {node.arguments[1].text(level + 1)}")
                node = node.arguments[0]
            text = "".join([node.text(level), *reversed(pieces)])
        return f"({text})" if level < outer else text


def _not_a_power(base: object, exponent: object) -> TypeError:
    try:
        power = str(expression(base) ** expression(exponent))  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        power = "x**2"
    return TypeError(f"'^' is exclusive or, between formulas; a power is {power}")


def constant_value(e: Expression) -> float | None:
    """Return the value of an expression without signals; None for one with signals."""
    return e.value if isinstance(e, Number) else e.__dict__.get("_constant")


def expression(value: "Term | float") -> Expression:
    """Return `value` as an expression.

    **Raises:** `TypeError` if it is neither an expression nor a number.
    """
    if isinstance(value, Expression):
        return value
    if isinstance(value, Formula):
        raise TypeError(f"a number or a signal is needed here, not the formula {value}")
    if isinstance(value, bool) or not hasattr(value, "__float__"):
        raise TypeError(f"a number or a signal is needed here; got {value!r}")
    return Number(float(value))  # pyright: ignore[reportArgumentType]


def signal(name: str) -> Signal:
    """Return the signal called `name`, to build expressions and predicates from.

    **Raises:** `ValueError` for an empty name, or one with quotes or line breaks.
    """
    return Signal(name)
