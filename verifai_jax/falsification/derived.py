"""The problem that a run simulated, derived again from the problem that the user gives.

    as_simulated(problem, record)       # with the properties of `fuzz`, and with features held

A command may simulate a modified problem: `fuzz` adds its own properties, and `--only` holds
features at their nominal values. To continue the run, users name the unmodified problem.
"""

from collections.abc import Mapping
from typing import Any

from verifai_jax.core.display.extensions import extension
from verifai_jax.problem.problem import Problem


def as_simulated(problem: Problem, record: Mapping[str, Any]) -> Problem:
    """Derive from the given problem the one that the run simulated, as its record says.

    **Arguments:**
    - `problem`: the user's problem, or the run's own, which is returned unchanged.
    - `record`: the record of the run.
    **Returns:** the given problem if none was derived from it, or if deriving fails.
    """
    problem = _with_held(problem, record)
    derived = record.get("derived")
    if derived is None or problem.system.derived is not None:
        return problem
    try:
        return extension("verifai_jax.runs", derived["verb"]).as_recorded(problem, derived)
    except (TypeError, ValueError, AttributeError, KeyError):
        return problem  # What differs is said where the two are compared.


def _with_held(problem: Problem, record: Mapping[str, Any]) -> Problem:
    """Hold the features that the run held, at the nominal values of the problem."""
    space = record.get("space_data")
    if space is None:
        return problem
    held = {name for name, domain in space["features"] if _is_held(domain)}
    varied = [name for name in problem.space.domains if name not in held]
    if not held or not varied:
        return problem
    try:
        return problem.only(*varied)
    except ValueError:
        return problem


def _is_held(domain: object) -> bool:
    return isinstance(domain, Mapping) and domain.get("kind") == "Fixed"
