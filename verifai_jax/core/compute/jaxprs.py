"""Running a program that JAX traced, on values of any kind instead of arrays."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from jax.extend.core import Literal

V = TypeVar("V")
CALLS = frozenset({
    "checkpoint", "closed_call", "core_call", "custom_vmap_call", "jit", "pjit", "remat", "remat2",
})  # fmt: skip
"""Steps that call a function, which has no derivative of its own."""
CUSTOM_CALLS = frozenset({"custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"})
"""Steps that call a function with a derivative of its own."""
_PARAMETERS = ("jaxpr", "call_jaxpr", "fun_jaxpr", "call")
"""Parameters by which such steps hold the program of the function."""


def called(step: Any) -> Any | None:
    """Return the program that an equation calls once on its operands; None if it calls none."""
    if step.primitive.name not in CALLS | CUSTOM_CALLS:
        return None
    return next(step.params[name] for name in _PARAMETERS if name in step.params)


def run_through(
    program: Any, constants: Sequence[V], inputs: Sequence[V], literal: Callable[[Any], V],
    step: Callable[[Any, list[V]], Sequence[V]],
) -> list[V]:  # fmt: skip
    """Interpret the equations of a `Jaxpr` in order, and return its results.

    **Arguments:**
    - `constants`, `inputs`: the values of its constants and arguments.
    - `literal`: a function that converts a number in the program, JAX's `Literal`, to a value.
    - `step`: a function that computes the results of an equation from its operands.
    """
    values: dict[object, V] = dict(zip(program.constvars, constants, strict=True))
    values.update(zip(program.invars, inputs, strict=True))

    def read(each: object) -> V:
        return literal(each) if isinstance(each, Literal) else values[each]

    for each in program.eqns:
        results = step(each, [read(operand) for operand in each.invars])
        values.update(zip(each.outvars, results, strict=True))
    return [read(each) for each in program.outvars]
