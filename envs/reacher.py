"""A planar arm of two links that reaches for a target: a manipulation task small enough for a CPU.

    reacher("target_angle", "load")                      # 2 s, a spring from the tip to the target
    reacher(*NOMINAL, controller=neural(policy))         # a trained network
    task = reacher_task()                                # to train on, in MJX

The arm lies in a horizontal plane: 0.4 m and 0.3 m long, 1 kg and 0.6 kg, with a motor in each
joint. `reacher` is what is tested, in MJX or native MuJoCo.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from verifai_jax.addons.rl import Continuous, Policy, load_policy
from verifai_jax.addons.rl.task.mjx import MjxState, MjxTask, mjx_task
from verifai_jax.addons.simulators.mujoco.bindings import Scaled
from verifai_jax.addons.simulators.mujoco.system import MuJoCo, mujoco
from verifai_jax.core.messages.errors import check_names

Controller = Callable[..., Float[Array, "2"]]

CONTROL_PERIOD = 0.04  # s; the model's own step is 0.01 s
LENGTHS = (0.4, 0.3)
TOLERANCE = 0.05  # m; closer than this has reached

# Nothing touches anything: there is no constraint to solve, which makes MJX fast. The target's
# joints have no motor, so it stays where an episode puts it.
MODEL = """
<mujoco model="reacher">
  <compiler autolimits="true"/>
  <option timestep="0.01" gravity="0 0 0" integrator="Euler">
    <flag eulerdamp="disable" contact="disable"/>
  </option>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 0 1" damping="0.3" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.025" mass="1"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="elbow" type="hinge" axis="0 0 1" damping="0.15" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.6"/>
        <body name="load" pos="0.3 0 0">
          <geom type="sphere" size="0.03" mass="0.1" rgba="0.2 0.5 0.7 1"/>
          <site name="tip"/>
        </body>
      </body>
    </body>
    <body name="target">
      <joint name="target_angle" type="hinge" axis="0 0 1"/>
      <joint name="target_radius" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.03" mass="0.01" rgba="0.8 0.3 0.35 1"/>
      <site name="goal"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" gear="4" ctrlrange="-1 1"/>
    <motor name="elbow" joint="elbow" gear="2" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""

# What features set, and what it is on an ordinary day.
BINDINGS = {
    "target_angle": "joint/target_angle/qpos",  # rad, from the shoulder
    "target_radius": "joint/target_radius/qpos",  # m
    "shoulder0": "joint/shoulder/qpos",  # rad
    "elbow0": "joint/elbow/qpos",
    "load": "body/load/mass",  # kg at the tip
    "strength": [Scaled(f"actuator/{joint}/gear[0]") for joint in ("shoulder", "elbow")],
    "damping": [Scaled(f"joint/{joint}/damping") for joint in ("shoulder", "elbow")],
}
NOMINAL = {
    "target_angle": 1.0,
    "target_radius": 0.5,
    "shoulder0": 0.0,
    "elbow0": 0.5,
    "load": 0.1,
    "strength": 1.0,
    "damping": 1.0,
}
LOAD = 3  # The number of the body.


def observe(data: Any) -> Float[Array, "10"]:
    """Return a network's input: angles by sine and cosine, speeds, the target, the way to it."""
    angles, tip, goal = data.qpos[:2], data.site_xpos[0, :2], data.site_xpos[1, :2]
    return jnp.concatenate(
        [jnp.sin(angles), jnp.cos(angles), 0.2 * data.qvel[:2], goal, 5.0 * (goal - tip)]
    )


def distance(data: Any) -> Float[Array, ""]:
    """Return the distance from the tip to the target, in m."""
    return jnp.sqrt(jnp.sum((data.site_xpos[1, :2] - data.site_xpos[0, :2]) ** 2) + 1e-12)


def spring(stiffness: float = 60.0, damping: float = 1.0) -> Controller:
    """Make a spring from the tip to the target (N/m), with a brake in the joints (N m s/rad).

    Source: Hogan, Impedance control: an approach to manipulation (1985), part II.
    """

    def control(time: Any, state: Any, features: Any) -> Float[Array, "2"]:
        tip, goal, elbow = state.site_xpos[0], state.site_xpos[1], state.xpos[2]
        pull = stiffness * (goal - tip)
        # The torque about each joint: the lever's cross product with the force.
        levers = jnp.stack([tip, tip - elbow])
        torque = levers[:, 0] * pull[1] - levers[:, 1] * pull[0] - damping * state.qvel[:2]
        return jnp.clip(torque / jnp.array([4.0, 2.0]), -1.0, 1.0)

    return control


