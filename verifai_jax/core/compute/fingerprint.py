"""The identity of a traced function: a hash of its computation and its derivative rules.

    traced = jax.jit(function).trace(*arguments)
    fingerprint(traced.jaxpr)                           # a hash, or None if one cannot be taken

Two functions of equal fingerprints compute the same, and so do all programs derived from them by
the same rules, such as their derivatives. The text of a user's code is not enough, since its
behaviour may depend on anything; the program that JAX has traced from it is.

Traced programs, and single steps of them, can be called as functions again:

    again = as_traced(traced)                           # of the same pytrees, not traced again
    used_inputs(jax.make_jaxpr(simulate)(features, key))    # whether results use each array
    call, variables = as_function(program, step)        # one equation of a program, alone
    moving = of_some(call, values, [0, 2])              # of the first and third of its arguments
    alone_only(program)                                 # steps that jax.vmap refuses, and why
"""

import enum
import hashlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.core
import jax.extend.core
import jax.numpy as jnp
import numpy as np
from jax.interpreters import batching, partial_eval

from verifai_jax.core.compute.jaxprs import CALLS, CUSTOM_CALLS, PROGRAM, programs_in
from verifai_jax.core.user_code.user_errors import source_line

_CUSTOM = ("custom_jvp_call", "custom_vjp_call")
"""Primitives of functions that bring their own derivative."""
_NAMED = ("UnspecifiedValue", "PRNGImpl", "Mesh", "AbstractMesh", "PyTreeDef", "Device", "FTTuple")
"""Classes of JAX whose text says all of them; the last one groups the operands of a loop (0.12)."""
_PLACE = re.compile(r" at 0x[0-9a-fA-F]+|(?<=<)(\w+\.)+(?=[\w.<>]+ object\b)")
"""Addresses in memory and modules of objects, which differ between processes and scripts."""


class _Unknown(Exception):
    """A value whose behaviour cannot be identified."""


def fingerprint(program: Any, derivatives: bool = True) -> str | None:
    """Return a hash of all that a traced function computes, with its constants.

    **Arguments:**
    - `program`: a program traced by JAX, with its constants.
    - `derivatives`: whether to include derivative rules. Only programs that differentiate this one
      depend on them; they are traced for it.
    **Returns:** the hash in hexadecimal digits; None if a part of the function is opaque, such as a
    Python callback.
    """
    reader = _Reader(derivatives)
    try:
        reader.read(program)
    except Exception:
        # Or JAX calls its parts by other names in another version: slower, and never wrong.
        return None
    return reader.digest()


def identity(*values: object) -> str | None:
    """Return a hash of plain values: numbers, texts, arrays, tuples, and dataclasses of them.

    **Returns:** the hash in hexadecimal digits; None if there is a value of another type.
    """
    reader = _Reader()
    try:
        reader.read(values)
    except _Unknown:
        return None
    return reader.digest()


