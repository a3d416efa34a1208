"""The F-16 of AeroBench: rigid body, engine, aerodynamics, and the inner control loop.

    slope(state, reference) -> state                    # d state / dt

Feet, seconds, radians; forces in pounds. Sources of equations and constants: Stevens and Lewis,
Aircraft Control and Simulation, 2nd ed. (air data, engine, rigid body, damping); Morelli, Global
nonlinear parametric modelling with application to F-16 aerodynamics, ACC 1998 (coefficients);
Heidlauf et al., Verification challenges in F-16 ground collision avoidance and other automated
maneuvers, ARCH 2018 (gains), as in the public Python code of AeroBench v2 and jax-f16. As there,
the tabulated damping is added to the one in Morelli's polynomials. The centre of gravity is at its
reference, so that its terms vanish.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from envs.arch.tables import bilinear, hinges, interpolated

Scalar = Float[Array, ""]

WING_AREA, SPAN, CHORD = 300.0, 30.0, 11.32
INVERSE_MASS = 1.57e-3
GRAVITY = 32.17
ENGINE_MOMENTUM = 160.0
PILOT = 15.0  # Where normal acceleration is felt, in front of the centre of gravity.
C1, C2, C3, C4, C5 = -0.770, 0.02755, 1.055e-4, 1.642e-6, 0.9604
C6, C7, C8, C9 = 1.759e-2, 1.792e-5, -0.7336, 1.587e-5

# Rows: Mach 0, 0.2, ... 1; columns: altitude 0, 10 000, ... 50 000 ft.
THRUST_IDLE = (
    (1060, 670, 880, 1140, 1500, 1860),
    (635, 425, 690, 1010, 1330, 1700),
    (60, 25, 345, 755, 1130, 1525),
    (-1020, -170, -300, 350, 910, 1360),
    (-2700, -1900, -1300, -247, 600, 1100),
    (-3600, -1400, -595, -342, -200, 700),
)
THRUST_MILITARY = (
    (12680, 9150, 6200, 3950, 2450, 1400),
    (12680, 9150, 6313, 4040, 2470, 1400),
    (12610, 9312, 6610, 4290, 2600, 1560),
    (12640, 9839, 7090, 4660, 2840, 1660),
    (12390, 10176, 7750, 5320, 3250, 1930),
    (11680, 9848, 8050, 6100, 3800, 2310),
)
THRUST_MAXIMUM = (
    (20000, 15000, 10800, 7000, 4000, 2500),
    (21420, 15700, 11225, 7323, 4435, 2600),
    (22700, 16860, 12250, 8154, 5000, 2835),
    (24240, 18910, 13760, 9285, 5700, 3215),
    (26070, 21075, 15975, 11115, 6860, 3950),
    (28886, 23319, 18300, 13484, 8642, 5057),
)
_IDLE, _MILITARY, _MAXIMUM = (
    bilinear(np.arange(0, 50_001, 10_000), np.arange(6) / 5, np.transpose(table))
    for table in (THRUST_IDLE, THRUST_MILITARY, THRUST_MAXIMUM)
)

# Cxq, Cyr, Cyp, Czq, Clr, Clp, Cmq, Cnr, Cnp at angles of attack of -10, -5, ... 45 degrees.
DAMPING = (
    (-0.267, -0.110, 0.308, 1.34, 2.08, 2.91, 2.76, 2.05, 1.50, 1.49, 1.83, 1.21),
    (0.882, 0.852, 0.876, 0.958, 0.962, 0.974, 0.819, 0.483, 0.590, 1.21, -0.493, -1.04),
    (-0.108, -0.108, -0.188, 0.110, 0.258, 0.226, 0.344, 0.362, 0.611, 0.529, 0.298, -2.27),
    (-8.80, -25.8, -28.9, -31.4, -31.2, -30.7, -27.7, -28.2, -29.0, -29.8, -38.3, -35.3),
    (-0.126, -0.026, 0.063, 0.113, 0.208, 0.230, 0.319, 0.437, 0.680, 0.100, 0.447, -0.330),
    (-0.360, -0.359, -0.443, -0.420, -0.383, -0.375, -0.329, -0.294, -0.230, -0.210, -0.12, -0.1),
    (-7.21, -0.540, -5.23, -5.26, -6.11, -6.64, -5.69, -6.00, -6.20, -6.40, -6.60, -6.00),
    (-0.380, -0.363, -0.378, -0.386, -0.370, -0.453, -0.550, -0.582, -0.595, -0.637, -1.02, -0.84),
    (0.061, 0.052, 0.052, -0.012, -0.013, -0.024, 0.050, 0.150, 0.130, 0.158, 0.240, 0.150),
)
_DAMPING = hinges(np.arange(-10, 46, 5), np.transpose(DAMPING))

# The trim around which the inner loop works, and its gains (LQR).
TRIM_ALPHA = 0.0389
TRIM_THROTTLE, TRIM_ELEVATOR = 0.1395, -0.7496
ELEVATOR_GAINS = (-156.8801506723475, -31.037008068526642, -38.72983346216317)
AILERON_GAINS = (37.84483, -25.40956, -6.82876, -332.88343, -17.15997)
RUDDER_GAINS = (-23.91233, 5.69968, -21.63431, 64.49490, -88.36203)
ELEVATOR_LIMIT, AILERON_LIMIT, RUDDER_LIMIT = 25.0, 21.5, 30.0


class Plane(NamedTuple):
    """Airspeed, angles of attack and sideslip, attitude, rates, place, power, integrators.

    The integrators are of the errors of normal load, of stability-axis roll rate, and of side load
    plus yaw rate.
    """

    vt: Scalar
    alpha: Scalar
    beta: Scalar
    phi: Scalar
    theta: Scalar
    psi: Scalar
    p: Scalar
    q: Scalar
    r: Scalar
    north: Scalar
    east: Scalar
    altitude: Scalar
    power: Scalar
    load_error: Scalar
    roll_error: Scalar
    side_error: Scalar


class Reference(NamedTuple):
    """The inner loop's reference: normal load in g beyond 1, and roll rate in rad/s.

    Side load plus yaw rate is to be zero, and so is the throttle beyond its trim.
    """

    load: Scalar
    roll: Scalar


class Surfaces(NamedTuple):
    """Throttle (0 to 1) and deflections in degrees."""

    throttle: Scalar
    elevator: Scalar
    aileron: Scalar
    rudder: Scalar


class Coefficients(NamedTuple):
    """Coefficients of forces along the body's axes, and of moments about them."""

    x: Scalar
    y: Scalar
    z: Scalar
    roll: Scalar
    pitch: Scalar
    yaw: Scalar


