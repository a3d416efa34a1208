"""Programs that JAX traced: what is within them, their work, and how other values run through."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jax.extend import core

V = TypeVar("V")
PROGRAM: Any = getattr(core, "ClosedJaxpr", core.Jaxpr)
"""The class of a program with its constants; newer versions of JAX have one class of programs."""
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
    if step.primitive.name not in CALLS and step.primitive.name not in CUSTOM_CALLS:
        return None
    return next(step.params[name] for name in _PARAMETERS if name in step.params)


def programs_read(parameters: Mapping[str, Any]) -> Iterator[Any]:
    """Yield the programs nested in an operation, such as the body of a loop."""
    for value in parameters.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            if isinstance(part, (core.Jaxpr, PROGRAM)):
                yield part


def programs_in(step: Any) -> list[Any]:
    """Return the programs among the parameters of an equation, without their constants."""
    return [getattr(each, "jaxpr", each) for each in programs_read(step.params)]


def work_of(program: core.Jaxpr) -> int:
    """Count the scalar operations of a `Jaxpr`; those in loops count as often as they run.

    For a loop with a condition one iteration counts, for a conditional all branches. The count
    decides whether native compilation pays.
    """
    count = 0
    for step in program.eqns:
        inside = sum(map(work_of, programs_in(step)))
        if inside:
            count += inside * int(step.params.get("length", 1))
        else:
            shapes: list[Any] = [each.aval for each in step.outvars]
            count += sum(int(np.prod(each.shape)) for each in shapes)
    return count


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
        return literal(each) if isinstance(each, core.Literal) else values[each]

    for each in program.eqns:
        results = step(each, [read(operand) for operand in each.invars])
        values.update(zip(each.outvars, results, strict=True))
    return [read(each) for each in program.outvars]
