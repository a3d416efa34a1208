"""A car that sees a disabled car behind traffic cones, or does not.

    cones(neural("narrow"))                       # around the cones, once the network sees them
    cones(perfect(), manoeuvre=aebs())            # the distance is known; brake before the cones

The first case study of the VerifAI paper (Dreossi et al., "VerifAI: a toolkit for the formal design
and analysis of artificial intelligence-based systems", CAV 2019, section 3.1), with a camera of our
own in place of Webots and a small network in place of squeezeDet: a network estimates the distance
of the cones; below 15 m the lane change begins, after a reaction time.

Everything in metres, seconds and rad; x along the road, y to the left, the lane's middle at y = 0.
The camera takes `FRAME_RATE` images a second, which is part of the system; the car moves in finer
steps, and `cone_gap` is the least gap since the last image.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.addons.perception import Box as BoxSolid
from verifai_jax.addons.perception import (
    Camera,
    Conditions,
    Cone,
    Detector,
    Ground,
    Line,
    Scene,
    Sun,
    hsv,
    load_detector,
)
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.values.trace import Trace
from verifai_jax.features import Array as ArrayOf
from verifai_jax.features import Box, Categorical
from verifai_jax.systems.base import System

Features = Mapping[str, Any]
Scalar = Float[Array, ""]

HEIGHT, WIDTH = 24, 48
FIELD_OF_VIEW = 0.61
FRAME_RATE = 4.0
PERIOD = 1 / FRAME_RATE
SUBSTEPS = 5
LANE = 3.5
LENGTH, BREADTH = 4.2, 1.8
"""Of both cars; the camera is `CAMERA` ahead of the middle of its own."""
CAMERA = 0.4
EYE = 1.3
PITCH = -0.05

CONE_RADIUS, CONE_HEIGHT = 0.25, 0.75
NOTHING = 60.0
"""The distance when no cone is seen."""
TRIGGER = 15.0
LATEST = 9.0
"""The distance at which a perception sees cones at the latest, where its error is abstracted."""
CLEARANCE = 2.2
DECELERATION = 4.0
ORANGE = 0.13
"""Hues below are red to orange: those of the cones' plastic."""

NETWORKS = {name: Path(__file__).with_name(f"cones_{name}.npz") for name in ("wide", "narrow")}
"""Trained by `python -m envs.train_cones`."""

CONE_COLOUR = (1.0, 0.35, 0.05)

SCENERY = {
    "car_hue": Box(0.0, 0.8),
    "car_value": Box(0.45, 1.0),
    "car_gap": Box(4.0, 10.0),
    "car_offset": Box(-1.0, 0.0),
    "car_yaw": Box(-0.4, 0.4),
    "cone_offset": ArrayOf(Box(-1.1, -0.3), 3),
    "cone_spacing": ArrayOf(Box(1.0, 3.0), 2),
    "cone_lies": ArrayOf(Categorical(0, 1, 2, 3, 4, weights=(0.8, 0.05, 0.05, 0.05, 0.05)), 3),
}
"""Colour and places of what stands in the lane; the ranges are those of VerifAI's example."""

WEATHER = {
    "brightness": Box(0.5, 1.15),
    "contrast": Box(0.7, 1.2),
    "saturation": Box(0.4, 1.2),
    "fog": Box(0.0, 0.02),
    "glare": Box(-0.7, 0.6),
    "glare_at": Box((0.2, 0.1), (0.8, 0.6)),
    "blur": Box(0.1, 0.7),
    "sun_azimuth": Box(-math.pi, math.pi),
    "sun_elevation": Box(0.5, 1.4),
}
"""What the camera makes of it; glare below zero is none."""

NOMINAL = {
    "car_hue": 0.6,
    "car_value": 0.8,
    "car_gap": 7.0,
    "car_offset": -0.5,
    "car_yaw": 0.0,
    "cone_offset": (-0.7, -0.7, -0.7),
    "cone_spacing": (2.0, 2.0),
    "cone_lies": (0, 0, 0),
    "brightness": 1.0,
    "contrast": 1.0,
    "saturation": 1.0,
    "fog": 0.0,
    "glare": 0.0,
    "glare_at": (0.5, 0.3),
    "blur": 0.3,
    "sun_azimuth": 1.0,
    "sun_elevation": 1.0,
}


