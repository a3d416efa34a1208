"""The cart-pole of Gymnasium's CartPole-v1 as a system under test.

    cartpole(linear())                                   # 4 s, a linear controller
    cartpole(linear(gains), duration=2.0, terminate=True)
    cartpole(neural())                                   # the trained network that is shipped

Also the worked example of writing one's own environment: an `ode` needs the state's derivative,
the initial state and a controller, each a function.

Features, all optional, with CartPole-v1's values where missing: `x0` and `theta0` (initial
position in m and angle in rad), `x_dot0`, `theta_dot0` (m/s, rad/s), `masscart`, `masspole` (kg),
`length` (m, half the pole's), `force_mag` (N), a `push` (N) against the cart that begins at
`push_time` (s) and lasts 0.1 s, a `wind` (a function of time in s, in N) against the cart, and
which `controller` drives it (see `either`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from verifai_jax.addons.rl.policy import Layers, Policy, load_policy, scalar_network
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.systems.actions import Discrete
from verifai_jax.systems.ode import Ode, ode, sin_cos

Features = Mapping[str, Any]
Scalar = Float[Array, ""]
Controller = Callable[[Any, "State", Features], Scalar]

DT = 0.02
GRAVITY = 9.8
X_LIMIT = 2.4
THETA_LIMIT = 12 * 2 * math.pi / 360
PUSH_SECONDS = 0.1

# Trained by `python -m envs.train_cartpole`.
POLICY_FILE = Path(__file__).with_name("cartpole_policy.npz")

# Discrete-time LQR of the nominal plant at 50 Hz with unit weights on state and force.
LQR_GAINS = (0.91, 2.13, 30.6, 7.84)

NOMINAL = {
    "x0": 0.0,
    "x_dot0": 0.0,
    "theta0": 0.0,
    "theta_dot0": 0.0,
    "masscart": 1.0,
    "masspole": 0.1,
    "length": 0.5,
    "force_mag": 10.0,
    "push": 0.0,
    "push_time": 1.0,
}


class State(NamedTuple):
    """Position of the cart in m, angle of the pole from upright in rad, and their rates."""

    x: Scalar
    x_dot: Scalar
    theta: Scalar
    theta_dot: Scalar


def feature(features: Features, name: str) -> Any:
    """Return a feature's value, or CartPole-v1's where it is missing."""
    return features.get(name, NOMINAL[name])


def initial(features: Features, key: Any = None) -> State:
    """Return the state at time 0."""
    return State(*(feature(features, name) for name in ("x0", "x_dot0", "theta0", "theta_dot0")))


def dynamics(time: Scalar | float, state: State, force: Scalar, features: Features) -> State:
    """Return the derivative of the state under `force` (N) on the cart.

    Source: Florian, Correct equations for the dynamics of the cart-pole system (2007), eqs. 23-24
    without friction, as in Gymnasium.
    """
    masspole, length = feature(features, "masspole"), feature(features, "length")
    total_mass = masspole + feature(features, "masscart")
    polemass_length = masspole * length
    if "push" in features:
        force = force + features["push"] * pushed(time, feature(features, "push_time"))
    if "wind" in features:
        force = force + features["wind"](time)
    sin, cos = sin_cos(state.theta)
    temp = (force + polemass_length * (state.theta_dot * state.theta_dot) * sin) / total_mass
    theta_acc = (GRAVITY * sin - cos * temp) / (
        length * (4.0 / 3.0 - masspole * (cos * cos) / total_mass)
    )
    x_acc = temp - polemass_length * theta_acc * cos / total_mass
    return State(state.x_dot, x_acc, state.theta_dot, theta_acc)


def pushed(time: Scalar | float, push_time: Scalar | float) -> Scalar:
    """Return the part of the 0.02 s around `time` during which the push acts, in `[0, 1]`.

    Continuous in `push_time`, so that a gradient search can shift the push; the same push at any
    step of the integration.
    """
    # A thousandth more than the quotient, which may be rounded down.
    time = jnp.floor(time / DT + 1e-3) * DT
    begin = jnp.maximum(time, push_time)
    end = jnp.minimum(time + DT, push_time + PUSH_SECONDS)
    return jnp.maximum(end - begin, 0.0) / DT


def terminated(state: State, features: Features) -> Bool[Array, ""]:
    """Return True where CartPole-v1's episode is over: off the track, or beyond 12 degrees."""
    return (jnp.abs(state.x) > X_LIMIT) | (jnp.abs(state.theta) > THETA_LIMIT)


def linear(gains: Sequence[float] = LQR_GAINS) -> Controller:
    """Make a linear state feedback, saturated at the `force_mag` of the features.

    - `gains`: N per m, m/s, rad and rad/s.
    """
    if len(gains) != 4:
        raise ValueError(f"a linear controller needs 4 gains; got {list(gains)}")
    k_x, k_x_dot, k_theta, k_theta_dot = map(float, gains)

    def control(time: Scalar | float, state: State, features: Features) -> Scalar:
        x, x_dot, theta, theta_dot = state
        force = k_x * x + k_x_dot * x_dot + k_theta * theta + k_theta_dot * theta_dot
        largest = feature(features, "force_mag")
        return jnp.clip(force, -largest, largest)

    return control


