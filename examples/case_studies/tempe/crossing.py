"""The intersection of Tempe (`envs/road/tempe.py`), by three requirements."""

from pathlib import Path

import verifai_jax as vj
from envs.road.tempe import NOMINAL, PICTURE, tempe

domains = {
    "ego_dist": vj.Box(45.0, 75.0),
    "ego_speed": vj.Box(30.0, 50.0),
    "turn_start": vj.Box(-12.0, -5.0),
    "turn_speed": vj.Box(20.0, 35.0),
    "delay": vj.Box(0.0, 3.0),
    "reaction": vj.Box(0.1, 0.3),
    "brake": vj.Box(6.0, 8.5),
    "notice": vj.Box(0.0, 4.0),
}

problem = vj.Problem(
    "crossing",
    domains,
    tempe(),
    {
        "TEMPE-1": "always gap > 0",
        "TEMPE-2": "always acceleration > -6",
        "TEMPE-3": "eventually ego_y > 10",
    },
    priority=["TEMPE-1", "TEMPE-2", "TEMPE-3"],
    requirements=Path(__file__).with_name("requirements.yaml"),
    nominal={name: NOMINAL[name] for name in domains},
    description="no collision with a car that turns left, then comfort, then flow",
    draw=PICTURE,
)
