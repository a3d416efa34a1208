"""The trained cart-pole controller on a MuJoCo model: does it keep what it keeps on paper?

    verifai-jax falsify specs/mujoco_cartpole.py:balance --search uniform
    verifai-jax falsify specs/mujoco_cartpole.py:gusts --search cross_entropy

`balance` has the features and the formula of the problem of that name in `specs/cartpole.py`.
"""

import verifai_jax as vj
from envs import cartpole, mujoco_cartpole
from envs.cartpole_drawing import draw

ON_THE_TRACK = "abs(x) <= 2.4"
UPRIGHT = "abs(theta) <= 0.20944"
NOMINAL = {"x0": 0.0, "theta0": 0.0, "masspole": 0.1, "length": 0.5}

poles = vj.FeatureSpace(
    {
        "x0": vj.Box(-1.0, 1.0),
        "theta0": vj.Box(-0.1, 0.1),
        "masspole": vj.Box(0.05, 0.5),
        "length": vj.Box(0.25, 1.2),
    }
)

balance = vj.Problem(
    "balance",
    poles,
    mujoco_cartpole.cartpole(cartpole.neural(), features=list(poles.domains), terminate=True),
    f"always[0, 4] ({ON_THE_TRACK} & {UPRIGHT})",
    nominal=NOMINAL,
    description="stay on the track and upright for 4 s, whatever the pole",
    draw=draw,
)

windy = vj.FeatureSpace(
    {
        "x0": vj.Box(-0.5, 0.5),
        "theta0": vj.Box(-0.1, 0.1),
        "masspole": vj.LogUniform(0.05, 0.5),
        "damping": vj.Box(0.0, 0.05),
        "controller": vj.Categorical("network", "linear", weights=[0.7, 0.3]),
        "wind": vj.Signal(vj.Box(-2.5, 2.5), knots=8, hold="linear"),
    }
)

gusts = vj.Problem(
    "gusts",
    windy,
    mujoco_cartpole.cartpole(
        cartpole.either(cartpole.neural(), cartpole.linear()),
        features=[name for name in windy.domains if name != "controller"],
        terminate=True,
    ),
    {
        "safe": f"always[0, 4] ({ON_THE_TRACK} & {UPRIGHT})",
        "calm": "always[1, 4] abs(theta) <= 0.15",
    },
    priority=["safe", "calm"],
    nominal={
        **{name: NOMINAL[name] for name in ("x0", "theta0", "masspole")},
        "damping": 0.0,
        "controller": "network",
        "wind": 0.0,
    },
    description="either controller in a gusty wind, with a rusty hinge: safe first, then calm",
    draw=draw,
)

settle = vj.Problem(
    "settle",
    vj.FeatureSpace(
        {
            "x0": vj.Box(-1.5, 1.5),
            "theta0": vj.Box(-0.15, 0.15),
            "masscart": vj.LogUniform(0.5, 4.0),
        }
    ),
    mujoco_cartpole.cartpole(cartpole.linear(), features=["x0", "theta0", "masscart"]),
    "eventually[0, 3] always[0, 1] (abs(theta) <= 0.04 & abs(x) <= 0.4)",
    nominal={"x0": 0.0, "theta0": 0.0, "masscart": 1.0},
    description="the linear controller brings any cart back to the middle and holds it there",
    draw=draw,
)
