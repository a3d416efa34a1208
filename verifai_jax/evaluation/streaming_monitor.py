"""A monitor that travels with the rollout, so that no trace is stored.

    monitor = carried_monitor(problem)                  # None where storing is better
    rho, status = monitor(features, key)                # what `engine.judge` says of the trace

Same robustness, bit for bit, up to twice as fast, and memory that does not grow with the horizon.
It needs a system with `fold` (see `systems.Ode`) and formulas whose online monitor is small: one
that holds a window of samples moves them all at every step.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from verifai_jax.core.trace import Status
from verifai_jax.mtl import online
from verifai_jax.problem.problem import Problem

SMALL = 16
"""Numbers that a monitor may hold to be worth carrying."""

Judge = Callable[[Any, Any], tuple[Float[Array, " formulas"], Int[Array, ""]]]


def carried_monitor(problem: Problem) -> Judge | None:
    """The function `(features, key) -> robustness, status`; None where it does not pay."""
    system = problem.system
    if not system.can_fold or system.dt is None or problem.end != "hold":
        return None
    try:
        monitors = [online(formula, system.dt) for formula in problem.formulas.values()]
        if sum(monitor.memory for monitor in monitors) > SMALL:
            return None
    except ValueError:
        return None  # It looks ahead without end; or its clock is wrong, which `judge` says better.

    def update(carry: Any, sample: Any) -> Any:
        states, finite = carry
        for name in problem.monitored:
            signal = jnp.asarray(sample[name])
            if jnp.issubdtype(signal.dtype, jnp.inexact):
                finite &= jnp.all(jnp.isfinite(signal))
        stepped = [m.step(state, sample) for m, state in zip(monitors, states, strict=True)]
        return tuple(stepped), finite

    def judge(features: Any, key: Any) -> tuple[Array, Array]:
        start = (tuple(monitor.init() for monitor in monitors), jnp.array(True))
        (states, finite), status = system.fold(features, key, start, update)
        rho = jnp.stack([m.finish(state) for m, state in zip(monitors, states, strict=True)])
        return with_status(rho, status, finite)

    return judge


def with_status(
    rho: Float[Array, " formulas"], status: Int[Array, ""], finite: Bool[Array, ""]
) -> tuple[Float[Array, " formulas"], Int[Array, ""]]:
    """The status, given whether all signals are finite; robustness is NaN unless it is OK."""
    status = jnp.where((status == Status.OK) & ~finite, jnp.int32(Status.NONFINITE), status)
    return jnp.where(status == Status.OK, rho, jnp.nan), status
