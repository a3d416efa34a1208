"""Four situations on a road, each a system `(features, key) -> Trace`.

    following()      # a platoon behind a car whose acceleration is a `Signal`
    cut_in()         # a slower car changes into the lane of a car with adaptive cruise control
    overtaking()     # a car changes lanes by MOBIL in front of a faster one that it may not see
    pedestrian()     # somebody steps out from behind a parked van

Features that are missing have the values of `NOMINAL`. Cars are named in the signals: `ego_x`,
`ego_y`, `ego_heading`, `ego_speed`, and so on; `gap` is the least distance in m at an instant.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from envs.road.bodies import CAR, PERSON, TRUCK, VAN, Body, Pose, gap, sight
from envs.road.cars import WHEELBASE, Car, bicycle, held_at_rest, steering
from envs.road.driving import Driver, cruise_control, equilibrium_gap, idm, lane_change, mobil
from envs.road.paths import Path
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.systems.ode import Ode, ode

Features = Mapping[str, Any]
Scalar = Float[Array, ""]

DT = 0.04
LANE = 3.5
STRAIGHT = Path.start(0.0, 0.0).straight(1000.0)
BEND = Path.start(0.0, 0.0).straight(120.0).turn(150.0, 1.2).straight(200.0)
"""The road of the platoon: straight, then a bend to the left."""
FOLLOWERS = 3
BICYCLE_CAR = Body(CAR.length, CAR.width, ahead=WHEELBASE / 2)
"""A car as its rear axle sees it."""
EYE = 1.5
"""The camera sits that far behind the front, in m."""
CERTAIN = 0.3
"""A view that misses what hides it by so many m shows enough to recognise somebody at once."""
BRAKE_RISE = 0.15
"""Seconds in which brakes reach their force."""
SAFE_BRAKING = 4.0
"""MOBIL: what a lane change may demand of the car behind, in m/s^2."""
NEVER = 1e6

NOMINAL: dict[str, dict[str, Any]] = {
    "following": {
        "speed0": 25.0,
        "headways": (1.2, 1.2, 1.2),
        "lag": 0.3,
        "hardest": 7.5,
        "lead_acceleration": 0.0,
    },
    "cut_in": {
        "ego_speed0": 28.0,
        "slower": 4.0,
        "ahead": 25.0,
        "begin": 1.5,
        "duration": 4.0,
        "headway": 1.2,
        "lag": 0.3,
        "hardest": 7.0,
        "other_braking": 0.0,
    },
    "overtaking": {
        "ego_speed0": 25.0,
        "truck_speed": 22.0,
        "truck_ahead": 40.0,
        "faster": 8.0,
        "behind": 90.0,
        "reach": 80.0,
        "misjudged": 0.0,
        "rear_lag": 0.5,
        "duration": 4.0,
    },
    "pedestrian": {
        "ego_speed0": 6.5,
        "van": 35.0,
        "step": 2.0,
        "leave": 2.0,
        "walk": 1.2,
        "reaction": 0.2,
        "braking": 7.0,
    },
}


def feature(scenario: str, features: Features, name: str, at: Any = None) -> Any:
    """Return a feature's value, of a function of time that `at`; the nominal one if missing."""
    value = features.get(name, NOMINAL[scenario][name])
    return value(at) if isinstance(value, Waveform) else value


def placed(name: str, pose: Pose, speed: Any) -> dict[str, Any]:
    """Return the signals that say where something is."""
    signals = {"x": pose.x, "y": pose.y, "heading": pose.heading, "speed": speed}
    return {f"{name}_{part}": jnp.asarray(value) for part, value in signals.items()}


class Platoon(NamedTuple):
    """Arc lengths (m) and speeds (m/s) of the leader and all followers, whose brakes lag."""

    distance: Any
    speed: Any
    acceleration: Any


