"""The bounds that the predicates of a formula put on its signals."""

from verifai_jax.mtl.expression import (
    Arithmetic,
    Component,
    Expression,
    Number,
    Signal,
    constant_value,
    expression,
)
from verifai_jax.mtl.formula import Formula, Predicate, Term
from verifai_jax.mtl.sampled import with_counted


def signal_bounds(formula: Formula, signal: str) -> list[tuple[Formula, list[Expression]]]:
    """Return the values with which predicates compare this signal, if they can be solved for it.

    `abs(x - 1) <= 0.2` bounds x by 1.2 and 0.8, `y >= 2 * x` bounds y by 2 * x.
    """
    bounds = []
    for part in (part for whole in with_counted(formula) for part in predicates_of(whole)):
        # An expression by itself holds where it is above zero.
        sides = part.terms() if part.compared else (*part.terms(), Number(0))
        left, right = map(expression, sides)
        for inner, limit in ((left, right), (right, left)):
            if signal in inner.signals() and signal not in limit.signals():
                limits = _solved(inner, signal, limit)
                if limits:
                    bounds.append((part, limits))
    return bounds


def predicates_of(formula: Formula) -> list[Formula]:
    """Return the predicates of a formula, each once."""
    return [part for part in dict.fromkeys(formula.subformulas()) if part.is_predicate]


def constant_bounds(predicate: Formula) -> tuple[Term, list[float]] | None:
    """Return the expression on the left of a comparison, and the numbers that bound it.

    `abs(x) <= 2` bounds `x` by 2 and -2. If signals are compared there are no numbers.

    **Returns:** None for a formula that is not a comparison.
    """
    match predicate:
        case Predicate("<" | "<=", Arithmetic("abs", (inner,)), Number(limit)):
            return inner, [limit, -limit]
        case Predicate(_, left, Number(limit)):
            return left, [limit]
        case Predicate(_, left, _):
            return left, []
    return None


def _solved(inner: Expression, signal: str, limit: Expression) -> list[Expression]:
    """Return the values of the signal at which `inner` is `limit`.

    An absolute value has two; an expression that is not linear gives none.
    """
    limits = [limit]
    try:
        while isinstance(inner, Arithmetic):
            if inner.name == "abs":
                inner, limits = inner.arguments[0], [*limits, *(-each for each in limits)]
                continue
            if inner.name == "neg":
                inner, limits = inner.arguments[0], [-each for each in limits]
                continue
            if inner.name not in ("+", "-", "*", "/"):
                return []
            left, right = inner.arguments
            first = signal in left.signals()
            if first and signal in right.signals():
                return []
            other = right if first else left
            if inner.name in ("*", "/") and constant_value(other) is None:
                return []
            if inner.name == "+":
                limits = [each - other for each in limits]
            elif inner.name == "-":
                limits = [each + other if first else other - each for each in limits]
            elif inner.name == "*":
                limits = [each / other for each in limits]
            else:
                limits = [each * other if first else other / each for each in limits]
            inner = left if first else right
    except ValueError:  # a division by zero
        return []
    if isinstance(inner, Component):
        inner = inner.vector
    return limits if inner == Signal(signal) else []
