"""shrink: least departures that are known in closed form, from many starts, in few simulations."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.counterexamples import Shrunk, shrink
from verifai_jax.counterexamples.fixed_key import fix_key, key_of
from verifai_jax.counterexamples.nominal import Nominal
from verifai_jax.statistics.shortest_vector import shortest_in_box


def problem_of(name, d, rho, nominal=None, black_box=False, space=None):
    """Robustness `rho(u)` over `d` features from -2 to 6, as a system of one signal."""
    names = [f"x{i}" for i in range(d)]
    space = space or vj.FeatureSpace({n: vj.Box(-2.0, 6.0) for n in names})

    def system(features, key):
        u = jnp.stack([(features[n] + 2) / 8 for n in names])
        return vj.Trace({"m": jnp.full((2,), rho(u))}, dt=1.0)

    if black_box:
        compiled = jax.jit(rho)

        def simulate(features):
            u = np.array([(features[n] + 2) / 8 for n in names], np.float32)
            return vj.Trace({"m": np.full(2, np.asarray(compiled(u)))}, dt=1.0)

        system = vj.blackbox(simulate)
    at = [0.5] * d if nominal is None else nominal
    usual = {n: 8 * v - 2 for n, v in zip(names, at, strict=True)}
    return vj.Problem(name, space, system, "always m >= 0", nominal=usual)


def two_modes(u):
    """A large ball far away, a small one near."""
    far = jnp.linalg.norm(u - 0.85 + 1e-9) - 0.2 * math.sqrt(len(u))
    near = jnp.linalg.norm(u - jnp.array([0.2, *[0.5] * (len(u) - 1)]) + 1e-9) - 0.1
    return jnp.minimum(far, near)


def edge(u):
    """Where two half-spaces meet, and a third feature does not matter."""
    return jnp.maximum(0.8 - u[0], 0.3 * (0.75 - u[1]))


def half(a, b):
    a = jnp.asarray(a, jnp.float32)
    return lambda u: b - a @ (u - 0.5)


def fewest_of_half(a, b):
    """The least count and, with so many, the least distance to `a v > b` in the cube's halves."""
    size = np.sort(np.abs(a))[::-1]
    count = int(np.argmax(np.cumsum(size) * 0.5 >= b)) + 1
    top, low, high = size[:count], 0.0, 1e3
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if top @ np.minimum(middle * top, 0.5) < b else (low, middle)
    return count, float(np.linalg.norm(np.minimum(high * top, 0.5)))


def starts(run, count, seed=0):
    failing = run.table.counterexamples.index
    return np.random.default_rng(seed).choice(failing, min(count, len(failing)), replace=False)


def checked(run, row, few, small, budget=2000, seed=0, others=True):
    """Both orders, against the known minimum; every result fails when simulated again."""
    for by, (count, distance) in (("count", few), ("distance", (None, small))):
        found = shrink(run, int(row), by=by, budget=budget, seed=seed, others=others)
        assert found.simulations <= budget
        assert found.rho <= 0
        assert found.replay().violated
        assert found.replay("float64").violated
        assert found.distance <= 1.05 * distance
        assert found.distance >= 0.999 * distance
        if count is not None:
            assert found.count == count


EDGE = (2, math.hypot(0.3, 0.25))


@pytest.fixture(scope="module")
def edges():
    return vj.falsify(problem_of("edge", 3, edge), "uniform", 512, batch=512, progress=False)


@pytest.mark.slow
def test_the_edge_of_two_half_spaces(edges):
    for seed, row in enumerate(starts(edges, 3)):
        checked(edges, row, EDGE, EDGE[1], seed=seed)
        checked(edges, row, EDGE, EDGE[1], seed=seed, others=False, budget=600)


@pytest.mark.slow
def test_what_it_says(edges):
    found = shrink(edges)
    assert isinstance(found, Shrunk)
    assert found.row == edges.best.name
    text = str(found)
    assert "edge: 2 of 3 features away from nominal are enough for a failure, by 0.39" in text
    assert "x0  2 -> 4.4" in text
    assert f"row {found.row} departed in 3 of 3 features" in text
    assert list(found.changed) == ["x0", "x1"]
    assert found.changed["x1"] == pytest.approx((2.0, 4.0), rel=0.01)
    assert found.start_distance > found.distance
    steps = [step.simulations for step in found.history]
    assert steps == sorted(steps)
    assert found.history[-1].count == 2
    assert float(found.features["x2"]) == 2.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same(edges):
    one, two = shrink(edges, seed=3, budget=300), shrink(edges, seed=3, budget=300)
    np.testing.assert_array_equal(one.u, two.u)


