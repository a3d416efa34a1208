"""CC: five cars in a row, each chasing the one before it.

    chasing_cars()                                      # 100 s; features throttle and brake
    chasing_cars(located=False)                         # transitions at the end of the step

Features, functions of time or numbers: `throttle` and `brake` of the first car, both 0 to 1.
Signals, every 0.01 s: `y1` ... `y5`, the positions. All cars run towards minus infinity.

Source: the public Simulink model cars.mdl, five continuous Stateflow charts. Its solver has a
variable step and locates transitions. Here the motion within a mode is the exact solution, and the
instant of a transition is found within the step, to rounding, which is also differentiated. At most
one transition of each car falls into a step; a second one would come at the next sample. A gap that
crosses a threshold and comes back within one step is not seen, as in any solver that looks for
changes of sign. An input that changes continuously is taken from the middle of the step.

`located=False` is what fixed-step wrappers of the model do, with the errors that the fact sheets of
the competition's results have; up to 3.6 in robustness.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from envs.arch.stepped import Features, Scalar, Stepped, real, repeated, value, whole

DT = 0.01
CHASING, KEEPING, BRAKING = 0, 1, 2
NOMINAL = {"throttle": 0.5, "brake": 0.5}
# Of the series in z below: the next term is less than 1e-16 of the sum for steps up to 0.01 s.
_SERIES = tuple(1 / math.factorial(n + 2) for n in range(6))


class State(NamedTuple):
    """Position and speed of the first car; gaps to the car before, speeds and modes of the others.

    Gaps are kept instead of positions: positions grow to thousands, of which single precision
    would round the gaps that decide.
    """

    y1: Scalar
    v1: Scalar
    gaps: Float[Array, "4"]
    speeds: Float[Array, "4"]
    modes: Int[Array, "4"]


class Motion(NamedTuple):
    """A motion `v' = push - drag v` and `y' = sign v`, from a place and a speed on."""

    position: Scalar
    speed: Scalar
    push: Any
    drag: Any
    sign: Any

    def at(self, t: Scalar | float) -> tuple[Scalar, Scalar]:
        """Return place and speed after `t` seconds, at most a step."""
        z = self.drag * t
        rate = self.push - self.drag * self.speed
        # (z - 1 + exp(-z)) / z^2, which has a value where z is 0.
        series: Any = 0.0
        for coefficient in reversed(_SERIES):
            series = coefficient - z * series
        position = self.position + self.sign * t * (self.speed + rate * t * series)
        return position, self.speed + rate * t * (1 - z * series)


class Path(NamedTuple):
    """One motion until `change`, another one from there; places count from the step's beginning."""

    before: Motion
    change: Scalar
    after: Motion


def _motion(mode: Any, position: Scalar, speed: Scalar) -> Motion:
    """Return a follower's motion in a mode: note that it moves up where it keeps its distance."""
    dtype = real()
    push = jnp.where(mode == CHASING, 1.0, 0.0).astype(dtype)
    drag = jnp.where(mode == BRAKING, 1.0, 0.0).astype(dtype)
    sign = jnp.where(mode == KEEPING, 1.0, -1.0).astype(dtype)
    return Motion(position, speed, push, drag, sign)


def _threshold(mode: Any, gap: Scalar) -> tuple[Scalar, Any, Any]:
    """Return the gap at which a mode ends, True if it has, and the next mode."""
    wide = gap > 10
    threshold = jnp.where(
        mode == CHASING, 10.0, jnp.where(mode == BRAKING, 20.0, jnp.where(wide, 15.0, 5.0))
    ).astype(gap.dtype)
    reached_from_above = (mode == CHASING) | ((mode == KEEPING) & ~wide)
    ended = jnp.where(reached_from_above, gap <= threshold, gap >= threshold)
    following = jnp.where(
        mode == CHASING, KEEPING, jnp.where((mode == KEEPING) & ~wide, BRAKING, CHASING)
    )
    return threshold, ended, following.astype(jnp.int32)


