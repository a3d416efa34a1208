"""What a run claims of a host system has been simulated once more, and has failed again."""

import itertools

import host_systems
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.confirmations import Repetitions, came_otherwise
from verifai_jax.evaluation.confirmer import REPEATED
from verifai_jax.systems.base import System

SPACE = vj.FeatureSpace({"a": vj.Box(0.0, 1.0)})


def problem(system, spec="always x > 0"):
    if not isinstance(system, System):
        system = vj.blackbox(system)
    return vj.Problem("own", SPACE, system, spec)


def constant(x):
    return Trace({"x": np.full(4, float(x))}, dt=0.1)


class Counter:
    """Counts its simulations, and gives what a function makes of features and count."""

    def __init__(self, function):
        self.function, self.count = function, 0

    def __call__(self, features):
        self.count += 1
        return constant(self.function(features["a"], self.count))


def failing_at(every):
    return Counter(lambda a, count: -1.0 if count % every == 0 else 1.0)


def falsified(system, budget=50, **options):
    options = {"search": "uniform", "batch": 25, "progress": False} | options
    return vj.falsify(problem(system), budget=budget, **options)


def same_verdicts(run):
    """Return the verdicts of the run and of `confirm`, row by row."""
    failing = run.table.violating
    return list(failing["verdict"]), [vj.confirm(run, int(row)).verdict for row in failing.index]


@pytest.mark.thorough
def test_what_fails_at_every_seventh_call_is_not_claimed():
    run = falsified(failing_at(7))
    assert len(run.table.counterexamples) == 0
    lost = run.table.unconfirmed
    assert len(lost) >= 6
    assert (lost["rho"] == -1.0).all()
    assert (lost["rho_again"] == 1.0).all()
    first, second = str(run).splitlines()[:2]
    assert first.endswith("of 50 simulations violate the property")
    n = len(lost)
    assert second == (
        f"  its own      the system has memory or chance of its own: of {n} violating rows "
        f"simulated again with the same features and seed, {n} gave another robustness (by up to "
        f"2), and {n} did not fail"
    )
    said = vj.confirm(run, int(lost.index[0]))
    assert said.why in (
        "it holds when simulated again: robustness 1, and -1 in the run",
        "it did not come again when the run simulated it again, with robustness 1",
    )
    of_run, of_confirm = same_verdicts(run)
    assert of_run == of_confirm == ["fragile"] * n


@pytest.mark.thorough
def test_a_counter_in_a_file_is_memory_too(tmp_path):
    file = tmp_path / "count"

    def simulate(features):
        count = int(file.read_text()) + 1 if file.exists() else 1
        file.write_text(str(count))
        return constant(features["a"] - 0.5 + 0.02 * count)

    run = falsified(simulate, 20, batch=20)
    repetitions = run.table.counts.repetitions
    assert repetitions.moved == repetitions.rows == len(run.table.violating) > 0
    assert "memory or chance of its own" in str(run).splitlines()[1]
    of_run, of_confirm = same_verdicts(run)
    assert of_run == of_confirm


@pytest.mark.slow
def test_a_deterministic_system_is_confirmed_and_costs_little():
    steady = Counter(lambda a, count: a - 0.5)
    run = falsified(steady, 40)
    failing = run.table.counterexamples
    assert steady.count == 40 + len(failing)
    assert set(failing["verdict"]) == {"confirmed"}
    np.testing.assert_array_equal(failing["rho"], failing["rho_again"])
    assert np.isnan(run.table.safe["rho_again"]).all()
    assert "own  " not in str(run)
    assert run.checked == "when simulated again; no finer step could be tried"
    assert same_verdicts(run)[0] == same_verdicts(run)[1]
    steady.count = 0
    run = falsified(steady, 1000, batch=50)
    assert steady.count <= 1050
    assert run.verdict_counts["confirmed"] == steady.count - 1000 >= REPEATED
    assert set(run.verdict_counts) == {"confirmed", "unexamined"}
    assert "unexamined: not claimed, as not replayed" in str(run)
    # The worst of all has been simulated again.
    assert run.best["verdict"] == "confirmed"


