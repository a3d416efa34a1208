"""One step of fixed length of an ordinary differential equation, explicit methods.

    step = integrator("rk4")
    state = step(slope, time, state, dt)                 # slope(time, state) -> d state / d time

The state is any pytree of as_floating-point arrays.
"""

from collections.abc import Callable
from typing import Any

import jax

from verifai_jax.core.errors import unknown_name

Slope = Callable[[Any, Any], Any]
Integrator = Callable[[Slope, Any, Any, float], Any]


def euler(slope: Slope, time: Any, state: Any, dt: float) -> Any:
    """Explicit Euler, order 1: `s + dt f(t, s)`."""
    return _advance(state, dt, slope(time, state))


def semi_implicit_euler(slope: Slope, time: Any, state: Any, dt: float) -> Any:
    """Symplectic Euler, order 1, on a state `(positions, velocities)`.

    Velocities first, then positions with the new velocities. Source: Hairer, Lubich and Wanner,
    Geometric Numerical Integration, 2nd ed., eq. I.1.9.
    """
    positions, velocities = state
    velocities = _advance(velocities, dt, slope(time, state)[1])
    # Asking the slope again is right for any kinematics (quaternions too) and free where the
    # positions' slope is the velocities: XLA drops the half that nobody reads.
    positions = _advance(positions, dt, slope(time, (positions, velocities))[0])
    return positions, velocities


def rk4(slope: Slope, time: Any, state: Any, dt: float) -> Any:
    """The classical Runge-Kutta method, order 4.

    Source: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, table II.1.2.
    """
    k1 = slope(time, state)
    k2 = slope(time + dt / 2, _advance(state, dt / 2, k1))
    k3 = slope(time + dt / 2, _advance(state, dt / 2, k2))
    k4 = slope(time + dt, _advance(state, dt, k3))
    return jax.tree.map(
        lambda s, a, b, c, d: s + dt / 6 * (a + 2 * (b + c) + d), state, k1, k2, k3, k4
    )


METHODS: dict[str, Integrator] = {
    "rk4": rk4,
    "euler": euler,
    "semi_implicit_euler": semi_implicit_euler,
}


def integrator(method: str) -> Integrator:
    """The integrator of this name.

    **Raises:** `UnknownNameError` for a name that is none of `METHODS`.
    """
    if method not in METHODS:
        raise unknown_name("method", method, METHODS)
    return METHODS[method]


def check_factor(factor: Any) -> None:
    """Refuse what cannot divide a step.

    **Raises:** `ValueError` for a factor that is not a positive integer.
    """
    if isinstance(factor, bool) or not isinstance(factor, int) or factor < 1:
        raise ValueError(f"factor must be a positive integer; got {factor!r}")


def _advance(state: Any, dt: float, slope: Any) -> Any:
    return jax.tree.map(lambda s, d: s + dt * d, state, slope)
