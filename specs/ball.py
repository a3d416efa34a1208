"""What a ball must do that is thrown, or rolled and braked.

verifai-jax falsify specs/ball.py:over --search uniform
verifai-jax falsify specs/ball.py:halt --search cross_entropy
"""

import verifai_jax as vj
from envs import ball

over = vj.Problem(
    "over",
    vj.FeatureSpace(
        {
            "speed": vj.Box(2.0, 5.0),
            "lift": vj.Box(2.5, 5.0),
            "height": vj.Box(0.2, 1.0),
            "radius": vj.Box(0.06, 0.14),
            "wind": vj.Signal(vj.Box(-0.5, 0.5), knots=4, hold="linear"),
        }
    ),
    ball.ball(features=["speed", "lift", "height", "radius", "wind"]),
    {"clears": "eventually[0, 1.6] x >= 2.2", "stays": "always x <= 8"},
    nominal={"speed": 3.5, "lift": 4.0, "height": 0.5, "radius": 0.1, "wind": 0.0},
    description="thrown in a wind: over the rail at 2 m, and not farther than 8 m",
)

halt = vj.Problem(
    "halt",
    vj.FeatureSpace(
        {
            "speed": vj.Box(0.5, 4.0),
            "friction": vj.LogUniform(0.05, 1.0),
            "radius": vj.Box(0.06, 0.14),
        }
    ),
    ball.ball(ball.brake(1.0), features=["speed", "friction", "radius"], duration=3.0),
    {"misses": "always hit <= 0.5", "halts": "eventually[0, 2.5] always[0, 0.5] abs(x - 1) <= 0.1"},
    priority=["misses", "halts"],
    nominal={"speed": 1.5, "friction": 0.5, "radius": 0.1},
    description="rolled towards the rail and braked: comes to a halt at 1 m and never touches it",
)
