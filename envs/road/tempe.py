"""The intersection of Tempe: a car that goes straight on, one that turns left, and stopped traffic.

    tempe()                  # the straight car brakes for the message of a smart intersection
    tempe(eyes=True)         # it also brakes for what it sees

The accident of March 2017 as the VerifAI paper varies it (Dreossi et al., CAV 2019, section 3.1): a
car drives north past two lanes of stopped traffic, and a car from the other side turns left through
a gap in them. Neither sees the other until just before the impact. A smart intersection may say
`notice` seconds ahead that the turning car is about to enter the straight car's lane.

The origin is the middle of the intersection, x to the east and y to the north; lanes are 3.5 m
wide. The northbound ones lie at x = 1.75 and 5.25, where traffic stands, and 8.75, where the ego
drives. The turning car comes down x = -1.75, turns on a circle of 9 m from its stop line at y = 9
and leaves to the east, at one speed. Its pose has a closed form in time; the ego is a point mass.

Features, with the values of `NOMINAL` where missing:

- `ego_dist`: m from the ego's middle to that of the intersection at time 0; `ego_speed`: km/h.
- `turn_start`: m of path from the stop line to the turning car's middle, negative before it;
  `turn_speed`: km/h; `delay`: s that it waits before it goes.
- `block_noise`: m by which the stopped cars stand to the left of the middle of their lanes.
- `reaction`: s from a message, or from a free view, to the brakes; `brake`: m/s^2 at most.
- `notice`: s from the message to the instant at which the turning car's front enters the lane.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp

from envs.road.bodies import CAR, Body, Pose, gap, sight
from envs.road.cars import held_at_rest
from envs.road.drawing import Picture
from envs.road.paths import Path
from verifai_jax.systems.ode import Ode, ode, sin_cos

Features = Mapping[str, Any]

DT = 0.04
LANE = 3.5
EGO_X = 8.75
STOP_LINE = 9.0
"""m from the middle of the intersection to each stop line, and the radius of the left turn."""
APPROACH = 40.0
GUIDEWAY = (
    Path.start(-LANE / 2, STOP_LINE + APPROACH, -math.pi / 2)
    .straight(APPROACH)
    .turn(STOP_LINE, math.pi / 2)
    .straight(40.0)
)
"""The turning car's path; its stop line is at `APPROACH`."""
STANDING, SPACING = 9, 5.7
"""Cars that stand in each of the two lanes, bumper to bumper, and m from one to the next."""
COLUMN = Body(STANDING * SPACING - 1.0, CAR.width)
"""What hides: the cars of a lane as one body, since nobody looks through a gap of 1 m."""
QUEUE_FRONT = -2.5
"""The traffic is backed up into the intersection, and leaves the turning car just its gap."""
COLUMN_Y = QUEUE_FRONT - COLUMN.length / 2
HALT_BY = -2.2
"""Who cannot halt with its front before this y goes on."""
LAST = 0.9
"""Who already brakes may need so many m more: it does not give up at the last moment."""

KMH = 1 / 3.6
RISE = 0.15
"""Seconds in which brakes reach their force."""
GENTLE = 2.0
"""The least braking for a message, and the acceleration once the lane is free again, m/s^2."""
EARLY = 1.1
"""The ego brakes by that much more than would just stop it at its line."""
CERTAIN = 0.3
"""A view that is free by so many m is as good as one that is wholly free."""

NOMINAL: dict[str, float] = {
    "ego_dist": 60.0,
    "ego_speed": 40.0,
    "turn_start": -8.0,
    "turn_speed": 27.0,
    "delay": 1.5,
    "block_noise": 0.0,
    "reaction": 0.2,
    "brake": 7.5,
    "notice": 4.0,
}


def _path_where(reached: Any) -> float:
    """Return the path from the stop line at which `reached` turns true, by bisection."""
    low, high = 0.0, 30.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


def _x_of(path: float, ahead: float) -> float:
    """Return the x of the point `ahead` metres ahead of the turning car's middle."""
    turned = min(max(path / STOP_LINE, 0.0), math.pi / 2)
    beyond = max(path - STOP_LINE * math.pi / 2, 0.0)
    middle = -LANE / 2 + STOP_LINE * (1 - math.cos(turned)) + beyond
    return middle + ahead * math.sin(turned)


ENTERS = _path_where(lambda s: _x_of(s, CAR.front) >= EGO_X - LANE / 2)
"""m of path from the stop line at which the turning car's front enters the ego's lane."""
LEAVES = _path_where(lambda s: _x_of(s, -CAR.rear) >= EGO_X + LANE / 2)
"""m of path at which its rear has left that lane."""


class Ego(NamedTuple):
    """The straight car: y of its middle, its speed, and how far it is in recognising (0 to 1)."""

    y: Any
    speed: Any
    recognised: Any


def feature(features: Features, name: str) -> Any:
    """Return a feature's value, or the nominal one where it is missing."""
    return features.get(name, NOMINAL[name])


def time_at(features: Features, path: float) -> Any:
    """Return the time (s) at which the turning car has got so far beyond its stop line."""
    speed = feature(features, "turn_speed") * KMH
    return feature(features, "delay") + (path - feature(features, "turn_start")) / speed


def turning_pose(time: Any, features: Features) -> Pose:
    """Return the pose of the turning car."""
    speed = feature(features, "turn_speed") * KMH
    driven = speed * jnp.maximum(time - feature(features, "delay"), 0.0)
    return GUIDEWAY.pose(APPROACH + feature(features, "turn_start") + driven)


