"""Synthesis against a closed form whose best gain is known, and what it says when there is none."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked
from click.testing import CliRunner
from scipy.stats import norm

import verifai_jax as vj
from specs.tuning import decay, first_order
from verifai_jax import repair, synthesize
from verifai_jax.addons.synthesis.commands.synthesize import synthesize as command
from verifai_jax.addons.synthesis.parametric import FeatureParameters

W, X0, LIMIT, FORCE, SECONDS = 1.0, 0.5, 1.0, 1.8, 4.0


def margin_of(k, x0=X0):
    """The least robustness of `first_order` over all environments, worked out by hand.

    |x| is largest with x0 and w of one sign; then it runs monotonously from |x0| to its last value.
    """
    ends = np.exp(-k * SECONDS)
    far = np.maximum(x0, x0 * ends + W / k * (1 - ends))
    return np.minimum(LIMIT - far, FORCE - k * far)


GAINS = np.linspace(0.2, 5.0, 20001)
BEST = margin_of(GAINS).max()


@pytest.fixture(scope="module")
def found():
    return synthesize(first_order, ["k"], 6000)


@pytest.mark.thorough
@pytest.mark.parametrize("gradient", [True, False])
def test_the_best_gain_is_found_and_its_margin(found, gradient):
    result = found if gradient else synthesize(first_order, "k", 6000, gradient=False)
    assert result.holds
    assert result.converged
    assert result.simulations <= 6000
    # The set holds the worst environment: what is seen is the margin over all of them.
    assert margin_of(result.parameters["k"]) == pytest.approx(BEST, abs=0.02)
    assert result.robustness == pytest.approx(margin_of(result.parameters["k"]), abs=2e-3)
    assert result.held_out.simulations == 2000
    assert result.held_out.failures == 0
    assert result.held_out.bound == pytest.approx(1 - 0.05 ** (1 / 2000))


@pytest.mark.thorough
def test_the_tables(found):
    assert list(found.candidates) == ["k", "rho", "environments"]
    assert list(found.environments) == ["x0", "w", "rho"]
    assert found.candidates["environments"].nunique() == 1
    # Over the environments of the set no candidate does worse than over all that there are.
    true = margin_of(found.candidates["k"].to_numpy())
    assert (found.candidates["rho"] >= true - 1e-5).all()
    assert (np.diff(found.candidates["rho"]) <= 0).all()
    assert len(found.robust) == (found.candidates["rho"] >= 0).sum()
    assert found.environments["rho"].min() == pytest.approx(found.robustness, abs=1e-3)


@pytest.mark.thorough
def test_the_chosen_problem_is_ready(found):
    assert found.chosen.nominal["k"] == found.parameters["k"]
    assert found.chosen.space.dim == 2
    assert len(vj.falsify(found.chosen, "uniform", 64, batch=64).table.counterexamples) == 0


@pytest.mark.thorough
def test_what_it_says(found):
    assert "holds with robustness" in str(found)
    assert "0 of 2000 held-out environments fail: failure probability < 0.0015 at 95 %" in str(
        found
    )
    assert "proves nothing" in str(found)


@pytest.mark.thorough
def test_the_same_seed_gives_the_same(found):
    again = synthesize(first_order, ["k"], 6000)
    assert again.parameters == found.parameters
    pd.testing.assert_frame_equal(again.candidates, found.candidates)


def test_no_gain_has_that_margin():
    result = synthesize(first_order, ["k"], 6000, aim=vj.Aim(margin=BEST + 0.1), gradient=False)
    assert not result.holds
    assert result.robustness == pytest.approx(BEST, abs=0.02)
    assert len(result.robust) == 0
    assert "NONE FOUND that holds by the margin" in str(result)
    assert f"{result.margin - result.robustness:.4g} too little" in str(result)
    assert result.held_out.failures == 0
    assert result.held_out.short > 0
    assert "keep less than the margin" in str(result)


@pytest.mark.thorough
def test_no_gain_is_safe():
    narrow = vj.FeatureSpace({**first_order.space.domains, "k": vj.Box(0.2, 0.8)})
    problem = dataclasses.replace(first_order, space=narrow)
    result = synthesize(problem, ["k"], 6000, gradient=False)
    assert not result.holds
    assert result.robustness == pytest.approx(margin_of(0.8), abs=2e-3)
    # The share of environments in which x goes too far with the gain of 0.8.
    ends = np.exp(-0.8 * SECONDS)
    rng = np.random.default_rng(0)
    x0, w = rng.uniform(-X0, X0, 100_000), rng.uniform(-W, W, 100_000)
    share = np.mean(abs(x0 * ends + w / 0.8 * (1 - ends)) > LIMIT)
    assert result.held_out.rate.low < share < result.held_out.rate.high
    assert "NONE FOUND that holds: the best so far has robustness -0." in str(result)


@pytest.mark.thorough
@pytest.mark.parametrize("gradient", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_all_features_are_parameters(gradient):
    problem = vj.Problem(
        "all",
        vj.FeatureSpace(
            {"k": vj.Box(0.2, 5.0), "x0": vj.Box(0.0, 1.5), "w": vj.Constant(1.0)},
            where=lambda f: f["x0"] >= 0.25,
        ),
        decay,
        "always (abs(x) <= 1 & abs(u) <= 1.8)",
    )
    result = synthesize(problem, budget=3000, gradient=gradient)
    grid = np.linspace(0.25, 1.5, 126)
    best = max(margin_of(GAINS[::10], x0).max() for x0 in grid)
    assert result.robustness == pytest.approx(best, abs=2e-3)
    assert result.parameters["x0"] >= 0.25
    assert result.held_out is None
    assert len(result.robust) > 100
    assert result.simulations <= 3000
    np.testing.assert_allclose(
        result.robust["rho"], margin_of(result.robust["k"], result.robust["x0"]), atol=1e-4
    )
    assert "held-out" not in str(result)


def black_box(features):
    if features["gain"] > 4.5:
        raise RuntimeError("the solver gave up")
    time = np.arange(41) * 0.1
    sign = {0: 1.0, 1: -1.0}[int(features["direction"])]
    rate = sign * features["gain"]
    ends = np.exp(-rate * time)
    x = features["x0"] * ends + features["w"] / rate * (1 - ends)
    return vj.Trace({"x": x, "u": rate * x}, dt=0.1)


@pytest.mark.slow
def test_a_black_box_with_a_choice_and_simulations_that_raise():
    problem = vj.Problem(
        "box",
        {
            "x0": vj.Box(-0.5, 0.5),
            "gain": vj.Box(0.2, 5.0),
            "direction": vj.Categorical("back", "away"),
            "w": vj.Box(-1.0, 1.0),
        },
        vj.blackbox(black_box),
        "always (abs(x) <= 1 & abs(u) <= 1.8)",
    )
    result = synthesize(
        problem, ["gain", "direction"], 2000, aim=vj.Aim(attack="halton", held_out=100)
    )
    assert result.parameters["direction"] == "back"
    assert margin_of(result.parameters["gain"]) == pytest.approx(BEST, abs=0.05)
    assert result.without_verdict > 0
    assert "gave no verdict" in str(result)
    assert result.held_out.failures == 0
    assert result.chosen.space.domains["direction"].size == 0


@pytest.mark.thorough
def test_a_constraint_between_parameter_and_environment():
    # Weak disturbances alone: |w| / k <= 0.5, so that |x| never grows beyond 0.5.
    space = vj.FeatureSpace(first_order.space.domains, where=lambda f: abs(f["w"]) <= f["k"] / 2)
    problem = dataclasses.replace(first_order, space=space, nominal=None)
    result = synthesize(problem, ["k"], 6000, gradient=False)
    assert result.holds
    assert result.robustness == pytest.approx(0.5, abs=0.02)
    assert result.held_out.simulations == 2000


@pytest.mark.thorough
def test_exactly_zero_is_decided_by_the_comparator():
    def system(features, key):
        return vj.Trace({"x": 0 * features["k"] + np.zeros(2, np.float32)}, dt=1.0)

    for formula, holds in (("always x >= 0", True), ("always x > 0", False)):
        problem = vj.Problem("zero", {"k": vj.Box(0, 1), "e": vj.Box(0, 1)}, system, formula)
        result = synthesize(
            problem, ["k"], 300, aim=vj.Aim(attack="halton", held_out=50), gradient=False
        )
        assert result.holds is holds
        assert result.held_out.failures == (0 if holds else 50)


def test_ctrl_c_returns_what_is_finished(monkeypatch):
    evaluate, calls = FeatureParameters.evaluate, 0

    def interrupted(self, *arguments):
        nonlocal calls
        calls += 1
        if calls > 30:
            raise KeyboardInterrupt
        return evaluate(self, *arguments)

    monkeypatch.setattr(FeatureParameters, "evaluate", interrupted)
    result = synthesize(first_order, ["k"], 6000)
    assert result.stopped == "interrupted"
    assert result.held_out is None
    assert "not checked in held-out environments" in str(result)
    assert margin_of(result.parameters["k"]) == pytest.approx(result.robustness, abs=0.2)


def test_parameters_of_every_kind_can_be_held():
    space = {
        "point": vj.Box([0.0, 1.0], [1.0, 3.0]),
        "count": vj.DiscreteBox(1, 4),
        "kind": vj.Categorical("slow", "fast"),
        "wave": vj.Signal(vj.Box(-1.0, 1.0), knots=3, hold="linear", duration=1.0),
        "e": vj.Box(0.0, 1.0),
    }

    def system(features, key):
        x = features["point"][0] + features["count"] + 2 * features["kind"] + features["e"]
        return vj.Trace({"x": x + features["wave"](0.4) + jnp.zeros(2)}, dt=1.0)

    problem = vj.Problem("kinds", space, system, "always x >= 0")
    loop = FeatureParameters(problem, ["point", "count", "kind", "wave"], batch=8, gradient=False)
    theta = np.random.default_rng(1).random(loop.dim)
    rho = loop.evaluate(theta[None], np.array([[0.25]])).rho[0, 0]
    held = loop.with_parameters(theta)
    assert held.space.dim == 1
    assert loop.values(theta)["kind"] in ("slow", "fast")
    again = FeatureParameters(held, ["e"], batch=8, gradient=False)
    assert again.evaluate(np.array([[0.25]]), np.zeros((1, 0))).rho[0, 0] == pytest.approx(rho)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parameters": ["gain"]}, "unknown parameter 'gain'"),
        ({"parameters": ["ww"]}, "did you mean 'w'"),
        ({"parameters": []}, "name at least one parameter, of k, x0, w"),
        ({"budgt": 5}, "did you mean 'budget'"),
        ({"budget": 0}, "budget must be an integer of at least 1; got 0"),
        ({"aim": "probabilty"}, "did you mean 'probability'"),
        ({"environments": 0}, "environments must be an integer of at least 1; got 0"),
        ({"parameters": "k", "aim": vj.Aim(attack="halten")}, "did you mean 'halton'"),
        (
            {"parameters": "k", "aim": vj.Aim(attack="gradient"), "gradient": False},
            "needs gradients",
        ),
    ],
)
def test_bad_input(options, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        synthesize(first_order, **options)


def test_a_black_box_has_no_gradient():
    problem = vj.Problem("box", first_order.space, vj.blackbox(black_box), "always abs(x) <= 1")
    with pytest.raises(ValueError, match="is a black box, which has no gradient"):
        synthesize(problem, ["k"], gradient=True)


def test_a_fixed_feature_is_no_parameter():
    with pytest.raises(ValueError, match="x0 does not vary, so it cannot be chosen"):
        synthesize(first_order.only("k", "w"), ["x0"])


def test_the_command_synthesizes_and_reports(tmp_path):
    arguments = ["specs/tuning.py:first_order", "--parameters", "k", "--budget", "1500"]
    options = ["--no-gradient", "--attack", "halton", "--held-out", "100"]
    options += ["--table", str(tmp_path / "found.csv")]
    shown = CliRunner().invoke(command, [*arguments, *options])
    assert shown.exit_code == 0, shown.output
    assert "0 of 100 held-out environments fail" in shown.output
    assert list(pd.read_csv(tmp_path / "found.csv")) == ["k", "rho", "environments"]


def shaken(features):
    """Fail with least probability at gain 0.3, and everywhere with some."""
    far = abs(features["gain"] - 0.3) + 0.5 * features["push"]
    return vj.Trace({"x": np.array([far])}, dt=1.0)


@pytest.fixture(scope="module")
def shaken_problem():
    space = {"gain": vj.Box(0.0, 1.0), "push": vj.Normal(0.0, 1.0)}
    return vj.Problem(
        "shaken", space, vj.blackbox(shaken), "x <= 1", nominal={"gain": 0.9, "push": 0.0}
    )


@pytest.mark.slow
def test_the_least_failure_probability_is_found_and_checked(shaken_problem):
    found = synthesize(shaken_problem, ["gain"], 4000, aim=vj.Aim(of="probability", held_out=1000))
    assert found.parameters["gain"] == pytest.approx(0.3, abs=0.15)
    assert found.simulations <= 4000
    failing, samples = found.counted
    assert failing / samples == pytest.approx(norm.sf(2), abs=0.03)
    exact = norm.sf(2 - 2 * abs(found.parameters["gain"] - 0.3))
    assert found.held_out.rate.low <= exact <= found.held_out.rate.high
    assert f"{failing} of {samples} samples of the prior fail" in str(found)
    assert not found.holds


@pytest.mark.slow
def test_a_repair_may_aim_at_it_too(shaken_problem):
    mended = repair(shaken_problem, ["gain"], 4000, aim=vj.Aim(of="probability", held_out=1000))
    assert mended.parameters["gain"] == pytest.approx(0.3, abs=0.15)
    assert mended.held_out_after.failures < mended.held_out_before.failures
    assert mended.stopped == "fewest failures"
    assert not mended.repaired
    assert "samples of the prior fail; the check counts in other samples" in str(mended)
    with pytest.raises(ValueError, match="needs features that vary: all are parameters here"):
        synthesize(shaken_problem, ["gain", "push"], aim="probability")
