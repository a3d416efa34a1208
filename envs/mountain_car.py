"""The mountain car of Gymnasium, discrete (v0) and continuous, as a system under test.

    mountain_car(along())                                # 200 steps, pushes the way it rolls
    mountain_car(neural(policy), continuous=True)        # a trained network, 999 steps
    mountain_car(lambda time, state, features: 1.0, steps=100)

The car has to swing back and forth to leave its valley. A step counts as one second. Once it is at
the goal it stays there, so that `eventually[0, 200] position >= 0.5` says that it arrives.

Features, all optional, with Gymnasium's values where missing: `position0` and `velocity0` at the
start, the `power` of the engine (velocity that full throttle adds in a step: 0.001 in MountainCar,
0.0015 in MountainCarContinuous), `gravity` (0.0025), `friction` (the part of the velocity that is
lost in a step, 0), `max_speed` (0.07), and `position_bias` and `velocity_bias`, added to what the
controller sees. All but those of the start may be a `Signal`.

Source: Moore, Efficient memory-based learning for robot control (1990), chapter 4; the numbers are
those of Gymnasium 1.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from envs.arch.stepped import Stepped, real, value
from envs.randomisation import check_ranges, factor
from verifai_jax.addons.rl import Continuous, Discrete, Policy, load_policy
from verifai_jax.addons.rl.algorithm import Number
from verifai_jax.systems.ode import sin_cos

Features = Mapping[str, Any]
Scalar = Float[Array, ""]
Controller = Callable[[Any, "State", Features], Any]

DT = 1.0  # Gymnasium gives a step no length.
LEFT, RIGHT = -1.2, 0.6
MAX_SPEED = 0.07
GOAL = {"discrete": 0.5, "continuous": 0.45}
STEPS = {"discrete": 200, "continuous": 999}
NOMINAL = {
    "position0": -0.5,
    "velocity0": 0.0,
    "power": 0.001,
    "gravity": 0.0025,
    "friction": 0.0,
    "max_speed": MAX_SPEED,
    "position_bias": 0.0,
    "velocity_bias": 0.0,
}
NOMINAL_CONTINUOUS = {**NOMINAL, "power": 0.0015}


class State(NamedTuple):
    """The car's place, from -1.2 to 0.6 (the valley's lowest point is -pi/6), and its velocity."""

    position: Scalar
    velocity: Scalar


def moved(
    state: State,
    throttle: Scalar,
    power: Scalar | float,
    gravity: Scalar | float,
    friction: Scalar | float = 0.0,
    max_speed: Scalar | float = MAX_SPEED,
) -> State:
    """Return the state after a step at a throttle from -1 to 1; the left wall stops the car."""
    uphill = gravity * sin_cos(3 * state.position)[1]
    velocity = state.velocity + (throttle * power - uphill) - friction * state.velocity
    velocity = jnp.clip(velocity, -max_speed, max_speed)
    position = jnp.clip(state.position + velocity, LEFT, RIGHT)
    stopped = (position == LEFT) & (velocity < 0)
    return State(position, jnp.where(stopped, 0.0, velocity))


def arrived(state: State, continuous: bool) -> Bool[Array, ""]:
    """Return True where the car is at the goal and not rolling back."""
    goal = GOAL["continuous" if continuous else "discrete"]
    return (state.position >= goal) & (state.velocity >= 0)


def energy(state: State, gravity: Scalar | float = NOMINAL["gravity"]) -> Scalar:
    """Return the energy: 0 at rest at the bottom, 1 at rest at the height of the right summit."""
    potential = gravity / 3 * (1 + sin_cos(3 * state.position)[0])
    return (state.velocity**2 / 2 + potential) / (2 * gravity / 3)


def observed(state: State) -> Float[Array, "2"]:
    """Return a network's input: position and velocity, each from about -1 to 1."""
    middle, half = (LEFT + RIGHT) / 2, (RIGHT - LEFT) / 2
    return jnp.stack([(state.position - middle) / half, state.velocity / MAX_SPEED])


def along(enough: float = math.inf) -> Controller:
    """Return full throttle the way the car rolls, to the right from rest: it climbs the hill.

    - `enough`: of `energy`, from which on it rolls back without throttle. 0.4 keeps it clear of the
      wall on the left, where Gymnasium's car would hit it.
    """

    def control(time: Scalar, state: State, features: Features) -> Scalar:
        back = jnp.where(energy(state) < enough, -1.0, 0.0)
        return jnp.where(state.velocity < 0, back, 1.0)

    return control


