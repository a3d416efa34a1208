"""AFC: the air-to-fuel ratio of an engine, kept by a controller of 10 ms.

    fuel_control()                                      # 50 s; features throttle and rpm
    fuel_control()({"throttle": 40.0, "rpm": 1000.0})

Features, functions of time or numbers: `throttle` in degrees (0 to 81.2) and `rpm`, the speed of
the engine (900 to 1100). Signals, every 0.01 s: `mu`, the relative error of the ratio, 0 until 1 s;
`ratio`, what its sensor reads; `throttle`; `power`, 1 in power mode.

Source: the public Simulink model AbstractFuelControl_M1.slx of X. Jin et al., Powertrain control
verification benchmark, HSCC 2014, model 1. Its solver is ode15s. Here the pressure of the manifold,
stiff where it comes near that of the air, takes implicit steps of 2.5 ms in the root of what is
missing to it; throttle, fuel film and sensor are exact for inputs that stay during a step. No
trajectory of the original was available to compare; half the step moves `mu` by 3e-5.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from envs.arch.stepped import Features, Scalar, Stepped, real, repeated, value, whole
from verifai_jax.addons.simulators.blocks import (
    DelayLine,
    LookupTable,
    delay_line,
    hysteresis,
    latch,
)

DT = 0.01
STEPS = 4
PERIOD = DT / STEPS
LONGEST = 1.0
"""Seconds that the exhaust gas takes to the sensor at most; 0.9 at the slowest and emptiest."""
NOMINAL = {"throttle": 10.0, "rpm": 1000.0}

RATIO, POWER_RATIO = 14.7, 12.5
PUMPING = 0.41328
POWER_LOW, POWER_HIGH = 50.0, 70.0
NORMAL_FROM = 10.0
MEASURED_FROM = 1.0
_RPM, _AIR = (1000, 1500, 2000, 2500, 3000), (0.1, 0.2, 0.3, 0.4)
TO_CYLINDER = LookupTable(
    _RPM,
    _AIR,
    [
        [0.8, 0.7, 0.66, 0.6],
        [0.7, 0.66, 0.66, 0.6],
        [0.7, 0.65, 0.63, 0.6],
        [0.8, 0.73, 0.66, 0.6],
        [0.9, 0.85, 0.8, 0.7],
    ],
    beyond="extrapolate",
)
"""Share of the injected fuel that does not wet the wall, by rpm and air in g a cylinder."""
FILM_TIME = LookupTable(
    _RPM,
    _AIR,
    [
        [0.4, 0.22, 0.2, 0.35],
        [0.3, 0.22, 0.22, 0.3],
        [0.35, 0.4, 0.5, 0.45],
        [0.3, 0.35, 0.4, 0.5],
        [0.2, 0.5, 0.35, 0.4],
    ],
    beyond="extrapolate",
)
"""Seconds in which the film on the wall evaporates."""
TRANSPORT = LookupTable(
    (800, 1000, 1500, 2000, 3000),
    (0.05, 0.15, 0.2, 0.25),
    [
        [0.8, 0.4, 0.3, 0.25],
        [0.6, 0.3, 0.25, 0.2],
        [0.4, 0.2, 0.2, 0.2],
        [0.3, 0.2, 0.2, 0.2],
        [0.2, 0.2, 0.2, 0.2],
    ],
    beyond="extrapolate",
)
"""Seconds that the exhaust gas takes to the sensor."""


class State(NamedTuple):
    """The engine, and its controller.

    `throttle` behind its lag; `pressure` of the manifold, 1 is that of the air; `film` of fuel;
    `first` and `sensed`, the two lags of the sensor; `progress`, the exhaust gas in lengths of its
    pipe, and `line` with the past of it and of the ratio. Of the controller: `estimate` of the
    pressure, `integral`, `fuel` (g/s), `normal` and `power`, its modes, and `target` of the ratio.
    """

    throttle: Scalar
    pressure: Scalar
    film: Scalar
    first: Scalar
    sensed: Scalar
    progress: Scalar
    line: DelayLine
    estimate: Scalar
    integral: Scalar
    fuel: Scalar
    normal: Scalar
    power: Scalar
    target: Scalar


def initial(features: Features) -> State:
    """Return the state at time 0: idling, before the controller has run."""
    zero, pressure, ratio = (jnp.asarray(number, real()) for number in (0.0, 0.982, RATIO))
    line = delay_line(jnp.asarray([0.0, RATIO], real()), longest=LONGEST, period=PERIOD)
    return State(
        throttle=zero,
        pressure=pressure,
        film=jnp.asarray(0.0112, real()),
        first=ratio,
        sensed=ratio,
        progress=zero,
        line=line,
        estimate=pressure,
        integral=zero,
        fuel=jnp.asarray(0.1726, real()),
        normal=zero,
        power=zero,
        target=ratio,
    )


def angle(state: State) -> Scalar:
    """Return the angle of the throttle plate in degrees."""
    return jnp.clip(state.throttle + 8.8, 0.0, 90.0)


def inflow(root: Scalar, plate: Scalar) -> Scalar:
    """Return the air in g/s past the throttle, `root` being that of 1 less the pressure, signed."""
    pressure = 1 - root * jnp.abs(root)
    area = 2.821 - 0.05231 * plate + 0.10299 * plate**2 - 0.00063 * plate**3
    # 2 sqrt(r - r^2), with r the smaller of the pressure and its inverse: smooth in the root.
    forwards = jnp.where(pressure >= 0.5, 2 * root * jnp.sqrt(jnp.maximum(pressure, 0.25)), 1.0)
    return area * jnp.where(root >= 0, forwards, 2 * root / jnp.maximum(pressure, 1.0))


def pumped(pressure: Scalar, speed: Scalar) -> Scalar:
    """Return the air in g/s that the engine would pump, of which it takes nine tenths."""
    return (
        -0.366
        + 0.08979 * pressure * speed
        - 0.0337 * speed * pressure**2
        + 0.0001 * pressure * speed**2
    )


def signed_root(pressure: Scalar) -> Scalar:
    """Return the root of what the pressure lacks to 1, negative above it."""
    lack = 1 - pressure
    size = jnp.abs(lack)
    # At zero the root has no derivative.
    return jnp.sign(lack) * jnp.where(size > 0, jnp.sqrt(jnp.where(size > 0, size, 1.0)), 0.0)


def manifold(pressure: Scalar, plate: Scalar, speed: Scalar, dt: Any) -> Scalar:
    """Take one step of implicit Euler, by Newton's method in the signed root."""

    def error(root: Scalar) -> Scalar:
        after = 1 - root * jnp.abs(root)
        flow = inflow(root, plate) - 0.9 * pumped(after, speed)
        return after - pressure - dt * PUMPING * flow

    root = signed_root(pressure)
    for _ in range(6):
        miss, slope = jax.jvp(error, (root,), (jnp.ones_like(root),))
        root = root - miss / slope
    return 1 - root * jnp.abs(root)


