"""Pictures: that they are drawn at all for odd tables, and what they say of known ones."""

import jax.numpy as jnp
import pytest
from PIL import Image

import verifai_jax as vj
from verifai_jax.plotting import plot_features, plot_replay, write_run_pictures
from verifai_jax.plotting.replay import decisive_instant
from verifai_jax.plotting.scatter import distinguishing_features


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
    assert any(text.startswith("x = 2.") and text.endswith("at 1 s") for text in texts)


@pytest.mark.thorough
def test_animation(tmp_path):
    drawn = []

    def draw(axes, trace, sample, features):
        drawn.append(sample)
        axes.plot(trace["x"][: sample + 1])

    problem = vj.Problem("p", {"a": vj.Box(2, 3)}, system, "always x < 1", draw=draw)
    replay = vj.falsify(problem, "uniform", 4, batch=4).replay(0)
    from verifai_jax.plotting import animate

    with Image.open(animate(replay, tmp_path / "new" / "it.gif")) as image:
        shown = []
        for frame in range(image.n_frames):
            image.seek(frame)
            shown.append(image.info["duration"])
    # Equal frames are merged: one for each sample, in real time, and the last one stays.
    assert sorted(set(drawn)) == [0, 1, 2, 3]
    assert len(shown) == 4
    assert sum(shown) == 40 * (len(drawn) - 1) + 1500
    silent = vj.Problem("p", {"a": vj.Box(2, 3)}, system, "always x < 1")
    with pytest.raises(ValueError, match="cannot be animated"):
        animate(vj.falsify(silent, "uniform", 4, batch=4).replay(0), tmp_path / "no.gif")


@pytest.mark.thorough
def test_figures_show_themselves_in_a_notebook():
    problem = vj.Problem("p", SPACES["names"], system, "always x < 0.5")
    run = vj.falsify(problem, "uniform", 16, batch=16)
    assert run.plot()._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="unknown feature 'colr'; did you mean 'color'"):
        plot_features(run, features=["a", "colr"])
