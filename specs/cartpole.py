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
    vj.FeatureSpace({**paper.domains, "length": vj.Box(0.25, 1.08)}),
    controlled,
    f"always[0, 4] ({ON_THE_TRACK} & {UPRIGHT})",
    nominal=NOMINAL,
    description="the same with poles up to 1.08 m: about one sample in a thousand fails",
    draw=draw,
)
