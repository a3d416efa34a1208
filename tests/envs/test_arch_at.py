from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from envs.arch import automatic_transmission as at
from specs.arch import automatic_transmission as specs
from verifai_jax.core.values.waveform import Waveform

# A trajectory that MATLAB made with the original model, thinned to 0.1 s and the segments' starts.
MATLAB = np.genfromtxt(Path(__file__).with_name("arch_at_matlab.csv"), delimiter=",", names=True)

# First and last sample, throttle and brake. The inputs are not recorded; within a segment every
# step identifies the same two numbers. Between segments is one step in which they change.
SEGMENTS = (
    (0, 506, 49.615113, 55.059994),
    (507, 1013, 0.9294569851625737, 193.67034943618097),
    (1014, 1499, 9.420953804808958, 57.47487735636747),
    (1500, 2006, 18.854463610341856, 251.34791203256344),
    (2007, 2513, 42.339143431810065, 17.49321281750595),
    (2514, 3000, 7.143137675104503, 68.128612603759),
)


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64():
        yield


@pytest.fixture(scope="module")
def simulate():
    """Simulates inputs that are constant for a sixth of 30 s."""
    with jax.enable_x64():
        system = at.automatic_transmission()

        @jax.jit
        def run(throttle, brake):
            pieces = {"throttle": throttle, "brake": brake}
            return system({n: Waveform(k, "constant") for n, k in pieces.items()})

        return lambda *inputs: run(*(jnp.asarray(k, jnp.float64) for k in inputs))


def test_segments_are_those_of_matlab():
    number = np.rint(MATLAB["time"] / at.DT).astype(int)
    speed, rpm = (
        dict(zip(number, MATLAB["SPEED"], strict=True)),
        dict(zip(number, MATLAB["RPM"], strict=True)),
    )
    steps = np.zeros((3000, 5))
    for first, last, throttle, brake in SEGMENTS:
        steps[first : last + 1, :2] = throttle, brake
        steps[first, 2:] = 1, speed[first], rpm[first]

    def step(state, row):
        k, (throttle, brake, restart, v, n) = row
        # The chart goes on through all segments; engine and wheels start anew.
        state = state._replace(
            engine=jnp.where(restart, n, state.engine),
            wheel=jnp.where(restart, v / at.MPH_PER_WHEEL_RPM, state.wheel),
        )
        state = at.advance(k, state, {"throttle": throttle, "brake": brake})
        return state, state

    rows = (jnp.arange(3000), jnp.asarray(steps))
    _, states = jax.jit(lambda rows: jax.lax.scan(step, at.initial({}), rows))(rows)
    for first, last, *_ in SEGMENTS:
        inside = np.array([k for k in number if first < k <= last])
        found = jax.tree.map(lambda leaf, inside=inside: np.asarray(leaf)[inside - 1], states)
        np.testing.assert_allclose(at.speed(found), [speed[k] for k in inside], rtol=0, atol=1e-6)
        np.testing.assert_allclose(found.engine, [rpm[k] for k in inside], rtol=0, atol=1e-4)
    assert set(np.asarray(states.gear)) == {1, 2, 3, 4}


@pytest.mark.thorough
def test_full_throttle_reaches_what_others_computed(simulate):
    trace = simulate([100.0] * 6, [0.0] * 6)
    wanted = {
        0.5: (10.935674, 2490.943687, 1),
        1: (20.422817, 2854.433128, 1),
        2: (34.335995, 3987.554192, 1),
        5: (62.378498, 4332.151830, 2),
        10: (90.490650, 4339.691689, 3),
        20: (120.213271, 3980.219447, 4),
        30: (137.980199, 4453.968371, 4),
    }
    for time, values in wanted.items():
        found = [float(trace[name][round(time * 100)]) for name in ("speed", "rpm", "gear")]
        np.testing.assert_allclose(found, values, rtol=0, atol=1e-6)
    margins = [
        float(vj.mtl.robustness(problem.formulas["spec"], trace))
        for problem in (specs.at1, specs.at2)
    ]
    np.testing.assert_allclose(margins, [-0.2133, -18.277], atol=1e-3)


def test_braking_stalls_the_engine_at_its_limit(simulate):
    trace = simulate([50, 50, 0, 0, 0, 0], [0, 0, 200, 200, 200, 200])
    wanted = {
        1: (17.141813, 2471.080679, 1),
        5: (45.992330, 2580.463461, 3),
        10: (64.910932, 2549.788942, 4),
        12: (61.281055, 600, 4),
        20: (47.170358, 600, 4),
    }
    for time, values in wanted.items():
        found = [float(trace[name][round(time * 100)]) for name in ("speed", "rpm", "gear")]
        np.testing.assert_allclose(found, values, rtol=0, atol=1e-6)


