"""A problem whose signals on sets contain the values at all times between two samples.

    problem = between_samples(problem)      # of a system that `vj.ode` made

Sample k of a signal represents all its values from time k `dt` until the next sample, with the
control that is held then; the last sample represents only the final time. Windows of `always` and
`eventually` over such samples cover every instant of the windows in time, and each of their samples
contains such an instant. So bounds of the robustness over sets also hold in continuous time.
"""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import PyTree

from verifai_jax.addons.verification.sets import flow
from verifai_jax.mtl.sampled import about_single_samples
from verifai_jax.problem.problem import Problem, ProblemError
from verifai_jax.systems.ode.closed_loop import Ode, substep
from verifai_jax.systems.pytree_checks import default_signals


def between_samples(problem: Problem) -> Problem:
    """Return the problem with the differential equation, whose system only sets can evaluate.

    **Raises:** `ProblemError` for a system that was not made by `vj.ode`, or that ends or jumps at
    its own instants, and for a formula about single samples.
    """
    loop = problem.system
    if not isinstance(loop, Ode):
        raise ProblemError(
            f"continuous=True is about the equations of a system that vj.ode made; that of problem "
            f"{problem.name!r} is a {type(loop).__name__}. Leave it out to verify the system in "
            "discrete time"
        )
    for name in ("switches", "terminate", "exact_step"):
        if getattr(loop, name):
            raise ProblemError(
                "continuous=True needs a plant that moves continuously for the whole duration; "
                f"the system of problem {problem.name!r} has {name}=. Leave one of the two out"
            )
    for part in about_single_samples(*problem.formulas.values()):
        raise ProblemError(
            "continuous=True supports formulas with comparisons, not, and, or, always, "
            f"eventually, historically and once; {part} is about single samples"
        )

    def during(time: Any, state: PyTree, control: Any, features: Any) -> Any:
        left = jnp.where(time < (loop.steps - 0.5) * loop.dt, loop.dt, 0.0)
        inside = replace(loop, method=lambda *step: flow(*step)[1])
        states = substep(inside, features, control, time, state, left)
        now = flow(lambda time, clock: jnp.ones_like(clock), time, time, left)[1]
        if loop.signals is None:
            return default_signals(states, control)
        return loop.signals(now, states, control, features)

    system = replace(loop, method=lambda *step: flow(*step)[0], signals=during)
    return replace(problem, system=system)