def neural(policy: Policy | str) -> Controller:
    """Load a trained network, or take one. JAX may trace its weights."""
    policy = policy if isinstance(policy, Policy) else load_policy(policy)
    if policy.action != Continuous(-1.0, 1.0, 2) or policy.layers[0][0].shape[0] != 10:
        raise ValueError(
            "a reacher's policy sees 10 numbers and has 2 actions in [-1, 1]; "
            f"got {policy.layers[0][0].shape[0]} and {policy.action}"
        )
    return lambda time, state, features: policy.act(observe(state))


def reacher(
    *varied: str,
    controller: Controller | None = None,
    duration: float = 2.0,
    backend: str = "auto",
) -> MuJoCo:
    """Make the closed loop, with signals `distance` (m), `shoulder` and `elbow` (rad).

    - `varied`: the features that it has, of those in `BINDINGS`.
    - `controller(time, state, features) -> control`: two torques in parts of the motors' greatest,
      every 0.04 s; `spring()` when left out.
    - `duration`: simulated seconds, a multiple of 0.04 s.
    - `backend`: as for `mujoco`.

    **Raises:** `UnknownNameError` for a feature that is not in `BINDINGS`.
    """
    check_names("feature of the reacher", varied, BINDINGS)

    def initial(features: Any, key: Any, qpos: Any, qvel: Any) -> tuple[Any, Any]:
        names = ("shoulder0", "elbow0", "target_angle", "target_radius")
        positions = [
            qpos[k] if name in varied else jnp.asarray(NOMINAL[name], qpos.dtype)
            for k, name in enumerate(names)
        ]
        return jnp.stack(positions), qvel

    return mujoco(
        MODEL,
        duration=duration,
        control_period=CONTROL_PERIOD,
        bind={name: BINDINGS[name] for name in varied},
        controller=spring() if controller is None else controller,
        initial=initial,
        signals={
            "distance": lambda time, state, control, features: distance(state),
            "shoulder": "joint/shoulder/qpos",
            "elbow": "joint/elbow/qpos",
        },
        backend=backend,
    )


def reacher_task(
    *,
    effort: float = 0.02,
    load_range: float = 0.0,
    strength_range: float = 0.0,
    varied: bool = False,
) -> MjxTask:
    """Make the task: bring the tip to a target within reach, and keep it there; 2 s.

    Each step of 0.04 s earns up to 2, half of it from afar and half at the target, less `effort`
    times the squares of the motors' signals.

    - `load_range`: up to so many kg more at the tip, drawn for each episode.
    - `strength_range`: motors are as strong as nominal times 1 +- this.
    - `varied`: whether an episode has an arm of its own, as for `start_with`, also without ranges.
    """

    def initial(key: Key[Array, ""], qpos: Array, qvel: Array) -> tuple[Array, Array]:
        low = jnp.array([-jnp.pi, -2.5, -jnp.pi, 0.15])
        high = jnp.array([jnp.pi, 2.5, jnp.pi, 0.65])
        speed_key, key = jax.random.split(key)
        moving = 0.2 * jax.random.normal(speed_key, qvel.shape)
        start = low + (high - low) * jax.random.uniform(key, (4,))
        return start, moving.at[2:].set(0.0)

    def reward(before: Any, action: Array, after: Any) -> Array:
        far = distance(after)
        near = jnp.exp(-jnp.square(far / TOLERANCE))
        return 1 - jnp.tanh(3 * far) + near - effort * jnp.sum(jnp.square(action))

    def vary(key: Key[Array, ""], model: Any) -> dict[str, Array]:
        more, stronger = jax.random.uniform(key, (2,))
        return {
            "body_mass": model.body_mass.at[LOAD].add(load_range * more),
            "actuator_gear": model.actuator_gear * (1 + strength_range * (2 * stronger - 1)),
        }

    return mjx_task(
        MODEL,
        control_period=CONTROL_PERIOD,
        time_limit=50,
        reward=reward,
        observe=observe,
        initial=initial,
        vary=vary if varied or load_range or strength_range else None,
    )


def start_with(task: MjxTask) -> Callable[[Key[Array, ""], Mapping[str, Any]], MjxState]:
    """Return what starts an episode of a task that varies with the features of a problem, at rest.

    Dampers stay as they are.
    """

    def start(key: Key[Array, ""], features: Mapping[str, Any]) -> MjxState:
        state, numbers = task.reset(key), {**NOMINAL, **features}
        names = ("shoulder0", "elbow0", "target_angle", "target_radius")
        qpos = jnp.stack([jnp.asarray(numbers[name], state.qpos.dtype) for name in names])
        mass, gear = (jnp.asarray(task.compiled.body_mass), task.compiled.actuator_gear)
        varied = {
            "body_mass": mass.at[LOAD].set(numbers["load"]),
            "actuator_gear": gear * numbers["strength"],
        }
        varied = {name: jnp.asarray(varied[name], old.dtype) for name, old in state.varied.items()}
        return state._replace(qpos=qpos, qvel=jnp.zeros_like(state.qvel), varied=varied)

    return start