def feature(features: Features, name: str) -> Any:
    """Return a feature's value, or the nominal one where it is missing."""
    return jnp.asarray(features.get(name, NOMINAL[name]))


class Pose(NamedTuple):
    """The middle of a car and its heading."""

    x: Scalar
    y: Scalar
    heading: Scalar


# --- what there is to see ------------------------------------------------------------------------


def cone_positions(features: Features) -> Float[Array, "3 2"]:
    """Return x and y of the cones; the first one is at x = 0."""
    spacing = feature(features, "cone_spacing")
    x = jnp.concatenate([jnp.zeros(1, spacing.dtype), jnp.cumsum(spacing)])
    return jnp.stack([x, feature(features, "cone_offset")], axis=1)


def _cones(features: Features) -> tuple[Cone, ...]:
    """Return the cones; 0 stands, 1 to 4 have fallen ahead, left, back, right."""
    slant = math.hypot(CONE_RADIUS, CONE_HEIGHT)
    cones = []
    for position, lies in zip(
        cone_positions(features), feature(features, "cone_lies"), strict=True
    ):
        turn = (lies - 1.0) * math.pi / 2
        flat = jnp.stack([jnp.cos(turn), jnp.sin(turn)]) * CONE_HEIGHT / slant
        stands = lies == 0
        axis = jnp.where(
            stands, jnp.asarray([0.0, 0.0, 1.0]), jnp.append(flat, -CONE_RADIUS / slant)
        )
        base = jnp.where(stands, 0.0, CONE_RADIUS * CONE_HEIGHT / slant)
        cones.append(Cone(jnp.append(position, base), CONE_RADIUS, CONE_HEIGHT, CONE_COLOUR, axis))
    return tuple(cones)


def scene(features: Features, present: Bool[Array, ""] | bool = True) -> Scene:
    """Return road, disabled car and cones; without the cones where they are not `present`."""
    colour = hsv(feature(features, "car_hue"), 0.85, feature(features, "car_value"))
    positions = cone_positions(features)
    x = positions[-1, 0] + feature(features, "car_gap") + LENGTH / 2
    y, yaw = feature(features, "car_offset"), feature(features, "car_yaw")
    body = BoxSolid(jnp.stack([x, y, jnp.full_like(x, 0.25)]), (LENGTH, BREADTH, 0.6), colour, yaw)
    cabin = BoxSolid(
        jnp.stack([x, y, jnp.full_like(x, 0.85)]), (2.2, 1.6, 0.55), 0.25 + 0.3 * colour, yaw
    )
    away = jnp.where(jnp.asarray(present), 0.0, -1e3)  # behind every camera
    cones = tuple(
        Cone(cone.position + away * jnp.asarray([1.0, 0.0, 0.0]), *_shape(cone))
        for cone in _cones(features)
    )
    road = (
        Line((0.0, LANE / 2), width=2 * LANE + 0.8, colour=(0.33, 0.33, 0.35)),
        Line((0.0, -LANE / 2)),
        Line((0.0, LANE / 2), dash=3.0, gap=6.0),
        Line((0.0, 1.5 * LANE)),
    )
    sun = Sun(feature(features, "sun_azimuth"), feature(features, "sun_elevation"))
    return Scene((body, cabin, *cones), Ground((0.32, 0.45, 0.25), road), sun=sun)


def _shape(cone: Cone) -> tuple[Any, ...]:
    return cone.radius, cone.height, cone.colour, cone.axis


def camera(pose: Pose, height: int = HEIGHT, width: int = WIDTH) -> Camera:
    """Return the camera behind the windscreen."""
    x, y = _eye(pose)
    return Camera(
        height, width, FIELD_OF_VIEW, jnp.stack([x, y, jnp.full_like(x, EYE)]), pose.heading, PITCH
    )


def _eye(pose: Pose) -> tuple[Scalar, Scalar]:
    return pose.x + CAMERA * jnp.cos(pose.heading), pose.y + CAMERA * jnp.sin(pose.heading)


