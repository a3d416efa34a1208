"""A hopper: one leg of thigh, shank and foot under a torso, in the vertical plane.

    system = hopper("torso_mass", "friction", duration=4.0)
    system({"torso_mass": 5.0, "friction": 0.6}, key)

The model is `hopper.xml`, 9 kg and 1.5 m tall, with three torque motors and two contact points
under its foot. `HopperTask` is what the network was trained on (`envs/train_hopper.py`), in MJX;
`hopper` is what is tested, in MJX or native MuJoCo.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.addons.rl import Continuous, Policy, load_policy
from verifai_jax.addons.simulators.mujoco.bindings import Scaled
from verifai_jax.addons.simulators.mujoco.system import MuJoCo, mujoco
from verifai_jax.core.messages.errors import check_names, require

Scalar = Float[Array, ""]
Controller = Callable[..., Float[Array, "3"]]

MODEL_FILE = Path(__file__).with_name("hopper.xml")
POLICY_FILE = Path(__file__).with_name("hopper_policy.npz")

CONTROL_PERIOD = 0.02  # s; the model's own step is 0.005 s
PHYSICS_STEPS = 4
SPEED = 1.5  # m/s; going faster earns nothing
LOW, BENT = 0.6, 0.9  # m and rad: hip lower, or torso farther from upright, is a fall
# The knee slightly bent, the flat foot 4 cm above the floor: x, hip height, pitch, joint angles.
STANCE = np.array([0.0, 1.03, 0.0, -0.2, 0.4, -0.2])

# What features set, and what it is on an ordinary day.
BINDINGS = {
    "torso_mass": "body/torso/mass",  # kg
    "friction": "geom/floor/friction[0]",
    "strength": [Scaled(f"actuator/{joint}/gear[0]") for joint in ("hip", "knee", "ankle")],
    "damping": [Scaled(f"joint/{joint}/damping") for joint in ("hip", "knee", "ankle")],
    "foot": "geom/foot/size[1]",  # m, half its length
    "pitch0": "joint/rooty/qpos",  # rad
    "speed0": "joint/rootx/qvel",  # m/s
    "push": "body/torso/force[0]",  # N forward on the torso; a number or a Signal
}
NOMINAL = {
    "torso_mass": 4.0,
    "friction": 0.9,
    "strength": 1.0,
    "damping": 1.0,
    "foot": 0.14,
    "pitch0": 0.0,
    "speed0": 0.0,
    "push": 0.0,
}

# The hoppers that the network was trained on: some are heavier, weaker or on smoother ground.
TRAINED_FOR = {
    "torso_mass": (3.5, 4.5),
    "friction": (0.6, 1.2),
    "strength": (0.85, 1.1),
    "damping": (0.7, 1.5),
}


class State(NamedTuple):
    """A hopper in training.

    Positions and speeds of the joints, where the solver begins, the motors' last signals, and what
    differs from one episode to the next: see `TRAINED_FOR`.
    """

    qpos: Float[Array, "6"]
    qvel: Float[Array, "6"]
    warmstart: Float[Array, "6"]
    control: Float[Array, "3"]
    body: Float[Array, "4"]


def observe(qpos: Float[Array, "6"], qvel: Float[Array, "6"]) -> Float[Array, "11"]:
    """Return the network's input: hip height, pitch, joint angles and all speeds; not the place."""
    return jnp.concatenate([qpos[1:], jnp.clip(qvel, -10.0, 10.0)])


def neural(policy: Policy | str | Path = POLICY_FILE) -> Controller:
    """Load a trained network; the one that is shipped when left out."""
    policy = policy if isinstance(policy, Policy) else load_policy(policy)
    if policy.action != Continuous(-1.0, 1.0, 3) or policy.layers[0][0].shape[0] != 11:
        raise ValueError(
            "a hopper's policy sees 11 numbers and has 3 actions in [-1, 1]; "
            f"got {policy.layers[0][0].shape[0]} and {policy.action}"
        )

    def control(time: Scalar, state: Any, features: Any) -> Float[Array, "3"]:
        return policy.act(observe(state.qpos, state.qvel))

    return control


def lying(state: Any, features: Any) -> Bool[Array, ""]:
    """Return True where knee or torso are about to touch the floor."""
    return (state.qpos[1] < 0.45) | (jnp.abs(state.qpos[2]) > 1.5)


def hopper(
    *varied: str,
    controller: Controller | None = None,
    duration: float = 4.0,
    backend: str = "auto",
) -> MuJoCo:
    """Make the closed loop, with signals `x`, `height`, `pitch` and `speed`.

    Begins at rest in `STANCE`, and ends when it lies on the floor. `x` and `height` (m) are the
    hip's, `speed` (m/s) the hip's forward, `pitch` (rad) the torso's, positive when it nods.

    - `varied`: the features that it has, of those in `BINDINGS`.
    - `controller(time, state, features) -> control`: three torques in parts of the motors'
      greatest, every 0.02 s; `neural()` when left out.
    - `duration`: simulated seconds, a multiple of 0.02 s.
    - `backend`: as for `mujoco`.

    **Raises:** `UnknownNameError` for a feature that is not in `BINDINGS`.
    """
    check_names("feature of the hopper", varied, BINDINGS)

    def initial(features: Any, key: Any, qpos: Any, qvel: Any) -> tuple[Any, Any]:
        return qpos + jnp.asarray(STANCE - model().qpos0, qpos.dtype), qvel

    return mujoco(
        MODEL_FILE,
        duration=duration,
        control_period=CONTROL_PERIOD,
        bind={name: BINDINGS[name] for name in varied},
        controller=neural() if controller is None else controller,
        initial=initial,
        signals={
            "x": "joint/rootx/qpos",
            "height": "joint/rootz/qpos",
            "pitch": "joint/rooty/qpos",
            "speed": "joint/rootx/qvel",
        },
        terminate=lying,
        backend=backend,
    )


