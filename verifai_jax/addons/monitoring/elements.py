"""Quantifiers over the elements of a vector signal: `all(x) < 3`, `any(abs(q - p)) >= 2`.

They hold if the comparison holds for all (or any) of the elements. An evaluation knows how many
there are, and replaces the comparison by one for each: `x[0] < 3 & x[1] < 3`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import Component, Expression, Signal, expression
from verifai_jax.mtl.fitting import rebuilt, with_terms
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.sampled import Sampled
from verifai_jax.mtl.tree import Node, postorder


@dataclass(frozen=True, eq=False, repr=False)
class Elements(Signal):
    """The elements of an expression over vectors, of which all, or any, are compared."""

    operand: Expression
    every: bool
    opened = 1

    def changed(self, change: Callable[[Any], Any]) -> "Elements":
        """Return the elements of a changed expression."""
        return (all_of if self.every else any_of)(change(self.operand))

    @property
    def is_signal(self) -> bool:
        """False, because its text is that of a function."""
        return False

    def below(self) -> tuple[Node, ...]:
        """Return its expression."""
        return (self.operand,)

    def signals(self) -> tuple[str, ...]:
        return self.operand.signals()

    def text(self, outer: int = 0) -> str:
        return self.name

    @classmethod
    def fitted(cls, leaf: Formula, units: Mapping[str, str], sizes: Mapping[str, int]) -> Formula:
        """Return a comparison for each element, all together.

        **Raises:** `ValueError` for no vector whose size is known, or vectors of two sizes.
        """
        parts = [part for term in leaf.terms() for part in postorder(term)]
        for each in (part for part in parts if isinstance(part, Sampled)):
            for operand in each.operands:
                if any(isinstance(part, Elements) for part in postorder(operand)):
                    raise ValueError(
                        f"{each} is one number, and {operand} stands for several: write all or any "
                        "around it"
                    )
        found = [part for part in parts if isinstance(part, Elements)]
        if not found:
            return leaf
        names = dict.fromkeys(name for each in found for name in each.signals())
        known = {name: sizes[name] for name in names if name in sizes}
        if len({each.every for each in found}) > 1:
            raise ValueError(f"{leaf} asks for all and for any elements: compare them one by one")
        if not known:
            name = next(iter(names))
            raise ValueError(
                f"{leaf} needs a vector: {name} as [time, k], or its number of components, as in "
                f"sizes={{{name!r}: 3}}"
            )
        if len(set(known.values())) > 1:
            raise ValueError(f"{leaf} needs vectors of one size; got {known}")

        def of(k: int) -> Formula:
            def component(part: Term) -> Term | None:
                if isinstance(part, Component):
                    return part
                is_vector = isinstance(part, Signal) and part.name in known
                return Component(expression(part), k) if is_vector else None

            def change(part: Term) -> Term | None:
                return rebuilt(part.operand, component) if isinstance(part, Elements) else None

            return with_terms(leaf, change)

        cases = [of(k) for k in range(next(iter(known.values())))]
        return ast.conjunction(*cases) if found[0].every else ast.disjunction(*cases)


def all_of(operand: Term) -> Elements:
    """Compare all elements of a vector: `all_of(x) <= 3` holds if each of them is at most 3."""
    return Elements(f"all({operand})", expression(operand), True)


def any_of(operand: Term) -> Elements:
    """Compare any element of a vector: `any_of(x) >= 3` holds if one of them is at least 3."""
    return Elements(f"any({operand})", expression(operand), False)