def following(duration: float = 12.0, dt: float = DT, path: Path = BEND) -> Ode:
    """Make a platoon of cars that follow by IDM with a lag, from equilibrium.

    Features: `speed0`, the `headways` of the three followers (s), the `lag` of their engines and
    brakes (s), the `hardest` braking that they are capable of, and `lead_acceleration`, usually a
    `Signal`. Signals: `gap`, and `gap_1` to `gap_3` for each pair along the road.
    """

    def get(features: Features, name: str, at: Any = None) -> Any:
        return feature("following", features, name, at)

    def drivers(features: Features) -> Driver:
        headways = jnp.asarray(get(features, "headways"))
        # Who wishes for more than the speed at which the platoon drives has an equilibrium there.
        wished = get(features, "speed0") * 1.2
        return Driver(speed=wished, headway=headways, hardest=get(features, "hardest"))

    def initial(features: Features, key: Any = None) -> Platoon:
        speed = get(features, "speed0") * jnp.ones(1 + FOLLOWERS)
        gaps = jnp.asarray(equilibrium_gap(speed[1:], drivers(features)))
        behind = jnp.concatenate([jnp.zeros_like(gaps[:1]), jnp.cumsum(gaps + CAR.length)])
        return Platoon(100.0 - behind, speed, jnp.zeros_like(gaps))

    def spaces(state: Platoon) -> Float[Array, "3"]:
        return state.distance[:-1] - state.distance[1:] - CAR.length

    def dynamics(time: Any, state: Platoon, control: None, features: Features) -> Platoon:
        wanted = idm(state.speed[1:], spaces(state), state.speed[:-1], drivers(features))
        lead = jnp.asarray(get(features, "lead_acceleration", time))
        # The leader brakes as it likes, and does not race.
        lead = jnp.where(state.speed[0] < 35.0, lead, jnp.minimum(lead, 0.0))
        rates = jnp.concatenate([lead[None], state.acceleration])
        return Platoon(
            distance=jnp.maximum(state.speed, 0.0),
            speed=held_at_rest(state.speed, rates),
            acceleration=(wanted - state.acceleration) / get(features, "lag"),
        )

    def signals(time: Any, state: Platoon, control: None, features: Features) -> dict[str, Any]:
        apart = spaces(state)
        result = {"gap": jnp.min(apart)}
        for i in range(FOLLOWERS):
            result[f"gap_{i + 1}"] = apart[i]
        for i, name in enumerate(("lead", *(f"car_{n + 1}" for n in range(FOLLOWERS)))):
            result |= placed(name, path.pose(state.distance[i]), state.speed[i])
        return result

    return ode(dynamics, initial, dt=dt, duration=duration, signals=signals)


class TwoCars(NamedTuple):
    """A car with adaptive cruise control, its acceleration, and the other car."""

    ego: Car
    acceleration: Any
    other: Car


def cut_in(duration: float = 10.0, dt: float = DT) -> Ode:
    """Make a car that changes into the lane of a faster one, `ahead` metres in front of it.

    Features: `ego_speed0`; how much `slower` the other is (m/s); when its lane change `begin`s and
    its `duration` (s); the gap `ahead` (m) as it begins; `headway`, `lag` and `hardest` braking of
    the adaptive cruise control; and `other_braking` (m/s^2) once it is in the lane. The cruise
    control takes the other for its leader as its body comes over the marking.
    """

    def get(features: Features, name: str) -> Any:
        return feature("cut_in", features, name)

    def initial(features: Features, key: Any = None) -> TwoCars:
        speed = get(features, "ego_speed0")
        before = get(features, "slower") * get(features, "begin")
        distance = get(features, "ahead") + before + CAR.length
        other = Car(distance, LANE, 0.0, speed - get(features, "slower"))
        return TwoCars(Car(0.0, 0.0, 0.0, speed), 0.0, other)

    def dynamics(time: Any, state: TwoCars, control: None, features: Features) -> TwoCars:
        ego, other = state.ego, state.other
        driver = Driver(
            speed=get(features, "ego_speed0"),
            headway=get(features, "headway"),
            hardest=get(features, "hardest"),
        )
        done, rate = lane_change(time, get(features, "begin"), get(features, "duration"))
        steer = steering(other, LANE * (1 - done), -LANE * rate)
        braking = jnp.where(done >= 1, -get(features, "other_braking"), 0.0)
        space = other.distance - ego.distance - CAR.length
        # From a body that touches the marking to one that is over it by half a metre.
        inside = jnp.clip(((LANE + CAR.width) / 2 - other.offset) / 0.5, 0.0, 1.0)
        free = idm(ego.speed, jnp.inf, ego.speed, driver)
        behind = cruise_control(ego.speed, space, other.speed, braking, driver)
        wanted = free + inside * (behind - free)
        # What is behind the cruise control no longer concerns it.
        wanted = jnp.where(space > -CAR.length, wanted, free)
        return TwoCars(
            ego=bicycle(ego, 0.0, state.acceleration),
            acceleration=(wanted - state.acceleration) / get(features, "lag"),
            other=bicycle(other, steer, braking),
        )

    def signals(time: Any, state: TwoCars, control: None, features: Features) -> dict[str, Any]:
        ego, other = (car.pose(STRAIGHT) for car in (state.ego, state.other))
        return {
            "gap": gap(ego, BICYCLE_CAR, other, BICYCLE_CAR),
            "acceleration": state.acceleration,
            **placed("ego", ego, state.ego.speed),
            **placed("other", other, state.other.speed),
        }

    return ode(dynamics, initial, dt=dt, duration=duration, signals=signals)


