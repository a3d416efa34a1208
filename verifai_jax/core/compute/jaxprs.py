"""Programs that JAX traced: what is within them, their work, and how other values run through."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, reduce
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
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
WRITTEN_OUT: dict[str, Callable[..., Any]] = {
    "log2": lambda x: jnp.log(x) / np.log(2),
    "one_minus_square": lambda x: (1 + x) * (1 - x),
    "polynomial": lambda x, *terms: reduce(lambda sum_, term: sum_ * x + term, terms[::-1]),
}
"""Steps of newer versions of JAX that are several older ones, as JAX itself compiles them."""


def called(step: Any) -> Any | None:
    """Return the program that an equation calls once on its operands; None if it calls none."""
    name = step.primitive.name
    if name in CALLS or name in CUSTOM_CALLS:
        return next(step.params[key] for key in _PARAMETERS if key in step.params)
    if name in WRITTEN_OUT or name == "call_hi_primitive":
        function = WRITTEN_OUT.get(name) or step.params["_prim"].expand
        return _traced(function, *((each.aval.shape, each.aval.dtype) for each in step.invars))
    return None


@lru_cache(256)
def _traced(function: Callable[..., Any], *operands: tuple[tuple[int, ...], Any]) -> Any:
    return jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(*each) for each in operands))


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
