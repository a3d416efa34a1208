"""A small road world: cars on lanes and guideways, traffic, lines of sight; compiled and batched.

    lane = Path.start(0.0, 0.0).straight(50.0).turn(9.0, math.pi / 2).straight(30.0)
    pose = lane.pose(60.0, offset=0.5)                      # x, y, heading at an arc length
    gap(pose, CAR, other, CAR)                              # m between two rectangles
    sight((0.0, 0.0), (40.0, 3.0), parked, CAR)             # m by which a view misses a body
    following(), cut_in(), overtaking(), pedestrian()       # systems, see `scenarios`

All in metres, seconds and rad; headings are anticlockwise from the x axis, offsets to the left.
Everything is a pure function of scalars that JAX batches and differentiates.
"""

from envs.road.bodies import CAR, PERSON, TRUCK, VAN, Body, Pose, disc_gap, gap, sight
from envs.road.cars import Car, bicycle, held_at_rest, steering
from envs.road.drawing import Picture
from envs.road.driving import Driver, cruise_control, equilibrium_gap, idm, lane_change, mobil
from envs.road.paths import Path
from envs.road.scenarios import cut_in, following, overtaking, pedestrian

__all__ = [
    "CAR",
    "PERSON",
    "TRUCK",
    "VAN",
    "Body",
    "Car",
    "Driver",
    "Path",
    "Picture",
    "Pose",
    "bicycle",
    "cruise_control",
    "cut_in",
    "disc_gap",
    "equilibrium_gap",
    "following",
    "gap",
    "held_at_rest",
    "idm",
    "lane_change",
    "mobil",
    "overtaking",
    "pedestrian",
    "sight",
    "steering",
]
