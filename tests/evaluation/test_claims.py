"""What `falsify` claims: rows that closer replays confirm, and failures of different kinds."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.falsification.validation import adapt_search
from verifai_jax.problem.dependence import has_gradient
from verifai_jax.search import Portfolio


@dataclasses.dataclass(frozen=True)
class Decay:
    """x' = -rate x by explicit Euler, which oscillates where the step is too long."""

    dt: float = 0.5

    def __call__(self, features, key=None):
        steps = round(4 / self.dt)
        x = features["x0"] * (1 - features["rate"] * self.dt) ** jnp.arange(steps + 1)
        every = round(0.5 / self.dt)
        return vj.Trace({"x": x[::every]}, dt=0.5)

    def refined(self, factor):
        return Decay(self.dt / factor)


SPACE = {"x0": vj.Box(0, 1), "rate": vj.Box(0.1, 3)}


@pytest.fixture(scope="module")
def artefact():
    # The true solution never changes its sign.
    return vj.Problem("artefact", SPACE, Decay(), "always x >= -0.05")


@pytest.mark.thorough
def test_artefacts_of_the_step_are_not_claimed(artefact):
    run = vj.falsify(artefact, "halton", 64, batch=64)
    raw = run.table.all
    assert raw["violated"].sum() > 5
    assert set(raw.loc[raw["violated"], "verdict"]) == {"refuted"}
    assert (raw.loc[~raw["violated"], "verdict"] == "").all()
    assert len(run.table.counterexamples) == 0
    assert len(run.table.unconfirmed) == raw["violated"].sum()
    assert "refuted and not claimed" in run.summary()
    # As simulated it does fail, and a run that is not asked to confirm says so.
    trusting = vj.falsify(artefact, "halton", 64, batch=64, confirm=False)
    assert len(trusting.table.counterexamples) == raw["violated"].sum()
    assert "verdict" not in trusting.table.all


@pytest.mark.thorough
def test_a_search_goes_on_where_nothing_is_confirmed(artefact):
    run = vj.falsify(artefact, "mutation", 48, batch=8, stop=vj.Stop(after=1))
    assert (run.simulations, run.stopped) == (48, "budget")
    assert len(run.table.unconfirmed)


@pytest.mark.slow
def test_true_failures_are_claimed():
    problem = vj.Problem("slow", SPACE, Decay(0.125), "eventually[0, 4] x <= 0.3")
    run = vj.falsify(problem, budget=64, batch=1, stop=vj.Stop(after=1))
    assert len(run.table.counterexamples) == 1
    row = run.best
    assert row["verdict"] == "confirmed"
    assert row["x0"] * np.exp(-4 * row["rate"]) > 0.3
    assert "1 confirmed in double precision, at a third and a quarter of the step" in run.summary()


@pytest.mark.slow
def test_slopes_are_left_out_where_there_are_none():
    space = {"a": vj.Box(0, 10), "b": vj.Box(0, 1)}

    def count(features, key):
        gear = jnp.round(features["a"]).astype(jnp.int32)
        return vj.Trace({"gear": gear[None], "a": features["a"][None]}, dt=1.0)

    counted = vj.Problem("gears", space, count, "gear < 9")
    assert not has_gradient(counted)
    assert has_gradient(vj.Problem("slopes", space, count, "gear < 9 & a < 9.5"))
    search, notes = adapt_search(counted, Portfolio())
    assert search == Portfolio(gradients=False)
    assert notes == ("portfolio without gradients: the robustness is constant almost everywhere",)
    run = vj.falsify(counted, budget=64, batch=8, stop=vj.Stop(after=1))
    assert len(run.table.counterexamples) >= 1
    assert "differentiated" not in run.table.all
    assert notes[0] in run.notes


@pytest.mark.addons
@pytest.mark.slow
def test_diverse_failures_are_of_both_kinds():
    def system(features, key):
        x, y = features["x"], features["y"]
        one, two = (jnp.hypot(x - a, y - b) for a, b in ((0.2, 0.2), (0.8, 0.75)))
        return vj.Trace({"far": jnp.minimum(one - 0.08, two - 0.05)[None]}, dt=1.0)

    space = {"x": vj.Box(0, 1), "y": vj.Box(0, 1)}
    problem = vj.Problem("two", space, system, "far > 0")
    run = vj.falsify(
        problem, "diverse", budget=2000, batch=16, stop=vj.Stop(after=4), confirm=False
    )
    failing = run.table.counterexamples
    assert run.stopped == "stop_after"
    assert (failing["x"] < 0.5).any()
    assert (failing["x"] > 0.5).any()
    assert "Diverse(search=Portfolio" in run.search
