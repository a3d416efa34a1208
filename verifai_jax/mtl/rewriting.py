"""Rewritings that keep a formula's value.

nnf(f)                                            # negations only at the leaves
simplify(f)                                       # fewer nodes, the same robustness
"""

from collections.abc import Mapping
from decimal import Decimal

from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.formula import FALSE, TRUE, Formula, Interval
from verifai_jax.mtl.tree import missing_case, postorder
from verifai_jax.mtl.words import COMPARISONS


def nnf(f: Formula) -> Formula:
    """Return the negation normal form: `!` only on equalities and bare signals.

    It has the same robustness. Inequalities absorb their negation (`!(x > 1)` becomes `x <= 1`).
    There is no node for the dual of until, so `!(f until g)` remains, with `f` and `g` in normal
    form; the same for since.
    """
    return _nnf(f, True, {})


def _nnf(f: Formula, positive: bool, known: dict[tuple[Formula, bool], Formula]) -> Formula:
    # Each part once, wherever it stands: `f <-> g` holds both sides twice.
    if (f, positive) not in known:
        known[f, positive] = _nnf_node(f, positive, known)
    return known[f, positive]


def _nnf_node(f: Formula, positive: bool, known: dict[tuple[Formula, bool], Formula]) -> Formula:
    match f:
        case ast.Constant(value):
            return TRUE if value == positive else FALSE
        case ast.Predicate(comparison, left, right):
            return f if positive else ast.Predicate(COMPARISONS[comparison].opposite, left, right)
        case ast.Atom():
            return f if positive else ast.Not(f)
        case ast.Not(operand):
            return _nnf(operand, not positive, known)
        case ast.Witness(left, right, interval):
            kept = type(f)(_nnf(left, True, known), _nnf(right, True, known), interval)
            return kept if positive else ast.Not(kept)
        case ast.Derived():
            return _nnf(f.meaning, positive, known)
    if not f.operator.dual:
        raise missing_case("the negation normal form", f)
    word = f.operator.word if positive else f.operator.dual
    operands = [_nnf(part, positive, known) for part in f.operands()]
    return ast.build(word, operands, *([f.interval] if f.operator.timed else ()))


def simplify(f: Formula) -> Formula:
    """Return a formula with fewer nodes and the same robustness on every trace under `hold`.

    It removes constants, double negations, duplicates in `&` and `|`, nested `always always` and
    `eventually eventually`, and operators over `[0,0]`. Under `end="truncate"` nested windows may
    differ from the merged one if a window is empty.
    """
    return _simplified(f, {})


def _simplified(f: Formula, known: dict[Formula, Formula]) -> Formula:
    # Each part once, wherever it stands: `f <-> g` holds both sides twice.
    if f not in known:
        operands = tuple(_simplified(part, known) for part in f.operands())
        known[f] = _simplified_node(rebuild(f, operands))
    return known[f]


def _simplified_node(f: Formula) -> Formula:
    match f:
        case ast.Not(ast.Not(inner)):
            return inner
        case ast.Not(ast.Constant(value)):
            return FALSE if value else TRUE
        case ast.Not(ast.Predicate()):
            return nnf(f)
        case ast.And(parts):
            return _simplified_join(parts, neutral=TRUE, absorbing=FALSE)
        case ast.Or(parts):
            return _simplified_join(parts, neutral=FALSE, absorbing=TRUE)
        case ast.Always(ast.Constant() as c, _) | ast.Eventually(ast.Constant() as c, _):
            return c
        case (
            ast.Always(inner, Interval(0.0, 0.0))
            | ast.Eventually(inner, Interval(0.0, 0.0))
            | ast.Historically(inner, Interval(0.0, 0.0))
            | ast.Once(inner, Interval(0.0, 0.0))
        ):
            return inner
        case ast.Always(ast.Always(inner, low), high) if low.closed and high.closed:
            return ast.Always(inner, _sum(low, high))
        case ast.Eventually(ast.Eventually(inner, low), high) if low.closed and high.closed:
            return ast.Eventually(inner, _sum(low, high))
        case ast.Until(ast.Constant(True), right, interval):
            return simplify(ast.Eventually(right, interval))
        case ast.Until(_, ast.Constant(False), _) | ast.Since(_, ast.Constant(False), _):
            return FALSE
        case ast.Until(_, right, Interval(0.0, 0.0)) | ast.Since(_, right, Interval(0.0, 0.0)):
            return right
        case ast.Since(ast.Constant(True), right, interval):
            return ast.Once(right, interval)
    return f


def _sum(low: Interval, high: Interval) -> Interval:
    # In decimal, so that 0.1 + 0.2 stays a multiple of the sampling period to the last digit.
    start, end = (
        float(Decimal(repr(a)) + Decimal(repr(b)))
        for a, b in ((low.start, high.start), (low.end, high.end))
    )
    return Interval(start, end)


def _simplified_join(parts: tuple[Formula, ...], neutral: Formula, absorbing: Formula) -> Formula:
    kind = ast.And if neutral == TRUE else ast.Or
    parts = tuple(q for p in parts for q in (p.parts if isinstance(p, kind) else (p,)))
    if absorbing in parts:
        return absorbing
    kept = tuple(dict.fromkeys(part for part in parts if part != neutral))
    if not kept:
        return neutral
    return kept[0] if len(kept) == 1 else kind(kept)


def rebuild(f: Formula, operands: tuple[Formula, ...]) -> Formula:
    """Return the same operator with other operands."""
    if isinstance(f, ast.Leaf):
        return f
    return ast.build(f.operator.word, operands, *([f.interval] if f.operator.timed else ()))


def replaced(f: Formula, parts: Mapping[Formula, Formula]) -> Formula:
    """Return the formula with some of its parts replaced by other formulas."""
    if f in parts:
        return parts[f]
    return rebuild(f, tuple(replaced(part, parts) for part in f.operands()))


def asked_at_once(f: Formula) -> Formula:
    """Return a formula without operators that look ahead which must hold at time 0 if `f` does."""
    f = nnf(f)
    match f:
        case ast.And(parts):
            return simplify(ast.And(tuple(map(asked_at_once, parts))))
        case ast.Always(part, span) if span.start == 0 and not span.open_start:
            return asked_at_once(part)
    return TRUE if any(part.side == "ahead" for part in f.subformulas(valued=True)) else f


def expand(f: Formula) -> Formula:
    """Return a formula without `Derived` operators: each is replaced by its meaning."""
    known: dict[Formula, Formula] = {}
    for part in postorder(f):
        if isinstance(part, Formula):
            operands = tuple(known[p] for p in part.valued())
            known[part] = operands[0] if isinstance(part, ast.Derived) else rebuild(part, operands)
    return known[f]
