"""Modes and jumps of a hybrid system: latches, hysteresis, and switches located within a step.

    floor = Switch(lambda t, s, f: s["height"], lambda t, s, f: {**s, "speed": -0.8 * s["speed"]})
    ode(fall, start, dt=0.01, duration=5.0, switches=[floor])

A mode is a number in the state whose derivative is 0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from verifai_jax.core.messages.checks import is_number
from verifai_jax.core.user_code.user_errors import check_called_with
from verifai_jax.systems.any_lane import in_any_lane
from verifai_jax.systems.ode.integrators import Derivative, Integrator, Step, Time, looped_rk4, rk4

Inputs: TypeAlias = tuple[PyTree, PyTree]
"""The control and the features of a step."""
BISECTIONS = 12
"""Halvings of the step on a cubic through its ends; one of Newton's steps follows."""
SHORT = 20
"""Operations of the dynamics up to which XLA compiles the stages of `rk4` written out; where there
are more, a loop over the stages compiles faster."""


@dataclass(frozen=True)
class Switch:
    """A jump of the state at the instant at which a quantity falls to zero.

    The instant is located within the step, to the order of the method, and is differentiated: the
    derivative of the simulation includes how the instant moves.

    **Arguments:**
    - `guard(time, state, features) -> number`: the switch happens when it stops being positive. A
      guard that is not positive at the start has to become positive first.
    - `reset(time, state, features) -> state`: returns the state after the jump.

    The first switch in an integration step is located. Further guards that fall to zero in the same
    step jump at its end. A guard that falls to zero and rises again within one step is missed.

    **Raises:** `ValueError` for functions with other arguments.
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
    - `on`: the present mode, 0 or 1, which is kept between the two thresholds.
    - `low`, `high`: the thresholds; numbers, or traced.
    **Raises:** `ValueError` if `low` is above `high`.
    """
    if is_number(low) and is_number(high) and low > high:
        raise ValueError(f"hysteresis needs low <= high; got (low={low}, high={high})")
    on = jnp.asarray(on, jnp.result_type(float, on))
    return jnp.where(value >= high, 1, jnp.where(value < low, 0, on)).astype(on.dtype)


def latch(on: Any, condition: Any) -> Any:
    """Return 1 if the condition is true or the latch is already set (`on`), as a real number."""
    on = jnp.asarray(on, jnp.result_type(float, on))
    return jnp.where(condition, 1, on).astype(on.dtype)


def switched_step(
    advance: Integrator, dynamics: Callable[[Time, PyTree, Inputs], PyTree], time: Time,
    state: PyTree, dt: Step, switches: Sequence[Switch], inputs: Inputs,
) -> Any:  # fmt: skip
    """Take one step, locating its first switch and applying the others at its end.

    A step in which no lane of a batch switches costs as much as one without switches. JAX traces
    the dynamics as often for many switches as for one.

    **Arguments:**
    - `dynamics(time, state, inputs) -> derivative`.
    - `inputs`: the control and the features, which are passed to guards and resets.

    Source of the derivative: the implicit function theorem at the instant, as in J. Hiskens and
    M. Pai, Trajectory sensitivity analysis of hybrid systems, IEEE Trans. Circuits Syst. I 47
    (2000), section III.
    """
    end = advance(lambda now, state: dynamics(now, state, inputs), time, state, dt)
    if not switches:
        return end
    state = jax.tree.map(jnp.asarray, state)
    dtype = jax.tree.leaves(state)[0].dtype
    time, dt = jnp.asarray(time, dtype), jnp.asarray(dt, dtype)
    if advance is rk4 and _length(dynamics, time, state, inputs) > SHORT:
        advance = looped_rk4
    step = _Step(advance, dynamics, time, state, dt, switches, inputs)
    end = _as(end, state)
    guards = step.guards
    # What is not finite stays so: no jump may hide it.
    happens = (guards(time, state) > 0) & (guards(time + dt, end) <= 0) & _finite(end)
    # Under `vmap` this stays a branch, since the condition is common to all lanes.
    return jax.lax.cond(
        in_any_lane(jnp.any(happens)), step.with_events, lambda end, _: end, end, happens
    )


