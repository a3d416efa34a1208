"""The choice of a backend for a problem whose system has several, such as MJX and native MuJoCo.

    problem = resolved(problem, gradient=False, batch=1024, budget=20_000)
    problem = resolved(problem, wanted="native")

If gradients are needed, the backend must be one that JAX can trace. Otherwise the faster backend is
chosen by measurements on this machine with this problem, unless the run would end before a
compilation; the run notes the choice and the reason. `engines_for` returns the problem in other
engines that have to confirm a failure.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import numpy as np

from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import format_error
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.confirmations import ENGINE
from verifai_jax.evaluation.engine import Engine, engine_for
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import System

if TYPE_CHECKING:
    from verifai_jax.evaluation.host_engine import HostEngine
MIN_BUDGET = 64
"""Simulations below which nothing is compiled, or measured: either takes longer than they do."""
WORTH_MEASURING = 30.0
"""Seconds that a run must take natively before a slow compiler is asked for a quicker program,"""
WORTH_TRYING = 5.0
"""or so many where the system says that the compiled program is likely the quicker one."""


class Choice(NamedTuple):
    """A problem on one backend; the backend's name, None for a system without; and the reason."""

    problem: Problem
    backend: str | None
    why: str = ""


def resolved(
    problem: Problem, *, gradient: bool = False, batch: int = 1024, budget: int = 10_000,
    precision: str = "float32", wanted: str | None = None,
) -> Choice:  # fmt: skip
    """Return the problem on the backend that suits the run.

    - `wanted`: a backend by name; by default the system's own, or else the faster one here.

    **Raises:** `UnknownNameError` for a backend that the system lacks; `ValueError` if the system
    has no backends.
    """
    system, candidates = problem.system, problem.system.backends
    if not candidates:
        if wanted is not None:
            raise ValueError(
                f"the system of problem {problem.name!r} has no backends to choose from; "
                f"got backend {wanted!r}"
            )
        return Choice(problem, None)
    if wanted in (None, "auto"):
        wanted = None if system.backend == "auto" else system.backend
    if wanted is not None:
        return Choice(problem.on_backend(wanted), wanted)
    on_host = [name for name in candidates if problem.on_backend(name).black_box]
    traced = [name for name in candidates if name not in on_host]
    device = jax.default_backend()
    if traced and (gradient or device != "cpu"):
        why = "the search needs gradients" if gradient else f"runs on the {device}"
        return Choice(problem.on_backend(traced[0]), traced[0], why)
    if not traced or not on_host:
        return Choice(problem.on_backend(candidates[0]), candidates[0])
    return _fastest(problem, on_host[0], traced[0], batch, precision, budget)


def _fastest(
    problem: Problem, on_host: str, traced: str, batch: int, precision: str, budget: int
) -> Choice:
    from verifai_jax.evaluation.host_engine import HostEngine

    # Measured once for a problem, so that its runs in one process agree on the backend.
    host, compiled = problem.on_backend(on_host), problem.on_backend(traced)
    other = problem.programs.peek(SPEEDS, (traced, batch, precision))
    if other is None and budget < MIN_BUDGET:
        why = f"{budget} simulations, which take less than compiling for {traced} takes"
        return Choice(host, on_host, why)
    speed = problem.programs.get(
        SPEEDS,
        (on_host, batch, precision),
        lambda: _speed(HostEngine(host, precision), host, batch),
    )
    if other is None:
        likely = problem.system.likely == traced
        if budget / speed < (WORTH_TRYING if likely else WORTH_MEASURING):
            seconds = f"{budget / speed:z.1f} s for all simulations"
            return Choice(host, on_host, f"{seconds}, less than compiling for {traced}")
        try:
            engine = engine_for(compiled, batch, precision=precision)
            engine.compile()
        except Exception as error:
            reason = f"{traced} cannot simulate this model: {format_error(error)}"
            return Choice(host, on_host, reason)
        other = problem.programs.get(
            SPEEDS, (traced, batch, precision), lambda: _speed(engine, compiled, batch)
        )
    why = f"measured {speed:z,.0f} simulations/s on {on_host}, {other:z,.0f} on {traced}"
    return Choice(compiled, traced, why) if other > speed else Choice(host, on_host, why)


SPEEDS: Slot[tuple[str, int, str], float] = Slot("speeds")
"""Simulations a second of each (backend, batch, precision), as measured."""


def _speed(engine: "Engine | HostEngine", problem: Problem, batch: int) -> float:
    """Measure simulations a second: the best of three batches after one to warm up."""
    key = run_keys(0)[1]
    u = np.random.default_rng(0).random((batch, problem.space.dim), np.float32)
    engine.evaluate(u, key, 0)
    best = float("inf")
    for _ in range(3):
        started = time.perf_counter()
        engine.evaluate(u, key, 0)
        best = min(best, time.perf_counter() - started)
        if best > 2.0:
            break  # One batch is enough to know a slow simulator.
    return batch / best


OtherEngine: TypeAlias = System | Callable[..., Trace] | Problem | str
Engines: TypeAlias = OtherEngine | Sequence[str] | Mapping[str, OtherEngine] | None
"""What `engines_for` reads."""


def engines_for(problem: Problem, engines: Engines) -> dict[str, Problem]:
    """Return the problem in other engines, by the names of their checks.

    **Arguments:**
    - `problem`: the problem on the backend on which it ran.
    - `engines`: another system for the same features and signals, a problem with one, the name of a
      backend of its system, `"all"` for all other installed backends; several names, or a
      dictionary of several of these.
    **Raises:** `ValueError` if there is no such backend; `UnknownNameError` for other features.
    """
    if engines is None:
        return {}
    if isinstance(engines, str):
        engines = (engines,)
    if isinstance(engines, Sequence):
        system = problem.system
        if not system.backends:
            raise ValueError(
                f"the system of problem {problem.name!r} has no backends; an engine must be a "
                f"system or a Problem, got {', '.join(map(repr, engines))}"
            )
        if tuple(engines) == ("all",):
            others = [name for name in system.backends if name != system.backend]
            engines = [name for name in others if not system.why_not(name)]
            if not engines:
                why = "; ".join(f"{name}: {system.why_not(name)}" for name in others)
                raise ValueError(f"problem {problem.name!r} has no other engine here: {why}")
        engines = {name: name for name in engines}
    named = engines if isinstance(engines, Mapping) else {"the other engine": engines}
    return {f"{ENGINE}{name}": _in_engine(problem, engine) for name, engine in named.items()}


def _in_engine(problem: Problem, engine: OtherEngine) -> Problem:
    if isinstance(engine, str):
        other = problem.on_backend(engine)
    else:
        system: Any = engine.system if isinstance(engine, Problem) else engine
        if isinstance(engine, Problem):
            check_names("feature of the engine", engine.space.columns, problem.space.columns)
            check_names("feature", problem.space.columns, engine.space.columns)
        other = replace(problem, system=system)
    other.check()
    return other
