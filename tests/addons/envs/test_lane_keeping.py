import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.signal import cont2discrete

import verifai_jax as vj
from envs import lane_keeping as lk
from envs.lane_keeping_drawing import draw
from specs import lane_keeping as specs
from verifai_jax.addons.rl import Continuous, Discrete, Policy, evaluate, load_policy, policy_notes
from verifai_jax.addons.rl.policy import new_layers
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.pictures.style import new_figure
from verifai_jax.search import PointList

KEY = jax.random.key(0)
PROBLEMS = {name: p for name in dir(specs) if isinstance(p := getattr(specs, name), vj.Problem)}


def hands_off(time, state, features):
    return 0.0


@pytest.fixture
def double():
    with jax.enable_x64():
        yield


def test_lqr_stays_in_the_middle_of_a_road_that_it_knows():
    curvature = jnp.array([0.0, 0.005, -0.005])
    system = lk.lane_keeping(lk.lqr(), duration=4.0)
    trace = jax.jit(jax.vmap(lambda k: system({"curvature": k}, KEY)))(curvature)
    np.testing.assert_allclose(trace["offset"], 0, atol=1e-5)
    np.testing.assert_allclose(trace["heading"], 0, atol=1e-6)
    np.testing.assert_allclose(trace["distance"][1], 20 * np.arange(101) * lk.DT, rtol=1e-5)
    sideways = np.broadcast_to(400 * curvature[:, None], (3, 101))
    np.testing.assert_allclose(trace["lateral_acceleration"], sideways, atol=1e-4)
    np.testing.assert_allclose(trace["lateral_jerk"], 0, atol=1e-3)


def test_turned_wheels_give_a_circle_of_radius_wheelbase_over_tangent(double):
    # Wheels that are off by a constant, and a steering that does nothing about it.
    system = lk.lane_keeping(hands_off, duration=4.0)
    angle, wheelbase = jnp.array([0.02, -0.03]), jnp.array([2.7, 2.5])
    traces = jax.jit(
        jax.vmap(lambda a, b: system({"bias": a, "wheelbase": b, "speed0": 15.0}, KEY))
    )(angle, wheelbase)
    radius = np.asarray(wheelbase / np.tan(angle))[:, None]
    turned = 15 * np.arange(101) * lk.DT / radius
    np.testing.assert_allclose(traces["heading"], turned, atol=1e-9)
    np.testing.assert_allclose(traces["distance"], radius * np.sin(turned), atol=1e-6)
    np.testing.assert_allclose(traces["offset"], radius * (1 - np.cos(turned)), atol=1e-6)
    sideways = np.broadcast_to(15**2 / radius, (2, 101))
    np.testing.assert_allclose(traces["lateral_acceleration"], sideways, rtol=1e-9)


def test_a_circle_beside_the_middle_of_a_round_road_stays_beside_it(double):
    # A car at an offset to the inside drives the smaller circle 1/k - offset.
    curvature, offset = 0.01, 0.7
    angle = np.arctan(2.7 / (1 / curvature - offset)) - np.arctan(2.7 * curvature)
    features = {"curvature": curvature, "offset0": jnp.float64(offset), "bias": angle}

    def as_it_is(time, state, features):
        return jnp.arctan(2.7 * curvature)

    trace = lk.lane_keeping(as_it_is, duration=4.0)(features, KEY)
    np.testing.assert_allclose(trace["offset"], offset, atol=1e-9)
    np.testing.assert_allclose(trace["heading"], 0, atol=1e-9)
    # The road's middle is longer than the inside of the bend.
    np.testing.assert_allclose(trace["distance"][-1], 80 / (1 - curvature * offset), rtol=1e-9)


@pytest.mark.thorough
def test_a_road_is_a_function_of_distance_and_not_of_time(double):
    # One bend between 40 m and 60 m, passed at two speeds with the wheels straight.
    road = Waveform(jnp.array([0.0, 0.0, 0.004, 0.0, 0.0, 0.0], jnp.float64), duration=100.0)
    system = lk.lane_keeping(hands_off, duration=8.0, dt=0.01)
    at = jax.jit(jax.vmap(lambda speed: system({"curvature": road, "speed0": speed}, KEY)))
    # The road turns by the area below its curvature: 40 m * 0.004 / 2.
    turned = at(jnp.array([10.0, 12.0]))["heading"][:, -1]
    np.testing.assert_allclose(turned, -0.08, rtol=2e-3)