class ThreeCars(NamedTuple):
    """A car behind a truck, and one that comes from behind on the other lane."""

    ego: Car
    rear: Car
    rear_acceleration: Any
    truck: Any


def overtaking(duration: float = 14.0, dt: float = DT) -> Ode:
    """Make a car that leaves its lane by MOBIL to overtake a truck, before a faster car.

    Features: `ego_speed0`; `truck_speed` and the gap `truck_ahead` (m); how much `faster` than the
    ego the rear car is (m/s) and how far `behind` (m); the `reach` of the sensor to the rear (m),
    by how much it `misjudged` that car's speed (m/s); `rear_lag`, the lag of that car's brakes (s);
    and the `duration` of the lane change (s). MOBIL decides every 0.2 s; a change is not taken
    back.
    """

    def get(features: Features, name: str) -> Any:
        return feature("overtaking", features, name)

    def wish(features: Features) -> Driver:
        return Driver(speed=get(features, "ego_speed0") + 5.0, headway=1.2)

    def rears_wish(features: Features) -> Driver:
        speed = get(features, "ego_speed0") + get(features, "faster")
        return Driver(speed=speed, headway=0.8, hardest=7.0)

    def initial(features: Features, key: Any = None) -> ThreeCars:
        speed = get(features, "ego_speed0")
        behind = -get(features, "behind") - CAR.length
        truck = get(features, "truck_ahead") + (CAR.length + TRUCK.length) / 2 + WHEELBASE / 2
        rear = Car(behind, LANE, 0.0, speed + get(features, "faster"))
        return ThreeCars(Car(0.0, 0.0, 0.0, speed), rear, 0.0, truck)

    def truck_gap(state: ThreeCars) -> Any:
        return state.truck - TRUCK.length / 2 - state.ego.distance - BICYCLE_CAR.front

    def ahead_of(state: ThreeCars) -> Any:
        return state.ego.distance - state.rear.distance - CAR.length

    def decide(time: Any, state: ThreeCars, begin: Any, features: Features) -> tuple[Any, Any]:
        ego, driver = state.ego, wish(features)
        space = ahead_of(state)
        now = idm(ego.speed, truck_gap(state), get(features, "truck_speed"), driver)
        then = idm(ego.speed, jnp.inf, ego.speed, driver)
        seen = space < get(features, "reach")
        speed = state.rear.speed + get(features, "misjudged")
        other = Driver(speed=speed, headway=0.8, hardest=20.0)
        demanded = jnp.where(seen, idm(speed, space, ego.speed, other), 0.0)
        incentive = mobil(then - now, demanded)
        change = (incentive > 0) & (demanded > -SAFE_BRAKING) & (begin >= NEVER)
        begin = jnp.where(change, time, begin)
        return begin, begin

    def dynamics(time: Any, state: ThreeCars, begin: Any, features: Features) -> ThreeCars:
        ego, rear = state.ego, state.rear
        done, rate = lane_change(time, begin, get(features, "duration"))
        out = jnp.clip((ego.offset - (LANE - CAR.width) / 2) / 0.5, 0.0, 1.0)
        driver, other = wish(features), rears_wish(features)
        free = idm(ego.speed, jnp.inf, ego.speed, driver)
        behind = idm(ego.speed, truck_gap(state), get(features, "truck_speed"), driver)
        # Until its body is out of the truck's lane the truck is its leader.
        gone = jnp.clip((ego.offset - LANE / 2) / 1.0, 0.0, 1.0)
        steer = steering(ego, LANE * done, LANE * rate)
        alone = idm(rear.speed, jnp.inf, rear.speed, other)
        braked = idm(rear.speed, ahead_of(state), ego.speed, other)
        wanted = alone + out * (braked - alone)
        return ThreeCars(
            ego=bicycle(ego, steer, behind + gone * (free - behind)),
            rear=bicycle(rear, 0.0, state.rear_acceleration),
            rear_acceleration=(wanted - state.rear_acceleration) / get(features, "rear_lag"),
            truck=get(features, "truck_speed") * jnp.ones_like(state.truck),
        )

    def signals(time: Any, state: ThreeCars, begin: Any, features: Features) -> dict[str, Any]:
        ego, rear = (car.pose(STRAIGHT) for car in (state.ego, state.rear))
        truck = STRAIGHT.pose(state.truck)
        return {
            "gap": gap(ego, BICYCLE_CAR, rear, BICYCLE_CAR),
            "truck_gap": gap(ego, BICYCLE_CAR, truck, TRUCK),
            "rear_acceleration": state.rear_acceleration,
            "offset": state.ego.offset,
            "passed": state.ego.distance - state.truck,
            **placed("ego", ego, state.ego.speed),
            **placed("rear", rear, state.rear.speed),
            **placed("truck", truck, get(features, "truck_speed")),
        }

    return ode(
        dynamics,
        initial,
        controller=decide,
        controller_memory=NEVER,
        control_period=0.2,
        dt=dt,
        duration=duration,
        signals=signals,
    )