class _Reader:
    """Reads values and programs into one hash, each part of a program once."""

    def __init__(self, derivatives: bool = True) -> None:
        self._derivatives = derivatives
        self._texts: list[str] = []
        self._known: dict[int, int] = {}
        self._kept: list[Any] = []  # So that their identities stay theirs.

    def digest(self) -> str:
        return hashlib.sha256("\0".join(self._texts).encode()).hexdigest()

    def read(self, value: Any) -> None:
        """Read any value.

        **Raises:** `_Unknown` for one whose behaviour cannot be identified.
        """
        add = self._texts.append
        if value is None or isinstance(value, (bool, int, float, complex, str, bytes)):
            add(f"{type(value).__name__} {value!r}")
        elif isinstance(value, PROGRAM):
            self._program(value.jaxpr, value.consts)
        elif isinstance(value, jax.extend.core.Jaxpr):
            self._program(value, ())
        elif isinstance(value, (np.ndarray, np.generic, jax.Array)):
            self._array(value)
        elif isinstance(value, (tuple, list)):
            add(f"{type(value).__name__} {len(value)}")
            for each in value:
                self.read(each)
        elif isinstance(value, Mapping):
            add(f"mapping {len(value)}")
            for key in sorted(value, key=repr):
                self.read(key)
                self.read(value[key])
        elif isinstance(value, (set, frozenset)):
            add(f"set {sorted(map(repr, value))}")
        elif isinstance(value, (np.dtype, jax.core.ShapedArray)):
            add(_form(value) if isinstance(value, jax.core.ShapedArray) else str(value))
        elif isinstance(value, (enum.Enum, type)):
            add(f"{_module_path(value if isinstance(value, type) else type(value))} {value}")
        elif type(value).__name__ in _NAMED and _module_path(type(value)).startswith("jax"):
            add(f"{_module_path(type(value))} {value}")
        elif hasattr(type(value), "__dataclass_fields__"):
            add(_module_path(type(value)))
            for name in type(value).__dataclass_fields__:
                add(name)
                self.read(getattr(value, name))
        else:
            raise _Unknown(_module_path(type(value)))

    def _array(self, value: Any) -> None:
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            self._texts.append(str(value.dtype))
            value = jax.random.key_data(value)
        array = np.asarray(value)
        if array.dtype == object:
            raise _Unknown("an array of objects")
        data = array.tobytes()
        weak = getattr(value, "weak_type", False)
        text = data.hex() if len(data) <= 64 else hashlib.sha256(data).hexdigest()
        self._texts.append(f"{array.dtype}{array.shape}{weak} {text}")

    def _program(self, program: Any, constants: Any, derived: bool = False) -> None:
        add = self._texts.append
        if id(program) in self._known and not constants:
            add(f"program {self._known[id(program)]}")
            return
        self._known[id(program)] = len(self._known)
        self._kept.append(program)
        numbers: dict[Any, int] = {}

        def defined(variables: Any) -> str:
            for variable in variables:
                numbers[variable] = len(numbers)
            return " ".join(_form(variable.aval) for variable in variables)

        add(f"constants {defined(program.constvars)} inputs {defined(program.invars)}")
        for constant in constants:
            self.read(constant)
        for step in program.eqns:
            name = step.primitive.name
            add(name)
            for value in step.invars:
                self._operand(value, numbers)
            add(defined(step.outvars))
            if name in _CUSTOM:
                self.read(step.params["call_jaxpr"])
                if self._derivatives and not derived:
                    self._derivative(program, step)
                continue
            hidden = ()
            if name == "custom_vmap_call":
                _check_rule(step.params["rule"])
                hidden = ("rule",)
            for parameter in sorted(set(step.params).difference(hidden)):
                add(parameter)
                self.read(step.params[parameter])
        for value in program.outvars:
            self._operand(value, numbers)

    def _operand(self, value: Any, numbers: Mapping[Any, int]) -> None:
        if isinstance(value, jax.extend.core.Literal):
            self._texts.append(_form(value.aval))
            self.read(value.val)
        else:
            self._texts.append(str(numbers[value]))

    def _derivative(self, program: Any, step: Any) -> None:
        """Read the derivative that a function brings, as it is traced."""
        if step.params.get("symbolic_zeros"):
            raise _Unknown("a derivative that depends on which tangents are zero")
        call, inputs = as_function(program, step)
        indices = [i for i, v in enumerate(inputs) if jnp.issubdtype(v.aval.dtype, jnp.inexact)]
        if not indices:
            return
        forms = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in inputs]

        def derivative(arguments: Any, directions: Any) -> Any:
            function = of_some(call, arguments, indices)
            values = [arguments[i] for i in indices]
            if step.primitive.name == "custom_jvp_call":
                return jax.jvp(function, values, directions)
            results, pull = jax.vjp(function, *values)
            return pull([jnp.ones_like(result) for result in results])

        # Only of these: the derivative of all else follows from what it computes.
        traced = jax.make_jaxpr(derivative)(forms, [forms[i] for i in indices])
        self._program(traced.jaxpr, traced.consts, derived=True)


def _check_rule(rule: Any) -> None:
    """Refuse a foreign batching rule, which may compute something else than the function.

    Those of JAX and of this package compute the same for each lane.
    """
    package = str(getattr(rule, "__module__", "")).partition(".")[0]
    if package not in ("jax", "verifai_jax"):
        raise _Unknown("a batching rule")


