"""Controllers whose gains are features: to be chosen (`synthesize`) or mended (`repair`).

    verifai-jax synthesize specs/tuning.py:first_order --parameters k
    verifai-jax repair specs/tuning.py:gains --parameters k_x,k_x_dot,k_theta,k_theta_dot

`first_order` has a known answer. The state x' = -k x + w under a constant disturbance |w| <= 1
starts at 0, so that |x| <= (1 - exp(-4 k)) / k for 4 s; the largest force |k x| comes with |w| = 1
and an x0 of 0.5. `gains` is the cart-pole under linear state feedback, tuned poorly: it hardly
damps the pole, and the cart drifts away.
"""

import jax.numpy as jnp

import verifai_jax as vj
from envs import cartpole
from envs.cartpole_drawing import draw


def decay(features, key=None) -> vj.Trace:
    """Return the solution of x' = -k x + w from x0, every 0.1 s for 4 s; `u` is the force k x."""
    time = jnp.arange(41) * 0.1
    fading = jnp.exp(-features["k"] * time)
    x = features["x0"] * fading + features["w"] / features["k"] * (1 - fading)
    return vj.Trace({"x": x, "u": features["k"] * x}, dt=0.1)


def feedback(time, state, features):
    """Return a linear state feedback with the gains of the features, saturated at 10 N."""
    force = (
        features["k_x"] * state.x
        + features["k_x_dot"] * state.x_dot
        + features["k_theta"] * state.theta
        + features["k_theta_dot"] * state.theta_dot
    )
    return jnp.clip(force, -10.0, 10.0)


first_order = vj.Problem(
    "first_order",
    vj.FeatureSpace({"k": vj.Box(0.2, 5.0), "x0": vj.Box(-0.5, 0.5), "w": vj.Box(-1.0, 1.0)}),
    decay,
    {"near": "always abs(x) <= 1.0", "gentle": "always abs(u) <= 1.8"},
    nominal={"k": 0.5, "x0": 0.0, "w": 0.0},
    description="a gain that keeps x near 0 without too large a force, whatever the disturbance",
)

gains = vj.Problem(
    "gains",
    vj.FeatureSpace(
        {
            "k_x": vj.Box(-2.0, 5.0),
            "k_x_dot": vj.Box(-2.0, 8.0),
            "k_theta": vj.Box(0.0, 60.0),
            "k_theta_dot": vj.Box(0.0, 20.0),
            "x0": vj.Box(-0.5, 0.5),
            "theta0": vj.Box(-0.1, 0.1),
            "push": vj.Box(-8.0, 8.0),
            "masspole": vj.Box(0.05, 0.3),
            "length": vj.Box(0.25, 1.0),
        }
    ),
    cartpole.cartpole(feedback, duration=4.0),
    {
        "safe": "always[0, 4] (abs(x) <= 2.4 & abs(theta) <= 0.20944)",
        "calm": "always[3, 4] (abs(x) <= 1.0 & abs(theta) <= 0.05)",
    },
    nominal={
        "k_x": 0.0,
        "k_x_dot": 0.0,
        "k_theta": 20.0,
        "k_theta_dot": 1.0,
        "x0": 0.0,
        "theta0": 0.0,
        "push": 0.0,
        "masspole": 0.1,
        "length": 0.5,
    },
    description="a cart-pole with poorly tuned gains; safe, and calm 2 s after a push",
    draw=draw,
)