def neural(
    policy: Policy | str | Path = POLICY_FILE,
    action: str = "argmax",
    straight_through: bool = True,
) -> Controller:
    """Load a trained network with two actions, left and right, at the features' `force_mag`.

    - `policy`: a `Policy` or the file of one; the one that is shipped when left out. JAX may trace
      its weights: then one program simulates any policy of the same form.
    - `action`: `"argmax"` pushes with full force in the likelier direction, as CartPole-v1 does.
      `"expected"` applies the mean force of the network's two probabilities, a smooth controller.
    - `straight_through`: give `"argmax"` the derivative of `"expected"`; its own is zero almost
      everywhere. The force itself is the same. Source: Bengio, Leonard and Courville (2013),
      section 4 (straight-through estimator).
    """
    if action not in ("argmax", "expected"):
        raise unknown_name("action", action, ["argmax", "expected"])
    policy = policy if isinstance(policy, Policy) else load_policy(policy)
    if policy.action != Discrete(2) or policy.layers[0][0].shape[0] != 4:
        raise ValueError(
            "a cart-pole policy sees 4 numbers and has 2 discrete actions; "
            f"got {policy.layers[0][0].shape[0]} and {policy.action}"
        )

    small = sum(weight.size for weight, _ in policy.layers) <= 600
    layers = _preferring(policy) if small and _known(policy) else None

    def control(time: Scalar | float, state: State, features: Features) -> Scalar:
        if layers is not None:
            (preference,) = scalar_network(layers, state, policy.activation)
        else:
            left, right = policy(jnp.stack(state))
            preference = right - left
        largest = feature(features, "force_mag")
        if action == "expected":
            return largest * jnp.tanh(preference / 2)
        return largest * (sign if straight_through else _sign)(preference)

    return control


def either(*controllers: Controller) -> Controller:
    """Make the controller that the feature `controller`, a `Categorical`, selects by its place."""
    if not controllers:
        raise ValueError("either needs at least one controller; got none")

    def control(time: Scalar | float, state: State, features: Features) -> Scalar:
        forces = [one(time, state, features) for one in controllers]
        return jnp.select([features["controller"] == i for i in range(len(forces))], forces)

    return control


def _known(policy: Policy) -> bool:
    """Return True where its numbers are constants, not being traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(policy))


def _preferring(policy: Policy) -> Layers:
    """Return the network with one output, its preference for right; on raw observations."""
    layers = [(np.asarray(weight), np.asarray(bias)) for weight, bias in policy.layers]
    if policy.mean is not None and policy.scale is not None:
        mean, (weight, bias) = np.asarray(policy.mean), layers[0]
        weight = weight / np.asarray(policy.scale)[:, None]
        layers[0] = (weight, bias - mean @ weight)
    weight, bias = layers[-1]
    layers[-1] = (weight[:, 1:] - weight[:, :1], bias[1:] - bias[:1])
    return tuple((jax.device_put(weight), jax.device_put(bias)) for weight, bias in layers)


def _sign(preference: Scalar) -> Scalar:
    # A tie goes to the left, as NumPy's argmax sends it.
    return jnp.where(preference > 0, 1.0, -1.0).astype(preference.dtype)


@jax.custom_jvp
def sign(preference: Scalar) -> Scalar:
    """Return 1 where positive, else -1, with the derivative of `tanh(preference / 2)`."""
    return _sign(preference)


@sign.defjvp
def _sign_jvp(primals: Any, tangents: Any) -> Any:
    smooth = jnp.tanh(primals[0] / 2)
    return sign(*primals), (1 - smooth * smooth) / 2 * tangents[0]


def cartpole(
    controller: Controller | None = None,
    *,
    duration: float = 4.0,
    terminate: bool = False,
    method: str = "euler",
    dt: float = DT,
) -> Ode:
    """Make the closed loop, with signals `x`, `x_dot`, `theta`, `theta_dot` and `force`.

    - `controller(time, state, features) -> force` in N; `linear()` when left out.
    - `duration`: simulated seconds, a multiple of `dt`.
    - `terminate`: end where CartPole-v1 would; otherwise the pole may fall and the cart run on.
    - `method`, `dt`: CartPole-v1 has explicit Euler with 0.02 s. The controller runs every 0.02 s
      at any step, which must divide it.

    CartPole-v1 is this difference equation and no continuous cart, so with its own method and step
    these belong to the system (`exact_step`), and no finer step is another look at the same one.
    With others the result approximates the continuous plant, as `envs.mujoco_cartpole` does.
    """
    return ode(
        dynamics,
        initial,
        controller=linear() if controller is None else controller,
        control_period=DT,
        dt=dt,
        duration=duration,
        method=method,
        signals=lambda time, state, force, features: {**state._asdict(), "force": force},
        terminate=terminated if terminate else None,
        exact_step=method == "euler" and dt == DT,
    )
