"""How wrong a probability is: each part against what is known, and the prior's bound."""

import json
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.optimize import brentq, minimize

import verifai_jax as vj
from verifai_jax.addons.estimation.divergence import (
    binary_divergence,
    radius_of,
    radius_of_mean,
    worst_mean,
    worst_probability,
)
from verifai_jax.addons.estimation.paired_rates import paired_rates
from verifai_jax.cli.main import main
from verifai_jax.evaluation.evaluator import Evaluator


@pytest.mark.parametrize("p", [1e-9, 1e-4, 0.01, 0.3, 0.9])
@pytest.mark.parametrize("radius", [1e-4, 0.01, 0.1, 1.0])
def test_the_worst_probability_is_the_root_of_the_divergence(p, radius):
    q = worst_probability(p, radius)
    if binary_divergence(1.0, p) <= radius:
        assert q == pytest.approx(1.0)
        return
    root = brentq(lambda each: binary_divergence(each, p) - radius, p, 1 - 1e-15, xtol=1e-15)
    assert q == pytest.approx(root, rel=1e-6)
    assert radius_of(p, q) == pytest.approx(radius, rel=1e-6)
    # The dual of the bound, which holds for every temperature.
    dual = [t * radius + t * np.log1p(p * np.expm1(1 / t)) for t in np.geomspace(0.03, 1e3, 4000)]
    assert q == pytest.approx(min(dual), rel=1e-3)


def test_normal_tails_within_a_shift():
    # Moving a normal mean by d is one prior within d^2 / 2 nats, so never worse than the worst.
    from scipy.special import ndtr

    for a in (1.0, 2.0, 3.0):
        for d in (0.1, 0.5, 1.0):
            assert ndtr(d - a) <= worst_probability(float(ndtr(-a)), d * d / 2) + 1e-12


def test_three_values_against_a_search_over_all_weights():
    values, weights, radius = (-1.0, 0.0, 1.0), (0.05, 0.9, 0.05), 0.02

    def divergence(q):
        return float(np.sum(q * np.log(np.maximum(q, 1e-300) / weights)))

    best = minimize(
        lambda q: -float(q @ values), weights, method="SLSQP", bounds=[(1e-12, 1)] * 3,
        constraints=[{"type": "eq", "fun": lambda q: q.sum() - 1},
                     {"type": "ineq", "fun": lambda q: radius - divergence(q)}],
    )  # fmt: skip
    assert worst_mean(values, weights, radius) == pytest.approx(-best.fun, abs=1e-5)
    # That two rates are equal: Chernoff's -log(1 - a - b + 2 sqrt(a b)).
    a, b = 0.04, 0.01
    closed = -math.log(1 - a - b + 2 * math.sqrt(a * b))
    assert radius_of_mean(values, (a, 1 - a - b, b), 0.0) == pytest.approx(closed, rel=1e-6)
    assert radius_of_mean(values, (b, 1 - a - b, a), 0.0) == 0.0
    assert radius_of_mean(values, (a, 1 - a - b, b), 2.0) == math.inf
    assert worst_probability(0.0, 5.0) == 0.0
    with pytest.raises(ValueError, match="a divergence is at least 0 nats; got -1"):
        worst_probability(0.5, -1)
    with pytest.raises(ValueError, match="between 0 and 1; got 2"):
        radius_of(2, 0.5)


def test_intervals_of_a_fixed_number_of_pairs_are_narrower():
    fixed, any_time = paired_rates(1, 8, 900, at_any_time=False), paired_rates(1, 8, 900)
    assert any_time.low < fixed.low < fixed.estimate < fixed.high < any_time.high
    assert "whenever" not in str(fixed)
    assert "whenever stopped" in str(any_time)


def decay(t, state, control, features):
    return -features["rate"] * state


SPACE = {"rate": vj.Box(0.5, 2.0), "start": vj.Box(0.5, 2.0)}