@pytest.mark.thorough
def test_another_row_compiles_nothing(edges):
    one, other = starts(edges, 2)
    shrink(edges, int(one), seed=5)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **about: compiled.append((event, about.get("fun_name")))
    )
    found = shrink(edges, int(other), seed=6)
    found.replay()
    assert [name for event, name in compiled if event.endswith("backend_compile_duration")] == []


@pytest.mark.thorough
def test_a_few_simulations_do_not_make_it_safe(edges):
    for budget in (1, 5, 20):
        found = shrink(edges, budget=budget)
        assert found.simulations <= budget
        assert found.replay().violated


@pytest.mark.thorough
def test_another_nominal(edges):
    found = shrink(edges, nominal={"x0": 5.0})
    assert list(found.changed) == ["x1"]
    already = shrink(edges, nominal={"x0": 5.0, "x1": 5.0})
    assert already.count == 0
    assert "the nominal features fail themselves" in str(already)


@pytest.mark.slow
def test_each_kind_by_itself():
    problem = problem_of("sides", 2, lambda u: jnp.where(u[0] > 0.5, 0.8 - u[0], u[0] - 0.4))
    run = vj.simulate(problem, [{"x0": 5.5, "x1": 5.0}, {"x0": -1.0, "x1": 0.0}], progress=False)
    assert shrink(run, 0, budget=200).changed["x0"][1] == pytest.approx(1.2, rel=0.01)
    there = shrink(run, 0, budget=200, stay=True)
    assert there.changed["x0"][1] == pytest.approx(4.4, rel=0.01)
    assert shrink(run, 1, budget=200, stay=True).changed["x0"][1] == pytest.approx(1.2, rel=0.01)


@pytest.mark.thorough
def test_what_cannot_work_is_refused_with_the_reason(edges):
    safe = int(edges.table.safe.index[0])
    with pytest.raises(ValueError, match=rf"row {safe} is not a counterexample: status ok"):
        shrink(edges, safe)
    with pytest.raises(IndexError, match="row 512 is not in the table of 512 simulations"):
        shrink(edges, 512)
    message = "unknown order 'distanc'; did you mean 'distance'"
    with unchecked(), pytest.raises(UnknownNameError, match=message):
        shrink(edges, by="distanc")
    with pytest.raises(ValueError, match="budget must be an integer of at least 1; got 0"):
        shrink(edges, budget=0)
    with pytest.raises(UnknownNameError, match="option of shrink 'nominl'; did you mean 'nominal'"):
        shrink(edges, nominl={})
    with pytest.raises(UnknownNameError, match="unknown feature 'x9'"):
        shrink(edges, nominal={"x9": 1.0})
    with unchecked(), pytest.raises(TypeError, match="a run of falsify is needed; got str"):
        shrink("run")
    nameless = replace(edges, problem=replace(edges.problem, nominal=None))
    with pytest.raises(ValueError, match="does not say what is nominal for x0, x1, x2; give it"):
        shrink(nameless)
    with pytest.raises(ValueError, match="loaded without its problem"):
        shrink(replace(edges, problem=None))


def test_a_row_that_no_longer_fails_is_said(edges):
    fixed = replace(edges, problem=problem_of("edge", 3, lambda u: 1.0 + 0 * u[0]))
    with pytest.raises(ValueError, match="does not fail when it is simulated again"):
        shrink(fixed)


def test_without_a_counterexample():
    run = vj.falsify(
        problem_of("safe", 3, lambda u: 1.0 + 0 * u[0]), "uniform", 16, batch=16, progress=False
    )
    with pytest.raises(ValueError, match="has no counterexample in 16 simulations"):
        shrink(run)