def table(x, xs, ys):
    """Linear interpolation and extrapolation, by search."""
    i = int(np.clip(np.searchsorted(xs, x, side="right") - 1, 0, len(xs) - 2))
    share = (x - xs[i]) / (xs[i + 1] - xs[i])
    return (1 - share) * np.asarray(ys[i], float) + share * np.asarray(ys[i + 1], float)


def plain(throttle, brake):
    """The model in plain Python, with loops and searches, as its documentation tells it."""
    engine, wheel, gear, state, counter, rows = 1000.0, 0.0, 1, "steady", 0, []
    nodes = (0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1)
    for k in range(3001):
        th, br = throttle[min(k // 500, 5)], brake[min(k // 500, 5)]
        v = wheel * 2 * np.pi * 60 / 5280
        if k % 4 == 0 and k > 0:
            up = table(th, at.UP_THROTTLE, at.UP_SPEED)[gear - 1]
            down = table(th, at.DOWN_THROTTLE, at.DOWN_SPEED)[gear - 1]
            counter += 1
            if state == "steady":
                if v > up:
                    state, counter = "up", 0
                elif v < down:
                    state, counter = "down", 0
            elif state == "up":
                if counter >= 2 and v >= up:
                    gear, state = min(gear + 1, 4), "steady"
                elif v < up:
                    state = "steady"
            elif counter >= 2 and v <= down:
                gear, state = max(gear - 1, 1), "steady"
            elif v > down:
                state = "steady"
        rows.append((v, engine, gear))
        ratio = at.GEAR_RATIO[gear - 1]
        torques = table(th, at.ENGINE_THROTTLE, at.ENGINE_TORQUE)

        def slope(n, w, ratio=ratio, torques=torques, br=br):
            sr = 3.23 * w * ratio / n
            turbine = (n / table(sr, at.SPEED_RATIO, at.K_FACTOR)) ** 2
            dn = (table(n, at.ENGINE_RPM, torques) - turbine) / at.ENGINE_INERTIA
            dn = 0.0 if (n >= 6000 and dn > 0) or (n <= 600 and dn < 0) else dn
            v = w * 2 * np.pi * 60 / 5280
            out = turbine * table(sr, at.SPEED_RATIO, at.TORQUE_RATIO) * ratio
            load = np.sign(v) * (40 + 0.02 * v**2 + br)
            return np.array([dn, (3.23 * out - load) / at.VEHICLE_INERTIA])

        start, slopes = np.array([engine, wheel]), []
        for row in ((), *at.TABLEAU):
            move = sum((a * s for a, s in zip(row, slopes, strict=False)), np.zeros(2))
            place = start + 0.01 * move
            place[0] = np.clip(place[0], 600, 6000)
            slopes.append(slope(*place))
        engine, wheel = place
    for node, row in zip(nodes[1:], at.TABLEAU, strict=False):
        assert sum(row) == pytest.approx(node)
    return np.array(rows)


@pytest.mark.thorough
def test_shifting_up_and_down_is_that_of_a_plain_program(simulate):
    throttle = [80.0, 5.0, 0.0, 95.0, 2.0, 60.0]
    brake = [10.0, 300.0, 320.0, 0.0, 310.0, 5.0]
    rows, trace = plain(throttle, brake), simulate(throttle, brake)
    assert np.min(np.diff(rows[:, 2])) == -1
    np.testing.assert_array_equal(trace["gear"], rows[:, 2])
    np.testing.assert_allclose(trace["speed"], rows[:, 0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(trace["rpm"], rows[:, 1], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    system = at.automatic_transmission(duration=5.0)

    def outcome(x):
        pieces = {"throttle": x[:2], "brake": x[2:]}
        trace = system({name: Waveform(knots, "constant") for name, knots in pieces.items()})
        return jnp.stack([trace["speed"][-1], trace["rpm"][-1] / 100])

    # Between the ticks at which a gear changes the model is smooth.
    x, step = jnp.array([62.0, 35.0, 20.0, 60.0]), 1e-4
    jacobian = jax.jit(jax.jacfwd(outcome))(x)
    shifts = step * jnp.eye(4)
    beside = jax.jit(jax.vmap(outcome))(jnp.concatenate([x + shifts, x - shifts]))
    ahead, behind = jnp.split(beside, 2)
    np.testing.assert_allclose(jacobian, ((ahead - behind) / (2 * step)).T, rtol=1e-5, atol=1e-7)


def test_features_that_it_does_not_have_are_refused():
    with pytest.raises(ValueError, match="unknown feature 'trottle'; did you mean 'throttle'"):
        at.automatic_transmission(duration=1.0)({"trottle": 1.0}, None)
    with pytest.raises(
        ValueError, match=r"duration must be a positive multiple of 0.01 s; got 0.015"
    ):
        at.automatic_transmission(duration=0.015)
