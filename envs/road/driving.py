"""How drivers drive: car following (IDM), lane changes (a smooth profile, MOBIL)."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""] | float

MIN_GAP = 0.1
"""Gaps in m are taken for at least this: beyond it cars have collided."""


@dataclass(frozen=True)
class Driver:
    """The parameters of the intelligent driver model; each may be a traced number.

    - `speed`: desired, in m/s; `headway`: in s; `standstill`: the gap in a queue, in m.
    - `acceleration`, `deceleration`: comfortable ones, in m/s^2; `exponent` of the free road.
    - `hardest`: the strongest braking that the car is capable of, in m/s^2.
    """

    speed: Any = 30.0
    headway: Any = 1.5
    standstill: Any = 2.0
    acceleration: Any = 1.4
    deceleration: Any = 2.0
    exponent: float = 4.0
    hardest: Any = 8.0


def idm(speed: Scalar, space: Scalar, leader: Scalar, driver: Driver) -> Scalar:
    """Compute the acceleration (m/s^2) of the intelligent driver model.

    **Arguments:**

    - `speed`: of the car; `leader`: of the one ahead, both in m/s.
    - `space`: m between them; infinite on a free road.

    Source: Treiber, Hennecke and Helbing, Congested traffic states in empirical observations and
    microscopic simulations, Phys. Rev. E 62 (2000), eqs. 3 and 4 with s1 = 0. Added to it: a gap
    wished for is never below that of a queue, and brakes have a limit.
    """
    closing = speed * (speed - leader) / (2 * jnp.sqrt(driver.acceleration * driver.deceleration))
    wished = driver.standstill + jnp.maximum(speed * driver.headway + closing, 0.0)
    free = (jnp.maximum(speed, 0.0) / driver.speed) ** driver.exponent
    near = (wished / jnp.maximum(space, MIN_GAP)) ** 2
    return jnp.maximum(driver.acceleration * (1 - free - near), -driver.hardest)


def equilibrium_gap(speed: Scalar, driver: Driver) -> Scalar:
    """Compute the gap (m) that the model keeps behind a car of constant speed (eq. 5 there)."""
    wished = driver.standstill + speed * driver.headway
    return wished / jnp.sqrt(1 - (speed / driver.speed) ** driver.exponent)


def cruise_control(
    speed: Scalar, space: Scalar, leader: Scalar, leader_acceleration: Scalar, driver: Driver
) -> Scalar:
    """Compute the acceleration (m/s^2) of the improved IDM, which does not panic at a cut-in.

    Arguments as of `idm`, and the leader's acceleration. Where the IDM brakes harder than what
    avoids a crash if the leader goes on as it does (the constant-acceleration heuristic), the two
    are mixed with a coolness of 0.99.

    Source: Kesting, Treiber and Helbing, Enhanced intelligent driver model to assess the impact of
    driving strategies on traffic capacity, Phil. Trans. R. Soc. A 368 (2010), section 2.
    """
    plain, space = idm(speed, space, leader, driver), jnp.maximum(space, MIN_GAP)
    lead = jnp.minimum(leader_acceleration, driver.acceleration)
    closing = speed - leader
    halting = leader * closing < -2 * space * lead
    # Both halves of a `where` have derivatives, so the one not taken must be finite.
    room = jnp.where(halting, jnp.maximum(leader**2 - 2 * space * lead, MIN_GAP), 1.0)
    going = lead - jnp.maximum(closing, 0.0) ** 2 / (2 * space)
    constant = jnp.where(halting, speed**2 * lead / room, going)
    comfort = driver.deceleration
    mixed = constant + comfort * jnp.tanh((plain - constant) / comfort)
    wanted = jnp.where(plain >= constant, plain, 0.01 * plain + 0.99 * mixed)
    return jnp.maximum(wanted, -driver.hardest)


def mobil(
    gained: Scalar, follower: Scalar, *, politeness: float = 0.2, threshold: float = 0.1
) -> Scalar:
    """Compute the incentive of a lane change beyond its threshold, in m/s^2; above 0: change.

    **Arguments:**

    - `gained`: the acceleration in the new lane less that in the old.
    - `follower`: the same difference of all whom the change makes brake (negative), or sets free.

    Source: Kesting, Treiber and Helbing, General lane-changing model MOBIL for car-following
    models, Transportation Research Record 1999 (2007); its safety criterion is the caller's.
    """
    return gained + politeness * follower - threshold


def lane_change(time: Scalar, begin: Scalar, duration: Scalar) -> tuple[Scalar, Scalar]:
    """Return the share of a lane change that is done, from 0 to 1, and its rate in 1/s.

    The polynomial of least jerk, 10 t^3 - 15 t^4 + 6 t^5: Flash and Hogan, The coordination of arm
    movements, J. Neurosci. 5 (1985).
    """
    done = jnp.clip((time - begin) / duration, 0.0, 1.0)
    return done**3 * (10 - 15 * done + 6 * done**2), 30 * (done * (1 - done)) ** 2 / duration