class Street(NamedTuple):
    """The ego's arc length and speed, and how far it is in recognising the pedestrian (0 to 1)."""

    distance: Any
    speed: Any
    recognised: Any


PARKED = -2.9
"""The middle of the parked van beside that of the lane, in m."""
KERB = -4.3
"""The pedestrian begins to walk there."""


def parked_van(features: Features) -> Pose:
    """Return where the van stands that hides the pedestrian."""
    return Pose(feature("pedestrian", features, "van"), PARKED, 0.0)


def pedestrian(duration: float = 8.0, dt: float = DT) -> Ode:
    """Make a car that brakes for somebody who steps out from behind a parked van.

    Features: `ego_speed0`; `van`, where the middle of the van is (m); `step`, how far in front of
    the van the pedestrian walks (m), when they `leave` the kerb (s) and how fast they `walk` (m/s);
    the `reaction` time of perception (s), during which the view has to be free, and the `braking`
    (m/s^2), which is held to the standstill. Signals: `gap` (m), `visible` (m by which the view
    misses the van, negative while it hides), `recognised`.
    """

    def get(features: Features, name: str) -> Any:
        return feature("pedestrian", features, name)

    def initial(features: Features, key: Any = None) -> Street:
        return Street(0.0, get(features, "ego_speed0"), 0.0)

    def person(time: Any, features: Features) -> Pose:
        walked = get(features, "walk") * jnp.maximum(time - get(features, "leave"), 0.0)
        x = get(features, "van") + VAN.length / 2 + get(features, "step")
        return Pose(x, KERB + walked, jnp.pi / 2)

    def visible(time: Any, state: Street, features: Features) -> Any:
        at = person(time, features)
        eye = (state.distance + CAR.front - EYE, 0.0)
        return sight(eye, (at.x, at.y), parked_van(features), VAN)

    def dynamics(time: Any, state: Street, control: None, features: Features) -> Street:
        # Nobody is recognised as stepping out before they do.
        walks = jnp.clip((time - get(features, "leave")) / BRAKE_RISE, 0.0, 1.0)
        seen = walks * jnp.clip(visible(time, state, features) / CERTAIN, 0.0, 1.0)
        brakes = jnp.clip((state.recognised - 1) * get(features, "reaction") / BRAKE_RISE, 0.0, 1.0)
        return Street(
            distance=jnp.maximum(state.speed, 0.0),
            speed=held_at_rest(state.speed, -get(features, "braking") * brakes),
            recognised=seen / get(features, "reaction"),
        )

    def signals(time: Any, state: Street, control: None, features: Features) -> dict[str, Any]:
        ego, at = STRAIGHT.pose(state.distance), person(time, features)
        return {
            "gap": gap(ego, CAR, at, PERSON),
            "visible": visible(time, state, features),
            "recognised": jnp.minimum(state.recognised, 1.0),
            **placed("ego", ego, state.speed),
            **placed("person", at, get(features, "walk")),
        }

    return ode(dynamics, initial, dt=dt, duration=duration, signals=signals)
