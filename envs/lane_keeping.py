"""A car that keeps its lane: a kinematic bicycle on a road of given curvature.

    lane_keeping(lqr())                                  # 10 s, a linear-quadratic regulator
    lane_keeping(neural())                               # the trained network that is shipped
    lane_keeping(lambda time, state, features: 0.0, duration=4.0)

The car is described where it is relative to its lane: `offset` of the rear axle from the lane's
centre (m, positive to the left), `heading` from the lane's direction (rad), the angle of the
`steer`ing (rad), `speed` (m/s), and `distance` along the road (m).

Features, all optional, with the values of `NOMINAL` where missing: `offset0`, `heading0` and
`speed0` at the start, an `acceleration` (m/s^2), the `wheelbase` (m) and the `lag` (s) of the
steering, a `bias` of the wheels against what the steering believes (rad), the `friction` of the
road, its `curvature` (1/m, positive to the left), and a `noise` (m) on the measured offset. A
`Signal` of curvature is a function of the distance, linear between its knots as roads are designed
(clothoids): its `duration` is the length of the road in metres. Those of acceleration, friction,
bias and noise are functions of time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.addons.rl import Continuous, Policy, load_policy
from verifai_jax.addons.rl.policy import network, scalar_network
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.systems.ode import Ode, ode, sin_cos
from verifai_jax.systems.ode.integrators import rk4

Features = Mapping[str, Any]
Scalar = Float[Array, ""]
Controller = Callable[[Any, "State", Features], Scalar]

DT = 0.04  # A lane camera gives 25 images a second.
NOISE_KNOTS = 11  # of the noise of a task that varies, as in `specs.lane_keeping`
GRAVITY = 9.81
LANE_WIDTH = 3.5
CAR_WIDTH = 1.8
REAR, FRONT = 0.9, 3.5  # How far the body reaches behind and ahead of the rear axle.
STEER_LIMIT = 0.08  # What the assistant may command, rad at the wheels.

# Trained by `python -m envs.train_lane_keeping`.
POLICY_FILE = Path(__file__).with_name("lane_keeping_policy.npz")

# Discrete-time LQR of the nominal car on a straight road at 25 Hz: 1 per m^2 of offset against
# 1000 per rad^2 of command; rad per m, per rad of heading and per rad of steering.
LQR_GAINS = (0.0298, 0.4561, 0.2944)

NOMINAL = {
    "offset0": 0.0,
    "heading0": 0.0,
    "speed0": 20.0,
    "acceleration": 0.0,
    "wheelbase": 2.7,
    "lag": 0.1,
    "bias": 0.0,
    "friction": 0.9,
    "curvature": 0.0,
    "noise": 0.0,
}


class State(NamedTuple):
    """The car relative to its lane; see the module."""

    offset: Scalar
    heading: Scalar
    steer: Scalar
    speed: Scalar
    distance: Scalar


def feature(features: Features, name: str, at: Any = None) -> Any:
    """Return a feature's value or the nominal one; of a function of time or distance, that `at`."""
    value = features.get(name, NOMINAL[name])
    return value(at) if isinstance(value, Waveform) else value


def initial(features: Features, key: Any = None) -> State:
    """Return the state at time 0, the wheels turned as the road's curvature asks."""
    curvature = feature(features, "curvature", 0.0)
    return State(
        offset=feature(features, "offset0"),
        heading=feature(features, "heading0"),
        steer=jnp.arctan(NOMINAL["wheelbase"] * curvature),
        speed=feature(features, "speed0"),
        distance=jnp.zeros(()),
    )


def path_curvature(time: Scalar | float, state: State, features: Features) -> Scalar:
    """Return the curvature of the rear axle's path, 1/m, limited by the tyres' grip."""
    wanted = jnp.tan(state.steer + feature(features, "bias", time)) / feature(features, "wheelbase")
    # The lateral acceleration is speed^2 times curvature, and at most friction times gravity.
    limit = feature(features, "friction", time) * GRAVITY / jnp.maximum(state.speed**2, 1.0)
    return jnp.clip(wanted, -limit, limit)


