"""explain: what is said of a failure whose causes are known, and what is drawn."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.counterexamples import Explained, explain
from verifai_jax.counterexamples.description import format_apart, format_spans
from verifai_jax.counterexamples.influence import Span, spans_of

SPACE = {
    "throttle": vj.Signal(vj.Box(0.0, 100.0), knots=4, hold="constant", duration=20.0),
    "brake": vj.Signal(vj.Box(0.0, 10.0), knots=2, hold="constant", duration=20.0),
    "mass": vj.Box(0.5, 1.5),
}


def drive(features, key):
    """Speed is the integral of the throttle over the mass; the brake does nothing."""
    times = jnp.arange(201) * 0.1
    throttle = features["throttle"]
    pushed = jax.vmap(throttle)(times[:200])
    speed = jnp.concatenate([jnp.zeros(1), jnp.cumsum(pushed) * 0.1]) / features["mass"]
    return vj.Trace({"speed": speed, "clock": times}, dt=0.1)


@pytest.fixture(scope="module")
def driven():
    problem = vj.Problem(
        "drive", SPACE, drive, "always[0, 18] speed < 1200",
        nominal={"throttle": 30.0, "brake": 0.0, "mass": 1.0},
    )  # fmt: skip
    rows = [
        {"throttle": [90.0, 70.0, 60.0, 50.0], "brake": [5.0, 5.0], "mass": 0.9},
        {"throttle": [40.0, 40.0, 40.0, 40.0], "brake": [5.0, 5.0], "mass": 1.0},
    ]
    return vj.simulate(problem, rows, batch=2, progress=False)


@pytest.fixture(scope="module")
def explained(driven):
    return explain(driven)


@pytest.mark.slow
def test_the_predicate_the_instant_and_the_features(explained):
    assert isinstance(explained, Explained)
    assert explained.row == 0
    assert str(explained.why.predicate) == "speed < 1200"
    assert explained.why.time == pytest.approx(18.0, abs=0.01)
    # 5 s each of 90, 70 and 60, and 3 s of 50, over 0.9.
    speed = (5 * 90 + 5 * 70 + 5 * 60 + 3 * 50) / 0.9
    assert explained.rho == pytest.approx(1200 - speed, rel=1e-3)
    influence = {i.name: i for i in explained.influences}
    assert influence["throttle"].gone
    assert influence["throttle"].reverted == pytest.approx(1200 - 18 * 30 / 0.9, rel=1e-3)
    assert influence["mass"].reverted == pytest.approx(1200 - 1250, rel=1e-2)
    assert not influence["mass"].gone
    assert influence["brake"].reverted == pytest.approx(explained.rho, rel=1e-5)
    assert [i.name for i in explained.matter] == ["throttle", "mass"]


@pytest.mark.thorough
def test_single_control_points_and_slopes(explained):
    throttle = next(i for i in explained.influences if i.name == "throttle")
    gains = np.array([5 * 60, 5 * 40, 5 * 30, 3 * 20]) / 0.9
    np.testing.assert_allclose(throttle.each - explained.rho, gains, rtol=1e-3)
    assert throttle.each_gone == (True, True, False, False)
    assert throttle.spans == (Span(0, 5), Span(5, 10), Span(10, 15), Span(15, 20))
    # Over the whole range of 100, in 5 s each; the last counts for 3 s.
    np.testing.assert_allclose(throttle.gradient, [-555.6, -555.6, -555.6, -333.3], rtol=0.02)
    mass = next(i for i in explained.influences if i.name == "mass")
    assert mass.gradient[0] == pytest.approx(1250 / 0.9**2, rel=0.02)


@pytest.mark.thorough
def test_the_paragraph(explained):
    text = str(explained)
    assert "Row 0 of drive breaks  always[0,18] (speed < 1200)" in text
    assert "at 18 s speed is 1389, which has to be below 1200" in text
    assert "With the signal throttle back at nominal (30) the failure vanishes" in text
    assert "Its part from 0 s to 10 s alone does it." in text
    assert "mass back at nominal (1) raises the robustness by 138.9 and is not enough" in text
    assert "brake does not matter." in text
    assert "A small change helps most in mass: more of it" in text


@pytest.mark.thorough
def test_without_nominal_features(driven):
    bare = replace(driven, problem=replace(driven.problem, nominal=None))
    why = explain(bare)
    assert "does not say what is nominal: only gradients tell what matters" in str(why)
    assert why.influences[0].name == "mass"
    assert np.isnan(why.influences[0].reverted)
    assert why.plot() is not None


def test_what_cannot_work_is_refused_with_the_reason(driven):
    with pytest.raises(ValueError, match="row 1 is not a counterexample: status ok"):
        explain(driven, 1)
    with pytest.raises(ValueError, match="unknown feature 'mas'; did you mean 'mass'"):
        explain(driven, nominal={"mas": 1.0})


@pytest.mark.thorough
def test_pictures_are_drawn_and_written(explained, tmp_path):
    figure = explained.plot(tmp_path / "why.png")
    assert (tmp_path / "why.png").stat().st_size > 10_000
    labels = [axes.get_ylabel() for axes in figure.get_axes()]
    assert labels[:3] == ["speed", "throttle", "brake"]
    bars = figure.get_axes()[-1]
    assert [t.get_text() for t in bars.get_yticklabels()] == ["throttle", "mass", "brake"]


@pytest.mark.thorough
def test_an_absolute_value_over_two_formulas_and_a_black_box():
    def simulate(features):
        x = features["x"] * np.linspace(0, 1, 11)
        return vj.Trace({"x": x, "y": np.zeros(11)}, dt=0.1)

    problem = vj.Problem(
        "two", {"x": vj.Box(-1.0, 1.0), "z": vj.Box(0.0, 1.0)}, vj.blackbox(simulate),
        {"near": "always abs(x) <= 0.5", "there": "eventually[0, 1] y >= 0"},
        nominal={"x": 0.0, "z": 0.5},
    )  # fmt: skip
    run = vj.simulate(problem, [{"x": -0.9, "z": 0.7}], progress=False)
    why = explain(run)
    assert why.formula == "near"
    text = str(why)
    assert "at 1 s abs(x) is 0.9, which may be at most 0.5" in text
    assert "With x back at nominal (0) the failure vanishes" in text
    assert "z does not matter" in text
    assert "A small change" not in text
    assert why.plot() is not None


def test_numbers_and_spans_are_written_so_that_they_differ():
    assert format_apart(120.0004, 120.0) == ("120.0004", "120")
    assert format_apart(1.0, 2.0) == ("1", "2")
    assert format_spans([Span(0, 5), Span(5, 10), Span(15, 20)]) == (
        "from 0 s to 10 s and from 15 s to 20 s"
    )
    linear = vj.Signal(vj.Box(0.0, 1.0), knots=3, hold="linear")
    assert spans_of(linear, 4.0) == (Span(0, 2), Span(0, 4), Span(2, 4))
    assert spans_of(vj.Box(0.0, 1.0), 4.0) is None


@pytest.mark.slow
def test_the_command(tmp_path):
    from verifai_jax.cli.explain import explain as command
    from verifai_jax.core.user_code.targets import load_target

    (tmp_path / "other.py").write_text(
        "import verifai_jax as vj\nimport jax.numpy as jnp\n"
        "def system(f, key):\n"
        "    return vj.Trace({'m': jnp.full((2,), 0.7 - f['x'])}, dt=1.0)\n"
        "p = vj.Problem('p', {'x': vj.Box(0.0, 1.0), 'y': vj.Box(0.0, 1.0)}, system,"
        " 'always m >= 0', nominal={'x': 0.2, 'y': 0.5})\n"
    )
    target = f"{tmp_path / 'other.py'}:p"
    run = vj.falsify(load_target(target, vj.Problem), "uniform", 64, batch=64, progress=False)
    run.save(tmp_path / "run")
    row = str(run.table.counterexamples.index[0])
    done = CliRunner().invoke(command, [str(tmp_path / "run"), row, "--problem", target])
    assert done.exit_code == 0, done.output
    assert f"Row {row} of p breaks" in done.output
    assert "y does not matter." in " ".join(done.output.split())
    assert (tmp_path / "run" / f"why-{row}.png").exists()


def test_sentences_tell_control_points_by_their_time(driven):
    assert "throttle from 5 s to 10 s=70" in driven.summary()
    assert "throttle from 5 s to 10 s=70" in str(driven.replay(0))
    text = str(vj.shrink(driven, budget=300))
    assert re.search(r"throttle from \d+ s to \d+ s +30 -> ", text)
    assert "throttle[" not in text


@pytest.mark.slow
def test_times_of_signals_are_those_of_the_whole_simulation_where_it_ends_early():
    # Over at 2.1 s of 8 s, so that of the points at 0, 2, 4, 6 and 8 s the first three matter.
    system = vj.ode(
        lambda t, s, c, f: {"x": f["w"](t)}, lambda f, key: {"x": 0.0}, dt=0.1, duration=8.0,
        terminate=lambda s, f: s["x"] > 1.05,
        signals=lambda t, s, c, f: {"x": s["x"], "seen": f["w"](t)},
    )  # fmt: skip
    space = {"w": vj.Signal(vj.Box(0.0, 1.0), knots=5)}
    problem = vj.Problem("early", space, system, "always x < 1.02", nominal={"w": 0.0})
    rows = vj.FeatureSpace(space).rows({"w": vj.Waveform(np.array([[0.0, 1.0, 1.0, 1.0, 1.0]]))})
    run = vj.simulate(problem, pd.DataFrame(rows), progress=False)
    replay = run.replay(0)
    assert float(replay.trace.clock()[-1]) == pytest.approx(2.1)
    assert replay.duration == pytest.approx(8.0)
    panels = {axes.get_ylabel(): axes for axes in replay.plot().axes}
    drawn = panels["w (input)"].lines[0].get_ydata()
    np.testing.assert_allclose(drawn, replay.trace["seen"], atol=1e-6)
    explained = vj.explain(run)
    assert explained.influences[0].spans[1] == pytest.approx((0, 4))
    shrunk = vj.shrink(run, seed=0)
    assert "w at 4 s " in str(shrunk)


@pytest.mark.slow
def test_a_batch_of_a_host_system_is_simulated_with_the_key_of_the_row():
    def simulate(features, seeds):
        x = features["x"] * 1.0 + (seeds % 7) * 0
        return vj.Trace({"x": np.repeat(x[:, None], 2, axis=1)}, dt=1.0)

    system = vj.blackbox(simulate, vectorised=True, seeded=True, signals=["x"], dt=1.0, length=2)
    space = {"x": vj.Box(0.0, 2.0), "y": vj.Box(0.0, 1.0)}
    problem = vj.Problem("rows", space, system, "x < 1", nominal={"x": 0.0, "y": 0.0})
    run = vj.falsify(problem, "uniform", 32, progress=False)
    explained = vj.explain(run)
    assert [each.gone for each in explained.influences] == [True, False]
    assert explained.influences[0].reverted == pytest.approx(1.0)
    assert vj.shrink(run, seed=0).changed.keys() == {"x"}


@pytest.mark.thorough
def test_it_is_said_that_changed_features_have_no_verdict():
    @vj.blackbox
    def fragile(features):
        if features["x"] < 0.5:
            raise RuntimeError("solver lost")
        return vj.Trace({"x": np.full(2, features["x"])}, dt=1.0)

    space = {"x": vj.Box(0.0, 2.0)}
    problem = vj.Problem("fragile", space, fragile, "x < 1", nominal={"x": 0.0})
    run = vj.falsify(problem, "uniform", 32, progress=False)
    said = str(vj.explain(run))
    assert "simulations had no verdict, the first because of RuntimeError: solver lost" in said


@pytest.mark.thorough
def test_without_nominal_features_and_gradients_it_says_what_is_missing():
    system = vj.blackbox(lambda features: vj.Trace({"x": np.full(2, features["x"])}, dt=1.0))
    run = vj.falsify(
        vj.Problem("host", {"x": vj.Box(0.0, 2.0)}, system, "x < 1"), "uniform", 16, progress=False
    )
    assert "nominal, and has no gradient here: give nominal= to learn what" in str(vj.explain(run))