def test_without_confirm_nothing_is_simulated_again():
    steady = Counter(lambda a, count: a - 0.5)
    run = falsified(steady, 40, confirm=False)
    assert steady.count == 40
    assert "rho_again" not in run.table.all


def test_once_a_row_came_otherwise_all_are_simulated_again():
    # It remembers: from its 200th simulation on it fails nowhere.
    forgetful = Counter(lambda a, count: -1.0 - a if count <= 200 else 1.0)
    run = falsified(forgetful, 200, batch=200)
    assert run.verdict_counts == {"fragile": 200}
    # One simulation each, but for those that fail again.
    assert forgetful.count == 400


def test_rounding_between_repetitions_is_no_memory_and_is_told():
    noise = np.random.default_rng(0)
    run = falsified(Counter(lambda a, count: (a - 0.5) * (1 + 1e-6 * noise.random())))
    assert set(run.verdict_counts) == {"confirmed"}
    text = str(run)
    assert "memory or chance" not in text
    assert "have other last digits, by up to" in text
    found = vj.confirm(run)
    assert found.counts == {"confirmed": len(found)}
    assert "have other last digits" in found.notes[0]


def test_another_number_that_fails_too_is_confirmed_and_told():
    run = falsified(Counter(lambda a, count: -1.0 - 0.01 * count), 20, batch=20)
    assert set(run.verdict_counts) == {"confirmed"}
    repetitions = run.table.counts.repetitions
    assert (repetitions.rows, repetitions.moved, repetitions.lost) == (20, 20, 0)
    assert "20 gave another robustness" in str(run).splitlines()[1]
    assert vj.confirm(run).counts == {"confirmed": 20}


def test_what_raises_when_it_is_simulated_again_is_not_claimed():
    def raises(a, count):
        if count > 20 and count % 2:
            raise RuntimeError("the port is taken")
        return -1.0

    run = falsified(Counter(raises), 20, batch=20)
    assert set(run.table.unconfirmed["verdict"]) == {"fragile"}
    assert "10 did not fail" in str(run).splitlines()[1]
    # Where nothing can be simulated any more, that says nothing of the row.
    down = falsified(Counter(lambda a, count: -1.0 if count <= 20 else 1 / 0), 20, batch=20)
    assert set(down.table.all["verdict"]) == {"raised"}
    assert "every replay to confirm them raised" in str(down)


@pytest.mark.thorough
def test_a_search_learns_what_came_again():
    # Fails by chance everywhere, but surely nowhere.
    system = failing_at(5)
    run = falsified(system, 60, search="cross_entropy", batch=20)
    assert run.table.counts.claimed == 0
    assert run.stopped == "budget"


def test_a_resumed_run_knows_that_its_system_wavers():
    run = falsified(failing_at(4), 25)
    assert run.table.counts.repetitions.lost
    checkpoint = run.checkpoint["confirmer"]
    assert checkpoint[2:].tolist() == [1.0, 1.0]
    longer = vj.resume(run, budget=50, progress=False)
    assert longer.table.counts.claimed == 0


@pytest.mark.slow
def test_workers_repeat_in_another_process():
    system = vj.blackbox(host_systems.counting, workers=2, signals=("x", "pid"))
    try:
        one, other = np.random.default_rng(0).random(2)
        features, seeds = [{"a": one}, {"a": other}, {"a": 0.5}], [1, 2, 3]
        pids = []
        for _ in range(3):
            found = dict(system.simulate_each(features, seeds))
            pids.append([found[i].trace["pid"][0] for i in range(3)])
        for before, after in itertools.pairwise(pids):
            assert all(a != b for a, b in zip(before, after, strict=True))
        assert len(np.unique(pids)) == 2
        run = vj.falsify(problem(system), "uniform", 24, batch=24, progress=False)
    finally:
        system.close()
    assert run.table.counts.claimed == 0
    assert "memory or chance of its own" in str(run).splitlines()[1]


