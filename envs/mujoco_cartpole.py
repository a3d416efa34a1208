"""The cart-pole of `envs.cartpole` as a MuJoCo model, on MJX or on MuJoCo itself.

    cartpole(linear(), features=["x0", "theta0"])
    cartpole(neural(), features=["x0", "theta0", "masspole", "length"], terminate=True)

The model is that of `envs.cartpole` (uniform thin rod, no friction, gravity 9.8); MuJoCo integrates
it with semi-implicit Euler at 0.005 s where CartPole-v1 has explicit Euler at 0.02 s. Controllers
are those of `envs.cartpole` and run every 0.02 s.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from envs import cartpole as analytic
from verifai_jax.addons.simulators.mujoco.loop import State
from verifai_jax.addons.simulators.mujoco.system import MuJoCo, mujoco
from verifai_jax.core.messages.errors import check_names

MODEL = Path(__file__).with_name("mujoco_cartpole.xml")

# What each feature sets. A pole of another length has its middle elsewhere.
BOUND_FEATURES: dict[str, Any] = {
    "x0": "joint/slider/qpos",
    "x_dot0": "joint/slider/qvel",
    "theta0": "joint/hinge/qpos",
    "theta_dot0": "joint/hinge/qvel",
    "masscart": "body/cart/mass",
    "masspole": "body/pole/mass",
    "length": ["geom/pole/size[2]", "geom/pole/pos[2]"],
    "wind": "body/cart/force[0]",
    "damping": "joint/hinge/damping",
    "gravity": "option/gravity[2]",
}


def observed(state: State) -> analytic.State:
    """Return the state in the order of `envs.cartpole`, for its controllers."""
    (x, theta), (x_dot, theta_dot) = state.qpos, state.qvel
    return analytic.State(x, x_dot, theta, theta_dot)


def terminated(state: State, features: Mapping[str, Any]) -> Bool[Array, ""]:
    """Return True where CartPole-v1's episode is over: off the track, or beyond 12 degrees."""
    return analytic.terminated(observed(state), features)


def cartpole(
    controller: analytic.Controller | None = None,
    *,
    features: Collection[str] = ("x0", "theta0"),
    duration: float = 4.0,
    terminate: bool = False,
    backend: str = "auto",
) -> MuJoCo:
    """Make the closed loop, with signals `x`, `x_dot`, `theta`, `theta_dot` and `force`.

    - `controller(time, state, features) -> force` in N, of `envs.cartpole`; `linear()` when left
      out.
    - `features`: which of `BOUND_FEATURES` the feature space has. Others go to the controller
      alone.
    - `duration`: simulated seconds, a multiple of 0.02.
    - `terminate`: end where CartPole-v1 would; otherwise the pole may fall and the cart run on.
    - `backend`: `"auto"`, `"mjx"` or `"native"`.

    **Raises:** `UnknownNameError` for a feature that there is no place for.
    """
    check_names("feature of the MuJoCo cart-pole", features, BOUND_FEATURES)
    chosen = analytic.linear() if controller is None else controller

    def control(time: Array, state: State, features: Mapping[str, Any]) -> Array:
        return jnp.asarray(chosen(time, observed(state), features))

    return mujoco(
        MODEL,
        duration=duration,
        control_period=analytic.DT,
        bind={name: BOUND_FEATURES[name] for name in features},
        controller=control,
        signals={
            "x": "joint/slider/qpos",
            "x_dot": "joint/slider/qvel",
            "theta": "joint/hinge/qpos",
            "theta_dot": "joint/hinge/qvel",
            "force": "actuator/motor/ctrl",
        },
        terminate=terminated if terminate else None,
        backend=backend,
    )
