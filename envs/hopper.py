"""A hopper: one leg of thigh, shank and foot under a torso, in the vertical plane.

    system = hopper(duration=4.0)                  # the trained network runs it at 1.5 m/s
    system({"mass_scale": 1.2, "friction": 0.6}, key)

The model is `hopper.xml`, 9 kg and 1.5 m tall, with three torque motors and two contact points
under its foot. `HopperTask` is what the network was trained on (`envs/train_hopper.py`), in MJX.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.errors import require
from verifai_jax.rl import Continuous

Scalar = Float[Array, ""]

MODEL_FILE = Path(__file__).with_name("hopper.xml")
POLICY_FILE = Path(__file__).with_name("hopper_policy.npz")

CONTROL_PERIOD = 0.02  # s; the model's own step is 0.005 s
PHYSICS_STEPS = 4
SPEED = 1.5  # m/s; going faster earns nothing
LOW, BENT = 0.6, 0.9  # m and rad: hip lower, or torso farther from upright, is a fall
# Knee slightly bent, the foot flat and 1 cm above the floor: x, hip height, pitch, then the joints.
STANCE = np.array([0.0, 1.01, 0.0, -0.2, 0.4, -0.2])


class State(NamedTuple):
    """Positions and speeds of the joints, where the solver begins, and the motors' last signals."""

    qpos: Float[Array, "6"]
    qvel: Float[Array, "6"]
    warmstart: Float[Array, "6"]
    control: Float[Array, "3"]


def observe(qpos: Float[Array, "6"], qvel: Float[Array, "6"]) -> Float[Array, "11"]:
    """What the network sees: hip height, pitch, joint angles, and all speeds; not the place."""
    return jnp.concatenate([qpos[1:], jnp.clip(qvel, -10.0, 10.0)])


@dataclass(frozen=True)
class HopperTask:
    """Run at 1.5 m/s, upright, with little torque; 6 s, cut short by a fall.

    Each step of 0.02 s earns up to 2.5: 1 for being up, 1 for each m/s up to `SPEED`, less for
    pitch, torque and its change. About once a second the robot is kicked forward or back.

    - `kick`: the greatest change of speed by a kick, in m/s.
    """

    time_limit: int = 300
    kick: float = 0.5

    @property
    def action(self) -> Continuous:
        """Hip, knee and ankle, in parts of the motors' greatest torques."""
        return Continuous(-1.0, 1.0, 3)

    def reset(self, key: Key[Array, ""]) -> State:
        """Near `STANCE`, nearly at rest."""
        pose, speed = jax.random.split(key)
        spread = jnp.array([0.0, 0.0, 0.1, 0.1, 0.1, 0.1])
        qpos = jnp.asarray(STANCE, jnp.float32) + spread * _even(pose, 6)
        spread = jnp.array([0.5, 0.1, 0.3, 0.3, 0.3, 0.3])
        return State(qpos, spread * _even(speed, 6), jnp.zeros(6), jnp.zeros(3))

    def step(
        self, key: Key[Array, ""], state: State, action: Float[Array, "3"]
    ) -> tuple[State, Scalar, Bool[Array, ""]]:
        """One control period."""
        from mujoco import mjx

        model, data = _mjx()
        data = data.replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=action
        )
        data = jax.lax.fori_loop(0, PHYSICS_STEPS, lambda _, d: mjx.step(model, d), data)
        often, much = jax.random.split(key)
        kicked = jax.random.bernoulli(often, CONTROL_PERIOD) * self.kick * _even(much, 1)[0]
        qpos, qvel = data.qpos, data.qvel.at[0].add(kicked)
        speed = (qpos[0] - state.qpos[0]) / CONTROL_PERIOD
        reward = 1.0 + jnp.clip(speed, -1.0, SPEED) - 0.5 * qpos[2] ** 2
        reward -= 0.1 * jnp.sum(action**2) + 0.25 * jnp.sum((action - state.control) ** 2)
        fallen = (qpos[1] < LOW) | (jnp.abs(qpos[2]) > BENT) | ~jnp.all(jnp.isfinite(qpos))
        return State(qpos, qvel, data.qacc_warmstart, action), reward, fallen

    def observe(self, state: State) -> Float[Array, "11"]:
        """See `observe`."""
        return observe(state.qpos, state.qvel)


def _even(key: Key[Array, ""], size: int) -> Array:
    return jax.random.uniform(key, (size,), minval=-1.0, maxval=1.0)


@cache
def model() -> Any:
    """The compiled `mujoco.MjModel`; not to be changed.

    **Raises:** `MissingExtra` without MuJoCo.
    """
    return require("mujoco", extra="mujoco").MjModel.from_xml_path(str(MODEL_FILE))


@cache
def _mjx() -> Any:
    """The model and a blank state in MJX."""
    mjx = require("mujoco.mjx", extra="mujoco")
    # Tracing must not leak into what the cache keeps.
    with jax.ensure_compile_time_eval():
        compiled = mjx.put_model(model())
        return compiled, mjx.make_data(compiled)
