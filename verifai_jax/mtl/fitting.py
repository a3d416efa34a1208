"""Expressions that a recording completes: by the units of its signals, and by their sizes.

    fitted(parse("speed <= 130 km/h"), {"speed": "m/s"}, {})      # speed <= 36.11
    fitted(parse("all(x) < 3"), {}, {"x": 2})                     # x[0] < 3 & x[1] < 3

Add-ons define them. Each evaluation fits the leaves of a formula to its signals.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import Arithmetic, Expression, Signal, expression
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.rewriting import replaced
from verifai_jax.mtl.sampled import Sampled, sampled_in, with_counted
from verifai_jax.mtl.tree import postorder


def fitted(formula: Formula, units: Mapping[str, str], sizes: Mapping[str, int]) -> Formula:
    """Return a formula without expressions that the units and the sizes of signals complete.

    **Arguments:**
    - `units`: units by signal, as far as they are known.
    - `sizes`: numbers of components by vector signal.
    **Raises:** `ValueError` for units that do not go together, and for a vector without a size.
    """
    kinds = _open_kinds(formula)
    if not kinds:
        return formula

    def counted(part: Term) -> Term | None:
        if not (isinstance(part, Sampled) and part.counted):
            return None
        return part.changed(
            lambda a: fitted(a, units, sizes) if isinstance(a, Formula) else rebuilt(a, counted)
        )

    formula = changed_leaves(formula, lambda leaf: with_terms(leaf, counted))
    for kind in kinds:
        formula = changed_leaves(formula, lambda leaf, k=kind: k.fitted(leaf, units, sizes))
    return formula


def sizes_of(signals: Mapping[str, Any], lanes: int = 0) -> dict[str, int]:
    """Return the numbers of components of vector signals `[time, *lanes, k]`."""
    return {name: x.shape[-1] for name, x in signals.items() if x.ndim == 2 + lanes}


def is_open(formula: Formula) -> bool:
    """Return whether units or sizes of signals have to complete a formula."""
    return bool(_open_kinds(formula))


def assumptions(formula: Formula, units: Mapping[str, str]) -> tuple[str, ...]:
    """Return sentences on what is taken for granted of signals whose units are not known."""
    leaves = [leaf for f in with_counted(formula) for leaf in f.subformulas() if leaf.terms()]
    kinds = [kind for kind in _open_kinds(formula) if hasattr(kind, "assumed")]
    return tuple(dict.fromkeys(s for k in kinds for leaf in leaves for s in k.assumed(leaf, units)))


def changed_leaves(formula: Formula, change: Callable[[Formula], Formula]) -> Formula:
    """Return a formula with other leaves in place of its predicates."""
    leaves = dict.fromkeys(leaf for leaf in formula.subformulas() if leaf.is_predicate)
    return replaced(formula, {leaf: change(leaf) for leaf in leaves})


def with_terms(leaf: Formula, change: Callable[[Term], Term | None]) -> Formula:
    """Return a predicate whose expressions have other parts (see `rebuilt`)."""
    if leaf.compared is None:
        return ast.Atom(rebuilt(leaf.terms()[0], change))
    left, comparison, right = leaf.compared
    return ast.Predicate(comparison, rebuilt(left, change), rebuilt(right, change))


@functools.lru_cache(1024)
def _open_kinds(formula: Formula) -> tuple[Any, ...]:
    leaves = (leaf for f in with_counted(formula) for leaf in f.subformulas())
    terms = [term for leaf in leaves for term in leaf.terms()]
    for each in sampled_in(formula):
        terms += (operand for operand in each.operands if isinstance(operand, Term))
    kinds = {type(part) for term in terms for part in postorder(term) if part.opened}
    return tuple(sorted(kinds, key=lambda kind: kind.opened))


def rebuilt(e: Term, change: Callable[[Term], Term | None]) -> Expression:
    """Return an expression in which parts are replaced by what `change` returns for them.

    What it returns None for is kept, and its parts are asked; formulas within are kept.
    """
    new = change(e)
    if new is not None:
        return expression(new)
    if isinstance(e, Arithmetic):
        return Arithmetic(e.name, tuple(rebuilt(a, change) for a in e.arguments))
    if isinstance(e, Signal):
        return e.changed(lambda a: a if isinstance(a, Formula) else rebuilt(a, change))
    return expression(e)