@dataclass(frozen=True, eq=False)
class _Step:
    """A step from `state` at `time` in which something may happen."""

    advance: Integrator
    dynamics: Callable[[Time, PyTree, Inputs], PyTree]
    time: Any
    state: Any
    dt: Any
    switches: Sequence[Switch]
    inputs: Inputs

    def guards(self, now: Any, state: PyTree) -> Float[Array, " switches"]:
        features = self.inputs[1]
        return jnp.stack([jnp.asarray(s.guard(now, state, features)) for s in self.switches])

    def derivative(self, now: Time, state: PyTree) -> Any:
        return _as(self.dynamics(now, state, self.inputs), state)

    def with_events(self, end: PyTree, happens: Bool[Array, " switches"]) -> Any:
        """Return the state at the end of the step, which is `end` where nothing happens."""
        time, dt = self.time, self.dt
        still = replace(self, state=_still(self.state), inputs=_still(self.inputs))
        still = replace(still, time=_still(time), dt=_still(dt))
        share, first, slope, course = still.located(_still(end), happens)
        reached = self.advance(self.derivative, time, self.state, share * dt)
        # The instant moves with all that the guard there depends on, and the state with it.
        value = _chosen(first, self.guards(time + share * dt, reached))
        moves = (value - _still(value)) / slope
        share = share - moves
        reached = jax.tree.map(lambda leaf, rate: leaf - rate * moves, reached, course)
        instant = time + share * dt
        jumped = self.reset(first, instant, reached)
        rest = self.advance(self.derivative, instant, jumped, (1 - share) * dt)
        again = still.armed(first, _still(instant), _still(jumped))
        again &= self.guards(time + dt, rest) <= 0
        return _where(jnp.any(happens), self.reset(again, time + dt, rest), end)

    def located(
        self, end: PyTree, happens: Bool[Array, " switches"]
    ) -> tuple[Float[Array, ""], Bool[Array, " switches"], Float[Array, ""], PyTree]:
        """Find the first switch in the step.

        **Returns:** the share of the step at which it happens, 1 where nothing does; which it is;
        and what the guard and the state gain there per share of the step: an infinite rate of the
        guard where the instant stays, whatever the guard depends on.
        """
        share, first = self.bisected(end, happens)

        def course(share: Any) -> tuple[Any, Any]:
            reached = self.advance(self.derivative, self.time, self.state, share * self.dt)
            return _chosen(first, self.guards(self.time + share * self.dt, reached)), reached

        (value, _), (slope, rates) = jax.jvp(course, (share,), (jnp.ones_like(share),))
        # A guard that touches zero without crossing it leaves the instant where it is.
        crosses = jnp.any(happens) & (slope < 0)
        newton = share - jnp.where(crosses, value / jnp.where(crosses, slope, 1), 0)
        moves = crosses & (newton >= 0) & (newton <= 1)
        return jnp.clip(newton, 0, 1), first, jnp.where(moves, slope, jnp.inf), rates

    def bisected(
        self, end: PyTree, happens: Bool[Array, " switches"]
    ) -> tuple[Float[Array, ""], Bool[Array, " switches"]]:
        """Return where on a cubic through the step the first guard falls, and which it is."""
        course = _cubic(self.derivative, self.time, self.state, end, self.dt)

        def halve(_: Any, found: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
            low, high, fallen = found
            middle = (low + high) / 2
            below = self.guards(self.time + middle * self.dt, course(middle)) <= 0
            over = jnp.any(below & happens)
            fallen = jnp.where(over, below & happens, fallen)
            return jnp.where(over, low, middle), jnp.where(over, middle, high), fallen

        one = jnp.ones_like(self.dt)
        low, high, fallen = jax.lax.fori_loop(0, BISECTIONS, halve, (0 * one, one, happens))
        # Of those that fall together, the first in the list.
        count = len(self.switches)
        earlier = jnp.any(jnp.tri(count, k=-1, dtype=bool) & fallen, axis=1)
        first = fallen & ~earlier
        return jnp.where(jnp.any(happens), (low + high) / 2, 1), first

    def armed(
        self, first: Bool[Array, " switches"], instant: Any, jumped: PyTree
    ) -> Bool[Array, " switches"]:
        """Return which switches may happen in the rest of the step, after the first."""
        ahead = (jnp.ones_like(instant), self.derivative(instant, jumped))
        guards, rates = jax.jvp(self.guards, (instant, jumped), ahead)
        # The switch that has just happened is at zero. It happens again where it moved away and
        # came back, not where it goes on falling.
        return jnp.where(first, rates > 0, guards > 0)

    def reset(self, chosen: Bool[Array, " switches"], now: Any, state: PyTree) -> Any:
        for i, switch in enumerate(self.switches):
            after = switch.reset(now, state, self.inputs[1])
            state = _where(chosen[i], _as(after, state), state)
        return state


def _cubic(
    derivative: Derivative, time: Any, state: PyTree, end: PyTree, dt: Any
) -> Callable[[Any], PyTree]:
    """Return Hermite's cubic through a step, as a function of the share of it."""
    begins, ends = derivative(time, state), derivative(time + dt, end)
    parts = (state, end, begins, ends)

    def course(share: Any) -> PyTree:
        def leaf(y0: Any, y1: Any, f0: Any, f1: Any) -> Any:
            rest = 1 - share
            values = y0 * (1 + 2 * share) * rest**2 + y1 * share**2 * (3 - 2 * share)
            return values + dt * share * rest * (f0 * rest - f1 * share)

        return jax.tree.map(leaf, *parts)

    return course


def _length(
    dynamics: Callable[[Time, PyTree, Inputs], PyTree], time: Any, state: PyTree, inputs: Inputs
) -> int:
    """Count the operations of the dynamics."""
    traced = jax.make_jaxpr(lambda now, state: dynamics(now, state, inputs))(time, state)
    inner = [step.params.get("jaxpr") for step in traced.jaxpr.eqns]
    return sum(len(getattr(program, "eqns", (None,))) for program in inner)


def _chosen(first: Bool[Array, " switches"], guards: Float[Array, " switches"]) -> Any:
    return jnp.sum(jnp.where(first, guards, 0))


def _still(tree: PyTree) -> Any:
    """Return the same, as what has no derivative."""
    is_number = lambda leaf: isinstance(leaf, jax.Array)  # noqa: E731
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if is_number(x) else x, tree)


def _as(values: PyTree, like: PyTree) -> Any:
    return jax.tree.map(lambda value, leaf: jnp.asarray(value, leaf.dtype), values, like)


def _finite(state: PyTree) -> Bool[Array, ""]:
    parts = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(state)]
    return jnp.all(jnp.stack(parts))


def _where(condition: Any, yes: PyTree, no: PyTree) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