def conditions(features: Features) -> Conditions:
    """Return weather and lens."""
    return Conditions(
        fog=feature(features, "fog"),
        glare=jnp.maximum(feature(features, "glare"), 0.0),
        glare_at=feature(features, "glare_at"),
        blur=feature(features, "blur"),
        brightness=feature(features, "brightness"),
        contrast=feature(features, "contrast"),
        saturation=feature(features, "saturation"),
    )


def render(
    features: Features,
    pose: Pose,
    present: Bool[Array, ""] | bool = True,
    height: int = HEIGHT,
    width: int = WIDTH,
) -> Float[Array, "height width 3"]:
    """Return what the camera sees from a pose."""
    return scene(features, present).render(camera(pose, height, width), conditions(features))


def distance_of_nearest(features: Features, pose: Pose) -> Scalar:
    """Return the distance from the camera to the nearest cone in sight; `NOTHING` without any."""
    x, y = _eye(pose)
    dx, dy = (cone_positions(features) - jnp.stack([x, y])).T
    cos, sin = jnp.cos(pose.heading), jnp.sin(pose.heading)
    ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
    in_sight = (ahead > 2.5) & (jnp.abs(left) < ahead * math.tan(FIELD_OF_VIEW / 2))
    return jnp.min(jnp.where(in_sight, jnp.hypot(dx, dy), NOTHING))


def gap_to_cones(features: Features, pose: Pose) -> Scalar:
    """Return the least distance between the car's outline and a cone; negative where they meet."""
    dx, dy = (cone_positions(features) - jnp.stack([pose.x, pose.y])).T
    cos, sin = jnp.cos(pose.heading), jnp.sin(pose.heading)
    along = jnp.abs(cos * dx + sin * dy) - LENGTH / 2
    across = jnp.abs(cos * dy - sin * dx) - BREADTH / 2
    beyond = jnp.maximum(along, 0.0) ** 2 + jnp.maximum(across, 0.0) ** 2
    outside = jnp.sqrt(jnp.maximum(beyond, 1e-12))
    return jnp.min(outside + jnp.minimum(jnp.maximum(along, across), 0.0)) - CONE_RADIUS


# --- what is made of it --------------------------------------------------------------------------

Perception = Callable[[Features, Pose], tuple[Scalar, Scalar]]
"""Logit that a cone is in sight, and the estimate of its distance."""


def perfect() -> Perception:
    """Return a perception that knows the distance."""

    def perceive(features: Features, pose: Pose) -> tuple[Scalar, Scalar]:
        distance = distance_of_nearest(features, pose)
        return jnp.where(distance < NOTHING, 10.0, -10.0), distance

    return perceive


def late(severity: Scalar | float) -> Perception:
    """Return a perception that sees cones late: the abstract error of the networks.

    **Arguments:**

    - `severity`: 0 sees them `TRIGGER` away, as soon as it matters; 1 not before `LATEST`.
    """
    reach = TRIGGER - (TRIGGER - LATEST) * jnp.asarray(severity, float)

    def perceive(features: Features, pose: Pose) -> tuple[Scalar, Scalar]:
        distance = distance_of_nearest(features, pose)
        return jnp.where(distance < reach, 10.0, -10.0), distance

    return perceive


def neural(network: Detector | str = "wide") -> Perception:
    """Return the perception of a network, or of one of those that are shipped.

    **Arguments:**

    - `network`: a `Detector` whose one value is the logarithm of the distance; `"wide"`, trained on
      all that the camera may see, or `"narrow"`, on cars that are not orange, without glare.
    """
    if isinstance(network, str):
        if network not in NETWORKS:
            raise unknown_name("network", network, NETWORKS)
        network = load_detector(NETWORKS[network])
    height, width = network.shape

    def perceive(features: Features, pose: Pose) -> tuple[Scalar, Scalar]:
        seen = network(render(features, pose, height=height, width=width))
        return jnp.asarray(seen.presence), jnp.exp(jnp.clip(seen.values[0], 0.0, 4.0))

    return perceive


# --- what is done about it -----------------------------------------------------------------------


