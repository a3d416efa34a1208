"""The dependence of a problem's robustness on its features, found without simulating.

A signal that is a whole number (a gear, a count) or a truth value is constant between its jumps:
its derivative is zero wherever there is one. Where formulas speak of nothing else, slopes would
cost simulations and say nothing. JAX knows: what does not depend differentiably on the features has
a derivative that does not depend on them either.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from verifai_jax.core.precision import truncate_silently
from verifai_jax.core.programs import Slot
from verifai_jax.problem.problem import Problem

DEPENDENCE: Slot[None, bool] = Slot("dependence")
"""Whether the robustness of a problem depends differentiably on a feature."""


def has_gradient(problem: Problem) -> bool:
    """Return whether a monitored signal depends differentiably on a feature; traced once."""
    return problem.programs.get(DEPENDENCE, None, lambda: _depends(problem))


@truncate_silently()
def _depends(problem: Problem) -> bool:
    key = jax.eval_shape(lambda: jax.random.key(0))

    def signals(u: Array, key: Array) -> list[Array]:
        trace = problem.system(problem.space.unflatten(u), key)
        found = [jnp.asarray(trace.signals[name]) for name in problem.monitored]
        return [signal for signal in found if jnp.issubdtype(signal.dtype, jnp.inexact)]

    def along(u: Array, direction: Array, key: Array) -> list[Array]:
        return jax.jvp(lambda u: signals(u, key), (u,), (direction,))[1]

    u = problem.space.point_form
    program = jax.make_jaxpr(along)(u, u, key).jaxpr
    # Which values depend on the direction: a forward sweep over the steps of the program.
    moved = {program.invars[1]}
    for step in program.eqns:
        if any(not hasattr(value, "val") and value in moved for value in step.invars):
            moved.update(step.outvars)
    return any(not hasattr(value, "val") and value in moved for value in program.outvars)