def dynamics(time: Scalar | float, state: State, command: Scalar, features: Features) -> State:
    """Return the derivative of the state under a steering `command` (rad).

    Source: the simple car of LaValle, Planning Algorithms (2006), eq. 13.15, whose reference is the
    rear axle, in the coordinates of a path: Micaelli and Samson, Trajectory tracking for
    unicycle-type and two-steering-wheels mobile robots (1993), section 2.
    """
    sin, cos = sin_cos(state.heading)
    curvature = feature(features, "curvature", state.distance)
    progress = state.speed * cos / jnp.maximum(1 - curvature * state.offset, 0.1)
    turning = state.speed * path_curvature(time, state, features)
    return State(
        offset=state.speed * sin,
        heading=turning - curvature * progress,
        steer=steer_rate(state, command, features),
        # A car that brakes to a standstill stays there.
        speed=jnp.where(state.speed > 0, feature(features, "acceleration", time), 0.0),
        distance=progress,
    )


def steer_rate(state: State, command: Scalar, features: Features) -> Scalar:
    """Return the steering's rate (rad/s): a first-order lag behind its saturated command."""
    wanted = jnp.clip(command, -STEER_LIMIT, STEER_LIMIT)
    return (wanted - state.steer) / feature(features, "lag")


def signals(
    time: Scalar | float, state: State, command: Scalar, features: Features
) -> dict[str, Scalar]:
    """Return the signals: the state, the command, and quantities of the driver and the lane.

    - `left`, `right`: m between the car's body and the lane marking on that side, negative beyond.
    - `lateral_acceleration` in m/s^2, `lateral_jerk` in m/s^3.
    """
    curvature = feature(features, "curvature", state.distance)
    sin, cos = sin_cos(state.heading)
    # Of the body's corners against the lane, which bends away from its tangent by k d^2 / 2.
    front = state.offset + FRONT * sin - curvature * FRONT**2 / 2
    rear = state.offset - REAR * sin - curvature * REAR**2 / 2
    room = (LANE_WIDTH - CAR_WIDTH * cos) / 2
    path = path_curvature(time, state, features)
    wheels = state.steer + feature(features, "bias", time)
    bending = steer_rate(state, command, features) / (
        jnp.cos(wheels) ** 2 * feature(features, "wheelbase")
    )
    # Tyres at their limit do not follow the wheels.
    grip = jnp.abs(path) < feature(features, "friction", time) * GRAVITY / jnp.maximum(
        state.speed**2, 1.0
    )
    return {
        **state._asdict(),
        "command": command,
        "left": room - jnp.maximum(front, rear),
        "right": room + jnp.minimum(front, rear),
        "lateral_acceleration": state.speed**2 * path,
        "lateral_jerk": jnp.where(grip, state.speed**2 * bending, 0.0),
    }


class Seen(NamedTuple):
    """The controller's knowledge: the measured offset, its own steering and speed, and the map."""

    offset: Scalar
    heading: Scalar
    steer: Scalar
    speed: Scalar
    curvature: Scalar


def measured(time: Scalar | float, state: State, features: Features) -> Seen:
    """Return the state as sensors and the map give it."""
    return Seen(
        offset=state.offset + feature(features, "noise", time),
        heading=state.heading,
        steer=state.steer,
        speed=state.speed,
        curvature=feature(features, "curvature", state.distance),
    )


def lqr(gains: Sequence[float] = LQR_GAINS) -> Controller:
    """Make a linear-quadratic regulator around the steering angle that the nominal car needs.

    - `gains`: rad per m of offset, per rad of heading, and per rad of steering.
    """
    if len(gains) != 3:
        raise ValueError(f"a lane-keeping LQR needs 3 gains; got {list(gains)}")
    k_offset, k_heading, k_steer = map(float, gains)

    def control(time: Scalar | float, state: State, features: Features) -> Scalar:
        seen = measured(time, state, features)
        curve = jnp.arctan(NOMINAL["wheelbase"] * seen.curvature)
        away = k_offset * seen.offset + k_heading * seen.heading + k_steer * (seen.steer - curve)
        return jnp.clip(curve - away, -STEER_LIMIT, STEER_LIMIT)

    return control


def observation(seen: Seen) -> list[Scalar]:
    """Return the network's input: the same numbers, each of the order of one."""
    return [
        seen.offset,
        10 * seen.heading,
        20 * seen.steer,
        (seen.speed - NOMINAL["speed0"]) / 5,
        200 * seen.curvature,
    ]


