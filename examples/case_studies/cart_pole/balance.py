"""The trained cart-pole of `envs/cartpole.py`, by two requirements."""

from pathlib import Path

import verifai_jax as vj
from envs import cartpole
from envs.cartpole_drawing import draw

problem = vj.Problem(
    "cart_pole",
    {
        "x0": vj.Box(-1.0, 1.0),
        "theta0": vj.Box(-0.1, 0.1),
        "masspole": vj.Box(0.05, 0.5),
        "length": vj.Box(0.25, 1.2),
    },
    cartpole.cartpole(cartpole.neural(), duration=4.0),
    {"CP-1": "always[0, 4] abs(x) <= 2.4", "CP-2": "always[0, 4] abs(theta) <= 0.20944"},
    requirements=Path(__file__).with_name("requirements.yaml"),
    nominal={"x0": 0.0, "theta0": 0.0, "masspole": 0.1, "length": 0.5},
    description="stay on the track and upright for 4 s, whatever the pole",
    draw=draw,
)
