"""The road world: paths, bodies, sight, drivers, and the four situations of `specs/road.py`."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import verifai_jax as vj
from envs import road
from envs.road import scenarios
from specs import road as specs
from verifai_jax.core.values.waveform import Waveform
from verifai_jax.pictures.style import new_figure
from verifai_jax.search import PointList

KEY = jax.random.key(0)
PROBLEMS = {name: p for name in dir(specs) if isinstance(p := getattr(specs, name), vj.Problem)}


@pytest.fixture
def double():
    with jax.enable_x64():
        yield


def corners(body, x, y, heading):
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    half = [(s * body.length / 2 + body.ahead, t * body.width / 2) for s, t in SQUARE]
    return np.array(half) @ turn.T + (x, y)


SQUARE = [(1, 1), (-1, 1), (-1, -1), (1, -1)]


def true_distance(a, b):
    """Distance of two convex polygons `[n, 2]`, 0 where they overlap: of a corner to a side."""
    if not separated(a, b):
        return 0.0
    best = np.inf
    for points, polygon in ((a, b), (b, a)):
        for p in points:
            for q, r in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
                t = np.clip((p - q) @ (r - q) / ((r - q) @ (r - q)), 0, 1)
                best = min(best, np.linalg.norm(p - q - t * (r - q)))
    return best


def separated(a, b):
    for polygon in (a, b):
        for q, r in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            normal = np.array([r[1] - q[1], q[0] - r[0]])
            if (a @ normal).max() < (b @ normal).min() or (b @ normal).max() < (a @ normal).min():
                return True
    return False


class TestPaths:
    def test_lines_and_arcs_are_where_geometry_puts_them(self):
        path = road.Path.start(1.0, 2.0, math.pi / 2).straight(10.0).turn(5.0, -math.pi / 2)
        assert path.length == pytest.approx(10 + 2.5 * math.pi)
        at = jax.jit(path.pose)(jnp.array([-1.0, 0.0, 10.0, path.length, path.length + 3]))
        np.testing.assert_allclose(at.x, [1, 1, 1, 6, 9], atol=1e-5)
        np.testing.assert_allclose(at.y, [1, 2, 12, 17, 17], atol=1e-5)
        np.testing.assert_allclose(at.heading, np.array([1, 1, 1, 0, 0]) * np.pi / 2, atol=1e-6)
        beside = jax.jit(lambda s: path.pose(s, 2.0))(jnp.float32(path.length))
        np.testing.assert_allclose((beside.x, beside.y), (6, 19), atol=1e-5)
        bends = jax.jit(path.curvature)(jnp.array([5.0, 12.0, 99.0]))
        np.testing.assert_allclose(bends, [0, -0.2, 0])

    @pytest.mark.slow
    def test_speed_along_a_path_is_one_everywhere(self, double):
        path = road.Path.start(0.0, 0.0, 0.3).straight(4.0).turn(6.0, 2.0).turn(3.0, -1.0)
        at = jnp.linspace(-3.0, path.length + 3.0, 40)
        moved = jax.vmap(jax.jacfwd(lambda s: jnp.stack(path.pose(s)[:2])))(at)
        heading = path.pose(at).heading
        expected = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        np.testing.assert_allclose(moved, expected, atol=1e-12)

    def test_through_points(self):
        points = [(0.0, 0.0), (3.0, 4.0), (3.0, 10.0), (-1.0, 10.0)]
        path = road.Path.through(points)
        assert path.length == pytest.approx(5 + 6 + 4)
        at = jax.jit(path.pose)(jnp.array([0.0, 5.0, 11.0, 15.0, 16.0]))
        np.testing.assert_allclose(np.stack([at.x, at.y], 1), [*points, (-2, 10)], atol=1e-5)
        np.testing.assert_allclose(at.heading[1:], np.pi * np.array([0.5, 1, 1, 1]), atol=1e-6)

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: road.Path.through([(0, 0)]), "at least two points; got"),
            (lambda: road.Path.through([(0, 0), (0, 0)]), r"stands still at \(0, 0\)"),
            (lambda: road.Path.start(0, 0).straight(0.0), "longer than 0 m; got 0.0"),
            (lambda: road.Path.start(0, 0).turn(-3.0, 1.0), "must be positive; got -3.0"),
        ],
    )
    def test_what_cannot_work_is_refused_with_the_reason(self, make, message):
        with pytest.raises(ValueError, match=message):
            make()


class TestBodies:
    @pytest.mark.thorough
    def test_gap_is_the_distance_of_the_boxes_and_discs_come_near(self):
        rng = np.random.default_rng(0)
        at = rng.uniform([-9, -9, -4, -9, -9, -4], [9, 9, 4, 9, 9, 4], (300, 6)).astype("f4")
        bodies = (road.CAR, scenarios.BICYCLE_CAR)

        @jax.jit
        def gaps(at):
            a, b = road.Pose(*at.T[:3]), road.Pose(*at.T[3:])
            sides = (a, bodies[0], b, bodies[1])
            smooth = road.disc_gap(*sides, temperature=0.05)
            return road.gap(*sides), road.disc_gap(*sides), smooth

        exact, discs, smooth = map(np.asarray, gaps(at))
        boxes = [
            [corners(body, *p) for p in half]
            for body, half in zip(bodies, (at[:, :3], at[:, 3:]), strict=True)
        ]
        true = np.array([true_distance(a, b) for a, b in zip(*boxes, strict=True)])
        apart = true > 0
        assert 50 < apart.sum() < 290
        np.testing.assert_allclose(exact[apart], true[apart], atol=2e-3)
        # Shifted apart by its depth along the best side, an overlapping pair touches.
        assert np.all(exact[~apart] < 0)
        for i in np.flatnonzero(~apart)[:40]:
            a, b = boxes[0][i], boxes[1][i]
            shifts = [
                side / np.linalg.norm(side)
                for box in (a, b)
                for side in np.roll(box, -1, axis=0) - box
            ]
            less, more = (
                any(separated(a, b + scale * -exact[i] * shift) for shift in shifts)
                for scale in (0.99, 1.01)
            )
            assert (less, more) == (False, True)
        assert np.all(discs[apart] <= true[apart] + 1e-5)
        assert np.all(discs[apart] >= true[apart] - sum(body.bulge for body in bodies) - 1e-5)
        assert np.all(smooth <= discs + 1e-5)
        assert np.all(smooth >= discs - 0.05 * np.log(16) - 1e-5)

    def test_corners_are_those_of_the_box(self):
        corner = jax.jit(lambda *pose: scenarios.BICYCLE_CAR.corners(road.Pose(*pose)))
        got = np.array(corner(1.0, 2.0, 0.7))
        expected = corners(scenarios.BICYCLE_CAR, 1.0, 2.0, 0.7)
        np.testing.assert_allclose(sorted(got.tolist()), sorted(expected.tolist()), atol=1e-5)

    @pytest.mark.thorough
    def test_a_view_is_hidden_where_some_point_of_it_is_in_the_box(self):
        rng = np.random.default_rng(1)
        ends = rng.uniform(-8, 8, (500, 4)).astype("f4")
        pose = rng.uniform([-2, -2, -4], [2, 2, 4], (500, 3)).astype("f4")
        got = road.sight(
            (ends[:, 0], ends[:, 1]), (ends[:, 2], ends[:, 3]), road.Pose(*pose.T), road.VAN
        )
        box = np.array([corners(road.VAN, *p) for p in pose])
        hidden = np.array(
            [
                not separated(np.stack([e[:2], e[2:]]).astype(float), b)
                for e, b in zip(ends, box, strict=True)
            ]
        )
        near = np.abs(got) < 1e-4
        assert 100 < hidden.sum() < 400
        np.testing.assert_array_equal((np.asarray(got) < 0)[~near], hidden[~near])

    def test_a_view_beside_a_box_misses_it_by_the_distance(self):
        place = road.Pose(0.0, 0.0, 0.0)
        misses = jax.jit(lambda y: road.sight((-10.0, y), (10.0, y), place, road.VAN))
        assert float(misses(2.5)) == pytest.approx(1.5, abs=1e-5)


class TestDrivers:
    def test_the_equilibrium_gap_is_kept(self):
        driver = road.Driver(speed=33.0, headway=1.3)
        speed = jnp.array([3.0, 10.0, 25.0, 32.0])
        space = jax.jit(partial(road.equilibrium_gap, driver=driver))(speed)
        kept = jax.jit(partial(road.idm, driver=driver))(speed, space, speed)
        np.testing.assert_allclose(kept, 0, atol=2e-6)
        by_hand = (2 + 1.3 * 25) / math.sqrt(1 - (25 / 33) ** 4)
        assert float(space[2]) == pytest.approx(by_hand, rel=1e-6)

    def test_idm_on_a_free_road_and_at_its_limits(self):
        driver = road.Driver(speed=20.0, acceleration=1.5, hardest=7.0)
        speed = jnp.array([0.0, 10.0, 20.0, 20.0, 20.0])
        space = jnp.array([np.inf, np.inf, np.inf, 1.0, -3.0])
        got = jax.jit(lambda v, s: road.idm(v, s, 0.0, driver))(speed, space)
        np.testing.assert_allclose(got, [1.5, 1.5 * (1 - 0.5**4), 0, -7, -7], atol=1e-6)

    def test_cruise_control_is_the_idm_where_that_is_milder_and_cooler_where_not(self):
        driver = road.Driver(speed=30.0)
        # Far; a cut-in at the same speed, which is no danger; a leader that stands.
        speed, space = jnp.array([25.0, 25.0, 20.0]), jnp.array([80.0, 15.0, 40.0])
        leader = jnp.array([25.0, 25.0, 0.0])

        @jax.jit
        def both(speed):
            cool = partial(road.cruise_control, leader_acceleration=0.0, driver=driver)
            slope = jax.vmap(jax.grad(cool))(speed, space, leader)
            return cool(speed, space, leader), road.idm(speed, space, leader, driver), slope

        cool, plain, slope = map(np.asarray, both(speed))
        assert cool[0] == pytest.approx(plain[0])
        assert plain[1] < -5
        assert -2.1 < cool[1] < -1
        # v^2 / (2 s) at least.
        assert cool[2] < -5
        assert np.isfinite(slope).all()

    def test_mobil_weighs_others_by_politeness(self):
        assert road.mobil(0.5, -1.0, politeness=0.2, threshold=0.1) == pytest.approx(0.2)
        assert road.mobil(0.5, -1.0, politeness=1.0, threshold=0.1) < 0

    def test_lane_changes_are_smooth_and_whole(self):
        time = jnp.linspace(0.0, 5.0, 101)
        done, rate = jax.jit(lambda t: road.lane_change(t, 1.0, 3.0))(time)
        assert float(done[0]) == 0
        assert float(done[-1]) == 1
        np.testing.assert_allclose(done[50], 0.5, atol=1e-6)
        np.testing.assert_allclose(np.gradient(done, time), rate, atol=2e-3)


class TestCars:
    @pytest.mark.slow
    def test_a_steered_car_stays_on_an_arc_and_comes_back_to_it(self, double):
        path = road.Path.start(0.0, 0.0).turn(40.0, 4.0)

        def after(offset):
            def rates(time, car, control, features):
                bend = path.curvature(car.distance)
                return road.bicycle(car, road.steering(car, 0.0, curvature=bend), 0.0, bend)

            start = road.Car(1.0, offset, 0.0, 8.0)
            return vj.ode(rates, lambda f, key=None: start, dt=0.04, duration=12.0)({}, KEY)

        kept, back = after(jnp.float64(0.0)), after(jnp.float64(1.0))
        np.testing.assert_allclose(kept["offset"], 0, atol=1e-9)
        pose = road.Car(*(kept[name] for name in road.Car._fields)).pose(path)
        np.testing.assert_allclose(np.hypot(pose.x, pose.y - 40), 40, rtol=1e-9)
        assert abs(float(back["offset"][-1])) < 1e-3
        assert float(back["offset"].min()) > -0.1

    @pytest.mark.thorough
    def test_a_stopped_car_stays(self):
        def rates(time, car, control, features):
            return road.bicycle(car, 0.0, -4.0)

        start = road.Car(0.0, 0.0, 0.0, 8.0)
        trace = vj.ode(rates, lambda f, key=None: start, dt=0.04, duration=4.0)({}, KEY)
        np.testing.assert_allclose(trace["distance"][-40:], 8.0, rtol=3e-3)


@pytest.mark.thorough
def test_platoon_in_equilibrium_keeps_its_gaps():
    trace = road.following(duration=2.0)({"speed0": 20.0, "headways": (0.9, 1.2, 1.5)}, KEY)
    for name, headway in zip(("gap_1", "gap_2", "gap_3"), (0.9, 1.2, 1.5), strict=True):
        kept = (2 + 20 * headway) / math.sqrt(1 - (1 / 1.2) ** 4)
        np.testing.assert_allclose(trace[name], kept, rtol=1e-5)


@pytest.mark.thorough
def test_platoon_agrees_with_an_independent_simulation(double):
    speed0, headways, lag, hardest = 25.0, np.array([0.9, 1.1, 1.4]), 0.5, 7.0
    knots = np.array([0.0, -6.0, 2.0])

    def wanted(space, v, leader):
        wish = 2 + np.maximum(v * headways + v * (v - leader) / (2 * math.sqrt(1.4 * 2)), 0)
        return np.maximum(1.4 * (1 - (v / 30) ** 4 - (wish / space) ** 2), -hardest)

    def rates(t, s, lead):
        x, v, a = s[:4], s[4:8], s[8:]
        jerk = (wanted(x[:-1] - x[1:] - 4.7, v[1:], v[:-1]) - a) / lag
        return np.concatenate([v, [lead], a, jerk])

    gaps = (2 + speed0 * headways) / math.sqrt(1 - (25 / 30) ** 4)
    behind = np.concatenate([[0], np.cumsum(gaps + 4.7)])
    state = np.concatenate([-behind, np.full(4, speed0), np.zeros(3)])
    expected = [gaps]
    for lead in knots:
        piece = solve_ivp(
            partial(rates, lead=lead), (0, 2), state, rtol=1e-9, t_eval=np.arange(1, 51) * 0.04
        )
        expected += list((piece.y[:3] - piece.y[1:4] - 4.7).T)
        state = piece.y[:, -1]
    lead = Waveform(jnp.asarray(knots), hold="constant", duration=6.0)
    features = {
        "speed0": jnp.float64(speed0),
        "headways": headways,
        "lag": lag,
        "hardest": hardest,
        "lead_acceleration": lead,
    }
    trace = road.following(duration=6.0)(features, KEY)
    got = np.stack([trace[f"gap_{i}"] for i in (1, 2, 3)], axis=1)
    np.testing.assert_allclose(got, expected, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["platoon", "cut_in", "pedestrian"])
def test_gradients_are_finite_differences(name, double):
    """Of the least gap, along random directions."""
    problem = PROBLEMS[name]

    def least(u):
        return jnp.min(problem.system(problem.space.unflatten(u), KEY)["gap"])

    rng = np.random.default_rng(2)
    points = rng.uniform(0.1, 0.9, (12, problem.space.dim))
    directions = rng.normal(size=points.shape)
    slope = jax.jit(jax.vmap(lambda u, along: jax.jvp(least, (u,), (along,))))
    slopes = slope(points, directions)[1]
    above, below = (slope(points + h * directions, directions)[0] for h in (1e-6, -1e-6))
    np.testing.assert_allclose(slopes, (above - below) / 2e-6, rtol=1e-3, atol=1e-3)
    assert np.abs(slopes).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_nominal_is_safe_and_failures_are_there_but_rare(name):
    problem = PROBLEMS[name]
    space = problem.space
    nominal = space.flatten(space.coerce(problem.nominal))
    points = np.random.default_rng(0).uniform(size=(4095, space.dim))
    run = vj.falsify(
        problem,
        PointList(np.vstack([nominal, points])),
        4096,
        batch=4096,
        progress=False,
        confirm=False,
    )
    table = run.table.all
    assert set(table.status) == {"ok"}
    assert not table.violated[0]
    assert table.rho[0] > 0.05
    assert 1 <= table.violated.sum() <= 0.1 * len(table)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["pedestrian", pytest.param("platoon", marks=pytest.mark.thorough)]
)
def test_a_picture_shows_the_bodies_and_turns_red_from_a_collision_on(name):
    problem = PROBLEMS[name]
    clock = np.arange(3)
    signals = {"gap": np.array([2.0, -0.1, 1.0]), "visible": np.array([-1.0, -1.0, 0.5])}
    for i, body in enumerate(problem.draw.bodies):
        signals |= {f"{body}_x": 10.0 * i + clock, f"{body}_y": 0.0 * clock}
        signals |= {f"{body}_heading": 0.0 * clock, f"{body}_speed": 1.0 + clock}
    trace = vj.Trace({name: jnp.asarray(value) for name, value in signals.items()}, dt=1.0)
    titles, counts = [], []
    for sample in range(3):
        axes = new_figure(figsize=(5, 2)).subplots()
        problem.draw(axes, trace, sample, problem.nominal)
        titles.append(axes.get_title())
        counts.append(len(axes.patches))
    assert ["collision" in title for title in titles] == [False, True, True]
    assert counts[0] >= len(problem.draw.lanes) + len(problem.draw.bodies)
    if name == "pedestrian":
        assert ["hidden" in title for title in titles] == [True, True, False]
