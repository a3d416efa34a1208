"""One step of fixed length of an ordinary differential equation, explicit methods.

    step = integrator("rk4")
    state = step(derivative, time, state, dt)       # derivative(time, state) -> d state / d time

The state is any pytree of floating-point arrays.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from verifai_jax.core.messages.errors import unknown_name

Time: TypeAlias = Float[Array, ""] | float
"""Seconds."""
Step: TypeAlias = Float[Array, ""] | float
"""Seconds from one state to the next."""
Derivative: TypeAlias = Callable[[Time, PyTree], PyTree]
"""A function `(time, state) -> d state / d time`."""
Integrator: TypeAlias = Callable[[Derivative, Time, PyTree, Step], PyTree]
"""A function `(derivative, time, state, dt) -> state` at `time + dt`."""
SPREAD = (0.7548776662466927, 0.5698402909980532)
"""Numbers whose multiples, modulo 1, fill the unit square evenly (the plastic ratio's powers)."""
LONGER = 0.4
"""Share by which the first and the last of an odd number of steps are longer, at most."""


def euler(derivative: Derivative, time: Time, state: PyTree, dt: Step) -> PyTree:
    """Take a step of explicit Euler, order 1: `s + dt f(t, s)`."""
    return _advance(state, dt, derivative(time, state))


def semi_implicit_euler(derivative: Derivative, time: Time, state: PyTree, dt: Step) -> PyTree:
    """Take a step of symplectic Euler, order 1, on a state `(positions, velocities)`.

    It updates velocities first, then positions with the new velocities. Source: Hairer, Lubich and
    Wanner, Geometric Numerical Integration, 2nd ed., eq. I.1.9.
    """
    positions, velocities = state
    velocities = _advance(velocities, dt, derivative(time, state)[1])
    # A second evaluation is right for any kinematics (quaternions too) and free where the
    # positions' derivative is the velocities: XLA drops the half that is not used.
    positions = _advance(positions, dt, derivative(time, (positions, velocities))[0])
    return positions, velocities


def rk4(derivative: Derivative, time: Time, state: PyTree, dt: Step) -> PyTree:
    """Take a step of the classical Runge-Kutta method, order 4.

    Source: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, table II.1.2.
    """
    k1 = derivative(time, state)
    k2 = derivative(time + dt / 2, _advance(state, dt / 2, k1))
    k3 = derivative(time + dt / 2, _advance(state, dt / 2, k2))
    k4 = derivative(time + dt, _advance(state, dt, k3))
    return jax.tree.map(
        lambda s, a, b, c, d: s + dt / 6 * (a + 2 * (b + c) + d), state, k1, k2, k3, k4
    )


def looped_rk4(derivative: Derivative, time: Time, state: PyTree, dt: Step) -> PyTree:
    """Take a step of `rk4` with a loop over its stages; equal up to rounding.

    The derivative is traced once instead of four times.
    """

    def stage(carry: tuple[PyTree, PyTree], parts: Float[Array, "2"]) -> Any:
        slope, total = carry
        share, weight = parts
        begin = _advance(state, share * dt, slope)
        slope = derivative(time + share * dt, begin)
        return (slope, _advance(total, weight * dt, slope)), None

    tableau = [[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]]
    parts = jnp.array(tableau, jax.tree.leaves(state)[0].dtype)
    return jax.lax.scan(stage, (jax.tree.map(jnp.zeros_like, state), state), parts)[0][1]


METHODS: dict[str, Integrator] = {
    "rk4": rk4,
    "euler": euler,
    "semi_implicit_euler": semi_implicit_euler,
}


def integrator(method: str | Integrator) -> Integrator:
    """Return the integrator of this name; a user's own integrator is returned unchanged.

    **Raises:** `UnknownNameError` for a name that is not in `METHODS`.
    """
    if callable(method):
        return method
    if method not in METHODS:
        raise unknown_name("method", method, METHODS)
    return METHODS[method]


def edge(time: Any, dt: float, count: Any, j: Any) -> Any:
    """Return the seconds after a sample at which step `j` of `count` steps to the next begins.

    Of an odd count the first and the last step are longer, by as much as differs from sample to
    sample: what happens at samples alone weighs more then, and not as much as with other counts.
    """
    odd = (count % 2 == 1) & (count > 1)
    first, last = (jnp.where(odd, LONGER * (time / dt * spread % 1), 0) for spread in SPREAD)
    inner = jnp.clip(j, 1, count - 1)
    moved = first - (first + last) * (inner - 1) / jnp.maximum(count - 2, 1)
    return (j + jnp.where(inner == j, moved, 0)) * jnp.asarray(dt / count, time.dtype)


def check_factor(factor: object) -> None:
    """Refuse a factor that cannot divide a step.

    **Raises:** `ValueError` for a factor that is not a positive integer.
    """
    if isinstance(factor, bool) or not isinstance(factor, int) or factor < 1:
        raise ValueError(f"factor must be a positive integer; got {factor!r}")


def _advance(state: PyTree, dt: Step, derivative: PyTree) -> PyTree:
    return jax.tree.map(lambda s, d: s + dt * d, state, derivative)
