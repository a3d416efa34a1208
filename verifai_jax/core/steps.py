"""Programs that JAX has traced, and single steps of them, as functions.

traced = jax.jit(simulate).trace(features, key)
again = as_traced(traced)                           # of the same pytrees; nothing is traced again
used_inputs(jax.make_jaxpr(simulate)(features, key))    # of each array, whether results use it
call, variables = as_function(program, step)        # one equation of a program, alone
moving = of_some(call, values, [0, 2])              # of the first and third of its arguments
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core
import jax.numpy as jnp
from jax.interpreters import partial_eval

PROGRAM: Any = getattr(jax.extend.core, "ClosedJaxpr", jax.extend.core.Jaxpr)
"""The class of a program with its constants; newer versions of JAX have one class of programs."""


def as_traced(traced: jax.stages.Traced) -> Callable[..., Any]:
    """Return what was traced as a function of pytrees: no code of a user's runs again.

    What none of its results is computed from is left out, so that it is not differentiated either.
    """
    closed = traced.jaxpr
    used = without_unused(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    known = jax.extend.core.jaxpr_as_fun(PROGRAM(used, closed.consts))
    form = jax.tree.structure(traced.out_info)
    return lambda *arguments: jax.tree.unflatten(form, known(*jax.tree.leaves(arguments)))


def used_inputs(program: Any) -> list[bool]:
    """Return which inputs of a program any of its results depends on."""
    results = [True] * len(program.jaxpr.outvars)
    return partial_eval.dce_jaxpr(program.jaxpr, results)[1]


def without_unused(program: Any, wanted: Sequence[bool]) -> Any:
    """Return a program that computes some of the results of another, from the same inputs.

    **Arguments:**

    - `program`: a `Jaxpr`.
    - `wanted`: which of its results.
    """
    return partial_eval.dce_jaxpr(program, list(wanted), instantiate=True)[0]


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
    return jax.extend.core.jaxpr_as_fun(PROGRAM(alone, [])), inputs


def of_some(
    call: Callable[..., list[Any]], values: Sequence[Any], places: Sequence[int]
) -> Callable[..., list[Any]]:
    """Return a function of some arguments of another, to be differentiated.

    **Arguments:**

    - `call`: the other function, of arrays.
    - `values`: all of its arguments.
    - `places`: numbers of those that the function takes; the others keep their values.

    **Returns:** the function, which returns those results that can have a derivative.
    """

    def function(*some: Any) -> list[Any]:
        whole = list(values)
        for i, value in zip(places, some, strict=True):
            whole[i] = value
        return [each for each in call(*whole) if jnp.issubdtype(each.dtype, jnp.inexact)]

    return function