def test_steering_lags_saturates_and_tyres_slip(double):
    def full(time, state, features):
        return 1.0

    features = {"lag": 0.2, "friction": 0.3, "speed0": jnp.float64(20.0)}
    trace = lk.lane_keeping(full, duration=2.0)(features, KEY)
    time = np.arange(51) * lk.DT
    # RK4 against the exponential that a first-order lag is.
    wanted = lk.STEER_LIMIT * (1 - np.exp(-time / 0.2))
    np.testing.assert_allclose(trace["steer"], wanted, atol=1e-6)
    sideways = np.asarray(trace["lateral_acceleration"])
    held = np.minimum(400 * np.tan(wanted) / 2.7, 0.3 * 9.81)
    np.testing.assert_allclose(sideways, held, atol=1e-4)
    assert sideways[-1] == pytest.approx(0.3 * 9.81)
    assert float(trace["lateral_jerk"][-1]) == 0


def test_a_braking_car_stops_and_stays():
    trace = lk.lane_keeping(lk.lqr(), duration=6.0)({"acceleration": -5.0}, KEY)
    assert float(trace["speed"][50]) == pytest.approx(10.0, rel=1e-4)
    np.testing.assert_allclose(trace["distance"][-20:], 40.0, rtol=5e-3)
    np.testing.assert_allclose(trace["speed"][-20:], 0, atol=0.2)


def test_room_is_that_of_the_four_corners():
    offset, heading = 0.3, 0.05
    trace = lk.lane_keeping(hands_off, duration=0.4)(
        {"offset0": offset, "heading0": heading, "speed0": 1e-3}, KEY
    )
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    corners = [(x, y) for x in (-lk.REAR, lk.FRONT) for y in (-0.9, 0.9)]
    sideways = [offset + (turn @ np.array(corner))[1] for corner in corners]
    assert float(trace["left"][0]) == pytest.approx(1.75 - max(sideways), abs=1e-5)
    assert float(trace["right"][0]) == pytest.approx(1.75 + min(sideways), abs=1e-5)


