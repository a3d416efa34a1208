"""Single steps of programs that JAX has traced, as functions of their own."""

from collections.abc import Callable
from typing import Any

import jax.extend.core


def as_function(program: Any, step: Any) -> tuple[Callable[..., list[Any]], list[Any]]:
    """Return a function that takes one step of a program, and the variables that are its arguments.

    **Arguments:**

    - `program`: a `Jaxpr`.
    - `step`: one of its equations.

    **Returns:** the function, of one array for each variable, which returns the step's results; and
    the variables, each once.
    """
    inputs = [each for each in step.invars if not isinstance(each, jax.extend.core.Literal)]
    inputs = list(dict.fromkeys(inputs))
    alone = program.replace(
        constvars=[], invars=inputs, outvars=step.outvars, eqns=[step], effects=step.effects,
        debug_info=program.debug_info.with_unknown_names(),
    )  # fmt: skip
    return jax.extend.core.jaxpr_as_fun(jax.extend.core.ClosedJaxpr(alone, [])), inputs
