"""The check that a function that JAX traces is a function of its arguments alone.

    watched = watch(system, lambda: jax.make_jaxpr(lambda *a: system(*a))(features, key))
    watched.why_impure                                  # "it keeps attribute 'integral' of PID ..."

JAX calls a function while it traces it, and never again. Memory and chance of Python are therefore
those of one call for all simulations.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import numpy as np
from jax.extend.core import Jaxpr, JaxprEqn, Literal

from verifai_jax.core.compute.fingerprint import PROGRAM
from verifai_jax.core.user_code.kept_state import CHANCE, changed, holds_tracer, state_of
from verifai_jax.core.user_code.user_errors import source_line

PATIENCE = 1.0
"""Seconds of a first tracing above which there is no second one without a suspicion."""
TRACED_ONCE = "JAX calls it while tracing, once for all steps of all simulations"
BY_KEY = "Draw random numbers from the key that the system is given, by jax.random"
AS_MEMORY = (
    "Return what it remembers: vj.ode and vj.mujoco take controller_memory=, environments take "
    "policy_memory=, and the function then receives its memory and returns it"
)
Program: TypeAlias = Any
"""A program with its constants, or one inside an operation, whose constants are operands of it."""


@dataclass(frozen=True)
class Watched:
    """A traced function with what was seen of its memory.

    - `result`: the result of the first tracing.
    - `kept`: what each call changes, in words.
    - `why_impure`: why the program is not that of each call; None for a function that is pure.
    """

    result: Any
    kept: tuple[str, ...] = ()
    why_impure: str | None = None

    @property
    def remedy(self) -> str:
        """Why it is impure, and what to do about it."""
        return f"{self.why_impure}. {TRACED_ONCE}. {AS_MEMORY if self.kept else BY_KEY}"


def watch(root: object, trace: Callable[[], Any], twice: bool = True) -> Watched:
    """Trace a function, and again if it may be impure, and compare.

    **Arguments:**
    - `root`: the function, or an object that holds it.
    - `trace`: traces it anew, and returns the program, or a tuple that begins with it.
    - `twice`: whether a quick function is traced again without a suspicion.
    **Raises:** the errors of the first tracing.
    """
    before, started = state_of(root), time.perf_counter()
    result = trace()
    quick = time.perf_counter() - started <= PATIENCE
    first = state_of(root)
    kept = changed(before, first)
    if not kept and not (twice and quick):
        return Watched(result)
    leaked = [name for name in kept if holds_tracer(first, name)]
    programs, line = [_program(result)], None
    try:
        programs.append(_program(trace()))
        varies, line = difference(*programs)
        if varies or set(kept) - {CHANCE}:
            # What is made once, at the first call, is no memory: later calls are compared.
            programs.append(_program(trace()))
            varies, line = difference(*programs[1:])
    except Exception:
        # Such as a value that JAX has traced before, in a place where it notices.
        varies = True
    after = state_of(root)
    later = [*leaked, *changed(first, after)]
    kept = [name for name in kept if name in later and name != CHANCE]
    if not varies and not (leaked and any(map(_has_tracers, programs))):
        return Watched(result, tuple(kept))
    where = "" if line is None else f" (see {line})"
    return Watched(result, tuple(kept), f"{why_differs(kept)}{where}")


def why_differs(kept: list[str]) -> str:
    """Write why calls of a function differ that change these."""
    kept = [name for name in kept if name != CHANCE]
    if not kept:
        return "computes with other numbers each time that it is called"
    return f"keeps {' and '.join(kept[:4])} from one call to the next"


def _has_tracers(program: Program) -> bool:
    return any(isinstance(c, jax.core.Tracer) for c in getattr(program, "consts", ()))


def _program(result: Any) -> Program:
    return result[0] if isinstance(result, tuple) else result


def difference(one: Program, other: Program) -> tuple[bool, str | None]:
    """Return whether two programs use different constants, and the source line where known.

    Compares operations, constants among their operands, and plain parameters.
    """
    # From JAX 0.12 on both are one class; before, a program inside an operation has no constants.
    constants, others = (getattr(each, "consts", ()) for each in (one, other))
    for a, b in zip(constants, others, strict=False):
        if not _same_value(a, b):
            return True, _line_of_constant(one, a)
    if len(constants) != len(others):
        return True, None
    return _difference(*(getattr(each, "jaxpr", each) for each in (one, other)))


def _difference(one: Jaxpr, other: Jaxpr) -> tuple[bool, str | None]:
    for a, b in zip(one.eqns, other.eqns, strict=False):
        if a.primitive is not b.primitive or not _same_operands(a, b):
            return True, _line(a)
        inner = list(zip(programs_read(a.params), programs_read(b.params), strict=False))
        for first, second in inner:
            differs, line = difference(first, second)
            if differs:
                return True, line or _line(a)
        plain = [name for name, value in a.params.items() if _is_plain(value)]
        if any(a.params[name] != b.params.get(name) for name in plain):
            return True, _line(a)
    return len(one.eqns) != len(other.eqns), None


def _same_operands(one: JaxprEqn, other: JaxprEqn) -> bool:
    if len(one.invars) != len(other.invars):
        return False
    for a, b in zip(one.invars, other.invars, strict=True):
        if isinstance(a, Literal) != isinstance(b, Literal):
            return False
        if isinstance(a, Literal) and isinstance(b, Literal) and not _same_value(a.val, b.val):
            return False
    return True


def programs_read(parameters: dict[str, Any]) -> Iterator[Program]:
    """Yield the programs nested in an operation, such as the body of a loop."""
    for value in parameters.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            if isinstance(part, (Jaxpr, PROGRAM)):
                yield part


def _is_plain(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    # Names of functions may hold addresses.
    return isinstance(value, bool | int | float) and value == value


def _same_value(one: object, other: object) -> bool:
    try:
        a, b = np.asarray(one), np.asarray(other)
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
    except TypeError:  # Random keys and the like.
        return True


def _line_of_constant(program: Program, constant: object) -> str | None:
    """Return the line of the first operation on a constant."""
    index = next(i for i, value in enumerate(program.consts) if value is constant)
    variable = program.jaxpr.constvars[index]
    for step in program.jaxpr.eqns:
        if any(value is variable for value in step.invars):
            return _line(step)
    return None


def _line(step: JaxprEqn) -> str | None:
    return source_line(getattr(step.source_info, "traceback", None))