@pytest.mark.slow
def test_choices_integers_and_a_constraint():
    space = vj.FeatureSpace(
        {
            "x": vj.Box(0.0, 1.0),
            "gear": vj.DiscreteBox(1, 9),
            "mode": vj.Categorical("eco", "sport", "race"),
        },
        where=lambda f: f["x"] <= 0.9,
    )

    def system(features, key):
        gear = features["gear"].astype(jnp.float32)
        rho = jnp.maximum(0.6 - features["x"], 0.2 * (6.0 - gear))
        rho = jnp.where(features["mode"] == 0, rho + 0.0, rho)
        return vj.Trace({"m": jnp.full((2,), rho)}, dt=1.0)

    nominal = {"x": 0.2, "gear": 3, "mode": "eco"}
    problem = vj.Problem("mixed", space, system, "always m > 0", nominal=nominal)
    run = vj.falsify(problem, "uniform", 256, batch=256, progress=False)
    found = shrink(run, budget=800)
    assert set(found.changed) == {"x", "gear"}
    assert found.changed["gear"] == (3, 6)
    assert found.changed["x"][1] == pytest.approx(0.6, rel=0.01)
    assert found.distance == pytest.approx(math.hypot(0.4, 3 / 8), rel=0.02)
    assert found.replay().violated


@pytest.mark.slow
def test_a_black_box_without_gradients():
    problem = problem_of("box", 3, half([0.8, 0.6, 0.0], 0.3), black_box=True)
    run = vj.falsify(problem, "uniform", 64, batch=64, progress=False)
    checked_run = shrink(run, by="distance", budget=600)
    assert checked_run.distance == pytest.approx(0.3, rel=0.05)
    assert checked_run.replay().violated
    few = shrink(run, budget=600)
    assert (few.count, few.distance) == (1, pytest.approx(0.375, rel=0.05))


@pytest.mark.slow
def test_a_system_that_draws_is_simulated_with_the_key_of_the_row():
    def system(features, key):
        lucky = jax.random.uniform(key)
        return vj.Trace({"m": jnp.full((2,), 0.5 + lucky - features["x"])}, dt=1.0)

    problem = vj.Problem("luck", {"x": vj.Box(0.0, 2.0)}, system, "always m >= 0", {"x": 0.0})
    run = vj.falsify(problem, "uniform", 64, batch=64, progress=False)
    row = int(run.table.counterexamples.index[0])
    found = shrink(run, row, budget=300)
    lucky = float(jax.random.uniform(key_of(run, row)))
    assert found.changed["x"][1] == pytest.approx(0.5 + lucky, rel=0.01)
    assert found.replay().violated
    keyed = fix_key(problem, run, row)
    traces = [keyed.system({"x": 0.0}, jax.random.key(k)) for k in range(2)]
    np.testing.assert_array_equal(traces[0].signals["m"], traces[1].signals["m"])
    still = problem_of("still", 2, lambda u: u[0])
    assert fix_key(still, run, row) is still


def test_the_nearest_point_of_half_spaces():
    rows, levels = np.array([[-1.0, 0.0], [0.0, -2.0]]), np.array([-0.3, -0.4])
    found = shortest_in_box(rows, levels, np.full(2, -1.0), np.full(2, 1.0))
    np.testing.assert_allclose(found, [0.3, 0.2], atol=1e-9)
    assert shortest_in_box(rows, np.array([-2.0, 0.0]), np.full(2, -1.0), np.full(2, 1.0)) is None
    slanted = np.array([[-3.0, -4.0]])
    np.testing.assert_allclose(
        shortest_in_box(slanted, np.array([-1.0]), np.full(2, -1.0), np.full(2, 1.0)), [0.12, 0.16]
    )
    capped = shortest_in_box(slanted, np.array([-1.0]), np.full(2, -1.0), np.array([1.0, 0.1]))
    np.testing.assert_allclose(capped, [0.2, 0.1], atol=1e-9)


