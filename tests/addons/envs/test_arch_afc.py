"""AFC against a plain program with SciPy's root finder and tables, and the values of its sheet."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import brentq

from envs.arch import fuel_control as model
from specs.arch import fuel_control as specs
from verifai_jax.core.values.waveform import Waveform

TIMES, ANGLES = (0.0, 20.0, 35.0), (10.0, 40.0, 5.0)
SHEET = {20.3: 8.1e-5, 20.5: -4.77e-4, 20.8: -5.03e-4, 22: 1.06e-4, 35.6: 7.97e-4, 36: 1.715e-3,
         37: -5.63e-4, 40: -4.5e-6}  # fmt: skip


def simulated(times, angles, duration, rpm=1000.0):
    system = model.fuel_control(duration)
    with jax.enable_x64(True):
        wave = Waveform(jnp.asarray(angles), "constant", duration, times)
        trace = jax.jit(lambda wave: system({"throttle": wave, "rpm": rpm}))(wave)
        return {name: np.asarray(part) for name, part in trace.signals.items()}


@pytest.mark.slow
def test_values_of_the_sheet():
    mu = simulated(TIMES, ANGLES, 50.0)["mu"]
    for time, expected in SHEET.items():
        assert mu[round(time * 100)] == pytest.approx(expected, abs=6e-5), time
    assert np.abs(mu[1100:]).max() == pytest.approx(2.09e-3, abs=6e-5)


def table(block):
    values = np.asarray(block.values)
    grid = RegularGridInterpolator(block.axes, values, bounds_error=False, fill_value=None)
    return lambda *at: float(np.ravel(grid(at))[0])


def program(times, angles, duration, rpm, h):
    """The sheet as a loop: explicit lags, the pressure by a root finder, a list for the past."""
    kappa, tau, late = (table(b) for b in (model.TO_CYLINDER, model.FILM_TIME, model.TRANSPORT))
    w = rpm * np.pi / 30

    def pump(p):
        return -0.366 + 0.08979 * p * w - 0.0337 * w * p * p + 0.0001 * p * w * w

    def flow(p, th):
        r = min(p, 1 / p)
        g = 2 * np.sqrt(max(r - r * r, 0)) if r >= 0.5 else 1
        return (2.821 - 0.05231 * th + 0.10299 * th**2 - 0.00063 * th**3) * g * np.sign(1 - p)

    lag, p, m, one, two, way = 0.0, 0.982, 0.0112, 14.7, 14.7, 0.0
    guess, total, fuel, normal, power, ref = 0.982, 0.0, 0.1726, False, False, 14.7
    ways, ratios, mu, every = [0.0], [14.7], [0.0], round(0.01 / h)
    for i in range(round(duration / h)):
        u = angles[np.searchsorted(times, i * h + 1e-9, side="right") - 1]
        lag += h * (u - lag) / 0.1
        th = min(max(lag + 8.8, 0), 90)
        p = brentq(
            lambda q, p=p, th=th: q - p - h * 0.41328 * (flow(q, th) - 0.9 * pump(q)), 1e-3, 1.5
        )
        air = 0.9 * pump(p)
        c = air / w * np.pi
        k, t = kappa(rpm, c), tau(rpm, c)
        m += h * (fuel * (1 - k) - m / t)
        way += h / late(rpm, c)
        ways.append(way)
        ratios.append(air / (k * fuel + m / t))
        came = 14.7 if way < 1 else np.interp(way - 1, ways, ratios)
        one, two = one + h * 10 * (came - one), two + h * 50 * (one - two)
        if (i + 1) % every == 0:
            now = (i + 1) * h
            normal, power = normal or now >= 10 - 1e-9, th >= (50 if power else 70)
            ref = 12.5 if normal and power else 14.7
            est = pump(guess)
            guess += 0.01 * 0.41328 * (flow(p, th) - est)
            trim = 1.0
            if normal and not power:
                total += 0.01 * 0.14 * (two - ref)
                trim = max(1 + 0.04 * (two - ref) + total, 0)
            fuel = min(max(est / ref * trim, 0.13), 1.66)
            mu.append(two / ref - 1 if now >= 1 - 1e-9 else 0.0)
    return np.array(mu)


@pytest.mark.slow
@pytest.mark.parametrize("angles", [(20.0, 55.0, 4.0), (70.0, 75.0, 30.0)])
def test_a_plain_program(angles):
    """Through the change to normal mode at 10 s, in power mode and out of it."""
    times, rpm = (0.0, 10.5, 12.0), 930.0
    mu = simulated(times, angles, 14.0, rpm)["mu"]
    oracle = program(times, angles, 14.0, rpm, 1e-3)
    assert np.abs(oracle).max() > 0.01
    np.testing.assert_allclose(mu[1:], oracle[1:], atol=2e-3)
    np.testing.assert_allclose(mu[1100:1200], oracle[1100:1200], atol=2e-4)


def test_the_pressure_takes_implicit_steps():
    """From below and above the air's pressure, with the throttle open and shut."""
    plates, before = np.float32([15, 60, 89, 20, 9]), np.float32([0.9, 0.98, 0.9999, 1.02, 0.3])

    @jax.jit
    @jax.vmap
    def step(pressure, plate):
        after = model.manifold(pressure, plate, 104.7, 0.0025)
        flow = model.inflow(model.signed_root(after), plate) - 0.9 * model.pumped(after, 104.7)
        return after, pressure + 0.0025 * 0.41328 * flow

    after, expected = step(before, plates)
    np.testing.assert_allclose(after, expected, atol=1e-5)


def test_the_requirements_are_those_of_the_competition():
    assert {specs.afc27.name, specs.afc29.name, specs.afc33.name} == {"afc27", "afc29", "afc33"}
    assert specs.afc27.formulas["spec"].horizon() == 50
    assert specs.afc33.space.dim == 11
