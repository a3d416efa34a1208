"""Pictures: that they are drawn at all for odd tables, and what they say of known ones."""

import base64
import io
import re
from itertools import combinations

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import verifai_jax as vj
from verifai_jax.pictures import plot_features, plot_replay, write_run_pictures
from verifai_jax.pictures.replay import decisive_instant, telling_signals
from verifai_jax.pictures.scatter import distinguishing_features
from verifai_jax.pictures.style import BOUND, SAFE, wrap_name


def system(features, key):
    """The signal x rises from 0 to a + 3 c (of which b is no part); NaN where broken."""
    peak = features["a"] + 3.0 * features.get("c", 0) + 0 * features.get("b", 0)
    x = peak * jnp.array([0.0, 0.5, 1.0, 0.5])
    return vj.Trace({"x": jnp.where(features.get("broken", 0) > 0, jnp.nan, x)}, dt=0.5)


SPACES = {
    "one feature": {"a": vj.Box(0, 1)},
    "discrete": {"a": vj.DiscreteBox(0, 1), "c": vj.Categorical(0, 1)},
    "names": {"a": vj.Box(0, 1), "color": vj.Categorical("red", "blue")},
    "nothing varies": {"a": vj.Constant(1.0)},
    "never finite": {"a": vj.Box(0, 1), "broken": vj.Constant(1.0)},
}


@pytest.mark.thorough
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("spec", ["always x < 0.5", "always x < 9"])
def test_every_run_can_be_drawn(space, spec, tmp_path):
    problem = vj.Problem("p", SPACES[space], system, spec)
    run = vj.falsify(problem, "uniform", 24, batch=24)
    paths = write_run_pictures(run, tmp_path)
    assert {p.name for p in paths} >= {"features.png", "robustness.png"}
    assert ("worst.png" in {p.name for p in paths}) == (space != "never finite")
    for path in paths:
        with Image.open(path) as image:
            assert image.size[0] > 100


@pytest.mark.thorough
def test_the_feature_that_decides_comes_first():
    space = {"b": vj.Box(0, 1), "a": vj.Box(0, 1)}
    for spec in ("always x < 0.5", "always x < 9"):  # with failures, and by robustness alone
        run = vj.falsify(vj.Problem("p", space, system, spec), "uniform", 64, batch=64)
        assert distinguishing_features(run) == ["a", "b"]


@pytest.mark.thorough
def test_the_decisive_instant_is_marked():
    problem = vj.Problem("p", {"a": vj.Box(2, 3)}, system, "always x < 1")
    replay = vj.falsify(problem, "uniform", 4, batch=4).replay(0)
    assert decisive_instant(problem.formulas["spec"], replay.trace) == ("x", 2)
    texts = [t.get_text() for axes in plot_replay(replay).axes for t in axes.texts]
    assert any(re.fullmatch(r"decided by x = 2\.\d+ at 1 s", text) for text in texts)


def pushed(features, key):
    """Nine signals of which y is the integral of the input."""
    clock = jnp.arange(5) * 0.25
    wind = features["air"]["wind"](clock)
    return vj.Trace({f"s{k}": k * clock for k in range(7)} | {"x": wind, "y": clock}, dt=0.25)


@pytest.mark.slow
def test_a_replay_shows_inputs_and_the_bounds_of_all_formulas(tmp_path):
    wind = vj.Signal(vj.Box(1, 2), knots=2, duration=1.0)
    specs = {"low": "always (x > 0.5 & abs(y) < 0.5)", "high": "always (9 > x & x < 8 & x < 7)"}
    problem = vj.Problem("p", {"air": vj.Struct({"wind": wind})}, pushed, specs)
    replay = vj.falsify(problem, "uniform", 4, batch=4).replay(0)
    figure = replay.plot()
    labels = [axes.get_ylabel() for axes in figure.axes]
    # The signal s0 does not change, and comes last.
    assert labels == ["x", "y", "air.wind (input)", "s1", "s2", "s3"]
    assert "and 4 more, not drawn: s4, s5, s6, s0" in figure.axes[-1].get_xlabel()
    x, drawn = figure.axes[0], figure.axes[2].lines[0]
    assert [text.get_text() for text in x.texts] == ["9 > x", "x < 8", "x < 7", "x > 0.5"]
    assert len({text.xyann for text in x.texts}) == 4
    assert {line.get_ydata()[0] for line in x.lines[1:-1]} <= {0.5, 7, 8, 9}
    clock = jnp.arange(5) * 0.25
    assert jnp.allclose(drawn.get_ydata(), replay.features["air"]["wind"](clock))
    chosen = replay.plot(tmp_path / "two.png", signals=["air.wind", "s5"])
    assert [axes.get_ylabel() for axes in chosen.axes] == ["air.wind (input)", "s5"]
    with pytest.raises(ValueError, match=r"unknown signal .air\.wnd.; did you mean .air\.wind."):
        replay.plot(signals=["air.wnd"])