def delayed(state: State) -> Scalar:
    """Return the ratio of the gas that now reaches the sensor: it entered one pipe's length ago."""
    shares_of_pipe, ratios = state.line.values[:, 0], state.line.values[:, 1]
    wanted = state.progress - 1
    left = jnp.clip(
        jnp.sum(shares_of_pipe >= wanted).astype(jnp.int32) - 1, 0, len(shares_of_pipe) - 2
    )
    gap = shares_of_pipe[left] - shares_of_pipe[left + 1]
    moved = gap > 0
    share = jnp.where(moved, (shares_of_pipe[left] - wanted) / jnp.where(moved, gap, 1), 0)
    return ratios[left] + jnp.clip(share, 0, 1) * (ratios[left + 1] - ratios[left])


def driven(state: State, throttle: Scalar, rpm: Scalar, dt: Any) -> tuple[State, Scalar]:
    """Take one step of the engine with the fuel of its controller; also return the ratio."""
    speed = rpm * (jnp.pi / 30)
    opened = throttle + (state.throttle - throttle) * jnp.exp(-dt / 0.1)
    state = state._replace(throttle=opened)
    pressure = manifold(state.pressure, angle(state), speed, dt)
    taken = 0.9 * pumped(pressure, speed)
    air = taken / speed * jnp.pi
    share, lasts = TO_CYLINDER(rpm, air), FILM_TIME(rpm, air)
    settled = lasts * state.fuel * (1 - share)
    film = settled + (state.film - settled) * jnp.exp(-dt / lasts)
    ratio = taken / (share * state.fuel + film / lasts)
    state = state._replace(
        pressure=pressure, film=film, progress=state.progress + dt / TRANSPORT(rpm, air)
    )
    arriving = delayed(state)
    first = arriving + (state.first - arriving) * jnp.exp(-10 * dt)
    middle = (first + state.first) / 2
    sensed = middle + (state.sensed - middle) * jnp.exp(-50 * dt)
    return state._replace(first=first, sensed=sensed), ratio


