"""What the trained cart-pole controller must keep, and under which circumstances.

    verifai-jax falsify specs/cartpole.py:balance --search uniform
    verifai-jax falsify specs/cartpole.py:rare --search cross_entropy --stop-after 1

The features are those of the paper's case study (Dreossi et al., VerifAI: a toolkit for the formal
design and analysis of artificial-intelligence-based systems, CAV 2019): initial position and angle,
mass and length of the pole. The network was trained on CartPole-v1, whose pole is 0.5 m (half
length) and 0.1 kg.
"""

import verifai_jax as vj
from envs import cartpole
from envs.cartpole_drawing import draw
from verifai_jax.addons.rl.policy import Policy

ON_THE_TRACK = "abs(x) <= 2.4"
UPRIGHT = "abs(theta) <= 0.20944"
NOMINAL = {"x0": 0.0, "theta0": 0.0, "masspole": 0.1, "length": 0.5}

paper = vj.FeatureSpace(
    {
        "x0": vj.Box(-1.0, 1.0),
        "theta0": vj.Box(-0.1, 0.1),
        "masspole": vj.Box(0.05, 0.5),
        "length": vj.Box(0.25, 1.2),
    }
)
controlled = cartpole.cartpole(cartpole.neural(), duration=4.0, terminate=True)

balance = vj.Problem(
    "balance",
    paper,
    controlled,
    f"always[0, 4] ({ON_THE_TRACK} & {UPRIGHT})",
    nominal=NOMINAL,
    description="stay on the track and upright for 4 s, whatever the pole",
    draw=draw,
)

rare = vj.Problem(
    "rare",
    vj.FeatureSpace({**paper.domains, "theta0": vj.Box(-0.05, 0.05), "length": vj.Box(0.25, 1.13)}),
    controlled,
    f"always[0, 4] ({ON_THE_TRACK} & {UPRIGHT})",
    nominal=NOMINAL,
    description="the same from gentle angles, poles up to 1.13 m: one sample in a thousand fails",
    draw=draw,
)

poles = {"masspole": vj.Box(0.05, 0.5), "length": vj.Box(0.25, 1.0)}

track = vj.Problem(
    "track",
    vj.FeatureSpace({"x0": vj.Box(-2.0, 2.0), "x_dot0": vj.Box(-2.0, 2.0), **poles}),
    controlled,
    f"always[0, 4] {ON_THE_TRACK}",
    nominal={"x0": 0.0, "x_dot0": 0.0, "masspole": 0.1, "length": 0.5},
    description="stay on the track, starting anywhere on it and moving",
    draw=draw,
)

upright = vj.Problem(
    "upright",
    vj.FeatureSpace({"theta0": vj.Box(-0.15, 0.15), "theta_dot0": vj.Box(-0.5, 0.5), **poles}),
    controlled,
    f"always[0, 4] {UPRIGHT}",
    nominal={"theta0": 0.0, "theta_dot0": 0.0, "masspole": 0.1, "length": 0.5},
    description="keep the pole within 12 degrees, starting with it falling",
    draw=draw,
)

settle = vj.Problem(
    "settle",
    vj.FeatureSpace({"x0": vj.Box(-1.0, 1.0), "theta0": vj.Box(-0.15, 0.15), **poles}),
    controlled,
    "(abs(theta) <= 0.2) until[0, 2] (abs(theta) <= 0.02 & abs(theta_dot) <= 0.2)",
    nominal=NOMINAL,
    description="come to rest upright within 2 s, and stay off the limits until then",
    draw=draw,
)

recover = vj.Problem(
    "recover",
    vj.FeatureSpace({"x0": vj.Box(-1.0, 1.0), "push": vj.Box(0.0, 15.0), **poles}),
    controlled,
    "eventually[1.1, 2.1] always[0, 0.5] abs(theta) <= 0.1",
    nominal={"x0": 0.0, "push": 0.0, "masspole": 0.1, "length": 0.5},
    description="within 1 s after a push from 1.0 s to 1.1 s, be calm for half a second",
    draw=draw,
)

gusts = vj.Problem(
    "gusts",
    vj.FeatureSpace(
        {
            "x0": vj.TruncatedNormal(0.0, 0.4, -1.0, 1.0),
            "theta0": vj.Box(-0.1, 0.1),
            "masspole": vj.LogUniform(0.05, 0.5),
            "length": vj.Box(0.25, 1.2),
            "controller": vj.Categorical("network", "linear", weights=[0.7, 0.3]),
            "wind": vj.Signal(vj.Box(-2.5, 2.5), knots=8, hold="linear"),
        },
        where=lambda f: f["masspole"] * f["length"] <= 0.3,
    ),
    cartpole.cartpole(
        cartpole.either(cartpole.neural(), cartpole.linear()), duration=4.0, terminate=True
    ),
    {
        "safe": f"always[0, 4] ({ON_THE_TRACK} & {UPRIGHT})",
        "centred": "always[0, 4] abs(x) <= 1.5",
        "calm": "always[1, 4] abs(theta) <= 0.15",
    },
    priority=[("safe", "centred"), ("safe", "calm")],
    nominal={**NOMINAL, "controller": "network", "wind": 0.0},
    description="either controller in a gusty wind: safe first, then centred and calm",
    draw=draw,
)


def balance_with(policy: Policy) -> vj.Problem:
    """Return `balance` for any policy with two actions; JAX may trace its weights."""
    return vj.Problem(
        "balance",
        paper,
        cartpole.cartpole(cartpole.neural(policy), duration=4.0, terminate=True),
        f"always[0, 4] ({ON_THE_TRACK} & {UPRIGHT})",
        nominal=NOMINAL,
        description="stay on the track and upright for 4 s, whatever the pole",
        draw=draw,
    )