def test_what_moves_is_shown_before_what_stands_and_each_body_once():
    clock = np.arange(3.0)
    names = ["ego_x", "ego_speed", "notice", "turning_x", "turning_y", "visible"]
    curves = dict.fromkeys(names, clock) | {"ego_x": np.full(3, 8.75), "notice": np.ones(3)}
    ordered = telling_signals(names, curves, ["gap", "ego_y"])
    assert ordered == ["turning_x", "visible", "ego_speed", "turning_y", "ego_x", "notice"]


def test_names_are_wrapped():
    assert wrap_name("initial_lateral_offset_of_the_vehicle") == (
        "initial_lateral_\noffset_of_the_\nvehicle"
    )
    assert wrap_name("x") == "x"
    # A value stays with its name, and digits with theirs, where there is a blank to break at.
    assert wrap_name("delay=0.3861, notice=0, b=0.25", 20) == "delay=0.3861,\nnotice=0, b=0.25"


def ramp(features, key):
    clock = jnp.arange(9) * 0.25
    y = features["a"] * clock
    return vj.Trace(
        {"y": y, "z": clock + 0.1, "hit": 0 * y, "pos": jnp.stack([y, -y], -1), "fine": y < 1,
         "a_signal.with_a.long_name": 1e6 * y, "gear": jnp.where(clock > 1, 2.0, 1.0)},
        dt=0.25,
    )  # fmt: skip


@pytest.mark.slow
def test_the_bounds_of_all_formulas_are_solved_for_their_signals(tmp_path):
    specs = {
        "near": "always abs(2 * y - 40) <= 39",  # y from 0.5 to 39.5, the far end is not drawn
        "angle": "always y <= pi / 4 + 0",
        "two": "always y + 0.1 <= z",
        "round": "always norm(pos) <= 9",
        "never": "always hit < 0.5",
        "fine": "always fine",
        "late": "always (gear == 2 -> y > -1)",
        "big": "eventually a_signal.with_a.long_name >= 1",
    }
    problem = vj.Problem("p", {"a": vj.Box(2, 3)}, ramp, specs)
    replay = vj.falsify(problem, "uniform", 4, batch=4).replay(0)
    figure = replay.plot()
    panels = dict(zip([a.get_ylabel() for a in figure.axes], figure.axes, strict=True))
    assert list(panels) == [
        "y", "z", "pos", "hit", "fine", "gear", "a_signal.with_a.\nlong_name",
    ]  # fmt: skip

    def bounds(name):
        dashed = [line for line in panels[name].lines if line.get_linestyle() == "--"]
        return [jnp.asarray(line.get_ydata()) for line in dashed]

    def named(name):
        return {t.get_text(): t.get_color() for t in panels[name].texts if "=" in t.get_text()}

    y, clock = replay.trace["y"], replay.trace.clock()
    levels = sorted(float(each[0]) for each in bounds("y") if len(each) == 2)
    assert levels == pytest.approx([-1, 0.5, jnp.pi / 4])
    assert any(len(each) == 9 and jnp.allclose(each, clock) for each in bounds("y"))
    assert jnp.allclose(bounds("z")[0], y + 0.1)
    assert [float(each[0]) for each in bounds("hit")] == [0.5]  # far from 0, but hit is flat anyway
    assert named("pos") == {"norm(pos) <= 9": SAFE}
    assert not bounds("pos")
    assert [float(each[0]) for each in bounds("gear")] == [2.0]
    # What may be false without a failure is neither red nor shaded: conditions, eventualities.
    assert named("gear") == {"gear == 2": BOUND}
    assert not panels["gear"].collections
    assert not panels["a_signal.with_a.\nlong_name"].collections
    assert panels["fine"].collections
    assert panels["z"].collections
    # No two texts overlap, at either size; above the axis there is no power of ten.
    for size in ((8, 11), (5, 7)):
        figure.set_size_inches(*size)
        figure.draw_without_rendering()
        for axes in figure.axes:
            assert not axes.yaxis.get_offset_text().get_text()
        names = [axes.yaxis.label.get_window_extent() for axes in figure.axes]
        assert not any(a.overlaps(b) for a, b in combinations(names, 2))
    with pytest.raises(TypeError, match=r"signals is a list of names, such as \['y'\]; got 'y'"):
        replay.plot(signals="y")


