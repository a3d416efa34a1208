"""A ball on a lawn with a rail across it: a small MuJoCo model whose contacts come and go.

    ball(features=["speed", "lift", "radius"])                 # thrown, and left alone
    ball(brake(1.0), features=["speed", "friction"])           # rolled, and pushed to a halt

Features, all optional: `speed` and `lift` (m/s, forwards and upwards at time 0), `height` (m, of
the ball's middle at time 0), `friction` of the ball on everything, `radius` in m, at constant
density, and `drag` (N s/m); a `wind` in N, a function of time.
"""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from verifai_jax.addons.simulators.mujoco.loop import State
from verifai_jax.addons.simulators.mujoco.system import MuJoCo, mujoco
from verifai_jax.core.messages.errors import check_names

MODEL = Path(__file__).with_name("ball.xml")
RAIL = 2.0

BOUND_FEATURES: dict[str, Any] = {
    "speed": "joint/ball/qvel[0]",
    "lift": "joint/ball/qvel[2]",
    "height": "joint/ball/qpos[2]",
    "friction": "geom/ball/friction[0]",
    "radius": "geom/ball/size[0]",
    "drag": [f"joint/ball/damping[{i}]" for i in range(3)],
    "wind": "body/ball/force[0]",
}

Controller = Callable[[Array, State, Mapping[str, Any]], Float[Array, ""]]


def brake(target: float, stiffness: float = 10.0, damping: float = 6.0) -> Controller:
    """Return a push of at most 2 N that brings the ball to a halt at `target` (m).

    - `stiffness`, `damping`: N per m, and N per m/s.
    """

    def control(time: Array, state: State, features: Mapping[str, Any]) -> Float[Array, ""]:
        return stiffness * (target - state.qpos[0]) - damping * state.qvel[0]

    return control


def ball(
    controller: Controller | None = None,
    *,
    features: Collection[str],
    duration: float = 2.0,
    backend: str = "auto",
) -> MuJoCo:
    """Make the ball a system with signals `x`, `z`, `speed` (forwards) and `hit`.

    - `controller(time, state, features) -> push` in N, forwards; none when left out.
    - `features`: which of `BOUND_FEATURES` the feature space has.
    - `duration`: simulated seconds, a multiple of 0.02.
    - `backend`: `"auto"`, `"mjx"` or `"native"`.

    `hit` is 1 while the ball touches the rail.

    **Raises:** `UnknownNameError` for a feature that there is no place for.
    """
    check_names("feature of the ball", features, BOUND_FEATURES)
    return mujoco(
        MODEL,
        duration=duration,
        control_period=0.02,
        bind={name: BOUND_FEATURES[name] for name in features},
        controller=controller,
        initial=None if "height" in features else _on_the_lawn,
        signals={
            "x": "joint/ball/qpos[0]",
            "z": "joint/ball/qpos[2]",
            "speed": "joint/ball/qvel[0]",
            "hit": "contact/ball/rail",
        },
        backend=backend,
    )


def _on_the_lawn(
    features: Mapping[str, Any], key: Any, qpos: Array, qvel: Array
) -> tuple[Array, Array]:
    """Place a ball of another size higher or lower."""
    return qpos.at[2].set(jnp.asarray(features.get("radius", 0.1), qpos.dtype)), qvel