def test_gains_are_the_riccati_equations():
    speed, wheelbase, lag = (lk.NOMINAL[n] for n in ("speed0", "wheelbase", "lag"))
    slope = np.array([[0, speed, 0], [0, 0, speed / wheelbase], [0, 0, -1 / lag]])
    command = np.array([[0], [0], [1 / lag]])
    a, b = cont2discrete((slope, command, np.eye(3), np.zeros((3, 1))), lk.DT)[:2]
    q, r = np.diag([1.0, 0.0, 0.0]), np.array([[1000.0]])
    p = solve_discrete_are(a, b, q, r)
    gains = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)[0]
    np.testing.assert_allclose(lk.LQR_GAINS, gains, atol=6e-5)
    assert np.max(np.abs(np.linalg.eigvals(a - b @ [gains]))) < 0.95

    # The slope is also that of the simulated car.
    def rates(offset, heading, steer):
        state = lk.State(offset, heading, steer, jnp.float32(speed), jnp.float32(0))
        return jnp.stack(lk.dynamics(jnp.zeros(()), state, jnp.zeros(()), {})[:3])

    jacobian = jax.jit(jax.jacfwd(rates, argnums=(0, 1, 2)))(*np.zeros(3, np.float32))
    np.testing.assert_allclose(np.stack(jacobian, axis=1), slope, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_gradients_are_finite_differences(double):
    # A network of the shipped one's kind that is quick to compile.
    layers = new_layers(KEY, (5, 4, 1), gain=1.0)
    small = Policy(layers, None, None, jnp.zeros(1), lk.LaneKeepingTask().action)
    system = lk.lane_keeping(lk.neural(small), duration=2.0)
    names = ("offset0", "heading0", "speed0", "wheelbase", "lag", "bias", "noise")
    start = jnp.array([0.3, 0.02, 22.0, 2.6, 0.2, 0.005, 0.05, 0.0, 0.004, -0.003], jnp.float64)

    def missed(point):
        features = dict(zip(names, point, strict=False))
        features["curvature"] = Waveform(point[len(names) :], duration=60.0)
        trace = system(features, KEY)
        return jnp.sum(trace["offset"] ** 2) + trace["lateral_jerk"][-1]

    both = jax.jit(lambda point: (missed(point), jax.jacfwd(missed)(point)))
    steps = np.concatenate([np.eye(10), -np.eye(10)]) * 1e-6
    values = np.array([float(both(start + step)[0]) for step in steps])
    differences = (values[:10] - values[10:]) / 2e-6
    np.testing.assert_allclose(both(start)[1], differences, rtol=2e-5, atol=1e-6)
    assert np.all(np.abs(differences) > 1e-3)


@pytest.mark.thorough
def test_shipped_network_drives_and_doing_nothing_does_not():
    task = lk.LaneKeepingTask()
    policy = load_policy(lk.POLICY_FILE)
    returns = evaluate(task, policy, seed=5, episodes=200)
    assert returns.min() > 235
    assert policy_notes(lk.POLICY_FILE)["mean_return"] == pytest.approx(returns.mean(), abs=1)
    lazy = Policy(
        jax.tree.map(jnp.zeros_like, policy.layers), None, None, policy.log_std, policy.action
    )
    assert evaluate(task, lazy, seed=5, episodes=200).mean() < 100


@pytest.mark.slow
def test_the_task_steps_like_the_system():
    policy = load_policy(lk.POLICY_FILE)
    task = lk.LaneKeepingTask()
    drive = task.reset(jax.random.key(3))
    first = drive.car

    def step(drive, _):
        after, reward, over = task.step(KEY, drive, policy.act(task.observe(drive)))
        return after, (jnp.stack(drive.car), reward, over)

    _, (rows, reward, over) = jax.lax.scan(step, drive, None, length=26)
    assert float(reward.max()) <= 1
    assert not over.any()
    features = {
        "offset0": first.offset,
        "heading0": first.heading,
        "speed0": first.speed,
        "curvature": drive.road,
    }
    trace = lk.lane_keeping(lk.neural(), duration=1.0)(features, KEY)
    got = np.stack([trace[name] for name in lk.State._fields], axis=1)
    np.testing.assert_allclose(got, rows, atol=1e-4)


@pytest.mark.thorough
def test_controllers_refuse_what_they_cannot_use():
    with pytest.raises(ValueError, match=r"LQR needs 3 gains; got \[1.0\]"):
        lk.lqr([1.0])
    layers = new_layers(KEY, (4, 8, 2), gain=1.0)
    with pytest.raises(ValueError, match=r"sees 5 numbers as they are .* got 4 and Discrete"):
        lk.neural(Policy(layers, None, None, None, Discrete(2)))
    layers = new_layers(KEY, (5, 8, 1), gain=1.0)
    with pytest.raises(ValueError, match=r"at most 0.08 rad; got 5 and Continuous"):
        lk.neural(Policy(layers, None, None, jnp.zeros(1), Continuous(-1.0, 1.0)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    # Each compiles a problem of its own; two stand for all where time is short.
    [
        name if name in ("lane", "learned") else pytest.param(name, marks=pytest.mark.proves)
        for name in PROBLEMS
    ],
)
def test_nominal_is_safe_and_failures_are_there_but_rare(name):
    problem = PROBLEMS[name]
    space = problem.space
    nominal = space.flatten(space.coerce(problem.nominal))
    points = np.random.default_rng(0).uniform(size=(2047, space.dim))
    run = vj.falsify(
        problem, PointList(np.vstack([nominal, points])), 2048, batch=2048, progress=False
    )
    table = run.table.all
    assert set(table.status) == {"ok"}
    assert not table.violated[0]
    assert table.rho[0] > 0.05
    assert 1 <= table.violated.sum() <= 0.1 * len(table)


@pytest.mark.slow
def test_a_frame_shows_the_car_in_red_where_it_is_over_a_marking():
    features = {"curvature": Waveform(jnp.array([0.0, 0.005]), duration=100.0), "bias": 0.03}
    trace = lk.lane_keeping(hands_off, duration=2.0)(features, KEY)
    titles = []
    for sample in (0, 50):
        axes = new_figure(figsize=(5.2, 3.0)).subplots()
        draw(axes, trace, sample, features)
        titles.append(axes.get_title())
    assert "20.0 m/s" in titles[0]
    assert "off the lane" not in titles[0]
    assert "off the lane" in titles[1]