def _followed(leader: Path, car: Any, dt: Any) -> tuple[Path, Any]:
    """Return the path of a car behind `leader` over one step, and its mode at the end."""
    gap, speed, mode = car
    own = _motion(mode, jnp.zeros_like(gap), speed)

    bend, end = leader.change, jnp.asarray(dt, gap.dtype)
    gap_bend = gap + own.at(bend)[0] - leader.after.position
    gap_end = gap + own.at(end)[0] - leader.after.at(end - bend)[0]
    # The first of three instants at which the mode is over: the transition lies just before it.
    at_start, at_bend, at_end = (_threshold(mode, g) for g in (gap, gap_bend, gap_end))
    early = at_bend[1]
    ended = at_start[1] | early | at_end[1]
    threshold = jnp.where(early, at_bend[0], at_end[0])
    low, high = jnp.where(early, 0, bend), jnp.where(early, bend, end)
    gap_low, gap_high = jnp.where(early, gap, gap_bend), jnp.where(early, gap_bend, gap_end)
    leading = jax.tree.map(lambda a, b: jnp.where(early, a, b), leader.before, leader.after)

    def newton(t: Scalar) -> Scalar:
        position, speed = own.at(t)
        leading_position, leading_speed = leading.at(t - low)
        error = gap + position - leading_position - threshold
        closing = jax.lax.stop_gradient(own.sign * speed - leading.sign * leading_speed)
        # A gap that touches its threshold without crossing it leaves the instant where it is.
        return t - error / jnp.where(jnp.abs(closing) > 1e-6, closing, 1e6)

    # The chord is off by the square of the step, two of Newton's steps leave nothing of it; the
    # second one also gives the instant the derivative of the implicit function.
    rise = gap_high - gap_low
    share = (threshold - gap_low) / jnp.where(rise == 0, 1, rise)
    chord = low + jnp.clip(share, 0, 1) * (high - low)
    t = newton(jax.lax.stop_gradient(jnp.clip(newton(chord), low, high)))
    t = jnp.where(at_start[1], 0, t)
    change = jnp.where(ended, jnp.clip(t, 0, end), end)
    following = jnp.where(at_start[1], at_start[2], jnp.where(early, at_bend[2], at_end[2]))
    following = jnp.where(ended, following, mode)
    return Path(own, change, _motion(following, *own.at(change))), following


def initial(features: Features) -> State:
    """Return the state at time 0: ten apart, at rest, keeping their distance."""
    zero = jnp.zeros((), real())
    return State(
        zero, zero, jnp.full(4, 10.0, real()), jnp.zeros(4, real()), jnp.full(4, KEEPING, jnp.int32)
    )


def _first(middle: Scalar, state: State, features: Features, dt: Any) -> Path:
    throttle, brake = value(features["throttle"], middle), value(features["brake"], middle)
    zero, one = jnp.zeros_like(state.y1), jnp.ones_like(state.y1)
    motion = Motion(zero, state.v1, -throttle, jnp.asarray(brake, zero.dtype), one)
    end = jnp.asarray(dt, zero.dtype)
    position, speed = motion.at(end)
    return Path(motion, end, motion._replace(position=position, speed=speed))


def advance(
    k: Int[Array, ""], state: State, features: Features, substeps: Any = 1, located: bool = True
) -> State:
    """Step a hundredth of a second, with transitions within its steps or at their ends."""
    step, dt = _located if located else _unlocated, DT / substeps

    def substep(j: Any, state: State) -> State:
        middle = k.astype(real()) * DT + (j + 0.5) * dt
        first = _first(middle, state, features, dt)
        # Each car follows the path of the one before; the first has only the input.
        _, cars = jax.lax.scan(
            partial(step, dt=dt),
            (first, first.after.position),
            (state.gaps, state.speeds, state.modes),
        )
        return State(state.y1 + first.after.position, first.after.speed, *cars)

    return repeated(substep, state, substeps)


def _located(carry: Any, car: Any, dt: Any) -> Any:
    leader, moved = carry
    path, mode = _followed(leader, car, dt)
    position, speed = path.after.at(dt - path.change)
    return (path, position), (car[0] + (position - moved), speed, mode)


def _unlocated(carry: Any, car: Any, dt: Any) -> Any:
    first, moved = carry
    gap, speed, mode = car
    position, speed = _motion(mode, jnp.zeros_like(gap), speed).at(dt)
    gap = gap + (position - moved)
    _, ended, following = _threshold(mode, gap)
    return (first, position), (gap, speed, jnp.where(ended, following, mode))


def signals(k: Int[Array, ""], state: State, features: Features) -> dict[str, Float[Array, ""]]:
    """Return the positions of the cars."""
    positions = [state.y1]
    for car in range(4):
        positions.append(positions[-1] + state.gaps[car])
    return {f"y{i}": position for i, position in enumerate(positions, 1)}


def chasing_cars(duration: float = 100.0, *, located: bool = True, substeps: Any = 1) -> Stepped:
    """Make the model a system.

    - `duration`: simulated seconds, a multiple of 0.01.
    - `located`: find transitions within the step; otherwise they wait for its end.
    - `substeps`: steps in 0.01 s.
    """
    return Stepped(
        initial,
        partial(advance, substeps=substeps, located=located),
        signals,
        DT,
        whole(duration, DT, "duration"),
        NOMINAL,
        lambda factor: chasing_cars(duration, located=located, substeps=substeps * factor),
        traced_factor=True,
    )