@pytest.mark.thorough
def test_only_instants_that_a_formula_asks_about_are_shaded():
    specs = {
        "window": "always[1, 2] abs(y) < 1",  # broken from 1 s on, and not yet at 0.75 s
        "nested": "eventually[0, 0.5] always[0, 0.5] z > 1.5",
        "response": "always (gear == 2 -> hit > 0)",
    }
    problem = vj.Problem("p", {"a": vj.Box(2, 3)}, ramp, specs)
    figure = vj.falsify(problem, "uniform", 4, batch=4).replay(0).plot()
    panels = dict(zip([a.get_ylabel() for a in figure.axes], figure.axes, strict=True))

    def shaded(name):
        ends = np.concatenate(
            [path.vertices[:, 0] for path in panels[name].collections[0].get_paths()]
        )
        return ends.min(), ends.max()

    assert shaded("y") == pytest.approx((0.875, 2))
    assert shaded("z") == pytest.approx((0, 1.125))
    assert shaded("hit") == pytest.approx((1.125, 2))
    assert not panels["gear"].collections


@pytest.mark.thorough
def test_many_monitored_signals_leave_room_for_the_inputs():
    space = {"air": vj.Struct({"wind": vj.Signal(vj.Box(1, 2), knots=2, duration=1.0)})}
    spec = "always (s0 + s1 + s2 + s3 + s4 + s5 + s6 < 900)"
    replay = vj.falsify(vj.Problem("p", space, pushed, spec), "uniform", 4, batch=4).replay(0)
    figure = replay.plot()
    assert figure.axes[-1].get_ylabel() == "air.wind (input)"
    assert "and 2 more, not drawn: x, y" in figure.axes[-1].get_xlabel()


@pytest.mark.thorough
@pytest.mark.filterwarnings("error")
def test_a_replay_in_double_precision_is_drawn_without_a_warning():
    space = {"air": vj.Struct({"wind": vj.Signal(vj.Box(1, 2), knots=2, duration=1.0)})}
    run = vj.falsify(vj.Problem("p", space, pushed, "always x < 9"), "uniform", 4, batch=4)
    figure = run.replay(0, "float64").plot(signals=["air.wind", "x"])
    wind, x = (axes.lines[0].get_ydata() for axes in figure.axes)
    assert jnp.allclose(wind, x)


def test_a_simulation_without_a_verdict_has_no_robustness_in_its_title():
    def explodes(features, key):
        return vj.Trace({"x": jnp.array([1.0, 2e6, jnp.inf]) * features["a"]}, dt=1.0)

    problem = vj.Problem("p", {"a": vj.Box(2, 3)}, explodes, "always x < 1")
    replay = vj.falsify(problem, "uniform", 4, batch=4).replay(0)
    assert "no verdict (nonfinite) at a=" in replay.plot().get_suptitle()


def test_draw_is_looked_at_before_anything_is_simulated():
    with pytest.raises(ValueError, match=r"draw is called with \(axes, trace, sample, fe"):
        vj.Problem("p", {"a": vj.Box(2, 3)}, system, "always x < 1", draw=lambda axes, trace: None)


@pytest.mark.slow
def test_animation(tmp_path):
    drawn = []

    def draw(axes, trace, sample, features):
        drawn.append(sample)
        axes.plot(trace["x"][: sample + 1])

    problem = vj.Problem("p", {"a": vj.Box(2, 3)}, system, "always x < 1", draw=draw)
    replay = vj.falsify(problem, "uniform", 4, batch=4).replay(0)
    file = tmp_path / "new" / "it.gif"
    animation = replay.animate(file)
    assert animation.gif == file.read_bytes()
    assert animation.gif == base64.b64decode(animation._repr_mimebundle_()["image/gif"])
    with Image.open(file) as image:
        shown = []
        for frame in range(getattr(image, "n_frames", 1)):
            image.seek(frame)
            shown.append(image.info["duration"])
    # Each sample is drawn once and shown in real time, 25 frames a second; the last one stays.
    assert drawn == [0, 1, 2, 3]
    assert len(shown) == 4
    seconds = float(replay.trace.clock()[-1])
    assert sum(shown) == 40 * (round(25 * seconds) - 1) + 1500
    with pytest.raises(ValueError, match=r"an animation is a GIF.*; got .*it\.mp4"):
        replay.animate(tmp_path / "it.mp4")
    assert not (tmp_path / "it.mp4").exists()
    # A problem that draws nothing has its signals.
    plain = vj.Problem("p", {"a": vj.Box(2, 3)}, system, "always x < 1")
    film = vj.falsify(plain, "uniform", 4, batch=4).replay(0).animate()
    with Image.open(io.BytesIO(film.gif)) as image:
        assert getattr(image, "n_frames", 1) == 4
        last = np.asarray(image.convert("RGB")).reshape(-1, 3)
    assert len(np.unique(last, axis=0)) > 2


@pytest.mark.thorough
def test_figures_show_themselves_in_a_notebook():
    problem = vj.Problem("p", SPACES["names"], system, "always x < 0.5")
    run = vj.falsify(problem, "uniform", 16, batch=16)
    assert run.plot()._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="unknown feature 'colr'; did you mean 'color'"):
        plot_features(run, features=["a", "colr"])
