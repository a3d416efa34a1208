"""`estimate` on problems: options, texts, black boxes, verdicts that are missing."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from click.testing import CliRunner
from scipy.stats import norm

import verifai_jax as vj
from verifai_jax.addons.estimation import estimate
from verifai_jax.addons.estimation.commands.estimate import estimate as command


def half_space(p, name="half_space"):
    b = norm.isf(p)

    def system(features, key):
        x = (features["x"] + features["y"]) / jnp.sqrt(2.0)
        return vj.Trace({"margin": (b - x)[None]}, dt=1.0)

    space = {"x": vj.Normal(0.0, 1.0), "y": vj.Normal(0.0, 1.0)}
    return vj.Problem(name, space, system, "margin >= 0")


@pytest.fixture(scope="module")
def rare():
    return estimate(half_space(1e-6, "rare"), budget=20_000, p0=1e-4)


@pytest.mark.slow
def test_one_in_a_million(rare):
    assert rare.method == "importance"
    assert rare.low < 1e-6 < rare.high
    assert rare.probability == pytest.approx(1e-6, rel=0.15)
    assert rare.simulations <= 20_000
    assert rare.failures > 1000


@pytest.mark.slow
def test_says_what_is_guaranteed_and_what_is_not(rare):
    text = str(rare)
    assert "rare: fails with probability" in text
    assert "importance sampling" in text
    assert "independent samples of the prior alone\n  p < 0.0001    shown, unless" in text
    assert rare.upper_bound == pytest.approx(3 / rare.prior_simulations, rel=0.01)
    assert rare.simulations_until(1e-4) == pytest.approx(29956 - rare.prior_simulations, abs=1)


@pytest.mark.thorough
def test_pictures_are_drawn_and_written(rare, tmp_path):
    rare.plot(tmp_path / "estimate.png")
    assert (tmp_path / "estimate.png").stat().st_size > 5000


@pytest.mark.thorough
def test_features_reach_beyond_single_precision():
    # At the upper end a float32 coordinate has 17 numbers in this tail, at the lower many more.
    b = norm.isf(1e-6)
    system = lambda f, key: vj.Trace({"m": (b - f["x"])[None]}, dt=1.0)  # noqa: E731
    found = estimate(
        vj.Problem("tail", {"x": vj.Normal(0.0, 1.0)}, system, "m >= 0"), budget=10_000
    )
    assert found.probability == pytest.approx(1e-6, rel=0.05)


@pytest.mark.thorough
def test_a_black_box_without_gradient_with_simulations_that_fail():
    @vj.blackbox
    def system(features):
        if features["x"] > 0.99:
            raise RuntimeError("solver")
        return vj.Trace({"m": np.array([features["x"] - 0.05])}, dt=1.0)

    problem = vj.Problem("box", {"x": vj.Box(0.0, 1.0)}, system, "m >= 0")
    found = estimate(problem, "monte_carlo", budget=1000, progress=False)
    assert found.no_verdict > 0
    assert found.low < 0.05 < found.high
    assert found.upper_bound > (found.failures + found.no_verdict) / 1000
    assert "without a verdict" in str(found)
    assert "neither safe nor failing" in str(found)


@pytest.mark.slow
def test_several_formulas_and_a_constraint():
    system = lambda f, key: vj.Trace({"x": f["x"][None], "y": f["y"][None]}, dt=1.0)  # noqa: E731
    space = vj.FeatureSpace(
        {"x": vj.Box(0.0, 1.0), "y": vj.Box(0.0, 1.0)}, where=lambda f: f["x"] + f["y"] < 1.0
    )
    problem = vj.Problem("two", space, system, {"a": "x >= 0.01", "b": "y >= 0.01"})
    found = estimate(problem, budget=5000)
    truth = 1 - (0.98**2 / 2) / 0.5
    assert found.low < truth < found.high


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "splittin"}, "unknown method 'splittin'; did you mean 'splitting'"),
        ({"confidence": 1.5}, "confidence must lie between 0 and 1; got 1.5"),
        ({"p0": 0}, "p0 must lie between 0 and 1; got 0"),
        ({"budget": 0}, "budget must be an integer of at least 1; got 0"),
        ({"bugdet": 10}, "unknown option of estimate 'bugdet'; did you mean 'budget'"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        estimate(half_space(0.1), **options)


def test_only_a_problem_can_be_estimated():
    with unchecked(), pytest.raises(TypeError, match="estimate needs a Problem; got str"):
        estimate("specs/cartpole.py:balance")


def test_time_ends_with_what_is_there():
    found = estimate(half_space(1e-3), budget=50_000, stop=vj.Stop(seconds=1e-6))
    assert found.probability is None
    assert any("max_seconds" in note for note in found.notes)
    assert found.upper_bound == 1.0


TARGET = """
import jax.numpy as jnp
import verifai_jax as vj
easy = vj.Problem(
    "easy", {"x": vj.Box(0.0, 1.0)},
    lambda f, key: vj.Trace({"x": f["x"][None]}, dt=1.0), "x >= 0.1"
)
"""


@pytest.mark.thorough
def test_the_command_estimates_the_probability(tmp_path):
    (tmp_path / "easy.py").write_text(TARGET)
    arguments = [f"{tmp_path / 'easy.py'}:easy", "--budget", "3000", "--p0", "0.5"]
    result = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert re.search(r"easy: fails with probability 0\.(09|1)", result.output)
    assert "p < 0.5    shown, by samples of the prior alone" in result.output


def test_without_any_verdict_no_robustness_is_claimed():
    lost = lambda f, key: vj.Trace({"x": (f["x"] * jnp.inf)[None]}, dt=1.0)  # noqa: E731
    problem = vj.Problem("lost", {"x": vj.Box(1.0, 2.0)}, lost, "x > 0")
    said = str(estimate(problem, budget=500, progress=False))
    assert "no simulation gave a verdict" in said
    assert "inf" not in said


@pytest.mark.slow
def test_chance_that_does_not_come_from_the_key_is_noticed():
    rng = np.random.default_rng(7)

    def noisy(features):
        margin = 3.5 - features["x"] - 0.9 * rng.standard_normal(features["x"].shape)
        return vj.Trace({"margin": np.repeat(margin[:, None], 2, axis=1)}, dt=1.0)

    def steady(features):
        return vj.Trace({"margin": np.repeat(3.5 - features["x"][:, None], 2, axis=1)}, dt=1.0)

    space = {"x": vj.Normal(0.0, 1.0), "y": vj.Normal(0.0, 1.0)}
    found = {
        system.__name__: estimate(
            vj.Problem("own", space, vj.blackbox(system, vectorised=True), "margin > 0"),
            budget=2000,
            progress=False,
        )
        for system in (noisy, steady)
    }
    assert "memory or chance of its own" not in str(found["steady"])
    assert "of 8 samples of the prior simulated again with the same features 8 gave another" in str(
        found["noisy"]
    )
    assert found["noisy"].method != "splitting"
    assert found["noisy"].low < norm.sf(3.5 / np.sqrt(1.81)) < found["noisy"].high
    assert found["noisy"].simulations <= 2000