def neural(
    policy: Policy | str | Path, *, raw: bool = False, straight_through: bool = True
) -> Controller:
    """Load a trained network, with 3 actions (left, none, right) or a throttle from -1 to 1.

    - `policy`: a `Policy` or the file of one. JAX may trace its weights.
    - `raw`: it sees position and velocity as they are, as Gymnasium's do, not as `observed` does.
    - `straight_through`: give the choice of an action the derivative of the mean throttle; its own
      is zero almost everywhere. Source: Bengio, Leonard and Courville (2013), section 4.
    """
    policy = policy if isinstance(policy, Policy) else load_policy(policy)
    fits = policy.action in (Discrete(3), Continuous(-1.0, 1.0))
    if not fits or policy.layers[0][0].shape[0] != 2:
        raise ValueError(
            "a mountain-car policy sees 2 numbers and has 3 discrete actions or one from -1 to 1; "
            f"got {policy.layers[0][0].shape[0]} and {policy.action}"
        )

    def control(time: Scalar, state: State, features: Features) -> Scalar:
        outputs = policy(jnp.stack(state) if raw else observed(state))
        if isinstance(policy.action, Continuous):
            return jnp.clip(outputs[0], -1.0, 1.0)
        throttle = (jnp.argmax(outputs) - 1).astype(outputs.dtype)
        if not straight_through:
            return throttle
        left, _, right = jax.nn.softmax(outputs)
        mean = right - left
        return throttle + (mean - jax.lax.stop_gradient(mean))

    return control


def mountain_car(
    controller: Controller | None = None, *, continuous: bool = False, steps: int | None = None
) -> Stepped:
    """Make the closed loop, with signals `position`, `velocity` and `throttle`.

    - `controller(time, state, features) -> throttle` from -1 to 1; `along()` when left out. Its
      state is what the sensors show.
    - `continuous`: MountainCarContinuous-v0's power and goal (0.45), not MountainCar-v0's (0.5).
    - `steps`: 200, or 999 of the continuous one, when left out.
    """
    decide = along() if controller is None else controller

    def initial(features: Features) -> State:
        return State(*(jnp.asarray(features[name], real()) for name in ("position0", "velocity0")))

    def throttle(k: Int[Array, ""], state: State, features: Features) -> Scalar:
        time = k * DT
        seen = State(
            state.position + value(features["position_bias"], time),
            state.velocity + value(features["velocity_bias"], time),
        )
        return jnp.clip(jnp.asarray(decide(time, seen, features), real()), -1.0, 1.0)

    def advance(k: Int[Array, ""], state: State, features: Features) -> State:
        names = ("power", "gravity", "friction", "max_speed")
        physics = [value(features[name], k * DT) for name in names]
        after = moved(state, throttle(k, state, features), *physics)
        there = arrived(state, continuous)
        return jax.tree.map(lambda old, new: jnp.where(there, old, new), state, after)

    def signals(k: Int[Array, ""], state: State, features: Features) -> dict[str, Any]:
        return {**state._asdict(), "throttle": throttle(k, state, features)}

    return Stepped(
        initial,
        advance,
        signals,
        dt=DT,
        steps=STEPS["continuous" if continuous else "discrete"] if steps is None else steps,
        nominal=NOMINAL_CONTINUOUS if continuous else NOMINAL,
    )


FARTHEST = {"start_range": -0.5 - LEFT, "start_speed_range": MAX_SPEED, "shaping_discount": 1.0}