def decaying(dt, method="euler", limit=0.3):
    system = vj.ode(
        decay, lambda f, key: f["start"] * jnp.ones(1), dt=dt, duration=1.0, method=method,
        signals=lambda t, s, c, f: {"x": s[0]},
    )  # fmt: skip
    return vj.Problem("decay", SPACE, system, f"eventually x < {limit}")


@pytest.mark.slow
def test_the_parts_of_an_estimate(tmp_path):
    problem = decaying(0.25)
    result = vj.estimate(problem, "monte_carlo", 2000, p0=0.9, progress=False)
    exact = decaying(0.25, "rk4")
    found = vj.error_budget(problem, result, pairs=2000, solvers={"rk4": exact}, seeds=1)
    rng = np.random.default_rng(0)
    rate, start = rng.uniform(0.5, 2.0, (2, 400_000))
    truth = float(np.mean(start * np.exp(-rate) >= 0.3))
    simulated = float(np.mean(start * (1 - rate * 0.25) ** 4 >= 0.3))
    step = truth - simulated
    assert step > 0.02
    assert found["step"].low <= step <= found["step"].high
    assert found["step"].high - found["step"].low < 0.15
    assert found.low <= truth <= found.high
    assert found["rk4"].low <= step <= found["rk4"].high
    assert not found["rk4"].counted
    assert not found["seeds"].counted
    assert found["precision"].low <= 0 <= found["precision"].high
    assert found["randomness"].text == "The model draws no random numbers."
    assert found.prior.radius == pytest.approx(radius_of(found.high, 0.9))
    text = str(found)
    assert "With sampling, step, precision together, the failure probability of decay lies" in text
    assert "needs the prior to be right within" in text
    page = result.report(tmp_path / "report.html", problem=problem, errors=found).read_text()
    assert "How wrong the number can be" in page
    assert "Claim E1: With sampling, step, precision together" in page
    claims = json.loads((tmp_path / "report.claims.json").read_text())["claims"]
    assert claims[-1]["claim"] == found.total
    assert list(found.table.part) == ["sampling", "step", "precision", "rk4", "seeds", "randomness"]


def coin(features, key):
    x = features["a"] + 0.2 * jax.random.normal(key)
    return vj.Trace({"x": x * jnp.ones(2)}, dt=1.0)


@pytest.mark.thorough
def test_a_system_with_chance_and_without_a_step():
    problem = vj.Problem("coin", {"a": vj.Box(0.0, 1.0)}, coin, "always x < 0.9")
    run = vj.falsify(problem, "uniform", 500, progress=False, confirm=False)
    assert run.failure_rate is not None
    found = vj.error_budget(problem, run.failure_rate, pairs=2000, limit=0.01)
    assert not found["step"].measured
    assert not found["precision"].measured
    assert not found["solver"].measured
    assert "Not measured, and not in it: step, precision, solver." in found.total
    assert "of the verdicts change" in found["randomness"].text
    assert found.prior.radius == 0
    assert "is not shown under this prior" in str(found.prior)


@pytest.mark.slow
def test_a_comparison():
    first, second = decaying(0.25), decaying(0.25, limit=0.31)
    compared = vj.compare(first, second, budget=2000, progress=False)
    found = vj.error_budget(second, compared["candidate"], baseline=first, pairs=500)
    assert found.what == "the difference of the failure probabilities"
    assert -1 <= found.low < found.high <= 1
    assert found["step"].low < 0 < found["step"].high
    with pytest.raises(ValueError, match="needs its baseline"):
        vj.error_budget(second, compared["candidate"])


def test_what_is_refused():
    problem, rate = decaying(0.25), vj.clopper_pearson(1, 100)
    with pytest.raises(ValueError, match="a baseline goes with a candidate"):
        vj.error_budget(problem, rate, baseline=problem)
    with pytest.raises(TypeError, match="got str"):
        vj.error_budget(problem, "rate")
    other = replace(problem, spec={"other": "always x < 1"})
    with pytest.raises(ValueError, match="solver 'b' must be the same problem"):
        vj.error_budget(problem, rate, solvers={"b": other})