class State(NamedTuple):
    """Place and motion of the car.

    - `begun`: the time at which the manoeuvre begins; infinite before the cones are seen.
    - `lasts`: how long the lane change takes.
    """

    x: Scalar
    y: Scalar
    drift: Scalar
    speed: Scalar
    begun: Scalar
    lasts: Scalar

    @property
    def pose(self) -> Pose:
        """Middle and heading."""
        return Pose(self.x, self.y, jnp.arctan2(self.drift, jnp.maximum(self.speed, 0.5)))


class Manoeuvre(NamedTuple):
    """The reaction to cones.

    - `decide`: `(state, time, logit, estimate, reaction time) -> state`, at each image.
    - `drive`: `(state, time) -> (acceleration to the left, acceleration ahead)`.
    """

    decide: Callable[[State, Scalar, Scalar, Scalar, Scalar], State]
    drive: Callable[[State, Scalar], tuple[Scalar, Scalar]]


def lanechange() -> Manoeuvre:
    """Return the lane change: below 15 m, after the reaction time, into the lane on the left.

    The closer the cones are, the faster it is; the tyres give 4 m/s^2 to the side at most.
    """

    def decide(
        state: State, time: Scalar, logit: Scalar, estimate: Scalar, reaction: Scalar
    ) -> State:
        first = (logit > 0) & (estimate < TRIGGER) & jnp.isinf(state.begun)
        lasts = jnp.clip(estimate / state.speed - 0.2, 1.6, 2.6)
        return state._replace(
            begun=jnp.where(first, time + reaction, state.begun),
            lasts=jnp.where(first, lasts, state.lasts),
        )

    def drive(state: State, time: Scalar) -> tuple[Scalar, Scalar]:
        s = jnp.clip((time - state.begun) / state.lasts, 0.0, 1.0)
        s = jnp.where(jnp.isinf(state.begun), 0.0, s)
        target = LANE * s**3 * (10 - 15 * s + 6 * s**2)
        rate = LANE * 30 * s**2 * (1 - s) ** 2 / state.lasts
        bend = LANE * 60 * s * (1 - s) * (1 - 2 * s) / state.lasts**2
        left = bend + 6.0 * (target - state.y) + 4.5 * (rate - state.drift)
        return jnp.clip(left, -4.0, 4.0), jnp.zeros_like(left)

    return Manoeuvre(decide, drive)


def aebs() -> Manoeuvre:
    """Return automatic emergency braking: where less than 2.5 m/s^2 would not stop the car."""

    def decide(
        state: State, time: Scalar, logit: Scalar, estimate: Scalar, reaction: Scalar
    ) -> State:
        needed = state.speed**2 / (2 * jnp.maximum(estimate - CLEARANCE, 0.1))
        first = (logit > 0) & (needed > 2.5) & jnp.isinf(state.begun)
        return state._replace(begun=jnp.where(first, time, state.begun))

    def drive(state: State, time: Scalar) -> tuple[Scalar, Scalar]:
        left = -6.0 * state.y - 4.5 * state.drift
        brake = jnp.where(time >= state.begun, -DECELERATION, 0.0)
        return jnp.clip(left, -4.0, 4.0), jnp.where(state.speed > 0, brake, 0.0)

    return Manoeuvre(decide, drive)


