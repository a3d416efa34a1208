"""Repair against closed forms: the least change that is enough is known."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from click.testing import CliRunner
from scipy.optimize import brentq
from scipy.stats import norm

import verifai_jax as vj
from envs import cartpole
from specs.cartpole import balance
from specs.tuning import decay, first_order, gains
from verifai_jax import repair
from verifai_jax.addons.rl import load_policy
from verifai_jax.addons.synthesis.commands.repair import repair as command


def fading(k):
    return np.exp(-4.0 * k)


# With a gain below this x goes beyond 1 for x0 = 0.5 and w = 1.
BOUNDARY = brentq(lambda k: 0.5 * fading(k) + (1 - fading(k)) / k - 1.0, 0.3, 2.0)


@pytest.fixture(scope="module")
def mended():
    return repair(first_order, ["k"], 6000)


@pytest.mark.thorough
@pytest.mark.parametrize("gradient", [True, False])
def test_the_least_change_that_is_enough(mended, gradient):
    result = mended if gradient else repair(first_order, "k", 6000, gradient=False)
    assert result.repaired
    assert result.stopped == "repaired"
    assert result.before == {"k": 0.5}
    assert BOUNDARY <= result.parameters["k"] <= 1.05 * BOUNDARY
    assert result.change == pytest.approx((result.parameters["k"] - 0.5) / 4.8, rel=1e-4)
    assert result.simulations <= 6000


@pytest.mark.thorough
def test_rates_before_and_after(mended):
    # The share of environments in which x goes too far with the gain of 0.5.
    rng = np.random.default_rng(0)
    x0, w = rng.uniform(-0.5, 0.5, 200_000), rng.uniform(-1, 1, 200_000)
    share = np.mean(abs(x0 * fading(0.5) + w / 0.5 * (1 - fading(0.5))) > 1)
    before, after = mended.held_out_before, mended.held_out_after
    assert before.rate.low < share < before.rate.high
    assert (after.simulations, after.failures, after.passed) == (2000, 0, True)


@pytest.mark.thorough
def test_rounds_and_what_it_says(mended):
    assert mended.rounds[0].counterexamples > 0
    assert mended.rounds[-1].counterexamples == 0
    assert mended.rounds[-1].worst >= 0
    text = str(mended)
    assert "k 0.5 -> " in text
    assert "before: " in text
    assert "after:  0 of 2000 held-out environments fail" in text
    assert len(mended.plot().axes) == 1


@pytest.mark.slow
def test_rare_failures_are_compared_by_estimates():
    space = {"k": vj.Box(0.0, 4.0), "x": vj.Normal(0.0, 1.0)}
    system = lambda f, key: vj.Trace({"x": jnp.full(2, f["x"] - f["k"])}, dt=1.0)  # noqa: E731
    problem = vj.Problem("tail", space, system, "always x < 3", nominal={"k": 1.0, "x": 0.0})
    result = repair(problem, "k", 4000)
    estimates = result.estimate("monte_carlo", 4000, seed=2)
    for estimate, k in ((estimates.before, 1.0), (estimates.after, result.parameters["k"])):
        share = norm.sf(3 + k)
        if estimate.probability is None:
            assert share < estimate.upper_bound
        else:
            assert 0.2 * share < estimate.probability < 5 * share
    lines = str(estimates).splitlines()
    assert lines[0] == "repair of tail, failure probabilities"
    assert lines[1].startswith("  before: ")
    assert lines[2].startswith("  after:  ")
    assert ("not shown" in lines[3]) != estimates.lowered
    assert result.nominal_problem.nominal["k"] == 1.0
    assert result.held_out_before.failures == result.held_out_after.failures == 0
    assert "too rare for the check to compare: see .estimate()" in str(result)


@pytest.mark.thorough
def test_the_repaired_problem_is_ready(mended):
    assert mended.problem.nominal["k"] == mended.parameters["k"]
    assert mended.problem.space.dim == 2


@pytest.mark.thorough
def test_counterexamples_of_a_run_come_first():
    run = vj.falsify(first_order, "uniform", 512, batch=256)
    result = repair(run, ["k"], 6000, gradient=False)
    assert result.repaired
    assert "16 counterexamples came from the run of 'first_order'" in str(result)
    assert result.rounds[0].change > 0


@pytest.mark.thorough
def test_nominal_parameters_that_hold_are_kept():
    result = repair(first_order, ["k"], 6000, nominal={"k": 1.2}, gradient=False)
    assert result.parameters == {"k": 1.2}
    assert "the nominal parameters were kept" in str(result)
    assert "k 1.2 unchanged" in str(result)


@pytest.mark.thorough
def test_the_margin_is_kept():
    result = repair(first_order, ["k"], 6000, aim=vj.Aim(margin=0.2), gradient=False)
    limit = brentq(lambda k: 0.5 * fading(k) + (1 - fading(k)) / k - 0.8, 0.3, 2.0)
    assert limit <= result.parameters["k"] <= 1.05 * limit
    assert result.robustness >= 0.2


@pytest.mark.thorough
@pytest.mark.parametrize("gradient", [True, False])
def test_no_parameters_are_enough(gradient):
    result = repair(first_order, ["k"], 6000, aim=vj.Aim(margin=0.6), gradient=gradient)
    assert result.stopped == "no parameters"
    assert not result.repaired
    assert "NO REPAIR FOUND: the best parameters have robustness 0.5" in str(result)
    assert "does not prove that none has more" in str(result)


def system_of(parameters):
    """The first-order loop whose gain is a product of two rows of numbers."""
    gain = jnp.sum(parameters["a"] * parameters["b"])
    return lambda features, key: decay({**features, "k": gain}, key)


ROWS = {"a": jnp.full(5, 0.3), "b": jnp.full(5, 0.3)}


@pytest.fixture(scope="module")
def rows():
    space = {name: first_order.space[name] for name in ("x0", "w")}
    return vj.Problem("rows", space, system_of(ROWS), "always abs(x) <= 1")


@pytest.mark.thorough
def test_arrays_of_parameters(rows):
    result = repair(rows, ROWS, 6000, system_of=system_of)
    assert result.repaired
    # All ten numbers move alike, to the square root of a fifth of the gain that is enough.
    wanted = np.sqrt(BOUNDARY / 5)
    for name in ROWS:
        np.testing.assert_allclose(result.parameters[name], wanted, rtol=0.03)
    assert result.change == pytest.approx(np.sqrt(10) * (wanted - 0.3), rel=0.06)
    assert "arrays changed by" in str(result)
    worst = result.problem.system({"x0": 0.5, "w": 1.0}, None).signals["x"]
    assert 0.97 < jnp.max(jnp.abs(worst)) <= 1


@pytest.mark.thorough
def test_a_black_box():
    def simulate(features):
        ends = np.exp(-features["k"] * np.arange(41) * 0.1)
        x = features["x0"] * ends + features["w"] / features["k"] * (1 - ends)
        return vj.Trace({"x": x, "u": features["k"] * x}, dt=0.1)

    problem = dataclasses.replace(first_order, system=vj.blackbox(simulate))
    result = repair(problem, ["k"], 1200, aim=vj.Aim(attack="halton", held_out=100))
    assert result.repaired
    assert BOUNDARY <= result.parameters["k"] <= 1.15 * BOUNDARY


NAMES = ["k_x", "k_x_dot", "k_theta", "k_theta_dot"]


@pytest.mark.slow
@pytest.mark.parametrize("gradient", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_a_cart_pole_is_tuned(gradient):
    result = repair(gains, NAMES, gradient=gradient)
    assert result.repaired
    assert result.held_out_before.failures > 1000
    assert result.held_out_after.failures == 0
    assert result.change < (0.3 if gradient else 1.0)


@pytest.mark.slow
def test_the_weights_of_a_network():
    """The trained cart-pole network, which fails in three of a hundred environments."""
    layers = cartpole._preferring(load_policy(cartpole.POLICY_FILE))

    def closed_loop(layers):
        def control(time, state, features):
            hidden = jnp.stack(state)
            for weight, bias in layers[:-1]:
                hidden = jnp.tanh(hidden @ weight + bias)
            weight, bias = layers[-1]
            return 10.0 * cartpole.sign((hidden @ weight + bias)[0])

        return cartpole.cartpole(control, duration=4.0)

    problem = vj.Problem("net", balance.space, closed_loop(layers), balance.spec)
    result = repair(problem, layers, system_of=closed_loop)
    assert result.repaired
    assert result.held_out_before.failures > 30
    assert result.held_out_after.failures == 0


@pytest.mark.thorough
def test_a_simulation_without_a_verdict_is_no_repair():
    def system(features, key):
        x = jnp.where(features["k"] > 0.5, jnp.nan, -1.0)
        return vj.Trace({"x": x + 0 * features["e"] + jnp.zeros(2)}, dt=1.0)

    problem = vj.Problem(
        "nan",
        {"k": vj.Box(0, 1), "e": vj.Box(0, 1)},
        system,
        "always x >= 0",
        nominal={"k": 0.2, "e": 0.5},
    )
    result = repair(problem, ["k"], 600, aim=vj.Aim(attack="halton", held_out=50), gradient=False)
    assert not result.repaired
    assert result.parameters == {"k": 0.2}
    assert "gave no verdict" in str(result)
    options = {"aim": vj.Aim(attack="halton", held_out=50), "gradient": False}
    started = repair(problem, ["k"], 600, nominal={"k": 0.8}, **options)
    assert started.stopped == "no verdict"
    assert "none of 50 held-out environments gave a verdict" in str(started)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: repair(first_order, ["kk"]), "unknown parameter 'kk'; did you mean 'k'"),
        (lambda: repair(first_order, ["k"], rond=3), "unknown option of repair 'rond'"),
        (lambda: repair(first_order, ROWS), "arrays need system_of="),
        (lambda: repair(first_order, []), "names of features, at least one"),
        (lambda: repair(first_order, ["k", "x0", "w"]), "use synthesize"),
        (
            lambda: repair(first_order, ["k"], nominal={"k": 9.0}),
            "k must lie in .*; got 9",
        ),
        (
            lambda: repair(first_order, ["k"], nominal={"w": 0.0}),
            "unknown parameter of nominal",
        ),
        (
            lambda: repair(dataclasses.replace(first_order, nominal=None), ["k"]),
            "k has none: give nominal=",
        ),
        (
            lambda: repair(first_order, ROWS, system_of=system_of, gradient=False),
            "arrays of parameters are repaired by gradients",
        ),
        (
            lambda: repair(
                first_order, {"a": jnp.ones(2)}, system_of=lambda p: lambda f, k: float(p["a"][0])
            ),
            r"must make a system that JAX can trace in the parameters",
        ),
        (
            lambda: repair(
                first_order, {"a": 0.5}, system_of=lambda p: vj.blackbox(lambda f: None)
            ),
            "by gradients, which a black box has not",
        ),
    ],
)
def test_bad_input(make, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        make()


def test_arrays_must_be_real():
    with pytest.raises(TypeError, match=r"\['a'\] is int"):
        repair(first_order, {"a": np.ones(2, int)}, system_of=system_of)


@pytest.mark.thorough
def test_the_command_repairs_and_reports(tmp_path):
    arguments = ["specs/tuning.py:first_order", "--parameters", "k", "--budget", "2500"]
    options = ["--no-gradient", "--attack", "halton", "--held-out", "100"]
    options += ["--plot", str(tmp_path / "rounds.png")]
    shown = CliRunner().invoke(command, [*arguments, *options, "--nominal", "k=0.6"])
    assert shown.exit_code == 0, shown.output
    assert "repair of first_order: k 0.6 -> " in shown.output
    assert (tmp_path / "rounds.png").exists()
    wrong = CliRunner().invoke(command, [*arguments, "--nominal", "k"])
    assert "--nominal needs NAME=VALUE; got 'k'" in wrong.output
