"""The check that a function that JAX traces is a function of its arguments alone.

    watched = watch(system, lambda: jax.make_jaxpr(lambda *a: system(*a))(features, key))
    watched.why_impure                                  # "it keeps attribute 'integral' of PID ..."

JAX calls a function while it traces it, and never again. Memory and chance of Python are therefore
those of one call for all simulations.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, TypeAlias

import jax
import jax.core
import numpy as np
from jax.extend.core import JaxprEqn, Literal

from verifai_jax.core.compute.jaxprs import programs_read
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
    """The result of the first tracing of a function, with what was seen of its memory.

    - `quick`: whether it took at most `PATIENCE` seconds.
    - `kept`: what each call changes, in words.
    - `why_impure`: why the program is not that of each call; None for a function that is pure.
    """

    result: Any
    quick: bool
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
        return Watched(result, quick)
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
        return Watched(result, quick, tuple(kept))
    where = "" if line is None else f" (see {line})"
    return Watched(result, quick, tuple(kept), f"{why_differs(kept)}{where}")


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
    """Return whether two programs have different constants, and the source line if known."""
    for a, b in zip_longest(_steps(one), _steps(other), fillvalue=(None, None)):
        if a[1] != b[1]:
            step = a[0] or b[0]
            return True, source_line(getattr(getattr(step, "source_info", None), "traceback", None))
    return False, None


def _steps(program: Program) -> Iterator[tuple[JaxprEqn | None, object]]:
    """Yield the operations of a program and of those within, with what they do and results."""
    # From JAX 0.12 on both are one class; before, a program inside an operation has no constants.
    inside = getattr(program, "jaxpr", program)
    held = dict(zip(inside.constvars, getattr(program, "consts", ()), strict=False))

    def values(operands: Sequence[Any]) -> list[object]:
        return [_value(v.val if isinstance(v, Literal) else held.get(v)) for v in operands]

    for step in inside.eqns:
        plain = {name: value for name, value in step.params.items() if _is_plain(value)}
        yield step, (step.primitive.name, values(step.invars), plain)
        for inner in programs_read(step.params):
            yield from _steps(inner)
    yield None, values(inside.outvars)


def _value(value: object) -> object:
    try:
        array = np.asarray(value)
        return None if value is None else (array.dtype.str, array.shape, array.tobytes())
    except TypeError:  # Random keys and the like.
        return type(value).__name__


def _is_plain(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    # Names of functions may hold addresses.
    return isinstance(value, bool | int | float) and value == value
