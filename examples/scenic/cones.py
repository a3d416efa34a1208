"""A car that brakes for a broken one, over the scenes of a Scenic program.

verifai-jax falsify examples/scenic/cones.py:braking
"""

from pathlib import Path

import jax.numpy as jnp

import verifai_jax as vj

STEP, STEPS = 0.1, 60
"""Seconds of a step, and their number."""

scene = vj.scenic(Path(__file__).parent / "cones.scenic")


def brake(now, key):
    """See the broken car the later the darker it is, then brake at 8.5 m/s²; straight ahead."""
    ego, broken = now["ego"], now["broken"]
    reaction = 0.3 + 1.0 * (1 - now["params"]["brightness"]) ** 2
    time = jnp.arange(STEPS) * STEP
    speed = jnp.maximum(ego["speed"] - 8.5 * jnp.maximum(time - reaction, 0.0), 0.0)
    way = jnp.cumsum(speed) * STEP
    x = ego["x"] - way * jnp.sin(ego["heading"])
    y = ego["y"] + way * jnp.cos(ego["heading"])
    gap = jnp.hypot(broken["x"] - x, broken["y"] - y) - 4.5
    return vj.Trace({"gap": gap, "speed": speed}, dt=STEP)


braking = vj.Problem(
    "braking",
    space=scene.space,
    system=scene.system(brake),
    spec="always gap > 0",
    description="a car that brakes for a broken one, in the scenes of a Scenic program",
)