def pendulum(t, s, c, f):
    return jnp.stack([s[1], -f["k"] * jnp.sin(s[0]) - 0.1 * s[1]])


def spring(t, s, c, f):
    return jnp.stack([s[1], -f["k"] * s[0]])


def van_der_pol(t, s, c, f):
    return jnp.stack([s[1], f["k"] * (1 - s[0] ** 2) * s[1] - s[0]])


def logistic(t, s, c, f):
    return jnp.stack([f["k"] * s[0] * (1 - s[0]), 0.0 * s[1]])


def predator(t, s, c, f):
    return jnp.stack([s[0] * (1 - s[1]), -f["k"] * s[1] * (1 - s[0])])


KNOWN = [
    (pendulum, "always x < 1.2"), (spring, "always x < 1.4"), (van_der_pol, "always x < 1.4"),
    (logistic, "always[2, 3] x > 0.9"), (predator, "always x < 2"),
]  # fmt: skip
"""Equations, and a limit that some simulations keep and some break."""


@pytest.mark.proves
# Compiles five programs of each of twenty systems, and simulates each of them 100 000 times.
def test_the_step_error_covers_that_of_a_step_sixteen_times_finer():
    covered, cases = 0, []
    rng = np.random.default_rng(7)
    for dynamics, formula in KNOWN:
        for method, dt in (("euler", 0.05), ("euler", 0.2), ("rk4", 0.1), ("rk4", 0.5)):
            system = vj.ode(
                dynamics, lambda f, key: jnp.stack([f["x"], f["v"]]), dt=dt, duration=3.0,
                method=method, signals=lambda t, s, c, f: {"x": s[0]},
            )  # fmt: skip
            space = {"k": vj.Box(0.5, 2.0), "x": vj.Box(0.2, 1.2), "v": vj.Box(0.2, 1.2)}
            problem = vj.Problem("known", space, system, formula)
            rate = vj.clopper_pearson(0, 1)
            part = vj.error_budget(problem, rate, pairs=4000, seed=len(cases))["step"]
            points = rng.random((100_000, 3), np.float32)
            rates = [
                float(np.mean(Evaluator(replace(problem, system=each), 4096)(points).violated))
                for each in (system, system.refined(16))
            ]
            inside = part.low <= rates[1] - rates[0] <= part.high
            covered += inside
            cases.append((dynamics.__name__, method, dt, rates, part.low, part.high, inside))
    print(*cases, sep="\n")
    assert covered >= 19, cases


SPEC = """
import jax.numpy as jnp
import verifai_jax as vj
SYSTEM = vj.ode(lambda t, s, c, f: -f["a"] * s, lambda f, key: jnp.ones(1), dt=0.5, duration=1.0,
                signals=lambda t, s, c, f: {"x": s[0]})
old = vj.Problem("old", {"a": vj.Box(0.0, 2.0)}, SYSTEM, "always x > 0.3")
new = vj.Problem("new", {"a": vj.Box(0.0, 2.0)}, SYSTEM, "always x > 0.4")
"""


@pytest.mark.slow
def test_the_commands_say_it_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(SPEC)
    ask = lambda *words: CliRunner().invoke(main, list(words))  # noqa: E731
    done = ask("estimate", "spec.py:old", "--method", "monte_carlo", "--budget", "200", "--errors",
               "200", "--report", "out.html")  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "the failure probability of old lies between" in done.output
    assert "How wrong the number can be" in (tmp_path / "out.html").read_text()
    done = ask("compare", "spec.py:old", "spec.py:new", "--budget", "400", "--errors", "100")
    assert done.exit_code == 0, done.output
    assert "the difference of the failure probabilities of new lies between" in done.output