def inner_loop(state: Plane) -> Surfaces:
    """Return the surfaces that the inner loop sets."""
    longitudinal = (state.alpha - TRIM_ALPHA, state.q, state.load_error)
    lateral = (state.beta, state.p, state.r, state.roll_error, state.side_error)

    def follow(gains: Any, errors: Any, trim: float, limit: float) -> Scalar:
        wanted = trim - sum(gain * error for gain, error in zip(gains, errors, strict=True))
        return jnp.clip(wanted, -limit, limit)

    return Surfaces(
        jnp.full_like(state.vt, TRIM_THROTTLE),
        follow(ELEVATOR_GAINS, longitudinal, TRIM_ELEVATOR, ELEVATOR_LIMIT),
        follow(AILERON_GAINS, lateral, 0.0, AILERON_LIMIT),
        follow(RUDDER_GAINS, lateral, 0.0, RUDDER_LIMIT),
    )


def air_data(vt: Scalar, altitude: Scalar) -> tuple[Scalar, Scalar]:
    """Return Mach number and dynamic pressure."""
    factor = 1 - 0.703e-5 * altitude
    temperature = jnp.where(altitude >= 35_000, 390.0, 519 * factor)
    density = 2.377e-3 * factor**4.14
    return vt / jnp.sqrt(1.4 * 1716.3 * temperature), 0.5 * density * vt * vt


def power_slope(power: Scalar, throttle: Scalar) -> Scalar:
    """Return the rate of the engine's power, which lags behind its throttle."""
    wanted = jnp.where(throttle <= 0.77, 64.94 * throttle, 217.38 * throttle - 117.38)

    def rate(difference: Scalar) -> Scalar:
        between = 1.9 - 0.036 * difference
        return jnp.where(difference <= 25, 1.0, jnp.where(difference >= 50, 0.1, between))

    burning, burns = wanted >= 50, power >= 50
    goal = jnp.where(burning, jnp.where(burns, wanted, 60.0), jnp.where(burns, 40.0, wanted))
    speed = jnp.where(burns, 5.0, jnp.where(burning, rate(60 - power), rate(wanted - power)))
    return speed * (goal - power)


