"""AT: a car with an automatic transmission of four gears.

    automatic_transmission()                            # 30 s; features throttle and brake
    automatic_transmission(duration=50.0)({"throttle": 100.0, "brake": 0.0}, key)

Features, functions of time or numbers: `throttle` (0 to 100) and `brake` (torque, 0 to 325 ft lb).
Signals, every 0.01 s: `speed` (mph), `rpm` (of the engine) and `gear` (1 to 4).

Source: the public Simulink model Autotrans_shift.mdl with the tables of sldemo_autotrans_data.mat.
Solver `ode5` (Dormand and Prince, order 5) with the fixed step 0.01 s; inputs held over a step; the
shift chart runs every 0.04 s, before the step of that instant, and only initialises at time 0.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from envs.arch.stepped import Features, Scalar, Stepped, real, repeated, value, whole
from envs.arch.tables import bilinear, hinges, interpolated

DT = 0.01
STEPS_PER_TICK = 4
WAIT_TICKS = 2
RPM_LIMITS = (600.0, 6000.0)
ENGINE_INERTIA = 0.0219914882835559
VEHICLE_INERTIA = 12.094147857312473
FINAL_DRIVE = 3.23
MPH_PER_WHEEL_RPM = 2 * math.pi * 60 / 5280

NOMINAL = {"throttle": 50.0, "brake": 0.0}

GEAR_RATIO = (2.393, 1.450, 1.000, 0.677)
SPEED_RATIO = (
    *(0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.81, 0.82, 0.83, 0.84, 0.85, 0.86, 0.87, 0.88),
    *(0.89, 0.9, 0.92, 0.94),
)
K_FACTOR = (
    *(137.4652089938063, 137.06501915685197, 135.86444964598905, 135.66435472751189),
    *(137.56525645304487, 140.36658531172509, 145.26890811441539, 152.87251771654735),
    *(162.97731109964374, 164.2779280697452, 166.17882979527823, 167.97968406157264),
    *(170.08068070558275, 172.78196210502438, 175.38319604522741, 179.58518933324765),
    *(183.58708770279083, 189.89007763482121, 197.69377945543027, 215.90241703685155),
    244.51599037908485,
)
TORQUE_RATIO = (
    *(2.232, 2.075, 1.975, 1.846, 1.72, 1.564, 1.409, 1.254, 1.096, 1.08, 1.061, 1.043, 1.028),
    *(1.012, 1.002, 1.002, 1.001, 0.998, 0.999, 1.001, 1.002),
)
ENGINE_THROTTLE = (0, 20, 30, 40, 50, 60, 70, 80, 90, 100)
ENGINE_RPM = tuple(range(800, 4801, 400))
ENGINE_TORQUE = (
    (-40, -44, -49, -53, -57, -61, -65, -70, -74, -78, -82),
    (215, 117, 85, 66, 44, 29, 10, -2, -13, -22, -32),
    (245, 208, 178, 148, 122, 104, 85, 66, 48, 33, 18),
    (264, 260, 241, 219, 193, 167, 152, 133, 119, 96, 85),
    (264, 279, 282, 275, 260, 238, 223, 208, 189, 171, 152),
    (267, 290, 293, 297, 290, 275, 260, 256, 234, 212, 193),
    (267, 297, 305, 305, 305, 301, 293, 282, 267, 249, 226),
    (267, 301, 308, 312, 319, 323, 319, 316, 297, 279, 253),
    (267, 301, 312, 319, 327, 327, 327, 327, 312, 293, 267),
    (267, 301, 312, 319, 327, 334, 334, 334, 319, 305, 275),
)
NEVER = 1e6
UP_THROTTLE = (0, 25, 35, 50, 90, 100)
UP_SPEED = (
    (10, 30, 50, NEVER),
    (10, 30, 50, NEVER),
    (15, 30, 50, NEVER),
    (23, 41, 60, NEVER),
    (40, 70, 100, NEVER),
    (40, 70, 100, NEVER),
)
DOWN_THROTTLE = (0, 5, 40, 50, 90, 100)
DOWN_SPEED = (
    (0, 5, 20, 35),
    (0, 5, 20, 35),
    (0, 5, 25, 40),
    (0, 5, 30, 50),
    (0, 30, 50, 80),
    (0, 30, 50, 80),
)
STEADY, UPSHIFTING, DOWNSHIFTING = 0, 1, 2

# Dormand and Prince (1980), the tableau of Simulink's ode5.
# Row i leads to stage i + 1, the last one to the end of the step.
TABLEAU = (
    (1 / 5, 0, 0, 0, 0, 0),
    (3 / 40, 9 / 40, 0, 0, 0, 0),
    (44 / 45, -56 / 15, 32 / 9, 0, 0, 0),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0),
    (35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)


class State(NamedTuple):
    """Engine and wheel speed in rpm, and the shift chart: gear, phase, ticks since its change."""

    engine: Scalar
    wheel: Scalar
    gear: Scalar
    phase: Int[Array, ""]
    ticks: Int[Array, ""]


_CONVERTER = hinges(SPEED_RATIO, np.stack([K_FACTOR, TORQUE_RATIO], axis=1))
_ENGINE = bilinear(ENGINE_THROTTLE, ENGINE_RPM, ENGINE_TORQUE)
_UP = hinges(UP_THROTTLE, UP_SPEED)
_DOWN = hinges(DOWN_THROTTLE, DOWN_SPEED)


def _of_gear(choices: Sequence[Any], gear: Scalar) -> Any:
    first, second, third, fourth = choices
    return jnp.where(
        gear < 2.5, jnp.where(gear < 1.5, first, second), jnp.where(gear < 3.5, third, fourth)
    )


def speed(state: State) -> Scalar:
    """Return the speed of the car in mph."""
    return state.wheel * MPH_PER_WHEEL_RPM


def shifted(state: State, throttle: Scalar) -> State:
    """Return the shift chart after one of its ticks."""
    v, gear = speed(state), state.gear
    up = _of_gear(interpolated(_UP, throttle), gear)
    down = _of_gear(interpolated(_DOWN, throttle), gear)
    ticks = state.ticks + 1
    rising, falling = state.phase == UPSHIFTING, state.phase == DOWNSHIFTING
    waited = ticks >= WAIT_TICKS
    shift_up, shift_down = rising & waited & (v >= up), falling & waited & (v <= down)
    back = shift_up | shift_down | (rising & (v < up)) | (falling & (v > down))
    start = jnp.where(v > up, UPSHIFTING, jnp.where(v < down, DOWNSHIFTING, STEADY))
    steady = state.phase == STEADY
    phase = jnp.where(steady, start, jnp.where(back, STEADY, state.phase))
    gear = jnp.where(
        shift_up, jnp.minimum(gear + 1, 4), jnp.where(shift_down, jnp.maximum(gear - 1, 1), gear)
    )
    ticks = jnp.where(steady & (start != STEADY), 0, ticks)
    return state._replace(gear=gear, phase=phase.astype(jnp.int32), ticks=ticks)


def driven(state: State, throttle: Scalar, brake: Scalar, dt: Any = DT) -> State:
    """Take one step of the engine and the wheels, in a gear that stays."""
    dtype = real()
    ratio = _of_gear(GEAR_RATIO, state.gear).astype(dtype)
    engine_torque = _ENGINE.along(throttle)
    low, high = RPM_LIMITS

    def slope(engine: Scalar, wheel: Scalar) -> tuple[Scalar, Scalar]:
        k, torque_ratio = interpolated(_CONVERTER, FINAL_DRIVE * ratio * wheel / engine)
        impeller = (engine / k) ** 2
        engine_slope = (engine_torque(engine) - impeller) / ENGINE_INERTIA
        # The integrator is limited: no slope leads out of its limits.
        out = ((engine >= high) & (engine_slope > 0)) | ((engine <= low) & (engine_slope < 0))
        v = wheel * MPH_PER_WHEEL_RPM
        load = jnp.sign(v) * (40 + 0.02 * v * v + brake)
        output = FINAL_DRIVE * impeller * torque_ratio * ratio
        return jnp.where(out, 0, engine_slope), (output - load) / VEHICLE_INERTIA

    # A scan over the stages instead of writing them out: a sixth of the compile time, and XLA does
    # not compute a stage again for each of those that use it.
    def stage(carry: Any, weights: Any) -> Any:
        before, at = carry
        row, index = weights
        slopes = tuple(b.at[index].set(s) for b, s in zip(before, slope(*at), strict=True))
        engine = jnp.clip(state.engine + dt * jnp.sum(row * slopes[0]), low, high)
        return (slopes, (engine, state.wheel + dt * jnp.sum(row * slopes[1]))), None

    start = ((jnp.zeros(6, dtype), jnp.zeros(6, dtype)), (state.engine, state.wheel))
    rows = (jnp.asarray(TABLEAU, dtype), jnp.arange(6))
    (_, (engine, wheel)), _ = jax.lax.scan(stage, start, rows)
    return state._replace(engine=engine, wheel=wheel)


def initial(features: Features) -> State:
    """Return the state at time 0: idling in first gear, at rest."""
    dtype = real()
    return State(
        jnp.asarray(1000.0, dtype),
        jnp.asarray(0.0, dtype),
        jnp.asarray(1.0, dtype),
        jnp.int32(STEADY),
        jnp.int32(0),
    )


def advance(k: Int[Array, ""], state: State, features: Features, substeps: Any = 1) -> State:
    """Step from sample `k` to the next, in the gear after the chart has run there."""
    time = k.astype(real()) * DT
    throttle, brake = value(features["throttle"], time), value(features["brake"], time)
    state = repeated(lambda _, s: driven(s, throttle, brake, DT / substeps), state, substeps)
    then = (k + 1).astype(real()) * DT
    ticked = shifted(state, value(features["throttle"], then))
    tick = (k + 1) % STEPS_PER_TICK == 0
    return State(*(jnp.where(tick, a, b) for a, b in zip(ticked, state, strict=True)))


def signals(k: Int[Array, ""], state: State, features: Features) -> dict[str, Float[Array, ""]]:
    """Return the signals of the requirements."""
    return {"speed": speed(state), "rpm": state.engine, "gear": state.gear}


def automatic_transmission(duration: float = 30.0, *, substeps: Any = 1) -> Stepped:
    """Make the model a system.

    - `duration`: simulated seconds, a multiple of 0.01. The competition has 50 s; its requirements
      look 30 s ahead (AT1, AT2, AT6) or 32.7 s (AT5).
    - `substeps`: integration steps in 0.01 s; the original has one.
    """
    return Stepped(
        initial,
        partial(advance, substeps=substeps),
        signals,
        DT,
        whole(duration, DT, "duration"),
        NOMINAL,
        lambda factor: automatic_transmission(duration, substeps=substeps * factor),
        traced_factor=True,
    )
