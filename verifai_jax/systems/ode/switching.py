"""Modes and jumps of a hybrid system: latches, hysteresis, and switches located within a step.

    floor = Switch(lambda t, s, f: s["height"], lambda t, s, f: {**s, "speed": -0.8 * s["speed"]})
    ode(fall, start, dt=0.01, duration=5.0, switches=[floor])

A mode is a number in the state whose derivative is 0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from verifai_jax.core.checks import is_number
from verifai_jax.core.user_errors import check_called_with
from verifai_jax.systems.ode.integrators import Derivative, Integrator, Step, Time

BISECTIONS = 12
"""Halvings of the step on a cubic through its ends; one of Newton's steps follows."""


@dataclass(frozen=True)
class Switch:
    """A jump of the state at the instant at which a quantity falls to zero.

    The instant is found within the step, to the order of the method, and is differentiated: the
    derivative of the simulation is that of the hybrid system, not of one whose instants stay.

    **Arguments:**

    - `guard(time, state, features) -> number`: the switch happens where it was positive and is so
      no more. A guard that is not positive at first waits until it has been.
    - `reset(time, state, features) -> state`: the state from there on.

    The first switch of an integration step is located. What falls to zero in the rest of the same
    step jumps at its end. A guard that falls to zero and rises again within one step is not seen.

    **Raises:** `ValueError` for functions of other arguments.
    """

    guard: Callable[..., Any]
    reset: Callable[..., Any]

    def __post_init__(self) -> None:
        for name, function in (("guard", self.guard), ("reset", self.reset)):
            if not callable(function):
                raise ValueError(
                    f"{name} must be a function (time, state, features); got {function!r}"
                )
            check_called_with(name, function, ("time", "state", "features"))


def hysteresis(on: Any, value: Any, low: Any, high: Any) -> Any:
    """Return the next mode of a switch with hysteresis: 1 from `high` on, 0 below `low`.

    **Arguments:**

    - `on`: the mode now, 0 or 1, which stays between the two.
    - `low`, `high`: where the mode changes; numbers, or traced.

    **Raises:** `ValueError` for numbers with `low` above `high`.
    """
    if is_number(low) and is_number(high) and low > high:
        raise ValueError(f"hysteresis needs low <= high; got (low={low}, high={high})")
    on = jnp.asarray(on, jnp.result_type(float, on))
    return jnp.where(value >= high, 1, jnp.where(value < low, 0, on)).astype(on.dtype)


def latch(on: Any, condition: Any) -> Any:
    """Return 1 where the condition is true or a latch is already set (`on`), as a real number."""
    on = jnp.asarray(on, jnp.result_type(float, on))
    return jnp.where(condition, 1, on).astype(on.dtype)


def switched_step(
    advance: Integrator,
    derivative: Derivative,
    time: Time,
    state: PyTree,
    dt: Step,
    switches: Sequence[Switch],
    features: PyTree,
) -> Any:
    """Take one step, with the first switch in it located and the others at its end.

    Source of the derivative: the implicit function theorem at the instant, as in J. Hiskens and
    M. Pai, Trajectory sensitivity analysis of hybrid systems, IEEE Trans. Circuits Syst. I 47
    (2000), section III.
    """
    end = advance(derivative, time, state, dt)
    if not switches:
        return end

    def guards(now: Any, state: PyTree) -> Float[Array, " switches"]:
        return jnp.stack([jnp.asarray(s.guard(now, state, features)) for s in switches])

    def reached(share: Any) -> PyTree:
        return advance(derivative, time, state, share * dt)

    # What is not finite stays so: no jump may hide it.
    happens = (guards(time, state) > 0) & (guards(time + dt, end) <= 0) & _finite(end)
    cubic = _cubic(derivative, time, state, end, dt)
    shares = _located(switches, features, cubic, time, dt, happens)
    first, any_happens = jnp.argmin(shares), jnp.any(happens)
    share = jax.lax.stop_gradient(jnp.min(shares))

    def margin(share: Any) -> Any:
        return guards(time + share * dt, reached(share))[first]

    value, slope = jax.jvp(margin, (share,), (jnp.ones_like(share),))
    slope = jax.lax.stop_gradient(slope)
    # A guard that touches zero without crossing it leaves the instant where it is.
    crosses = any_happens & (slope < 0)
    share = jnp.clip(share - jnp.where(crosses, value / jnp.where(crosses, slope, 1), 0), 0, 1)
    instant = time + share * dt
    jumped = _reset(switches, jnp.arange(len(switches)) == first, instant, reached(share), features)
    rest = advance(derivative, instant, jumped, (1 - share) * dt)

    # The switch that has just happened is at zero. It happens again where it moved away and came
    # back, not where it goes on falling.
    slopes = derivative(instant, jumped)
    _, rates = jax.jvp(guards, (instant, jumped), (jnp.ones_like(instant), slopes))
    armed = jnp.where(jnp.arange(len(switches)) == first, rates > 0, guards(instant, jumped) > 0)
    again = armed & (guards(time + dt, rest) <= 0)
    rest = _reset(switches, again, time + dt, rest, features)
    return _where(any_happens, rest, end)


def _located(
    switches: Sequence[Switch],
    features: PyTree,
    cubic: Callable[[Any], PyTree],
    time: Any,
    dt: Any,
    happens: Bool[Array, " switches"],
) -> Float[Array, " switches"]:
    """Return the share of the step at which each guard falls to zero; 1 where it does not."""

    def halve(_: Any, ends: tuple[Any, Any]) -> tuple[Any, Any]:
        low, high = ends
        middle = (low + high) / 2
        guards = [
            s.guard(time + middle[i] * dt, cubic(middle[i]), features)
            for i, s in enumerate(switches)
        ]
        over = jnp.stack([jnp.asarray(guard) <= 0 for guard in guards])
        return jnp.where(over, low, middle), jnp.where(over, middle, high)

    dtype = jnp.result_type(float, jax.tree.leaves(cubic(0.0))[0])
    ends = (jnp.zeros(len(switches), dtype), jnp.ones(len(switches), dtype))
    low, high = jax.lax.fori_loop(0, BISECTIONS, halve, jax.lax.stop_gradient(ends))
    return jax.lax.stop_gradient(jnp.where(happens, (low + high) / 2, 1))


def _cubic(
    derivative: Derivative, time: Any, state: PyTree, end: PyTree, dt: Any
) -> Callable[[Any], PyTree]:
    """Return Hermite's cubic through a step, as a function of the share of it."""
    begins, ends = derivative(time, state), derivative(time + dt, end)
    parts = jax.lax.stop_gradient((state, end, begins, ends))

    def course(share: Any) -> PyTree:
        def leaf(y0: Any, y1: Any, f0: Any, f1: Any) -> Any:
            rest = 1 - share
            values = y0 * (1 + 2 * share) * rest**2 + y1 * share**2 * (3 - 2 * share)
            return values + dt * share * rest * (f0 * rest - f1 * share)

        return jax.tree.map(leaf, *parts)

    return course


def _reset(
    switches: Sequence[Switch],
    chosen: Bool[Array, " switches"],
    time: Any,
    state: PyTree,
    features: PyTree,
) -> Any:
    for i, switch in enumerate(switches):
        state = _where(chosen[i], switch.reset(time, state, features), state)
    return state


def _finite(state: PyTree) -> Bool[Array, ""]:
    parts = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(state)]
    return jnp.all(jnp.stack(parts))


def _where(condition: Any, yes: PyTree, no: PyTree) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