class Cones(System):
    """The loop of camera, perception, manoeuvre and car; see the module's docstring."""

    # Images of eight simulations fit the cache.
    lanes = 8
    exact_step = True

    def __init__(self, perception: Perception, manoeuvre: Manoeuvre, duration: float) -> None:
        self.perception, self.manoeuvre, self.duration = perception, manoeuvre, duration
        self.dt = PERIOD

    def __call__(self, features: Features, key: Key[Array, ""] | int | None = None) -> Trace:
        """Simulate once; the signals are those of `cones`."""
        step = PERIOD / SUBSTEPS
        reaction = jnp.asarray(features.get("reaction_time", 0.0), float)

        def move(state: State, time: Scalar) -> tuple[State, Scalar]:
            left, ahead = self.manoeuvre.drive(state, time)
            drift = state.drift + step * left
            speed = jnp.maximum(state.speed + step * ahead, 0.0)
            # Who stands does not drift.
            drift = jnp.where(speed > 0, drift, 0.0)
            moved = state._replace(
                x=state.x + step * speed, y=state.y + step * drift, drift=drift, speed=speed
            )
            return moved, gap_to_cones(features, moved.pose)

        def frame(carry: tuple[State, Scalar], number: Scalar) -> tuple[tuple[State, Scalar], dict]:
            state, gap = carry
            time = number * PERIOD
            logit, estimate = self.perception(features, state.pose)
            reading, estimate = estimate, jnp.where(logit > 0, estimate, NOTHING)
            distance = distance_of_nearest(features, state.pose)
            waiting = time < state.begun
            sample = {
                "cone_gap": gap,
                "x": state.x,
                "offset": state.y,
                "heading": state.pose.heading,
                "speed": state.speed,
                "distance": jnp.where(waiting, distance, NOTHING),
                "estimate": estimate,
                "presence": jax.nn.sigmoid(logit),
                "logit": logit,
                "reading": reading,
            }
            state = self.manoeuvre.decide(state, time, logit, estimate, reaction)
            gaps = []
            for number_of_step in range(SUBSTEPS):
                state, gap = move(state, time + number_of_step * step)
                gaps.append(gap)
            return (state, jnp.min(jnp.stack(gaps))), sample

        start = self._start(features)
        numbers = jnp.arange(round(self.duration * FRAME_RATE) + 1, dtype=start.x.dtype)
        first = (start, gap_to_cones(features, start.pose))
        _, signals = jax.lax.scan(frame, first, numbers)
        return Trace(signals, dt=PERIOD)

    def film(self, trace: Trace, features: Features) -> Float[Array, "time height width 3"]:
        """Return what the camera saw in a simulation, from its trace."""
        poses = Pose(*(jnp.asarray(trace[name]) for name in ("x", "offset", "heading")))
        return jax.jit(lambda at: jax.lax.map(lambda pose: render(features, pose), at))(poses)

    def frame(self, features: Features, sample: Mapping[str, Scalar]) -> dict[str, Scalar]:
        """Look once, from where the car is in one sample of a trace.

        **Returns:** `distance`, `estimate`, `logit` and `reading`, as in a trace.
        """
        pose = Pose(sample["x"], sample["offset"], sample["heading"])
        logit, reading = self.perception(features, pose)
        return {
            "distance": sample["distance"],
            "estimate": jnp.where(logit > 0, reading, NOTHING),
            "logit": logit,
            "reading": reading,
        }

    def _start(self, features: Features) -> State:
        speed = jnp.asarray(features["cruising_speed"], float)
        x = -jnp.asarray(features["distance0"], speed.dtype) - CAMERA
        y = jnp.asarray(features.get("offset0", 0.0), speed.dtype)
        drift = speed * jnp.tan(jnp.asarray(features.get("heading0", 0.0), speed.dtype))
        waiting = jnp.full_like(x, jnp.inf)
        return State(x, y, drift, speed, waiting, jnp.full_like(x, 2.6))


def cones(
    perception: Perception, manoeuvre: Manoeuvre | None = None, duration: float = 8.0
) -> Cones:
    """Return the loop as a system under test.

    **Features:** `distance0` (m, from the camera to the first cone), `cruising_speed` (m/s),
    `reaction_time` (s, before the lane change); `offset0` (m) and `heading0` (rad); those of
    `SCENERY` and `WEATHER`, nominal where missing.

    **Signals:** `cone_gap` (m, between the car and the nearest cone, the least since the last
    image), `x` (m, of the car's middle; the first cone is at 0), `offset` (m, to the left of the
    lane's middle), `heading` (rad), `speed` (m/s), `distance` (m, to the nearest cone in sight; 60
    without any, and once the manoeuvre has begun), `estimate` (m; 60 where nothing is seen),
    `presence` (probability), `logit` (its logit, which does not saturate) and `reading` (m, the
    estimate whether anything is seen or not).

    **Arguments:**

    - `perception`: `perfect()` or `neural(...)`.
    - `manoeuvre`: `lanechange()` where left out, or `aebs()`.
    - `duration`: in s.
    """
    return Cones(perception, manoeuvre or lanechange(), duration)