@dataclass(frozen=True)
class HopperTask:
    """A task: run at 1.5 m/s, upright, with little torque; 6 s, cut short by a fall.

    Each episode has a hopper of its own, drawn from `TRAINED_FOR`.

    Each step of 0.02 s earns up to 2.5: 1 for being up, 1 for each m/s up to `SPEED`, less for
    lean, torque and its change. About once a second the robot is kicked forward or back.

    - `kick`: the greatest change of speed by a kick, in m/s.
    """

    time_limit: int = 300
    kick: float = 0.5

    @property
    def action(self) -> Continuous:
        """The torques of hip, knee and ankle, in parts of the motors' greatest ones."""
        return Continuous(-1.0, 1.0, 3)

    def reset(self, key: Key[Array, ""]) -> State:
        """Start near `STANCE`, nearly at rest."""
        pose, speed, body = jax.random.split(key, 3)
        spread = jnp.array([0.0, 0.0, 0.05, 0.05, 0.05, 0.05])
        qpos = jnp.asarray(STANCE, jnp.float32) + spread * _even(pose, 6)
        spread = jnp.array([0.5, 0.1, 0.3, 0.3, 0.3, 0.3])
        lowest, maximum = jnp.array(list(TRAINED_FOR.values())).T
        made = lowest + (maximum - lowest) * jax.random.uniform(body, (4,))
        return State(qpos, spread * _even(speed, 6), jnp.zeros(6), jnp.zeros(3), made)

    def start(self, key: Key[Array, ""], features: Mapping[str, Any]) -> State:
        """Start with the features of a problem, at rest in `STANCE` but for the pitch."""
        numbers = {**NOMINAL, **features}
        qpos = jnp.asarray(STANCE, jnp.float32).at[2].set(numbers["pitch0"])
        body = jnp.stack([jnp.asarray(numbers[name], jnp.float32) for name in TRAINED_FOR])
        return State(qpos, jnp.zeros(6), jnp.zeros(6), jnp.zeros(3), body)

    def step(
        self, key: Key[Array, ""], state: State, action: Float[Array, "3"]
    ) -> tuple[State, Scalar, Bool[Array, ""]]:
        """Take one control period."""
        from mujoco import mjx

        model, data = _mjx(state.body)
        data = data.replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=action
        )
        data = jax.lax.fori_loop(0, PHYSICS_STEPS, lambda _, d: mjx.step(model, d), data)
        often, much = jax.random.split(key)
        kicked = jax.random.bernoulli(often, CONTROL_PERIOD) * self.kick * _even(much, 1)[0]
        qpos, qvel = data.qpos, data.qvel.at[0].add(kicked)
        speed = (qpos[0] - state.qpos[0]) / CONTROL_PERIOD
        reward = 1.0 + jnp.clip(speed, -1.0, SPEED) - 2.0 * qpos[2] ** 2
        reward -= 0.05 * jnp.sum(action**2) + 0.1 * jnp.sum((action - state.control) ** 2)
        fallen = (qpos[1] < LOW) | (jnp.abs(qpos[2]) > BENT) | ~jnp.all(jnp.isfinite(qpos))
        after = State(qpos, qvel, data.qacc_warmstart, action, state.body)
        return after, reward, fallen

    def observe(self, state: State) -> Float[Array, "11"]:
        """Return the network's input; see `observe`."""
        return observe(state.qpos, state.qvel)


def _even(key: Key[Array, ""], size: int) -> Array:
    return jax.random.uniform(key, (size,), minval=-1.0, maxval=1.0)


@cache
def model() -> Any:
    """Return the compiled `mujoco.MjModel`, which must not be changed.

    **Raises:** `MissingExtra` without MuJoCo.
    """
    return require("mujoco", extra="mujoco").MjModel.from_xml_path(str(MODEL_FILE))


def _mjx(body: Float[Array, "4"]) -> tuple[Any, Any]:
    """Return the model of one episode, and a blank state, in MJX.

    Constants that MuJoCo derives from masses soften contacts a little; they stay as they are.
    """
    mjx, blank = _nominal()
    torso_mass, friction, strength, damping = body
    torso, floor = model().body("torso").id, model().geom("floor").id
    heavier = torso_mass / mjx.body_mass[torso]
    changed = {
        "body_mass": mjx.body_mass.at[torso].set(torso_mass),
        "body_inertia": mjx.body_inertia.at[torso].multiply(heavier),
        "geom_friction": mjx.geom_friction.at[floor, 0].set(friction),
        "actuator_gear": mjx.actuator_gear * strength,
        "dof_damping": mjx.dof_damping * damping,
    }
    return mjx.tree_replace(changed), blank


@cache
def _nominal() -> tuple[Any, Any]:
    mjx = require("mujoco.mjx", extra="mujoco")
    # Tracing must not leak into what the cache keeps.
    with jax.ensure_compile_time_eval():
        compiled = mjx.put_model(model())
        return compiled, mjx.make_data(compiled)
