"""Several formulas in a priority order, and stopping by what the samples say of the rate."""

import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj

SPACE = {"hit": vj.Box(0, 1), "jerk": vj.Box(0, 1), "late": vj.Box(0, 1)}
SPEC = {
    "safe": "always hit < 0.97",
    "smooth": "always jerk < 0.5",
    "punctual": "always late < 0.5",
}


def trip(features, key):
    return vj.Trace({name: value * jnp.ones(3) for name, value in features.items()}, dt=1.0)


@pytest.fixture(scope="module")
def ordered():
    edges = [("safe", "smooth"), ("safe", "punctual")]
    return vj.Problem("trip", space=SPACE, system=trip, spec=SPEC, priority=edges)


@pytest.fixture(scope="module")
def plain():
    return vj.Problem("trip", space=SPACE, system=trip, spec=SPEC)


def test_the_order_of_a_problem(ordered, plain):
    assert ordered.rulebook.order == ("safe", "smooth", "punctual")
    assert plain.rulebook is None
    chain = vj.Problem(
        "trip", space=SPACE, system=trip, spec=SPEC, priority=["punctual", "safe", "smooth"]
    )
    assert chain.rulebook.order == ("punctual", "safe", "smooth")
    with pytest.raises(ValueError, match="unknown rule 'save'; did you mean 'safe'"):
        vj.Problem("trip", space=SPACE, system=trip, spec=SPEC, priority=["save", "smooth"])


@pytest.mark.slow
def test_a_search_goes_for_the_gravest(ordered, plain):
    # Three in four samples break one of the lesser rules, one in thirty the important one.
    def grave(problem):
        runs = [vj.falsify(problem, "cross_entropy", 480, batch=16, seed=seed) for seed in range(4)]
        return [float((run.table.all["rho.safe"] < 0).mean()) for run in runs]

    assert min(grave(ordered)) > 0.3
    assert max(grave(plain)) < min(grave(ordered))


@pytest.mark.thorough
def test_the_front_holds_the_gravest_failures(ordered, plain):
    run = vj.falsify(ordered, "uniform", 256, batch=256)
    broken = np.maximum(-run.table.all[[f"rho.{name}" for name in SPEC]].to_numpy(), 0)
    front = run.front
    assert set(front.index) <= set(run.table.counterexamples.index)
    # The row that breaks safety most is in it, and all others break it as much.
    assert front["rho.safe"].max() == run.table.all["rho.safe"].min()
    # Without a priority all three corners are, and nothing in it is outdone in everything.
    front = vj.falsify(plain, "uniform", 256, batch=256).front
    assert len(front) >= 3
    for row in front.index:
        assert not np.any(np.all(broken > broken[row], axis=1))


@pytest.mark.thorough
def test_front_of_one_formula_is_its_worst_row(plain):
    problem = vj.Problem("one", space=SPACE, system=trip, spec=SPEC["smooth"])
    run = vj.falsify(problem, "uniform", 64, batch=64)
    assert list(run.front.index) == [run.best.name]
    kept = vj.Problem("kept", space=SPACE, system=trip, spec="always jerk < 2")
    assert len(vj.falsify(kept, "uniform", 16, batch=16).front) == 0


@pytest.mark.slow
def test_resuming_keeps_the_gravest(ordered):
    whole = vj.falsify(ordered, budget=96, batch=16)
    part = vj.falsify(ordered, budget=48, batch=16)
    assert vj.resume(part, budget=96).table.all.equals(whole.table.all)


class TestStopWhen:
    def test_a_run_ends_when_the_rate_is_known_within_a_width(self, plain):
        run = vj.falsify(plain, "uniform", 100_000, batch=256, stop=vj.Stop(when=vj.Within(0.05)))
        assert run.stopped == "stop_when"
        assert run.failure_rate.high - run.failure_rate.low <= 0.1
        assert run.failure_rate.low <= 1 - 0.97 * 0.25 <= run.failure_rate.high
        assert 256 < run.simulations < 4096

    def test_a_run_ends_when_the_rate_is_decided(self, plain):
        run = vj.falsify(plain, "uniform", 100_000, batch=256, stop=vj.Stop(when=vj.Decided(0.5)))
        assert run.failure_rate.low > 0.5

    def test_only_for_prior_samples(self, plain):
        with pytest.raises(ValueError, match=r"Stop\(when=\) needs independent samples"):
            vj.falsify(plain, "cross_entropy", stop=vj.Stop(when=vj.Within(0.05)))
        with (
            unchecked(),
            pytest.raises(TypeError, match=r"a rule such as Within\(0.005\); got 0.05"),
        ):
            vj.falsify(plain, "uniform", stop=vj.Stop(when=0.05))
