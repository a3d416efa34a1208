"""What a lane-keeping assistant must keep, and on which roads.

    verifai-jax falsify specs/lane_keeping.py:lane
    verifai-jax falsify specs/lane_keeping.py:learned --search cross_entropy --stop-after 1

A lane of 3.5 m and a car of 1.8 m leave 0.85 m on each side. Roads are 300 m of clothoids between
random curvatures. Acceleration and jerk are bounded as is usual for assistance in the lane (here by
3 m/s^2 and 5 m/s^3).
"""

import verifai_jax as vj
from envs.lane_keeping import lane_keeping, lqr, neural
from envs.lane_keeping_drawing import draw

IN_LANE = "left >= 0 & right >= 0"
ROAD = 300.0  # m; what lies behind goes on as its last knot.

car = {
    "speed0": vj.Box(16.0, 26.0),
    "wheelbase": vj.Box(2.5, 2.9),
    "lag": vj.LogUniform(0.05, 0.4),
    "friction": vj.Box(0.35, 1.0),
}
as_built = {"speed0": 20.0, "wheelbase": 2.7, "lag": 0.1, "friction": 0.9}


def road(sharpest: float) -> vj.Signal:
    """Return a road whose curvature (1/m) is anything up to `sharpest` at every 50 m."""
    return vj.Signal(vj.Box(-sharpest, sharpest), knots=7, hold="linear", duration=ROAD)


winding = vj.FeatureSpace(
    {
        **car,
        "offset0": vj.Box(-0.5, 0.5),
        "heading0": vj.Box(-0.04, 0.04),
        "bias": vj.Box(-0.012, 0.012),
        "noise": vj.Signal(vj.Box(-0.2, 0.2), knots=11, hold="linear"),
        "curvature": road(1 / 180),
    }
)
straight = {
    **as_built,
    "offset0": 0.0,
    "heading0": 0.0,
    "bias": 0.0,
    "noise": 0.0,
    "curvature": 0.0,
}
regulated = lane_keeping(lqr())

lane = vj.Problem(
    "lane",
    winding,
    regulated,
    f"always[0, 10] ({IN_LANE})",
    nominal=straight,
    description="the LQR keeps the whole car in its lane for 10 s on a winding road",
    draw=draw,
)

learned = vj.Problem(
    "learned",
    winding,
    lane_keeping(neural()),
    f"always[0, 10] ({IN_LANE})",
    nominal=straight,
    description="the trained network keeps the car in its lane: it fails several times as often",
    draw=draw,
)

recover = vj.Problem(
    "recover",
    vj.FeatureSpace(
        {
            **car,
            "offset0": vj.Box(-0.8, 0.8),
            "heading0": vj.Box(-0.06, 0.06),
            "bias": vj.Box(-0.0035, 0.0035),
            "curvature": road(1 / 200),
        }
    ),
    regulated,
    "eventually[0, 5] always[0, 5] abs(offset) <= 0.2",
    nominal={**as_built, "offset0": 0.6, "heading0": 0.0, "bias": 0.0, "curvature": 0.0},
    description="within 5 s back to 0.2 m from the lane's middle, and stay there",
    draw=draw,
)

comfort = vj.Problem(
    "comfort",
    vj.FeatureSpace(
        {
            **car,
            "speed0": vj.Box(14.0, 23.0),
            "acceleration": vj.Box(-1.0, 1.0),
            "offset0": vj.Box(-0.1, 0.1),
            "heading0": vj.Box(-0.01, 0.01),
            "curvature": road(1 / 200),
        }
    ),
    regulated,
    {
        "lane": f"always[0, 10] ({IN_LANE})",
        "acceleration": "always[0, 10] abs(lateral_acceleration) <= 3",
        "jerk": "always[0.4, 10] abs(lateral_jerk) <= 5",
    },
    priority=[("lane", "acceleration"), ("lane", "jerk")],
    nominal={**as_built, "acceleration": 0.0, "offset0": 0.0, "heading0": 0.0, "curvature": 0.0},
    description="in the lane first; then lateral acceleration and jerk within their limits",
    draw=draw,
)

ice = vj.Problem(
    "ice",
    vj.FeatureSpace(
        {
            **car,
            "speed0": vj.Box(12.0, 18.0),
            "friction": vj.Signal(vj.Box(0.06, 0.5), knots=10, hold="constant"),
            "offset0": vj.Box(-0.2, 0.2),
            "curvature": road(1 / 180),
        }
    ),
    regulated,
    f"always[0, 10] ({IN_LANE})",
    nominal={**as_built, "speed0": 13.0, "offset0": 0.0, "friction": 0.4, "curvature": 0.0},
    description="a road with a patch of another friction every second, down to black ice",
    draw=draw,
)
