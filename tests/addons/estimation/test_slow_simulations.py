"""Few simulations: a surrogate, or a cheap model, proposes; fresh simulations are the estimate."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtri

import verifai_jax as vj
from tests.addons.estimation.closed_forms import closed_form, normal
from verifai_jax.addons.estimation.answers import Plan
from verifai_jax.addons.estimation.components import Gaussian, Prior
from verifai_jax.addons.estimation.control_variate import Control
from verifai_jax.addons.estimation.gaussian_surrogate import Surrogate
from verifai_jax.addons.estimation.importance import sample_proposal
from verifai_jax.addons.estimation.mixture import Mixture
from verifai_jax.addons.estimation.normal_space import LimitState
from verifai_jax.addons.estimation.surrogate import estimate_by_surrogate

PLAN = Plan(0.95, 32, np.zeros(2, bool))


def trap(z):
    """A robustness that leads away from the probable failures (Breitung, 2019); P = 3.209e-5."""
    a, b = z.T
    first = np.where(a > 3.5, 4 - a, 0.85 - 0.1 * a)
    return np.minimum(first, np.where(b > 2, 0.5 - 0.1 * b, 2.3 - b))


def series(z):
    """Four branches; P = 2.224e-3."""
    a, b = z.T
    root = np.sqrt(2)
    return np.minimum(3 + 0.1 * (a - b) ** 2 - np.abs(a + b) / root, 7 / root - np.abs(a - b))


CASES = {"trap": (trap, 3.209e-5), "series": (series, 2.224e-3)}


SIDES = [Gaussian(np.array([side, 0.0]), np.eye(2), np.array([0.5, 1.0])) for side in (-2.3, 2.3)]
WIDE = Mixture((Prior(2), *SIDES), np.array([0.1, 0.45, 0.45]))


def answer_of(robustness, seed, plan=PLAN, budget=500):
    limit_state = closed_form(lambda u: robustness(normal(u)), 2, budget)
    return limit_state, estimate_by_surrogate(limit_state, np.random.default_rng(seed), plan)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*CASES])
def test_five_hundred_simulations(name):
    robustness, truth = CASES[name]
    limit_state, answer = answer_of(robustness, 1)
    assert limit_state.simulations == 500
    assert answer.low < truth < answer.high < 1.6 * answer.low
    assert answer.diagnostics["agreement"] > 0.85
    assert answer.prior.simulations < 60


class Workers:
    """A limit state whose simulations are begun and waited for; notes what happens when."""

    def __init__(self, robustness):
        self.robustness, self.log = robustness, []

    def __call__(self, u):
        rho = self.robustness(normal(u))
        return rho, rho < 0, np.ones(len(u), bool)

    def begin(self, u):
        rho, violated, proper = self(u)
        name = len(self.log)
        self.log.append(f"begin {name}")

        def result():
            self.log.append(f"result {name}")
            return SimpleNamespace(lowest=rho, violated=violated, proper=proper)

        return SimpleNamespace(result=result, cancel=lambda: self.log.append("cancel"))


def test_simulations_that_are_begun_count_once_they_are_waited_for():
    workers = Workers(lambda z: 1 - z[:, 0])
    limit_state = LimitState(workers, 2, 100, batch=50)
    begun = limit_state.begin(np.array([[0.0, 0.0], [2.0, 0.0]]))
    assert (limit_state.simulations, workers.log) == (0, ["begin 0"])
    assert begun.result().failing.tolist() == [False, True]
    assert (limit_state.simulations, limit_state.failures) == (2, 1)
    # More than are simulated together are simulated when they are waited for.
    assert limit_state.begin(np.zeros((60, 2))).result().failing.sum() == 0
    assert workers.log == ["begin 0", "result 0"]


class Known(Surrogate):
    """One that says that everything beyond its border fails."""

    def predict(self, z):
        return self.border - np.abs(z[:, 0]), np.ones(len(z))


@pytest.mark.thorough
@pytest.mark.parametrize("shift", [0.0, 0.1, 3.0])
def test_a_control_variate_is_right_whatever_the_surrogate_is_worth(shift):
    rng, covered = np.random.default_rng(0), []
    surrogate = Known(2)
    surrogate.posterior, surrogate.border = True, 2.0 - shift
    for _ in range(20):
        # Half of the prior is refused; of the rest 0.0455 fails, more than two deviations away.
        limit_state = LimitState(
            lambda u: (lambda rho: (rho, rho < 0, rho < 9))(2.0 - np.abs(normal(u)[:, 0])),
            2, 400, batch=400, constraint=lambda u: u[:, 1] > 0.5,
        )  # fmt: skip
        control = Control(limit_state, rng, surrogate, WIDE)
        mean = control.estimate(sample_proposal(limit_state, rng, WIDE, 100), 0.95)
        covered.append(mean.low < 0.0455003 < mean.high)
        # Samples alone have a relative error of a fifth.
        assert mean.cv < 0.12 or shift
    assert np.mean(covered) > 0.9


@pytest.mark.slow
def test_workers_have_the_next_round_while_one_is_simulated():
    def half_space(z):
        return 2.5 - z[:, 0]

    workers = Workers(half_space)
    limit_state = LimitState(workers, 2, 120, batch=120)
    answer = estimate_by_surrogate(limit_state, np.random.default_rng(0), PLAN)
    assert workers.log[:3] == ["begin 0", "begin 1", "result 0"]
    # Whether there are workers decides about nothing else.
    _, same = answer_of(half_space, 0, budget=120)
    assert (answer.probability, answer.low) == (same.probability, same.low)


@pytest.mark.slow
def test_few_simulations_of_a_half_space():
    _, answer = answer_of(lambda z: 2.5 - z[:, 0], 0, budget=120)
    assert answer.low < 6.21e-3 < answer.high < 3 * answer.low


@pytest.mark.slow
def test_a_surrogate_that_is_wrong_everywhere_costs_precision_alone(monkeypatch):
    def wrong(self, z):
        return np.sin(3 * z.sum(axis=1)) + 0.5, np.full(len(z), 0.2)

    monkeypatch.setattr(Surrogate, "predict", wrong)
    for seed in range(2):
        _, answer = answer_of(series, seed)
        high = answer.high if answer.probability is not None else answer.prior.upper_bound(0.95)
        assert answer.low < 2.224e-3 < high


@pytest.mark.slow
def test_a_cheap_model_saves_simulations():
    def cheap(u):
        z = ndtri(np.clip(u, 1e-300, 1 - 1e-16))
        return 2 * series(z) + 0.3 * np.sin(2 * z[:, 0])

    helped, answer = answer_of(series, 2, Plan(*[0.95, 32, PLAN.clamped, 1.5], cheap=cheap))
    assert answer.low < 2.224e-3 < answer.high <= 1.5**2 * answer.low
    assert helped.simulations < 110
    # Another one that is wrong everywhere is found out.
    _, misled = answer_of(series, 2, Plan(*[0.95, 32, PLAN.clamped, 1.5], cheap=lambda u: u[:, 0]))
    assert misled.low < 2.224e-3 < misled.high


def slow(features):
    x, y = features["x"], features["y"]
    return vj.Trace({"m": np.array([3.2 - (x + y) / 2**0.5])}, dt=1.0)


def cheap(features, key):
    return vj.Trace({"m": (3.0 - (features["x"] + features["y"]) / 1.4)[None]}, dt=1.0)


SPACE = {"x": vj.Normal(0.0, 1.0), "y": vj.Normal(0.0, 1.0)}
SLOW = vj.Problem("slow", SPACE, vj.blackbox(slow), "m >= 0")
CHEAP = vj.Problem("cheap", SPACE, cheap, "m >= 0")


@pytest.mark.slow
class TestProblems:
    def test_estimate(self):
        result = vj.estimate(SLOW, budget=400, cheap=CHEAP)
        assert result.method == "surrogate"
        assert result.low < 6.871e-4 < result.high <= 1.5**2 * result.low
        assert result.simulations < 300
        assert "the surrogate knew the verdict of" in str(result)

    def test_falsify_begins_where_the_cheap_model_fails(self):
        run = vj.falsify(SLOW, vj.Start("uniform", cheap=CHEAP), 16, batch=8)
        assert run.table.all["violated"][:4].any()
        assert "cheap" not in str(run.table.all.columns)

    def test_slowness_is_measured(self, monkeypatch):
        import verifai_jax.addons.estimation._estimate as module

        monkeypatch.setattr(module, "SLOW", 0.0)
        result = vj.estimate(SLOW, budget=240)
        assert result.method == "surrogate"

    def test_command(self, tmp_path, monkeypatch):
        from click.testing import CliRunner

        from verifai_jax.cli.main import main

        monkeypatch.chdir(tmp_path)
        (tmp_path / "model.py").write_text(
            "import numpy as np\nimport verifai_jax as vj\n"
            "def slow(f):\n    return vj.Trace({'m': np.array([2.5 - f['x']])}, dt=1.0)\n"
            "tail = vj.Problem('tail', {'x': vj.Normal(0.0, 1.0)}, vj.blackbox(slow), 'm >= 0')\n"
        )
        options = ["--simulations-are", "slow", "--within", "1.5", "--budget", "300", "--json"]
        done = CliRunner().invoke(main, ["estimate", "model.py:tail", *options])
        assert done.exit_code == 0, done.output
        found = json.loads(done.stdout)
        assert found["low"] < 6.21e-3 < found["high"]
        assert found["method"] == "surrogate"


def test_what_does_not_fit_is_refused():
    other = vj.Problem("other", {**SPACE, "y": vj.Normal(0.0, 2.0)}, cheap, "m >= 0")
    fewer = vj.Problem("fewer", {"x": SPACE["x"]}, cheap, "m >= 0")
    with pytest.raises(vj.ProblemError, match=r"y is Normal\(.*in the cheap one Normal"):
        vj.estimate(SLOW, budget=400, cheap=other)
    with pytest.raises(vj.ProblemError, match="in the cheap one missing"):
        vj.falsify(SLOW, vj.Start(cheap=fewer), budget=16)
    with pytest.raises(ValueError, match="either rows, or a cheap model"):
        vj.falsify(SLOW, vj.Start(cheap=CHEAP, rows=[{"x": 0.0, "y": 0.0}]), budget=16)
    with pytest.raises(ValueError, match=r"within must be a factor above 1.*got 0\.5"):
        vj.estimate(SLOW, within=0.5)
