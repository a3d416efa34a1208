"""The intersection of Tempe: its geometry, its drivers, and the curve of collisions over notice."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import fisher_exact

import verifai_jax as vj
from envs.road import CAR
from envs.road import tempe as model
from specs import tempe as specs
from verifai_jax.pictures.style import new_figure

KEY = jax.random.key(0)
NAMES = tuple(specs.space.domains)


def simulate(points, notice=None, **options):
    """Signals `[n, samples]` of NumPy features `[n]`, in plain loops over small explicit steps."""
    f = {name: points[:, i] for i, name in enumerate(NAMES)}
    if notice is not None:
        f["notice"] = np.full(len(points), notice)
    return independent(f, **options)


def independent(f, dt=0.002, duration=12.0):
    """Least gap of bodies sampled as points, and the ego's course, without a line of `envs`."""
    kmh, count = 1 / 3.6, len(f["notice"])
    speed = f["turn_speed"] * kmh
    wanted = f["ego_speed"] * kmh
    y, v = -f["ego_dist"].copy(), wanted.copy()
    least = np.full(count, np.inf)
    for k in range(round(duration / dt) + 1):
        time = k * dt
        s = f["turn_start"] + speed * np.maximum(time - f["delay"], 0)
        angle = np.clip(s / 9, 0, np.pi / 2)
        x_turn = -1.75 + 9 * (1 - np.cos(angle)) + np.maximum(s - 9 * np.pi / 2, 0)
        y_turn = 9 - 9 * np.sin(angle) + np.maximum(-s, 0)
        heading = angle - np.pi / 2
        if k % 10 == 0:
            least = np.minimum(least, box_gap(y, x_turn, y_turn, heading))
        enter = f["delay"] + (model.ENTERS - f["turn_start"]) / speed
        leave = f["delay"] + (model.LEAVES - f["turn_start"]) / speed
        rise = np.clip((time - enter + f["notice"] - f["reaction"]) / 0.15, 0, 1)
        todo = -9 - CAR.length / 2 - y
        needed = np.clip(1.1 * v**2 / (2 * np.maximum(todo, 1e-3)), 2, f["brake"])
        needed = np.where(todo > 0, needed, f["brake"])
        room = -2.2 - CAR.length / 2 - y + 0.9 * rise
        braking = np.where(room > v**2 / (2 * f["brake"]), needed, 0)
        a = np.where(time > leave, 2 * np.clip(wanted - v, 0, 1), -rise * braking)
        y, v = y + dt * v, np.maximum(v + dt * a, 0)
    return least


def box_gap(y, x_turn, y_turn, heading):
    """Least distance between the ego's box and points around the turning car's, without depth."""
    along = np.linspace(-CAR.length / 2, CAR.length / 2, 48)
    across = np.linspace(-CAR.width / 2, CAR.width / 2, 19)
    edge = [(a, b) for a in along for b in across[[0, -1]]]
    edge += [(a, b) for a in along[[0, -1]] for b in across]
    best = np.full(len(y), np.inf)
    for a, b in edge:
        px = x_turn + a * np.cos(heading) - b * np.sin(heading) - 8.75
        py = y_turn + a * np.sin(heading) + b * np.cos(heading) - y
        dx = np.maximum(np.abs(px) - CAR.width / 2, 0)
        dy = np.maximum(np.abs(py) - CAR.length / 2, 0)
        best = np.minimum(best, np.hypot(dx, dy))
    return best


def features_of(seed, count):
    low, high = (
        np.array([float(getattr(domain, end)) for domain in specs.space.domains.values()])
        for end in ("low", "high")
    )
    return low + np.random.default_rng(seed).uniform(size=(count, len(NAMES))) * (high - low)


def test_the_conflict_begins_and_ends_at_the_lane_of_the_ego():
    at = jax.jit(model.GUIDEWAY.pose)(
        jnp.array([model.ENTERS, model.LEAVES], float) + model.APPROACH
    )
    front = at.x[0] + CAR.front * jnp.cos(at.heading[0])
    rear = at.x[1] - CAR.rear * jnp.cos(at.heading[1])
    np.testing.assert_allclose((front, rear), (7.0, 10.5), atol=1e-4)


def test_the_assumption_leaves_room_to_halt():
    """Whoever is warned at the start comes to rest before the line, at worst."""
    slowest, fastest = (50 / 3.6, 0.3 + model.RISE)
    halting = slowest * fastest + slowest**2 / (2 * 6.0)
    low = float(specs.space.domains["ego_dist"].low)
    assert halting < low - CAR.front - model.STOP_LINE
    # From 25 m there is no such room.
    assert halting > 25 - CAR.front - model.STOP_LINE


@pytest.mark.slow
def test_notice_helps_those_too_who_start_too_near_to_halt():
    """They go on, and are through before the other car comes (docs/road.md)."""
    domains = {**specs.accident.space.domains, "ego_dist": vj.Box(25.0, 45.0)}
    near = vj.Problem("near", domains, specs.accident.system, specs.SAFE)
    curve = specs.collisions([0.0, 1.5, 2.0, 4.0], samples=4096, seed=11, problem=near)
    assert curve["share"].is_monotonic_decreasing
    assert curve["low"][0.0] < 0.222 < curve["high"][0.0]
    assert curve["low"][1.5] < 0.024 < curve["high"][1.5]
    assert (curve.loc[[2.0, 4.0], "collisions"] == 0).all()
    # The independent simulation says so too.
    points = features_of(7, 1000)
    points[:, NAMES.index("ego_dist")] = np.linspace(25, 45, len(points))
    assert (simulate(points, notice=4.0) > 0.1).all()
    assert (simulate(points, notice=0.0) < 0.02).mean() > 0.15


