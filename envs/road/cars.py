"""Cars as kinematic bicycles in the coordinates of their path."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from envs.road.bodies import Pose
from envs.road.paths import Path
from verifai_jax.systems.ode import sin_cos

Scalar = Float[Array, ""] | float

WHEELBASE = 2.8
STEER_LIMIT = 0.6
"""At the wheels, in rad."""


class Car(NamedTuple):
    """A car on its path: arc length, offset to the left, heading against it, and speed."""

    distance: Any
    offset: Any
    heading: Any
    speed: Any

    def pose(self, path: Path) -> Pose:
        """Return where it is in the plane."""
        position = path.pose(self.distance, self.offset)
        return Pose(position.x, position.y, position.heading + self.heading)


def bicycle(
    car: Car,
    steer: Scalar,
    acceleration: Scalar,
    curvature: Scalar = 0.0,
    wheelbase: Scalar = WHEELBASE,
) -> Car:
    """Return the derivative of a kinematic bicycle whose reference is the rear axle.

    **Arguments:**

    - `steer`: the angle of the front wheels, in rad; `acceleration`: in m/s^2.
    - `curvature`: of the path where the car is, 1/m.

    Source: LaValle, Planning Algorithms (2006), eq. 13.15, in the coordinates of a path: Micaelli
    and Samson, Trajectory tracking for unicycle-type and two-steering-wheels mobile robots (1993),
    section 2.
    """
    sin, cos = sin_cos(jnp.asarray(car.heading))
    # A step ends a little below zero where a car comes to rest; it does not roll back.
    speed = jnp.maximum(car.speed, 0.0)
    progress = speed * cos / jnp.maximum(1 - curvature * car.offset, 0.1)
    return Car(
        distance=progress,
        offset=speed * sin,
        heading=speed * jnp.tan(steer) / wheelbase - curvature * progress,
        speed=held_at_rest(car.speed, acceleration),
    )


def held_at_rest(speed: Scalar, acceleration: Scalar) -> Scalar:
    """Return the acceleration, but none backwards from a standstill."""
    return jnp.where(speed > 0, acceleration, jnp.maximum(acceleration, 0.0))


def steering(
    car: Car,
    offset: Scalar,
    rate: Scalar = 0.0,
    curvature: Scalar = 0.0,
    wheelbase: Scalar = WHEELBASE,
    lowest: float = 6.0,
) -> Scalar:
    """Return the angle of the wheels (rad) that leads to an `offset` beside the path.

    For small angles o'' = -(o - offset) / l^2 - 2 (o' - offset') / l over the distance: critically
    damped, with l what the car drives in 0.8 s, at `lowest` that many metres.

    **Arguments:**

    - `offset`: wanted, in m; `rate`: in m/s, where it changes.
    - `curvature`: of the path where the car is, 1/m.
    """
    ahead = jnp.maximum(0.8 * car.speed, lowest)
    slope = rate / jnp.maximum(car.speed, 1.0)
    wanted = curvature - (car.offset - offset) / ahead**2 - 2 * (car.heading - slope) / ahead
    return jnp.clip(jnp.arctan(wheelbase * wanted), -STEER_LIMIT, STEER_LIMIT)