def _form(value: Any) -> str:
    return f"{value.dtype}{value.shape}{getattr(value, 'weak_type', False)}"


def _module_path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def as_traced(traced: jax.stages.Traced) -> Callable[..., Any]:
    """Return a traced program as a function of pytrees, which runs no user code again.

    Equations that no result depends on are left out, so that they are not differentiated either.
    """
    closed = traced.jaxpr
    used = without_unused(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    known = jax.extend.core.jaxpr_as_fun(PROGRAM(used, closed.consts))
    form = jax.tree.structure(traced.out_info)
    return lambda *arguments: jax.tree.unflatten(form, known(*jax.tree.leaves(arguments)))


def used_inputs(program: Any, wanted: Sequence[bool] | None = None) -> list[bool]:
    """Return, for each input of a program, whether a result depends on it.

    **Arguments:**
    - `program`: a `Jaxpr` with its constants.
    - `wanted`: which results count; all when left out.
    """
    results = [True] * len(program.jaxpr.outvars) if wanted is None else list(wanted)
    return partial_eval.dce_jaxpr(program.jaxpr, results)[1]


def without_unused(program: Any, wanted: Sequence[bool]) -> Any:
    """Return a program that computes some of the results of another, from the same inputs.

    **Arguments:**
    - `program`: a `Jaxpr`.
    - `wanted`: which results to compute.
    """
    return partial_eval.dce_jaxpr(program, list(wanted), instantiate=True)[0]


def as_function(program: Any, step: Any) -> tuple[Callable[..., list[Any]], list[Any]]:
    """Return a function that performs one equation of a program, and its argument variables.

    **Arguments:**
    - `program`: a `Jaxpr`.
    - `step`: one of its equations.
    **Returns:** the function, with one array for each variable, which returns the equation's
    results; and the variables, each once.
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
    """Fix all other arguments of a function, to differentiate it by these.

    **Arguments:**
    - `call`: the other function of arrays.
    - `values`: all its arguments.
    - `indices`: indices of the arguments that stay; the others are fixed.
    **Returns:** the function, which returns only results that can have a derivative.
    """

    def function(*some: Any) -> list[Any]:
        whole = list(values)
        for i, value in zip(indices, some, strict=True):
            whole[i] = value
        return [each for each in call(*whole) if jnp.issubdtype(each.dtype, jnp.inexact)]

    return function


def describe_step(step: Any) -> str:
    """Describe an equation: its operation, the function that it calls, and the user's line."""
    called = step.params.get("callback")
    name = getattr(getattr(called, "callback_func", called), "__name__", "")
    named = f" of {name}" if name and not name.startswith("<") else ""
    line = source_line(getattr(step.source_info, "traceback", None))
    return f"{step.primitive.name}{named}{'' if line is None else f' ({line})'}"


def alone_only(program: Any) -> Iterator[tuple[Any, Exception]]:
    """Yield the equations of a `Jaxpr` that `jax.vmap` refuses, each with the error.

    Only Python callbacks, and operations without a batching rule, are tried.
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


def operands_of_scan(options: Mapping[str, Any]) -> tuple[int, int]:
    """Return how many operands of a scan are constants, and how many are carried."""
    if "ft_in" in options:  # JAX 0.12 groups the operands, versions before it count them.
        constants, carried, _ = options["ft_in"].unpack()
        return len(constants), len(carried)
    return options["num_consts"], options["num_carry"]


_RUN_AS_THEY_ARE = CUSTOM_CALLS | CALLS - {"custom_vmap_call"} | {"cond", "scan", "while"}
"""Steps whose programs are in a batch if they are."""
_CALLBACKS = frozenset({"pure_callback", "io_callback"})
"""Calls of Python, which have a rule that refuses some of them."""


def stable_text(value: object) -> str:
    """Return the `repr` of a value without addresses and modules; for an array, all its numbers."""
    if isinstance(value, np.ndarray | jax.Array):
        return repr(np.asarray(value).tolist())
    return _PLACE.sub("", repr(value))
