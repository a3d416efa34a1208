"""A car among traffic cones: whatever fails here is perception's fault.

    verifai-jax falsify specs/cones.py:narrow --search uniform --budget 2000
    verifai-jax falsify specs/cones.py:braking_narrow

With perfect perception neither manoeuvre ever fails. The network `wide` was trained on all that the
camera may see; `narrow` on cars that are not orange and without glare. The formula `seen` is that
of perception alone: cones nearer than 12 m are estimated nearer than 15 m.
"""

import verifai_jax as vj
from envs.cones import (
    NOMINAL,
    SCENERY,
    WEATHER,
    Manoeuvre,
    Perception,
    aebs,
    cones,
    lanechange,
    neural,
    perfect,
)
from envs.cones_drawing import draw

SAFE = "always cone_gap > 0.1"
SWERVE = "always heading < 0.53"
"""The lane change is no swerve. Its duration follows from the estimate, 1.63 s or more where that
is right, so that the heading is atan(15/8 * 3.5 m / 1.63 s / 7.2 m/s) = 0.509 at most."""
SEEN = "always (distance < 12 -> estimate < 15)"

SPEEDS = {"lanechange": (4.5, 7.2), "aebs": (5.0, 9.0)}
"""In m/s; at the greatest, perfect perception leaves some decimetres."""


def space(manoeuvre: str) -> vj.FeatureSpace:
    """Return where the car comes from, what stands in its lane, and the weather."""
    # Brakes act at once.
    reaction = {"reaction_time": vj.Box(0.7, 1.0)} if manoeuvre == "lanechange" else {}
    return vj.FeatureSpace(
        {
            "distance0": vj.Box(22.0, 30.0),
            "cruising_speed": vj.Box(*SPEEDS[manoeuvre]),
            **reaction,
            "offset0": vj.Box(-0.3, 0.3),
            "heading0": vj.Box(-0.04, 0.04),
            **SCENERY,
            **WEATHER,
        }
    )


def problem(name: str, perception: Perception, manoeuvre: str, about: str) -> vj.Problem:
    """Return a problem whose every failure is the perception's."""
    reactions: dict[str, Manoeuvre] = {"lanechange": lanechange(), "aebs": aebs()}
    # At the least speed, the time to pass the cones.
    duration = {"lanechange": 8.0, "aebs": 7.0}[manoeuvre]
    rules = {"safe": SAFE, "swerve": SWERVE, "seen": SEEN}
    if manoeuvre == "aebs":
        del rules["swerve"]
    first = [("safe", other) for other in rules if other != "safe"]
    low, high = SPEEDS[manoeuvre]
    reaction = {"reaction_time": 0.85} if manoeuvre == "lanechange" else {}
    return vj.Problem(
        name,
        space(manoeuvre),
        cones(perception, reactions[manoeuvre], duration),
        rules,
        priority=first,
        nominal={
            "distance0": 26.0,
            "cruising_speed": (low + high) / 2,
            **reaction,
            "offset0": 0.0,
            "heading0": 0.0,
            **NOMINAL,
        },
        description=about,
        draw=draw,
    )


perfectly = problem("perfectly", perfect(), "lanechange", "the distance is known")
wide = problem("wide", neural("wide"), "lanechange", "the network that saw everything in training")
narrow = problem("narrow", neural("narrow"), "lanechange", "the network that saw no orange car")
braking_perfectly = problem("braking_perfectly", perfect(), "aebs", "the distance is known")
braking_wide = problem("braking_wide", neural("wide"), "aebs", "the wide network brakes for cones")
braking_narrow = problem("braking_narrow", neural("narrow"), "aebs", "and the narrow one")
