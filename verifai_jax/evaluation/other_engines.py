"""The same problem in other engines, by which a failure has to be confirmed, too.

engines_for(problem, "all")                         # {"engine.mjx": Problem, ...}
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

from verifai_jax.core.errors import check_names
from verifai_jax.core.trace import Trace
from verifai_jax.evaluation.confirmations import ENGINE
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import System

Engine: TypeAlias = System | Callable[..., Trace] | Problem | str
Engines: TypeAlias = Engine | Sequence[str] | Mapping[str, Engine] | None
"""What `engines_for` reads."""


def engines_for(problem: Problem, engines: Engines) -> dict[str, Problem]:
    """Return the problem in other engines, by the names of their checks.

    **Arguments:**
    - `problem`: on the backend that it ran on.
    - `engines`: another system for the same features and signals, a problem with one, the name of a
      backend of its system, `"all"` for all other backends that are installed; several names, or
      several of these by name.
    **Raises:** `ValueError` without such a backend; `UnknownNameError` for other features.
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


def _in_engine(problem: Problem, engine: Engine) -> Problem:
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