@pytest.mark.thorough
@pytest.mark.addons
def test_an_environment_with_a_running_mean_is_found_out():
    gym = pytest.importorskip("gymnasium")

    def make():
        return gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1"))

    system = vj.gymnasium(
        make,
        lambda observation: np.array([-observation[2]]),
        steps=20,
        signals=lambda env, observation, action, reward, features: {"x": observation[2]},
        features=("g",),
    )
    problem = vj.Problem("pendulum", {"g": vj.Box(5.0, 15.0)}, system, "always abs(x) < 2")
    run = vj.falsify(problem, "uniform", 20, batch=20, progress=False)
    repetitions = run.table.counts.repetitions
    assert repetitions.moved == repetitions.rows > 0
    assert "memory or chance of its own" in str(run).splitlines()[1]
    of_run, of_confirm = same_verdicts(run)
    assert of_run == of_confirm
    fresh = system.renewed()
    assert fresh.simulation.function is not system.simulation.function
    assert fresh.simulation.function.environment is not system.simulation.function.environment


@pytest.mark.thorough
@pytest.mark.addons
def test_fuzz_claims_what_came_again():
    run = vj.fuzz(problem(failing_at(17)), 60, batch=20, progress=False)
    assert run.table.counts.violating > 0
    assert run.table.counts.claimed == 0
    assert "memory or chance of its own" in str(run).splitlines()[1]


@pytest.mark.slow
def test_certificates_show_what_came_again():
    systems = {0.0: failing_at(7), 1.0: Counter(lambda a, count: a - 0.3)}
    certificates = vj.certify(
        lambda policy: problem(systems[float(policy)]),
        [0.0, 1.0],
        p=0.2,
        certification=vj.Certification(samples=16, attack_simulations=16, budget=32),
    )
    wavering, steady = certificates
    assert len(wavering.counterexamples["rho"]) == wavering.attack_failures == 0
    assert wavering.failures > 0
    assert wavering.worst_robustness == 1.0
    taken_out = (
        f"worst robustness 1, leaving out {wavering.fragile} failures that did not fail again"
    )
    assert wavering.fragile > 1
    assert taken_out in str(certificates)
    assert steady.fragile == 0
    assert len(steady.counterexamples["rho"]) == steady.failures + steady.attack_failures > 0
    (note,) = certificates.notes
    assert note.startswith("policy 0: the system has memory or chance of its own")


@pytest.mark.slow
@pytest.mark.addons
def test_a_corpus_holds_what_comes_again(tmp_path):
    wavering = Counter(lambda a, count: 1.0 if count % 2 else -1.0)
    run = falsified(wavering, 10, batch=10, confirm=False)
    claimed = len(run.table.counterexamples)
    assert claimed == 5
    wavering.count = 0
    assert run.save_counterexamples(tmp_path / "none", max_count=1) == []
    steady = falsified(Counter(lambda a, count: a - 0.5), 10, batch=10)
    [path] = steady.save_counterexamples(tmp_path / "some", max_count=1)
    assert vj.replay_counterexamples(steady.problem, path).failing
    wavering.count = 1
    seen = vj.replay_counterexamples(problem(wavering), path)
    assert not seen.failing
    assert not seen.passed
    assert "closer replays do not confirm it: it holds when simulated again: robustness 1" in str(
        seen
    )


def test_counts_of_repetitions():
    rho = np.array([-1.0, -1.0, -1.0, -1.0, -2.0])
    again = np.array([-1.0, -1.0 - 1e-6, 0.5, np.nan, np.nan])
    verdict = np.array(["confirmed", "confirmed", "fragile", "fragile", "unexamined"], object)
    found = Repetitions.count(rho, again, verdict)
    assert (found.rows, found.moved, found.rounded, found.lost) == (4, 2, 1, 2)
    assert found.max_difference == 1.5
    assert found.joined(Repetitions()) == found
    assert str(Repetitions(5)) == ""
    assert came_otherwise(rho, again).tolist() == [False, False, True, False, False]
