import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.arch import f16 as plane
from envs.arch.f16_dynamics import (
    THRUST_IDLE,
    THRUST_MAXIMUM,
    THRUST_MILITARY,
    Plane,
    air_data,
    power_slope,
    thrust,
)


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64():
        yield


@pytest.fixture(scope="module")
def falls():
    """Altitudes `[n, time]` of falls from attitudes and altitudes `[n, 4]`."""
    with jax.enable_x64():
        system, names = plane.f16(), ("phi", "theta", "psi", "altitude")
        run = jax.jit(jax.vmap(lambda row: system(dict(zip(names, row, strict=True)))["altitude"]))
        return lambda rows: np.asarray(run(jnp.asarray(rows, jnp.float64)))


@pytest.mark.thorough
def test_falls_are_those_of_aerobench(falls):
    pi = math.pi
    # Least altitudes by AeroBench v2 with its adaptive method.
    rows = [
        (pi / 4 + pi / 30, -0.4 * pi, 0.3, 4040, 1703.476),
        (pi / 4 - pi / 20, -0.4 * pi, -pi / 4, 4040, 1843.914),
        (pi / 4, -0.375 * pi, -pi / 4, 4040, 1909.268),
        (pi / 4 + pi / 30, -0.4 * pi, -pi / 4, 2200, -138.195),
        (pi / 4 + pi / 30, -0.4 * pi, -pi / 4, 2250, -88.147),
        (pi / 4 + pi / 30, -0.4 * pi, -pi / 4, 2300, -38.099),
        (pi / 4 + pi / 30, -0.4 * pi, -pi / 4, 2330, -8.071),
        (pi / 4 + pi / 30, -0.4 * pi, -pi / 4, 2338, -0.063),
        (pi / 4 + pi / 30, -0.4 * pi, -pi / 4, 2400, 61.996),
    ]
    rows = np.array(rows)
    altitude = falls(rows[:, :4])
    np.testing.assert_allclose(altitude.min(axis=1), rows[:, 4], rtol=0, atol=0.01)
    wanted = [3510.642, 2960.571, 1803.795, 2076.035]
    np.testing.assert_allclose(altitude[0, [30, 60, 150, 450]], wanted, rtol=0, atol=0.01)


@pytest.mark.slow
def test_heading_makes_no_difference_and_the_rest_is_differentiable(falls):
    system, centre = plane.f16(), np.array([math.pi / 4, -0.375 * math.pi, -math.pi / 4])

    def least(x):
        return system({"phi": x[0], "theta": x[1], "psi": x[2]})["altitude"].min()

    gradient = np.asarray(jax.jit(jax.jacfwd(least))(jnp.asarray(centre)))
    rows = np.tile([*centre, 2338.0], (6, 1))
    rows[:3, :3] += 1e-5 * np.eye(3)
    rows[3:, :3] -= 1e-5 * np.eye(3)
    bottom = falls(rows).min(axis=1)
    # The least of the samples has a derivative where it is not reached between two of them.
    np.testing.assert_allclose(gradient, (bottom[:3] - bottom[3:]) / 2e-5, rtol=1e-4, atol=1e-6)
    assert gradient[2] == 0
    assert gradient[1] == pytest.approx(2142, rel=2e-3)


def test_engine_is_that_of_its_tables():
    for table, power in ((THRUST_IDLE, 0.0), (THRUST_MILITARY, 50.0), (THRUST_MAXIMUM, 100.0)):
        found = [
            [float(thrust(power, jnp.array(1e4 * i), jnp.array(0.2 * m))) for i in (0, 2, 5)]
            for m in (0, 3, 5)
        ]
        wanted = np.array(table)[np.ix_([0, 3, 5], [0, 2, 5])]
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-6)
    between = float(thrust(25.0, jnp.array(5000.0), jnp.array(0.3)))
    corners = [np.array(t, float)[1:3, :2].mean() for t in (THRUST_IDLE, THRUST_MILITARY)]
    assert between == pytest.approx(np.mean(corners))
    # Throttle 0.1395 asks for a power of 9.06; from 60 it falls towards 40 first.
    slopes = [float(power_slope(jnp.array(p), jnp.array(0.1395))) for p in (9.0, 60.0)]
    np.testing.assert_allclose(slopes, [64.94 * 0.1395 - 9, -100])
    mach, pressure = air_data(jnp.array(500.0), jnp.array(0.0))
    assert float(mach) == pytest.approx(500 / math.sqrt(1.4 * 1716.3 * 519))
    assert float(pressure) == pytest.approx(0.5 * 2.377e-3 * 500**2)


@pytest.mark.thorough
def test_the_pilot_rolls_pulls_and_stands_by():
    trace = jax.jit(plane.f16().__call__)({"phi": 0.7})
    modes = np.asarray(trace["mode"]).astype(int)
    changes = np.flatnonzero(np.diff(modes)) + 1
    np.testing.assert_array_equal(modes[[0, *changes]], [plane.ROLL, plane.PULL, plane.STANDBY])
    rolled, pulled = changes
    assert abs(float(trace["phi"][rolled])) < plane.LEVEL_PHI
    assert pulled - rolled >= plane.MIN_PULL
    assert float(trace["theta"][pulled] - trace["alpha"][pulled]) > 0
    # Below the flight deck, nose down, it does not stay on standby.
    falling = Plane(*(jnp.array(0.0),) * 16)._replace(theta=jnp.array(-0.2))
    for altitude, mode in ((999.0, plane.ROLL), (1000.0, plane.STANDBY)):
        state = plane.State(falling._replace(altitude=jnp.array(altitude)), plane.STANDBY, 3)
        assert int(plane.decided(state).mode) == mode