def thrust(power: Scalar, altitude: Scalar, mach: Scalar) -> Scalar:
    """Return the engine's thrust in pounds."""
    altitude = jnp.where(altitude < 0, 0.01, altitude)
    idle, military, maximum = (t.along(altitude)(mach) for t in (_IDLE, _MILITARY, _MAXIMUM))
    below = idle + (military - idle) * power * 0.02
    return jnp.where(power < 50, below, military + (maximum - military) * (power - 50) * 0.02)


def _polynomial(x: Scalar, *coefficients: float) -> Scalar:
    total: Any = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = coefficient + x * total
    return total


def aerodynamics(state: Plane, surfaces: Surfaces) -> Coefficients:
    """Evaluate Morelli's polynomials."""
    a, b = state.alpha, state.beta
    de, da, dr = (jnp.deg2rad(angle) for angle in surfaces[1:])
    p, r = (rate * SPAN / (2 * state.vt) for rate in (state.p, state.r))
    q = state.q * CHORD / (2 * state.vt)
    poly = _polynomial
    x = (
        poly(a, -1.943367e-2, 2.136104e-1, 6.988016e-1, -9.035381e-1)
        + de * (-3.348641e-3 - 2.903457e-1 * de - 2.060504e-1 * a)
        + q * poly(a, 4.833383e-1, 8.644627, 1.131098e1, -7.422961e1, 6.075776e1)
    )
    y = (
        -1.145916 * b
        + 6.016057e-2 * da
        + 1.642479e-1 * dr
        + p * poly(a, -1.006733e-1, 8.679799e-1, 4.260586, -6.923267)
        + r * poly(a, 8.071648e-1, 1.189633e-1, 4.177702, -9.162236)
    )
    z = (
        poly(a, -1.378278e-1, -4.211369, 4.775187, -1.026225e1, 8.399763) * (1 - b * b)
        - 4.354000e-1 * de
        + q * poly(a, -3.054956e1, -4.132305e1, 3.292788e2, -6.848038e2, 4.080244e2)
    )
    roll = (
        b * poly(a, -1.05853e-1, -5.776677e-1, -1.672435e-2, 3.464156, -2.835451)
        + b * b * poly(a, 1.357256e-1, 2.172952e-1, -1.098104)
        + p * poly(a, -4.126806e-1, -1.189974e-1, 1.247721, -7.391132e-1)
        + r * poly(a, 6.250437e-2, 6.067723e-1, -1.101964, 9.100087, -1.192672e1)
        + da * poly(a, -1.463144e-1, -4.07391e-2, 4.851209e-1, -3.213068e-1)
        + da * b * poly(a, 3.253159e-2, 2.978850e-1, -3.746393e-1)
        + dr * (2.635729e-2 - 2.192910e-2 * a - 1.579864e-2 * b * b)
        + dr * b * poly(a, -3.152901e-3, -5.817803e-2, 4.516159e-1, -4.928702e-1)
    )
    pitch = (
        -2.029370e-2
        + 4.660702e-2 * a
        + de * poly(a, -6.012308e-1, -8.062977e-2, 5.018538e-1)
        + de * de * (8.320429e-2 + 6.378864e-1 * de + 4.226356e-1 * a)
        + q * poly(a, -5.19153, -3.554716, -3.598636e1, 2.247355e2, -4.120991e2, 2.411750e2)
    )
    yaw = (
        b * poly(a, 2.993363e-1, 6.594004e-2, -2.107885, 8.476901e-1)
        + b * b * poly(a, -2.003125e-1, -6.233977e-2, 2.141420)
        + p * poly(a, 2.677652e-2, -3.298246e-1, 1.926178e-1, 4.013325, -4.404302)
        + r * poly(a, -3.698756e-1, -1.167551e-1, -7.641297e-1)
        + da * poly(a, -3.348717e-2, 4.276655e-2, 2.302543e-1, -2.512876e-1)
        + da * b * poly(a, 6.573646e-3, 3.535831e-1, -1.373308, 1.237582)
        + da * b * b * b * (1.588105e-1 - 5.199526e-1 * a)
        + dr * poly(a, -8.115894e-2, -1.156580e-2, 1.004297e-1)
        + dr * b * poly(a, 2.514167e-2, 2.038748e-1, -3.337476e-1)
    )
    return Coefficients(x, y, z, roll, pitch, yaw)


