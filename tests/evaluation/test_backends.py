"""Which backend simulates a problem whose system has several."""

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import verifai_jax as vj
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation import backends
from verifai_jax.evaluation.backends import resolved

SPACE = {"a": vj.Box(0, 1)}


def ramp(features, key):
    return Trace({"x": features["a"] * jnp.linspace(0, 1, 5)}, dt=0.25)


@dataclasses.dataclass(frozen=True, eq=False)
class TwoEngines:
    """Simulated by JAX or on the host, where each batch takes `slow` seconds."""

    backend: str = "auto"
    slow: float = 0.0
    backends: tuple[str, ...] = ("native", "mjx")
    broken: str = ""
    likely: str = "native"

    @property
    def black_box(self):
        return self.backend == "native"

    def with_backend(self, name):
        if name not in (*self.backends, "auto"):
            raise ValueError(f"backend {name!r} is not possible: {self.why_not(name)}")
        return dataclasses.replace(self, backend=name)

    def why_not(self, name):
        return f"no {name} for hills"

    def __call__(self, features, key=None):
        if self.broken and self.backend == "mjx":
            raise NotImplementedError(self.broken)
        return ramp(features, key)

    def simulate_batch(self, features, keys):
        time.sleep(self.slow)
        return jax.vmap(ramp)(features, keys)


def problem(**options: Any):
    return vj.Problem("two", SPACE, TwoEngines(**options), "always x <= 0.9")


@pytest.mark.slow
def test_a_gradient_needs_the_backend_that_jax_traces():
    run = vj.falsify(problem(), "gradient", 32, batch=8)
    assert run.backend == "mjx"
    assert run.notes == ("backend mjx: the search needs gradients",)
    assert "note         backend mjx: the search needs gradients" in run.summary()
    with pytest.raises(ValueError, match="is a black box, which has no gradient"):
        vj.falsify(problem(), "gradient", 32, run_on=vj.RunOn(backend="native"))
    alone = problem(backend="native", backends=("native",))
    with pytest.raises(ValueError, match="does not run on mjx: no mjx for hills"):
        vj.falsify(alone, "gradient", 32)


def test_a_short_run_does_not_wait_for_a_compiler():
    choice = resolved(problem(), batch=8, budget=8)
    assert choice.backend == "native"
    assert "less than compiling for mjx takes" in choice.why


def test_few_simulations_are_not_measured_however_slow(monkeypatch):
    monkeypatch.setattr(backends, "_speed", lambda *arguments: pytest.fail("measured"))
    choice = resolved(problem(likely="mjx"), batch=8, budget=30)
    assert choice.backend == "native"
    assert choice.why == "30 simulations, which take less than compiling for mjx takes"


@pytest.mark.thorough
@pytest.mark.parametrize(("slow", "faster"), [(0.2, "mjx"), (0.0, "native")])
def test_the_faster_one_is_taken_as_measured(monkeypatch, slow, faster):
    monkeypatch.setattr(backends, "WORTH_MEASURING", 0.0)
    if faster == "native":
        engine = backends.engine_for

        def slowed(*arguments, **options):
            made = engine(*arguments, **options)
            run = made.evaluate
            made.evaluate = lambda *a: (time.sleep(0.2), run(*a))[1]
            return made

        monkeypatch.setattr(backends, "engine_for", slowed)
    two = problem(slow=slow)
    choice = resolved(two, batch=8, budget=100)
    assert choice.backend == faster
    assert "simulations/s on native" in choice.why
    # Measured once: runs of one process agree.
    assert resolved(two, batch=8, budget=8)[:2] == choice[:2]


@pytest.mark.parametrize(
    ("likely", "budget", "tried"),
    [("native", 400, False), ("mjx", 400, True), ("mjx", 100, False), ("native", 2000, True)],
)
def test_a_compiler_is_asked_where_it_may_pay(monkeypatch, likely, budget, tried):
    monkeypatch.setattr(backends, "_speed", lambda engine, on, batch: 40 if on.black_box else 90)
    choice = resolved(problem(likely=likely), batch=8, budget=budget)
    assert choice.backend == ("mjx" if tried else "native")


def test_a_model_that_mjx_cannot_do_is_simulated_natively(monkeypatch):
    monkeypatch.setattr(backends, "WORTH_MEASURING", 0.0)
    choice = resolved(problem(broken="tendons with pulleys"), batch=8)
    assert choice.backend == "native"
    assert "mjx cannot simulate this model" in choice.why
    assert "tendons with pulleys" in choice.why


@pytest.mark.slow
def test_runs_remember_their_backend(tmp_path):
    two = problem()
    whole = vj.falsify(two, "uniform", 64, batch=16, run_on=vj.RunOn(backend="native"))
    vj.falsify(two, "uniform", 32, batch=16, run_on=vj.RunOn(backend="native"), folder=tmp_path)
    loaded = vj.load(tmp_path, two)
    assert loaded.backend == "native"
    assert loaded.problem is not None
    assert loaded.problem.black_box
    assert vj.resume(tmp_path, two, budget=64).table.all.equals(whole.table.all)
    assert loaded.replay(0).rho["spec"] == pytest.approx(whole.table.all["rho"][0])


def test_names_that_do_not_exist():
    with pytest.raises(ValueError, match="backend 'brax' is not possible: no brax for hills"):
        vj.falsify(problem(), "uniform", 8, run_on=vj.RunOn(backend="brax"))
    plain = vj.Problem("one", SPACE, ramp, "always x <= 0.9")
    with pytest.raises(ValueError, match="has no backends to choose from; got backend 'native'"):
        vj.falsify(plain, "uniform", 8, run_on=vj.RunOn(backend="native"))