def controlled(time: Scalar, state: State, rpm: Scalar) -> State:
    """Return the state after one run of the controller."""
    speed, plate = rpm * (jnp.pi / 30), angle(state)
    normal = latch(state.normal, time >= NORMAL_FROM - DT / 2)
    power = hysteresis(state.power, plate, POWER_LOW, POWER_HIGH)
    target = jnp.where((normal > 0) & (power > 0), POWER_RATIO, RATIO).astype(plate.dtype)
    air = pumped(state.estimate, speed)
    flow = inflow(signed_root(state.pressure), plate)
    estimate = state.estimate + DT * PUMPING * (flow - air)
    # The integrator stands still where the loop is open.
    closed = (normal > 0) & (power < 1)
    miss = state.sensed - target
    integral = jnp.where(closed, state.integral + DT * 0.14 * miss, state.integral)
    trim = jnp.where(closed, jnp.maximum(1 + 0.04 * miss + integral, 0), 1)
    fuel = jnp.clip(air / target * trim, 0.13, 1.66)
    return state._replace(
        estimate=estimate, integral=integral, fuel=fuel, normal=normal, power=power, target=target
    )


def advance(k: Int[Array, ""], state: State, features: Features, substeps: Any = 1) -> State:
    """Step a hundredth of a second, at whose end the controller runs."""
    time = k.astype(real()) * DT
    throttle = value(features["throttle"], time)
    rpm = jnp.clip(value(features["rpm"], time), 900.0, 1100.0)

    def block(j: Any, state: State) -> State:
        def substep(_: Any, carry: tuple[State, Scalar]) -> tuple[State, Scalar]:
            return driven(carry[0], throttle, rpm, PERIOD / substeps)

        state, ratio = repeated(substep, (state, state.sensed), substeps)
        line = state.line.push(time + (j + 1) * PERIOD, jnp.stack([state.progress, ratio]))
        return state._replace(line=line)

    state = jax.lax.fori_loop(0, STEPS, block, state)
    return controlled((k + 1).astype(real()) * DT, state, rpm)


def signals(k: Int[Array, ""], state: State, features: Features) -> dict[str, Float[Array, ""]]:
    """Return the signals of the requirements."""
    time = k.astype(real()) * DT
    measured = time >= MEASURED_FROM - DT / 2
    return {
        "mu": jnp.where(measured, state.sensed / state.target - 1, 0.0),
        "ratio": state.sensed,
        "throttle": value(features["throttle"], time),
        "power": state.power,
    }


def fuel_control(duration: float = 50.0, *, substeps: Any = 1) -> Stepped:
    """Make the model a system.

    - `duration`: simulated seconds, a multiple of 0.01.
    - `substeps`: integration steps in 2.5 ms.
    """
    return Stepped(
        initial,
        partial(advance, substeps=substeps),
        signals,
        DT,
        whole(duration, DT, "duration"),
        NOMINAL,
        lambda factor: fuel_control(duration, substeps=substeps * factor),
        traced_factor=True,
    )
