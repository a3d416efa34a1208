"""What the trained hopper must keep, on hoppers and ground that it was not trained for.

    verifai-jax falsify specs/hopper.py:upright --search uniform --budget 1000
    verifai-jax falsify specs/hopper.py:gusts --search cross_entropy --stop-after 1

It was trained with a torso of 3.5 to 4.5 kg, friction from 0.6, and motors of 85 % to 110 % of
their strength (`envs.hopper.TRAINED_FOR`), and kicked about now and then.
"""

import verifai_jax as vj
from envs.hopper import NOMINAL, TRAINED_FOR, hopper

UPRIGHT = "always[0, 4] (height >= 0.8 & abs(pitch) <= 0.8)"


def nominal(*features: str) -> dict[str, float]:
    """Return these features' nominal values."""
    return {name: NOMINAL[name] for name in features}


bodies = {
    "torso_mass": vj.Box(3.0, 5.5),
    "friction": vj.Box(0.45, 1.2),
    "strength": vj.Box(0.8, 1.1),
    "damping": vj.Box(0.5, 2.0),
    "pitch0": vj.Box(-0.1, 0.1),
}

upright = vj.Problem(
    "upright",
    vj.FeatureSpace(bodies),
    hopper(*bodies),
    UPRIGHT,
    nominal=nominal(*bodies),
    description="stay on the foot for 4 s, whatever the torso, the motors and the ground",
)

familiar = vj.Problem(
    "familiar",
    vj.FeatureSpace(
        {
            **{name: vj.Box(*TRAINED_FOR[name]) for name in TRAINED_FOR},
            "pitch0": vj.Box(-0.05, 0.05),
        }
    ),
    hopper(*bodies),
    UPRIGHT,
    nominal=nominal(*bodies),
    description="the same among the hoppers that it was trained on",
)

gusty = {
    "friction": vj.Box(0.7, 1.2),
    "push": vj.Signal(vj.Box(-8.0, 8.0), knots=8, hold="constant"),
}

gusts = vj.Problem(
    "gusts",
    vj.FeatureSpace(gusty),
    hopper(*gusty),
    UPRIGHT,
    nominal=nominal(*gusty),
    description="stay on the foot in a wind that turns every half second, up to 8 N",
)

advances = vj.Problem(
    "advances",
    vj.FeatureSpace({**bodies, "foot": vj.Box(0.11, 0.17)}),
    hopper(*bodies, "foot"),
    {
        "upright": UPRIGHT,
        "advances": "eventually[0, 4] x >= 3.5",
        "careful": "always[1, 4] abs(pitch) <= 0.4",
    },
    priority=["upright", "advances", "careful"],
    nominal=nominal(*bodies, "foot"),
    description="get 3.5 m ahead in 4 s: upright first, then fast, then without swaying",
)