def columns(features: Features) -> list[Pose]:
    """Return where the two columns of stopped cars are."""
    noise = feature(features, "block_noise")
    return [Pose(x - noise, COLUMN_Y, math.pi / 2) for x in (LANE / 2, 3 * LANE / 2)]


def stopped_cars(features: Features) -> list[tuple[Pose, Body]]:
    """Return the cars that the columns consist of."""
    first = COLUMN_Y + (COLUMN.length - CAR.length) / 2
    return [
        (Pose(column.x, first - i * SPACING, column.heading), CAR)
        for column in columns(features)
        for i in range(STANDING)
    ]


def view(time: Any, state: Ego, features: Features) -> Any:
    """Return by how many m the view between the fronts misses the stopped cars, or is hidden."""
    turning = turning_pose(time, features)
    sin, cos = sin_cos(turning.heading)
    target = (turning.x + CAR.front * cos, turning.y + CAR.front * sin)
    eye = (EGO_X, state.y + CAR.front)
    misses: Any = jnp.inf
    for pose in columns(features):
        misses = jnp.minimum(misses, sight(eye, target, pose, COLUMN))
    return misses


def tempe(eyes: bool = False, duration: float = 12.0, dt: float = DT) -> Ode:
    """Make the intersection a system.

    **Arguments:**

    - `eyes`: the ego also brakes once it has had a free view of the turning car for its `reaction`.
      Without, it brakes for the message alone, as in the paper.
    - `duration`: simulated seconds.

    The ego holds its speed. From `notice - reaction` before the turning car enters its lane until
    that has left it, the ego brakes to halt at its stop line, by 1.1 v^2 / (2 d) within `brake`, or
    beyond the line where it is too late for that. Where its strongest braking cannot halt it before
    the turning car's way, it goes on: that is safer than to halt in the way. Once the lane is free
    it gets up to its speed again.

    Signals: `gap` (m) between the two moving cars; `acceleration` of the ego; `visible`, m by which
    the view between their fronts misses the stopped cars, negative while they hide each other;
    `until_conflict`, s until the turning car enters the lane; the `notice`; places and speeds.
    """

    def initial(features: Features, key: Any = None) -> Ego:
        return Ego(-feature(features, "ego_dist"), feature(features, "ego_speed") * KMH, 0.0)

    def acceleration(time: Any, state: Ego, features: Features) -> Any:
        reaction, strongest = feature(features, "reaction"), feature(features, "brake")
        message = time_at(features, ENTERS) - feature(features, "notice")
        warned = jnp.clip((time - message - reaction) / RISE, 0.0, 1.0)
        if eyes:
            seen = (state.recognised - 1) * reaction / RISE
            warned = jnp.maximum(warned, jnp.clip(seen, 0.0, 1.0))
        todo = -STOP_LINE - CAR.front - state.y
        needed = EARLY * state.speed**2 / (2 * jnp.maximum(todo, 1e-3))
        needed = jnp.where(todo > 0, jnp.clip(needed, GENTLE, strongest), strongest)
        room = HALT_BY - CAR.front - state.y + LAST * warned
        braking = jnp.where(room > state.speed**2 / (2 * strongest), needed, 0.0)
        cleared = time > time_at(features, LEAVES)
        wanted = feature(features, "ego_speed") * KMH
        resumed = jnp.clip(wanted - state.speed, 0.0, 1.0) * GENTLE
        return held_at_rest(state.speed, jnp.where(cleared, resumed, -warned * braking))

    def dynamics(time: Any, state: Ego, control: None, features: Features) -> Ego:
        recognised = jnp.zeros_like(state.recognised)
        if eyes:
            seen = jnp.clip(view(time, state, features) / CERTAIN, 0.0, 1.0)
            recognised = seen / feature(features, "reaction")
        return Ego(jnp.maximum(state.speed, 0.0), acceleration(time, state, features), recognised)

    def signals(time: Any, state: Ego, control: None, features: Features) -> dict[str, Any]:
        ego, turning = Pose(EGO_X, state.y, math.pi / 2), turning_pose(time, features)
        return {
            "gap": gap(ego, CAR, turning, CAR),
            "acceleration": acceleration(time, state, features),
            "visible": view(time, state, features),
            "notice": jnp.broadcast_to(feature(features, "notice"), jnp.shape(state.y)),
            "until_conflict": time_at(features, ENTERS) - time,
            "ego_x": jnp.full_like(state.y, EGO_X),
            "ego_y": state.y,
            "ego_heading": jnp.full_like(state.y, math.pi / 2),
            "ego_speed": state.speed,
            "turning_x": turning.x,
            "turning_y": turning.y,
            "turning_heading": turning.heading,
        }

    return ode(dynamics, initial, dt=dt, duration=duration, signals=signals)


def _road(x: float, y: float, heading: float) -> Path:
    return Path.start(x, y, heading).straight(200.0)


PICTURE = Picture(
    {"ego": CAR, "turning": CAR},
    lanes=[
        (_road(1.75, -100.0, math.pi / 2), 6 * LANE - LANE + 0.6),
        (_road(-100.0, 0.0, 0.0), 4 * LANE),
    ],
    lines=[(_road(x, -100.0 - 109.0, math.pi / 2), x != 0.0) for x in (0.0, 3.5, 7.0)],
    standing=stopped_cars,
    window=(-22.0, 32.0, -50.0, 26.0),
    hidden=("ego", "turning"),
)
"""The intersection from above."""
