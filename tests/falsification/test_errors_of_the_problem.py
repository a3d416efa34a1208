"""An error of the problem is one error: the run ends after its first simulations, unless asked."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation import raising
from verifai_jax.evaluation.raising import ALIKE, ALWAYS, FEW, SLOW, Raising

CALLS = []
SPACE = {"x": vj.Box(0.0, 1.0)}


def _trace(features):
    CALLS.append(features["x"])
    return vj.Trace({"x": np.full(3, features["x"]), "p": np.zeros((3, 2))}, dt=1.0)


def _raises(features):
    CALLS.append(features["x"])
    raise RuntimeError(f"no road at {features['x']}")


def _late(features):
    if len(CALLS) < 5:
        return _raises(features)
    return _trace(features)


def _sometimes(features):
    return _raises(features) if len(CALLS) % 2 else _trace(features)


def problem(function, formula="always x > 0.5", **options):
    CALLS.clear()
    return vj.Problem("p", SPACE, vj.blackbox(function, **options), formula)


HOPELESS = {
    "unknown signal": (_trace, "always y > 0", r"the trace has no signal 'y'"),
    "vector as a number": (_trace, "always p > 0", r"signal 'p' is a vector of 2 components"),
    "an interval between samples": (_trace, "F[0,0.7] x > 0", "does not fit the sampling period"),
    "always raises": (_raises, "always x > 0", r"RuntimeError: no road at 0\.\d+"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("search", ["auto", "uniform"])
@pytest.mark.parametrize("name", HOPELESS)
def test_the_run_ends_after_its_first_simulations(name, search, tmp_path):
    function, formula, says = HOPELESS[name]
    asked, folder = problem(function, formula), tmp_path / "run"
    with pytest.raises(vj.RunError, match=says) as caught:
        vj.falsify(asked, search, 1000, folder=folder, progress=False)
    said = str(caught.value)
    assert said.startswith("the run of 'p' ended after 64 of 1,000 simulations, since none ")
    assert said.endswith("Stop(keep_going=True), or --keep-going, simulates all")
    run = caught.value.run
    assert len(CALLS) == run.simulations == 64
    assert run.stopped == "an error of every simulation"
    assert list(run.table.all["status"]) == ["error"] * 64
    # The finished part is on disk, and the run can go on.
    assert len(vj.load(folder).table) == 64
    run = vj.resume(folder, asked, budget=90, stop=vj.Stop(keep_going=True), progress=False)
    assert run.simulations == 90


@pytest.mark.thorough
def test_whoever_asks_gets_all(tmp_path):
    run = vj.falsify(problem(_raises), "uniform", 40, stop=vj.Stop(keep_going=True), progress=False)
    assert run.simulations == 40
    assert vj.simulate(problem(_raises), [{"x": 0.1}] * 20, progress=False).simulations == 20
    few = vj.falsify(problem(_raises), "uniform", 8, progress=False)
    assert (few.simulations, few.stopped) == (8, "budget")


@pytest.mark.thorough
@pytest.mark.parametrize("function", [_late, _sometimes])
def test_where_some_succeed_the_run_goes_on_with_the_same_rows(function):
    first = vj.falsify(problem(function), "cross_entropy", 64, progress=False, confirm=False)
    again = vj.falsify(
        problem(function),
        "cross_entropy",
        64,
        stop=vj.Stop(keep_going=True),
        progress=False,
        confirm=False,
    )
    assert first.simulations == len(CALLS) == 64
    assert first.table.all.equals(again.table.all)


@pytest.mark.addons
@pytest.mark.thorough
def test_a_small_grid_is_simulated_whole():
    grid = vj.search.Grid(points=5)
    run = vj.falsify(problem(_trace), grid, 100, progress=False, confirm=False)
    assert (run.simulations, run.stopped) == (5, "exhausted")
    with pytest.raises(vj.RunError, match="ended after 64 of 100 simulations"):
        vj.falsify(problem(_raises), vj.search.Grid(points=90), 100, progress=False)


@pytest.mark.thorough
def test_a_system_of_many_at_once_ends_after_its_first_round():
    def together(features):
        raise KeyError("mass")

    asked = vj.Problem("p", SPACE, vj.blackbox(together, vectorised=True), "always x > 0")
    with pytest.raises(vj.RunError, match=r"ended after 64 of 512 .* KeyError: 'mass'"):
        vj.falsify(asked, "uniform", 512, batch=64, progress=False)

    def traced(features, key):
        bad = jnp.int32(Status.ERROR)
        return vj.Trace({"x": jnp.full(2, features["x"])}, dt=1.0, status=bad)

    with pytest.raises(vj.RunError, match=r"ended after 64 of 512 .* each raised an error"):
        vj.falsify(
            vj.Problem("p", SPACE, traced, "x > 0"), "uniform", 512, batch=64, progress=False
        )


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["always raises", "unknown signal"])
def test_other_verbs_end_too(name):
    function, formula, says = HOPELESS[name]
    asked = problem(function, formula)
    for verb in (
        lambda: vj.estimate(asked, budget=3000, progress=False),
        lambda: vj.compare(asked, {"other": asked}, budget=2000),
        lambda: vj.analysis.sobol_indices(asked, samples=64),
    ):
        CALLS.clear()
        with pytest.raises(RuntimeError, match=rf"each of the first 64 simulations .*{says}"):
            verb()
        assert len(CALLS) == 64


def _of_policy(policy):
    def simulate(features):
        return _raises(features) if policy < 3 else _trace(features)

    return vj.Problem("p", SPACE, vj.blackbox(simulate), "always x > 0.5")


@pytest.mark.thorough
def test_policies_of_which_all_raise_are_not_certified():
    options = {"certification": vj.Certification(64, attack_simulations=64), "progress": False}
    CALLS.clear()
    with pytest.raises(RuntimeError, match=r"each of the first 66 simulations .* no road at"):
        vj.certify(_of_policy, [0.0, 1.0, 2.0], **options)
    assert len(CALLS) == 66
    certificates = vj.certify(_of_policy, [0.0, 5.0], **options)
    assert [row.not_finite for row in certificates.rows] == [64, 0]


@pytest.mark.thorough
def test_parameters_with_which_all_raise_are_not_searched():
    space = {"x": vj.Box(0.0, 1.0), "k": vj.Box(0.0, 1.0)}
    asked = vj.Problem("p", space, vj.blackbox(_raises), "x > 0", nominal={"x": 0.5, "k": 0.5})
    for verb in (vj.synthesize, vj.repair):
        CALLS.clear()
        with pytest.raises(RuntimeError, match=r"each of the first 64 simulations .* no road at"):
            verb(asked, ["k"], budget=2000, progress=False)
        assert len(CALLS) == 64


def test_what_is_known_of_signals_is_checked_before():
    declared = problem(_trace, "always p > 0", signals={"x": 1, "p": 2})
    with pytest.raises(TypeError, match="signal 'p' is a vector of 2 components"):
        declared.check()
    with pytest.raises(TypeError, match="signal 'x' is a scalar"):
        dataclasses.replace(declared, spec="always x[0] > 0").check()
    dataclasses.replace(declared, spec="always[0,0.3] norm(p) > x").check()
    several = vj.blackbox(_trace, vectorised=True, signals=("x",))
    with pytest.raises(ValueError, match="the trace has no signal 'y'"):
        vj.Problem("p", SPACE, several, "y > 0").check()


def test_when_work_is_hopeless(monkeypatch):
    def told(messages, seconds=0.0):
        clock = [0.0]
        monkeypatch.setattr(raising.time, "monotonic", lambda: clock[0])
        asked = Raising()
        for message in messages:
            asked.add(np.array([Status.ERROR]), [message])
        clock[0] = seconds
        return asked.reason

    alike = [f"ValueError: {i / 3} is too much" for i in range(ALWAYS)]
    assert told(alike) == alike[0]
    assert told(alike[:-1]) is None
    # Nine of ten that raise by chance do not end a run of milliseconds; slow ones end sooner.
    assert told(alike[:ALIKE], seconds=SLOW + 1.0) == alike[0]
    assert told(alike[: ALIKE - 1], seconds=SLOW + 1.0) is None
    assert told(alike[:FEW], seconds=31.0) == alike[0]
    different = [f"ValueError: {'x' * i}" for i in range(ALWAYS)]
    assert told(different) == different[0]
    assert told(different[:-1], seconds=31.0) is None
    asked = Raising()
    asked.add(np.array([Status.ERROR] * 70 + [Status.TIMEOUT]), None)
    assert asked.reason is None
