"""Going through a program that JAX traced, with values of any kind in place of arrays."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from jax.extend.core import Literal

V = TypeVar("V")


def run_through(
    program: Any,
    constants: Sequence[V],
    inputs: Sequence[V],
    literal: Callable[[Any], V],
    step: Callable[[Any, list[V]], Sequence[V]],
) -> list[V]:
    """Go through the steps of a `Jaxpr` in their order, and return its results.

    **Arguments:**

    - `constants`, `inputs`: the values of its constants and of its arguments.
    - `literal`: makes a value of a number in the program, given as JAX's `Literal`.
    - `step`: makes the results of one step from its operands.
    """
    values: dict[object, V] = dict(zip(program.constvars, constants, strict=True))
    values.update(zip(program.invars, inputs, strict=True))

    def read(each: object) -> V:
        return literal(each) if isinstance(each, Literal) else values[each]

    for each in program.eqns:
        results = step(each, [read(operand) for operand in each.invars])
        values.update(zip(each.outvars, results, strict=True))
    return [read(each) for each in program.outvars]