@pytest.mark.thorough
def test_departures_from_nominal_are_counted():
    space = {"x": vj.Box(0.0, 10.0), "n": vj.DiscreteBox(0, 4), "c": vj.Categorical("a", "b", "c")}
    problem = vj.Problem(
        "p", space, lambda f, k: vj.Trace({"m": jnp.zeros(2)}, dt=1.0), "m >= 0",
        nominal={"x": 5.0, "n": 1, "c": "a"},
    )  # fmt: skip
    nominal = Nominal.of(problem)
    far = np.asarray(problem.space.flatten({"x": 8.0, "n": 4, "c": "c"}))[None]
    points = nominal.settle(np.concatenate([far, nominal.u[None]]))
    np.testing.assert_allclose(nominal.gaps(points)[0], [0.3, 0.75, 1.0], atol=1e-6)
    assert nominal.count(points).tolist() == [3, 0]
    assert nominal.distance(points)[1] == 0
    assert [name for name, _ in nominal.groups] == ["x", "n", "c"]


@pytest.mark.slow
def test_the_command(edges, tmp_path):
    from verifai_jax.cli.shrink import shrink as command

    (tmp_path / "mine.py").write_text(
        "import verifai_jax as vj\nimport jax.numpy as jnp\n"
        "def system(f, key):\n"
        "    return vj.Trace({'m': jnp.full((2,), 0.7 - f['x'])}, dt=1.0)\n"
        "p = vj.Problem('p', {'x': vj.Box(0.0, 1.0), 'y': vj.Box(0.0, 1.0)}, system,"
        " 'always m >= 0', nominal={'x': 0.2, 'y': 0.5})\n"
    )
    from verifai_jax.core.user_code.targets import load_target

    target = f"{tmp_path / 'mine.py'}:p"
    run = vj.falsify(load_target(target, vj.Problem), "uniform", 64, batch=64, progress=False)
    run.save(tmp_path / "run")
    done = CliRunner().invoke(
        command, [str(tmp_path / "run"), "--problem", target, "--budget", "200"]
    )
    assert done.exit_code == 0, done.output
    assert "p: 1 of 2 features away from nominal is enough for a failure" in done.output
    assert (tmp_path / "run" / f"shrunk-{run.best.name}.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 5, 10, 20])
def test_half_spaces(d):
    a = np.random.default_rng(d).normal(size=d)
    a /= np.linalg.norm(a)
    run = vj.falsify(
        problem_of("half", d, half(a, 0.3)), "uniform", 2048, batch=2048, progress=False
    )
    for seed, row in enumerate(starts(run, 5)):
        checked(run, row, fewest_of_half(a, 0.3), 0.3, seed=seed, others=seed % 2 == 0)


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 4, 6])
def test_the_nearer_of_two_modes(d):
    run = vj.falsify(problem_of("modes", d, two_modes), "uniform", 4096, batch=4096, progress=False)
    for seed, row in enumerate(starts(run, 5)):
        checked(run, row, (1, 0.2), 0.2, seed=seed, others=seed % 2 == 0)


@pytest.mark.slow
def test_curved_boundaries():
    def ball(u):
        return jnp.linalg.norm(u - jnp.array([0.8, 0.75, 0.5, 0.5, 0.5]) + 1e-9) - 0.14

    away = math.hypot(0.3, 0.25) - 0.14
    run = vj.falsify(problem_of("ball", 5, ball), "uniform", 16384, batch=4096, progress=False)
    for seed, row in enumerate(starts(run, 5)):
        checked(run, row, (2, away), away, seed=seed, others=seed % 2 == 0)

    def outside(u):
        v = (u - 0.5) / jnp.linspace(0.2, 0.45, len(u))
        return 1 - jnp.sqrt(v @ v + 1e-12)

    run = vj.falsify(problem_of("outside", 6, outside), "uniform", 512, batch=512, progress=False)
    for seed, row in enumerate(starts(run, 5)):
        checked(run, row, (1, 0.2), 0.2, seed=seed, others=seed % 2 == 0)


@pytest.mark.slow
def test_a_robustness_of_two_values():
    def yes_or_no(u):
        return jnp.where((u[0] > 0.75) & (u[2] < 0.3), -1.0, 1.0)

    run = vj.falsify(problem_of("sign", 5, yes_or_no), "uniform", 512, batch=512, progress=False)
    away = math.hypot(0.25, 0.2)
    for seed, row in enumerate(starts(run, 5)):
        checked(run, row, (2, away), away, seed=seed, others=seed % 2 == 0)