@pytest.mark.slow
def test_the_system_agrees_with_an_independent_simulation():
    points = features_of(3, 200)
    system = jax.jit(jax.vmap(lambda row: jnp.min(specs.accident.system(row, KEY)["gap"])))
    rows = {name: jnp.asarray(points[:, i], jnp.float32) for i, name in enumerate(NAMES)}
    got = np.asarray(system(rows))
    expected = simulate(points)
    touching = expected < 0.02
    assert 5 < touching.sum() < 100
    # Between two samples a car moves by half a metre.
    near = np.abs(got) < 0.1
    np.testing.assert_array_equal((got < 0)[~near], touching[~near])
    apart = ~touching & (expected < 8)
    assert apart.sum() > 10
    np.testing.assert_allclose(got[apart], expected[apart], atol=0.15)


@pytest.mark.slow
def test_slopes_are_finite_differences():
    """Of the least gap, along random directions, off the decision to halt or to go on."""
    with jax.enable_x64():
        problem = specs.accident

        def least(u):
            return jnp.min(problem.system(problem.space.unflatten(u), KEY)["gap"])

        rng = np.random.default_rng(5)
        points = rng.uniform(0.05, 0.95, (16, problem.space.dim))
        directions = rng.normal(size=points.shape)
        slope = jax.jit(jax.vmap(lambda u, along: jax.jvp(least, (u,), (along,))))
        slopes = slope(points, directions)[1]
        above, below = (slope(points + h * directions, directions)[0] for h in (1e-6, -1e-6))
        differences = np.asarray(above - below) / 2e-6
    np.testing.assert_allclose(slopes, differences, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_fewer_collisions_with_more_notice_and_none_with_enough():
    curve = specs.collisions([0.0, 0.5, 1.0, 1.5, 2.0, 4.0], samples=4096, seed=11)
    assert curve["share"].is_monotonic_decreasing
    # Measured with 10 000 samples of another seed.
    for notice, share in ((0.0, 0.321), (0.5, 0.240), (1.0, 0.126), (1.5, 0.0189)):
        row = curve.loc[notice]
        assert row["low"] - 0.005 < share < row["high"] + 0.005
    assert (curve.loc[[2.0, 4.0], "collisions"] == 0).all()
    assert (curve.loc[[2.0, 4.0], "worst_gap"] > 0.2).all()


@pytest.mark.proves
def test_a_search_needs_more_notice_than_samples_do_and_finds_none_beyond():
    found = specs.failing_notices(floor=1.7, step=0.05)
    longest = found["longest"].max()
    assert 1.8 < longest < 1.97
    assert found["collisions"].iloc[-1] == 0
    # Ten thousand samples hardly ever see these.
    assert specs.collisions([longest], samples=10_000, seed=3)["share"].iloc[0] < 1e-3


@pytest.mark.proves
def test_the_scenes_of_the_scenic_program_have_the_same_curve():
    pytest.importorskip("scenic")
    notices = [0.0, 0.5, 1.0, 1.5, 2.0]
    samples = 8192
    ours = specs.collisions(notices, samples=samples)["collisions"]
    theirs = specs.collisions(notices, samples=samples, seed=100, problem=specs.from_scenic())
    for one, other in zip(ours, theirs["collisions"], strict=True):
        table = [[one, samples - one], [other, samples - other]]
        # Corrected for five tests, at one false alarm in a hundred.
        assert fisher_exact(table)[1] > 0.01 / len(notices)


@pytest.mark.slow
def test_most_collisions_happen_between_cars_that_hide_each_other():
    both = vj.Problem(
        "both", specs.views, model.tempe(), {"safe": specs.SAFE, "premise": specs.PREMISE}
    )
    run = vj.falsify(
        specs.warned(0.0, both), "uniform", 4096, batch=4096, confirm=False, progress=False
    )
    table = run.table.all
    crashed = table[table["rho.safe"] < 0]
    assert (crashed["rho.premise"] > 0).mean() > 0.75
    assert run.notes == ()


@pytest.mark.thorough
def test_a_picture_shows_both_cars_and_the_stopped_traffic():
    signals = {name: jnp.zeros(2) for name in ("turning_x", "turning_heading", "ego_x")}
    signals |= {"gap": jnp.array([3.0, -1.0]), "visible": jnp.array([-1.0, 1.0])}
    signals |= {"ego_y": jnp.array([-20.0, -3.0]), "turning_y": jnp.array([9.0, 0.0])}
    signals |= {"ego_heading": jnp.full(2, math.pi / 2)}
    trace = vj.Trace(signals, dt=0.04)
    titles = []
    for sample in (0, 1):
        axes = new_figure(figsize=(4, 5)).subplots()
        model.PICTURE(axes, trace, sample, specs.tempe.nominal)
        titles.append(axes.get_title())
    assert "hidden" in titles[0]
    assert "in sight  collision" in titles[1]
    # Two lanes of stopped cars, two that move with a windscreen each, two roads.
    assert len(axes.patches) == 2 * model.STANDING + 4 + 2
