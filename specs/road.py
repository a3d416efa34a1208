"""What drivers and assistants must keep on a small road: `envs/road/`.

    verifai-jax falsify specs/road.py:platoon
    verifai-jax falsify specs/road.py:cut_in --search cross_entropy --stop-after 1
    verifai-jax replay runs/cut_in-1                    # the road from above

A gap is the distance between two rectangles in m; below zero they overlap.
"""

import verifai_jax as vj
from envs import road
from envs.road import scenarios
from envs.road.scenarios import BEND, BICYCLE_CAR, LANE, NOMINAL, STRAIGHT

CAR = road.CAR

platoon = vj.Problem(
    "platoon",
    vj.FeatureSpace(
        {
            "speed0": vj.Box(18.0, 30.0),
            "headways": vj.Array(vj.Box(0.8, 1.6), 3),
            "lag": vj.Box(0.2, 1.0),
            "hardest": vj.Box(5.5, 8.5),
            "lead_acceleration": vj.Signal(vj.Box(-8.0, 3.0), knots=6, hold="constant"),
        }
    ),
    road.following(),
    "always gap > 0",
    nominal=NOMINAL["following"],
    description="three cars follow one that brakes as hard as it likes: nobody hits another",
    draw=road.Picture(
        {"lead": CAR, "car_1": CAR, "car_2": CAR, "car_3": CAR},
        lanes=[(BEND, 4.5)],
        follow="lead",
        window=(-110.0, 25.0, -35.0, 35.0),
    ),
)

motorway = {
    "lanes": [(road.Path.start(0.0, LANE / 2).straight(1000.0), 2 * LANE + 1)],
    "lines": [(road.Path.start(0.0, LANE / 2).straight(1000.0), True)],
}

cut_in = vj.Problem(
    "cut_in",
    vj.FeatureSpace(
        {
            "ego_speed0": vj.Box(22.0, 34.0),
            "slower": vj.Box(0.0, 6.0),
            "ahead": vj.Box(12.0, 45.0),
            "begin": vj.Box(0.5, 3.0),
            "duration": vj.Box(2.5, 6.0),
            "headway": vj.Box(0.9, 1.8),
            "lag": vj.Box(0.1, 0.4),
            "hardest": vj.Box(6.0, 9.0),
            "other_braking": vj.Box(0.0, 3.0),
        }
    ),
    road.cut_in(),
    {"safe": "always gap > 0", "calm": "always acceleration > -5"},
    priority=["safe", "calm"],
    nominal=NOMINAL["cut_in"],
    description="adaptive cruise control and a slower car that cuts in: no collision, then comfort",
    draw=road.Picture({"ego": BICYCLE_CAR, "other": BICYCLE_CAR}, **motorway, follow="ego"),
)

overtaking = vj.Problem(
    "overtaking",
    vj.FeatureSpace(
        {
            "ego_speed0": vj.Box(22.0, 28.0),
            "truck_speed": vj.Box(20.0, 24.0),
            "truck_ahead": vj.Box(25.0, 60.0),
            "faster": vj.Box(3.0, 14.0),
            "behind": vj.Box(40.0, 150.0),
            "reach": vj.Box(70.0, 110.0),
            "misjudged": vj.Box(-2.5, 2.5),
            "rear_lag": vj.Box(0.3, 1.0),
            "duration": vj.Box(3.0, 6.0),
        }
    ),
    road.overtaking(),
    {"safe": "always (gap > 0 & truck_gap > 0)", "polite": "always rear_acceleration > -6.5"},
    priority=["safe", "polite"],
    nominal=NOMINAL["overtaking"],
    description="a lane change by MOBIL before a faster car that the sensor sees late",
    draw=road.Picture(
        {"ego": BICYCLE_CAR, "rear": BICYCLE_CAR, "truck": road.TRUCK},
        **motorway,
        follow="ego",
        window=(-60.0, 50.0, -12.0, 15.0),
    ),
)

pedestrian = vj.Problem(
    "pedestrian",
    vj.FeatureSpace(
        {
            "ego_speed0": vj.Box(5.0, 7.5),
            "van": vj.Box(25.0, 45.0),
            "step": vj.Box(1.5, 3.0),
            "leave": vj.Box(0.0, 4.0),
            "walk": vj.Box(0.8, 1.4),
            "reaction": vj.Box(0.1, 0.25),
            "braking": vj.Box(6.0, 9.0),
        }
    ),
    road.pedestrian(),
    "always (gap > 0 | ego_speed < 0.5)",
    nominal=NOMINAL["pedestrian"],
    description="somebody steps out from behind a parked van: the car does not hit them",
    draw=road.Picture(
        {"ego": CAR, "person": road.PERSON},
        lanes=[(STRAIGHT, LANE + 0.6), (road.Path.start(0.0, -2.9).straight(1000.0), 2.4)],
        standing=lambda features: [(scenarios.parked_van(features), road.VAN)],
        window=(0.0, 60.0, -8.0, 8.0),
        hidden=("ego", "person"),
    ),
)
