"""F16: a plane that falls, and an automatic pilot that keeps it off the ground.

    f16()                                               # 15 s; features phi, theta, psi, altitude
    f16()({"altitude": 4040.0}, key)

Features: the attitude at first, `phi`, `theta`, `psi` (rad), the `altitude` (ft), the airspeed `vt`
(ft/s), the angle of attack `alpha` (rad) and the engine's `power` (0 to 100). Signals, 30 a second:
`altitude`, the attitude, `vt`, `alpha`, and `mode` (0 stands by, 1 rolls, 2 pulls).

Source: AeroBench v2 in Python, with its ground collision avoidance. It is not the MATLAB version
of 2018, of which earlier results speak. AeroBench integrates with an adaptive method; here it is
the classical Runge-Kutta method with 1/30 s, the period of the automatic pilot, 0.01 ft off in the
least altitude. That altitude jumps where a decision of the pilot falls into another period, so that
the worst attitude from 2338 ft is not in the corner of the box.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from envs.arch.f16_dynamics import Plane, Reference, Scalar, slope
from envs.arch.stepped import Features, Stepped, real, repeated, whole

DT = 1 / 30
STANDBY, ROLL, PULL = 0, 1, 2

LEVEL_PHI = math.radians(5)
LEVEL_P = math.radians(10)
LOAD = 5.0
PROPORTIONAL, DERIVATIVE = 4.0, 2.0
MIN_PULL = 60  # Samples: 2 s.
FLIGHT_DECK = 1000.0

NOMINAL = {
    "phi": math.pi / 4,
    "theta": -0.4 * math.pi,
    "psi": -math.pi / 4,
    "altitude": 2338.0,
    "vt": 540.0,
    "alpha": math.radians(2.1215),
    "power": 9.0,
}


class State(NamedTuple):
    """The plane, the automatic pilot's mode, and the number of samples in it."""

    plane: Plane
    mode: Int[Array, ""]
    since: Int[Array, ""]


def _wrapped(angle: Scalar) -> Scalar:
    return angle - 2 * math.pi * jnp.round(angle / (2 * math.pi))


def nose_high(plane: Plane) -> Bool[Array, ""]:
    """Return True where the path leads up."""
    return _wrapped(plane.theta - plane.alpha) > 0


def decided(state: State) -> State:
    """Return the automatic pilot's mode from a sample on."""
    plane = state.plane
    level = (jnp.abs(_wrapped(plane.phi)) < LEVEL_PHI) & (jnp.abs(plane.p) < LEVEL_P)
    low = ~nose_high(plane) & (plane.altitude < FLIGHT_DECK)
    up = nose_high(plane) & (state.since >= MIN_PULL)
    mode = jnp.where(
        state.mode == ROLL,
        jnp.where(level, PULL, ROLL),
        jnp.where(state.mode == PULL, jnp.where(up, STANDBY, PULL), jnp.where(low, ROLL, STANDBY)),
    ).astype(jnp.int32)
    return State(plane, mode, jnp.where(mode == state.mode, state.since, 0))


def reference(plane: Plane, mode: Any) -> Reference:
    """Return the automatic pilot's demand on the inner loop."""
    zero = jnp.zeros_like(plane.p)
    levelling = -PROPORTIONAL * _wrapped(plane.phi) - DERIVATIVE * plane.p
    return Reference(jnp.where(mode == PULL, LOAD, zero), jnp.where(mode == ROLL, levelling, zero))


def initial(features: Features) -> State:
    """Return the state at time 0, about to roll its wings level."""
    zero = jnp.zeros((), real())
    plane = Plane(*(zero,) * len(Plane._fields))
    given = {name: jnp.asarray(features[name], real()) for name in NOMINAL}
    return decided(State(plane._replace(**given), jnp.int32(ROLL), jnp.int32(0)))


def advance(k: Int[Array, ""], state: State, features: Features, substeps: Any = 1) -> State:
    """Step a thirtieth of a second, at whose end the automatic pilot decides again."""
    plane = repeated(lambda _, p: _flown(p, state.mode, DT / substeps), state.plane, substeps)
    return decided(State(plane, state.mode, state.since + 1))


def _flown(start: Plane, mode: Int[Array, ""], dt: Any) -> Plane:
    """Take one step of the classical Runge-Kutta method."""

    # A scan over the four stages of the classical method: XLA takes minutes for the derivative of
    # stages that are written out.
    def stage(carry: Any, weights: Any) -> Any:
        rate, total = carry
        position, share = weights
        rate = _moved(start, rate, position)
        rate = slope(rate, reference(rate, mode))
        return (rate, _moved(total, rate, share)), None

    weights = jnp.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]], real()) * dt
    at_rest = jax.tree.map(jnp.zeros_like, start)
    (_, plane), _ = jax.lax.scan(stage, (at_rest, start), (weights[:, 0], weights[:, 1]))
    return plane


def _moved(plane: Plane, rate: Plane, seconds: Scalar) -> Plane:
    return jax.tree.map(lambda x, slope: x + seconds * slope, plane, rate)


def signals(k: Int[Array, ""], state: State, features: Features) -> dict[str, Float[Array, ""]]:
    """Return the altitude, and other quantities of the flight."""
    names = ("altitude", "phi", "theta", "psi", "vt", "alpha")
    flight = {name: getattr(state.plane, name) for name in names}
    return {**flight, "mode": state.mode.astype(real())}


def f16(duration: float = 15.0, *, substeps: Any = 1) -> Stepped:
    """Make the model a system.

    - `duration`: simulated seconds, a multiple of 1/30.
    - `substeps`: integration steps in 1/30 s, the period of the automatic pilot.
    """
    return Stepped(
        initial,
        partial(advance, substeps=substeps),
        signals,
        DT,
        whole(duration, DT, "duration"),
        NOMINAL,
        lambda factor: f16(duration, substeps=substeps * factor),
        traced_factor=True,
    )