def neural(policy: Policy | str | Path = POLICY_FILE) -> Controller:
    """Load a trained network from measurements to a command of at most `STEER_LIMIT`.

    - `policy`: a `Policy` or the file of one; the one that is shipped when left out.
    """
    policy = policy if isinstance(policy, Policy) else load_policy(policy)
    inputs = policy.layers[0][0].shape[0]
    if policy.action != LaneKeepingTask().action or inputs != 5 or policy.mean is not None:
        raise ValueError(
            f"a lane-keeping policy sees 5 numbers as they are and gives one command of at most "
            f"{STEER_LIMIT} rad; got {inputs} and {policy.action}"
        )
    layers = policy.layers
    small = sum(weight.size for weight, _ in layers) <= 600

    def control(time: Scalar | float, state: State, features: Features) -> Scalar:
        sees = observation(measured(time, state, features))
        if small:
            (unit,) = scalar_network(layers, sees, policy.activation)
        else:
            (unit,) = network(layers, jnp.stack(sees), policy.activation)
        if policy.squash:
            unit = jnp.tanh(unit)
        return STEER_LIMIT * jnp.clip(unit, -1.0, 1.0)

    return control


class Drive(NamedTuple):
    """A car in training: its state, the road that it is on, what else varies, and the time."""

    car: State
    road: Waveform
    others: dict[str, Any]
    time: Scalar

    @property
    def features(self) -> dict[str, Any]:
        """All features of the episode that its steps use."""
        return {"curvature": self.road, **self.others}


@dataclass(frozen=True)
class LaneKeepingTask:
    """The lane to train on: a nominal car near 20 m/s, gentle bends, 10 s.

    The reward of a step is 1 in the middle of the lane, less for offset, heading and for steering
    in jerks; leaving the lane ends the episode.

    - `varied`: whether the car differs from one episode to the next, so that an episode can `start`
      with the features of a problem; those that the task draws itself stay nominal.
    """

    time_limit: int = 250
    varied: bool = False

    @property
    def action(self) -> Continuous:
        """The command to the steering."""
        return Continuous(-STEER_LIMIT, STEER_LIMIT)

    def reset(self, key: Key[Array, ""]) -> Drive:
        """Start somewhere in the lane, on a road of 300 m with radii of at least 300 m."""
        position, road = jax.random.split(key)
        offset, heading, speed = jax.random.uniform(position, (3,), minval=-1.0, maxval=1.0)
        knots = jax.random.uniform(road, (7,), minval=-1 / 300, maxval=1 / 300)
        features = {
            "offset0": 0.6 * offset,
            "heading0": 0.05 * heading,
            "speed0": NOMINAL["speed0"] + 3.0 * speed,
            "curvature": Waveform(knots, duration=300.0),
        }
        if self.varied:
            features |= {name: NOMINAL[name] for name in ("wheelbase", "lag", "friction", "bias")}
            features["noise"] = Waveform(jnp.zeros(NOISE_KNOTS))
        return self.start(key, features)

    def start(self, key: Key[Array, ""], features: Features) -> Drive:
        """Start with these features: a road, and a car unless that is nominal."""
        state = State(*(jnp.asarray(part, float) for part in initial(features)))
        duration, others = self.time_limit * DT, {}
        for name, value in features.items():
            if name in ("wheelbase", "lag", "friction", "bias", "noise"):
                wave = isinstance(value, Waveform)
                others[name] = value.over(duration) if wave else jnp.asarray(value, float)
        return Drive(state, features["curvature"], others, jnp.zeros(()))

    def step(
        self, key: Key[Array, ""], state: Drive, action: Float[Array, "1"]
    ) -> tuple[Drive, Scalar, Bool[Array, ""]]:
        """Take one step of 0.04 s."""
        features, time = state.features, state.time
        before, command = state.car, action[0]
        rates = dynamics(time, before, command, features)
        after = rk4(lambda t, s: dynamics(t, s, command, features), time, before, DT)
        reward = 1 - after.offset**2 - 20 * after.heading**2 - rates.steer**2
        over = jnp.abs(after.offset) > LANE_WIDTH / 2
        return state._replace(car=after, time=time + DT), reward, over

    def observe(self, state: Drive) -> Float[Array, "5"]:
        """Return the input that `neural` gives to the network."""
        seen = measured(state.time, state.car, state.features)
        return jnp.stack(observation(seen))


def lane_keeping(
    controller: Controller | None = None, *, duration: float = 10.0, dt: float = DT
) -> Ode:
    """Make the closed loop a system; `signals` documents its signals.

    - `controller(time, state, features) -> command` in rad; `lqr()` when left out.
    - `duration`: simulated seconds, a multiple of 0.04.
    - `dt`: step of the integration (RK4). The controller runs every 0.04 s at any step, which must
      divide it.
    """
    return ode(
        dynamics,
        initial,
        controller=lqr() if controller is None else controller,
        control_period=DT,
        dt=dt,
        duration=duration,
        signals=signals,
    )
