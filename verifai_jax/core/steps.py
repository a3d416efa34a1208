"""Programs that JAX has traced, and single steps of them, as functions.

traced = jax.jit(simulate).trace(features, key)
again = as_traced(traced)                           # of the same pytrees; nothing is traced again
used_inputs(jax.make_jaxpr(simulate)(features, key))    # of each array, whether results use it
call, variables = as_function(program, step)        # one equation of a program, alone
moving = of_some(call, values, [0, 2])              # of the first and third of its arguments
alone_only(program)                                 # steps that jax.vmap refuses, and why
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.extend.core
import jax.numpy as jnp
from jax.interpreters import batching, partial_eval

from verifai_jax.core.user_errors import source_line

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
    call: Callable[..., list[Any]], values: Sequence[Any], indices: Sequence[int]
) -> Callable[..., list[Any]]:
    """Return a function of some arguments of another, to be differentiated.

    **Arguments:**

    - `call`: the other function, of arrays.
    - `values`: all of its arguments.
    - `indices`: numbers of those that the function takes; the others keep their values.

    **Returns:** the function, which returns those results that can have a derivative.
    """

    def function(*some: Any) -> list[Any]:
        whole = list(values)
        for i, value in zip(indices, some, strict=True):
            whole[i] = value
        return [each for each in call(*whole) if jnp.issubdtype(each.dtype, jnp.inexact)]

    return function


def describe_step(step: Any) -> str:
    """Write a step for people: its operation, the function that it calls, and the user's line."""
    called = step.params.get("callback")
    name = getattr(getattr(called, "callback_func", called), "__name__", "")
    named = f" of {name}" if name and not name.startswith("<") else ""
    line = source_line(getattr(step.source_info, "traceback", None))
    return f"{step.primitive.name}{named}{'' if line is None else f' ({line})'}"


def programs_in(step: Any) -> list[Any]:
    """Return the programs among the parameters of a step, such as the body of a loop."""
    kinds = (jax.extend.core.Jaxpr, PROGRAM)
    leaves = jax.tree.leaves(
        list(step.params.values()), is_leaf=lambda each: isinstance(each, kinds)
    )
    return [getattr(each, "jaxpr", each) for each in leaves if isinstance(each, kinds)]


def alone_only(program: Any) -> Iterator[tuple[Any, Exception]]:
    """Yield the steps of a `Jaxpr` that `jax.vmap` refuses, each with what it says.

    Only calls of Python, and operations without a rule for batches, are tried.
    """
    for step in program.eqns:
        inside = programs_in(step)
        # Others, such as kernels and what has a rule of its own for batches, are not looked into.
        for each in inside if step.primitive.name in _RUN_AS_THEY_ARE else ():
            yield from alone_only(each)
        if inside or (step.primitive.name not in _CALLBACKS and _has_rule(step.primitive)):
            continue
        call, inputs = as_function(program, step)
        if not inputs:
            continue
        forms = [jax.ShapeDtypeStruct((2, *each.aval.shape), each.aval.dtype) for each in inputs]
        try:
            jax.eval_shape(jax.vmap(call), *forms)
        except Exception as error:
            # JAX says by errors of many kinds that it cannot, each operation by its own.
            yield step, error


def _has_rule(primitive: Any) -> bool:
    # Some versions of JAX keep rules in two tables, of which newer ones show but one.
    tables = (batching.fancy_primitive_batchers, batching.primitive_batchers)
    return any(isinstance(table, dict) and primitive in table for table in tables)


_CUSTOM = ("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr")
_CALLS = ("checkpoint", "closed_call", "core_call", "jit", "pjit", "remat", "remat2")
_RUN_AS_THEY_ARE = frozenset({*_CUSTOM, *_CALLS, "cond", "scan", "while"})
"""Steps whose programs are in a batch if they are."""
_CALLBACKS = frozenset({"pure_callback", "io_callback"})
"""Calls of Python, which have a rule that refuses some of them."""