def damped(state: Plane, c: Coefficients) -> Coefficients:
    """Return the same coefficients with the tabulated damping."""
    p, r = (rate * SPAN / (2 * state.vt) for rate in (state.p, state.r))
    q = state.q * CHORD / (2 * state.vt)
    d = interpolated(_DAMPING, jnp.rad2deg(state.alpha))
    return Coefficients(
        c.x + q * d[0],
        c.y + r * d[1] + p * d[2],
        c.z + q * d[3],
        c.roll + r * d[4] + p * d[5],
        c.pitch + q * d[6],
        c.yaw + r * d[7] + p * d[8],
    )


def slope(state: Plane, reference: Reference) -> Plane:
    """Return the derivative of the plane with its inner loop, which follows a reference."""
    s, surfaces = state, inner_loop(state)
    mach, pressure = air_data(s.vt, s.altitude)
    c = damped(s, aerodynamics(s, surfaces))
    force = pressure * WING_AREA
    sin_phi, cos_phi = jnp.sin(s.phi), jnp.cos(s.phi)
    sin_theta, cos_theta = jnp.sin(s.theta), jnp.cos(s.theta)
    sin_psi, cos_psi = jnp.sin(s.psi), jnp.cos(s.psi)
    sin_alpha, cos_alpha = jnp.sin(s.alpha), jnp.cos(s.alpha)
    sin_beta, cos_beta = jnp.sin(s.beta), jnp.cos(s.beta)

    # Velocity and acceleration along the axes of the body.
    u, v, w = s.vt * cos_alpha * cos_beta, s.vt * sin_beta, s.vt * sin_alpha * cos_beta
    ay, az = INVERSE_MASS * force * c.y, INVERSE_MASS * force * c.z
    pull = thrust(s.power, s.altitude, mach)
    u_dot = s.r * v - s.q * w - GRAVITY * sin_theta + INVERSE_MASS * (force * c.x + pull)
    v_dot = s.p * w - s.r * u + GRAVITY * cos_theta * sin_phi + ay
    w_dot = s.q * u - s.p * v + GRAVITY * cos_theta * cos_phi + az
    vt_dot = (u * u_dot + v * v_dot + w * w_dot) / s.vt
    uw = u * u + w * w

    moment = force * SPAN
    p_dot = (C2 * s.p + C1 * s.r + C4 * ENGINE_MOMENTUM) * s.q + moment * (C3 * c.roll + C4 * c.yaw)
    q_dot = (
        (C5 * s.p - C7 * ENGINE_MOMENTUM) * s.r
        + C6 * (s.r * s.r - s.p * s.p)
        + force * CHORD * C7 * c.pitch
    )
    r_dot = (C8 * s.p - C2 * s.r + C9 * ENGINE_MOMENTUM) * s.q + moment * (C4 * c.roll + C9 * c.yaw)

    turn = s.q * sin_phi + s.r * cos_phi
    load = -(az - PILOT * q_dot) / GRAVITY - 1
    side = (ay + PILOT * r_dot) / GRAVITY
    # The inner loop takes the angle of attack beyond its trim for the angle between the axes.
    tilt = s.alpha - TRIM_ALPHA
    roll = s.p * jnp.cos(tilt) + s.r * jnp.sin(tilt)
    return Plane(
        vt=vt_dot,
        alpha=(u * w_dot - w * u_dot) / uw,
        beta=(s.vt * v_dot - v * vt_dot) * cos_beta / uw,
        phi=s.p + sin_theta / cos_theta * turn,
        theta=s.q * cos_phi - s.r * sin_phi,
        psi=turn / cos_theta,
        p=p_dot,
        q=q_dot,
        r=r_dot,
        north=u * cos_theta * cos_psi
        + v * (sin_phi * cos_psi * sin_theta - cos_phi * sin_psi)
        + w * (cos_phi * sin_theta * cos_psi + sin_phi * sin_psi),
        east=u * cos_theta * sin_psi
        + v * (sin_phi * sin_psi * sin_theta + cos_phi * cos_psi)
        + w * (cos_phi * sin_theta * sin_psi - sin_phi * cos_psi),
        altitude=u * sin_theta - v * sin_phi * cos_theta - w * cos_phi * cos_theta,
        power=power_slope(s.power, surfaces.throttle),
        load_error=load - reference.load,
        roll_error=roll - reference.roll,
        side_error=side + s.r,
    )