class Episode(NamedTuple):
    """A state, the physics of this episode, and what is added to the velocity that is observed."""

    state: State
    power: Scalar
    gravity: Scalar
    velocity_bias: Scalar | float = 0.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MountainCarTask:
    """MountainCar-v0 to train on: reward -1 a step, cut off after 200.

    All zeros but `start_range` are Gymnasium's own task, and what returns are measured on. Floats
    may be traced.

    - `potential`: weight of the shaping by `energy`: a step also earns `shaping_discount *
      potential(after) - potential(before)`, with potential 0 at the goal, which changes no best
      policy if that discount is the algorithm's. Source: Ng, Harada and Russell, Policy invariance
      under reward transformations (1999), theorem 1.
    - `start_range`: initial positions are uniform in -0.5 +- this.
    - `start_speed_range`: initial velocities are uniform in 0 +- this.
    - `power_range`, `gravity_range`: each episode's is the nominal one times a factor, log-uniform
      between `1 / (1 + range)` and `1 + range`. 0: no randomisation.

    **Raises:** `ValueError` for a negative weight or range, or a start outside of the valley.
    """

    potential: Number = 0.0
    shaping_discount: Number = 0.99
    start_range: Number = 0.1
    start_speed_range: Number = 0.0
    power_range: Number = 0.0
    gravity_range: Number = 0.0
    time_limit: int = field(default=STEPS["discrete"], metadata={"static": True})

    def __post_init__(self) -> None:
        check_ranges(self, FARTHEST)

    @property
    def action(self) -> Discrete:
        """The three actions: 0 accelerates to the left, 2 to the right, 1 not."""
        return Discrete(3)

    def reset(self, key: Key[Array, ""]) -> Episode:
        """Start at rest at the bottom of the valley, or as the ranges say."""
        return _reset(self, key, NOMINAL["power"])

    def start(self, key: Key[Array, ""], features: Features) -> Episode:
        """Start with the features of a problem, all else nominal."""
        return _start(features, NOMINAL)

    def step(
        self, key: Key[Array, ""], state: Episode, action: Int[Array, ""]
    ) -> tuple[Episode, Scalar, Bool[Array, ""]]:
        """Take one step."""
        return _step(self, state, action - 1.0, lambda there: -1.0, continuous=False)

    def observe(self, state: Episode) -> Float[Array, "2"]:
        """Return position and velocity as `observed`, with the episode's bias."""
        return _observe(state)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContinuousMountainCarTask:
    """MountainCarContinuous-v0 to train on: 100 at the goal, less 0.1 throttle^2, 999 steps.

    The fields are those of `MountainCarTask`.
    """

    potential: Number = 0.0
    shaping_discount: Number = 0.99
    start_range: Number = 0.1
    start_speed_range: Number = 0.0
    power_range: Number = 0.0
    gravity_range: Number = 0.0
    time_limit: int = field(default=STEPS["continuous"], metadata={"static": True})

    def __post_init__(self) -> None:
        check_ranges(self, FARTHEST)

    @property
    def action(self) -> Continuous:
        """The throttle."""
        return Continuous(-1.0, 1.0)

    def reset(self, key: Key[Array, ""]) -> Episode:
        """Start at rest at the bottom of the valley, or as the ranges say."""
        return _reset(self, key, NOMINAL_CONTINUOUS["power"])

    def start(self, key: Key[Array, ""], features: Features) -> Episode:
        """Start with the features of a problem, all else nominal."""
        return _start(features, NOMINAL_CONTINUOUS)

    def step(
        self, key: Key[Array, ""], state: Episode, action: Float[Array, "1"]
    ) -> tuple[Episode, Scalar, Bool[Array, ""]]:
        """Take one step."""
        throttle = jnp.clip(action[0], -1.0, 1.0)

        def reward(there: Bool[Array, ""]) -> Scalar:
            return jnp.where(there, 100.0, 0.0) - 0.1 * action[0] ** 2

        return _step(self, state, throttle, reward, continuous=True)

    def observe(self, state: Episode) -> Float[Array, "2"]:
        """Return position and velocity as `observed`, with the episode's bias."""
        return _observe(state)


Either = MountainCarTask | ContinuousMountainCarTask


def _reset(task: Either, key: Key[Array, ""], power: float) -> Episode:
    position, velocity, engine, pull = jax.random.uniform(key, (4,), minval=-1.0, maxval=1.0)
    return Episode(
        State(-0.5 + task.start_range * position, task.start_speed_range * velocity),
        power * factor(engine, task.power_range),
        NOMINAL["gravity"] * factor(pull, task.gravity_range),
        jnp.zeros(()),
    )


def _start(features: Features, nominal: Features) -> Episode:
    names = ("position0", "velocity0", "power", "gravity", "velocity_bias")
    position, velocity, *physics = (
        jnp.asarray({**nominal, **features}[name], float) for name in names
    )
    return Episode(State(position, velocity), *physics)


def _observe(episode: Episode) -> Float[Array, "2"]:
    position, velocity = episode.state
    return observed(State(position, velocity + episode.velocity_bias))


def _step(
    task: Either,
    episode: Episode,
    throttle: Scalar,
    reward: Callable[[Bool[Array, ""]], Any],
    continuous: bool,
) -> tuple[Episode, Scalar, Bool[Array, ""]]:
    after = moved(episode.state, throttle, episode.power, episode.gravity)
    there = arrived(after, continuous)
    # Shaped by the nominal energy: what the reward says does not depend on the episode's physics.
    potential = partial(_potential, task)
    gain = task.shaping_discount * jnp.where(there, 0.0, potential(after))
    shaped = reward(there) + (gain - potential(episode.state))
    return episode._replace(state=after), shaped, there


def _potential(task: Either, state: State) -> Scalar:
    return task.potential * (energy(state) - 1)
