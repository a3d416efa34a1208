"""Simulators on the host: in lock-step, one by one in any order, with rows that fail."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.evaluation.journal import JOURNAL, Journal
from verifai_jax.evaluation.verdicts import RowVerdict
from verifai_jax.falsification.loop import Rounds
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.search import Uniform
from verifai_jax.systems.base import Outcome

SPACE = {"a": vj.Box(0, 1), "b": vj.Box(-1, 1)}
SPEC = "always x <= 0.9"
CLOCK = np.linspace(0, 1, 5)


def ramp(features, key):
    return Trace({"x": (features["a"] + 0.1 * features["b"]) * jnp.asarray(CLOCK)}, dt=0.25)


class LockStep:
    black_box: ClassVar[bool] = True

    def __call__(self, features, key=None):
        return ramp(features, key)

    def simulate_batch(self, features, keys):
        return jax.vmap(ramp)(features, keys)


class OneByOne:
    """Answers in a shuffled order; what each row does depends on its feature alone."""

    black_box: ClassVar[bool] = True

    def __init__(self):
        self.simulated = []

    def __call__(self, features, key=None):
        return ramp(features, key)

    def outcome(self, features):
        if features["b"] > 0.9:
            return Outcome(None, Status.TIMEOUT, "no answer for 1 s")
        if features["b"] < -0.9:
            return Outcome(None, Status.ERROR, "worker died")
        trace = ramp(features, None)
        # Traces of several lengths: held at the end, they say the same.
        return Outcome(trace if features["b"] > 0 else held(trace, 9))

    def simulate_each(self, features, seeds):
        for i in np.random.default_rng(1).permutation(len(features)):
            self.simulated.append(round(features[i]["a"], 6))
            yield int(i), self.outcome(features[i])


def held(trace, length):
    signals = {
        n: np.append(s, [np.asarray(s)[-1]] * (length - 5)) for n, s in trace.signals.items()
    }
    return dataclasses.replace(trace, signals=signals)


def problem_of(system):
    return vj.Problem("ramp", SPACE, system, SPEC)


@pytest.fixture(scope="module")
def traced():
    return vj.falsify(problem_of(ramp), "uniform", 200, batch=64).table.all


@pytest.mark.slow
def test_lock_step_gives_the_table_of_the_traced_system(traced):
    table = vj.falsify(problem_of(LockStep()), "uniform", 200, batch=64).table.all
    assert (table["message"] == "").all()
    np.testing.assert_allclose(table["rho"], traced["rho"], atol=1e-6)
    assert (table["violated"] == traced["violated"]).all()


@pytest.mark.thorough
def test_rows_come_in_any_order_and_are_told_apart(traced):
    table = vj.falsify(problem_of(OneByOne()), "uniform", 200, batch=64).table.all
    late, dead = table["b"] > 0.9, table["b"] < -0.9
    assert late.any()
    assert dead.any()
    assert (table.loc[late, "status"] == "timeout").all()
    assert (table.loc[late, "message"] == "no answer for 1 s").all()
    assert (table.loc[dead, "message"] == "worker died").all()
    proper = ~late & ~dead
    assert (table.loc[proper, "status"] == "ok").all()
    np.testing.assert_allclose(table.loc[proper, "rho"], traced.loc[proper, "rho"], atol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("system", "message"),
    [
        (lambda f: 3, "TypeError: the system must return a Trace; it returned int"),
        (lambda f: Trace({"y": np.ones(3)}, dt=1.0), "the trace has no signal 'x'"),
        (lambda f: 1 / 0, "ZeroDivisionError: division by zero"),
    ],
)
def test_what_goes_wrong_is_a_row(system, message):
    run = vj.falsify(
        problem_of(vj.blackbox(system)), "uniform", 40, batch=40, stop=vj.Stop(keep_going=True)
    )
    table = run.table.all
    assert len(table) == 40
    assert (table["status"] == "error").all()
    assert table["message"].str.contains(message, regex=False).all()


def test_a_simulator_that_exits_is_a_row():
    def simulate(f):
        raise SystemExit(3)

    table = vj.falsify(problem_of(vj.blackbox(simulate)), "uniform", 4, batch=4).table.all
    assert (table["status"] == "error").all()
    assert table["message"].str.contains("SystemExit: 3", regex=False).all()


def test_a_batch_of_the_wrong_form_is_rows_too():
    class Short(LockStep):
        def simulate_batch(self, features, keys):
            return jax.vmap(ramp)(*jax.tree.map(lambda leaf: leaf[:3], (features, keys)))

    table = vj.falsify(problem_of(Short()), "uniform", 8, batch=8).table.all
    assert (table["status"] == "error").all()
    assert "a batch of 8 simulations must give signals [8, time]; 'x' has" in table["message"][0]


@pytest.mark.thorough
def test_finished_rows_of_a_batch_survive_a_kill(tmp_path, traced):
    """A process that dies within a batch leaves a journal; only the other rows are simulated."""

    class Dies(OneByOne):
        def simulate_each(self, features, seeds):
            for k, answer in enumerate(super().simulate_each(features, seeds)):
                if k == 40:
                    raise KeyboardInterrupt
                yield answer

    folder = tmp_path / "run"
    whole = vj.falsify(problem_of(OneByOne()), "uniform", 64, batch=64)
    first = Dies()
    run = vj.falsify(problem_of(first), "uniform", 64, batch=64, folder=folder)
    assert run.stopped == "interrupted"
    assert len(run.table) == 0
    # The first sixteen, to see whether they raise, and forty of the others.
    assert "56 finished simulations of a batch in flight are kept" in run.summary()
    second = OneByOne()
    resumed = vj.resume(folder, problem_of(second))
    assert resumed.table.all.equals(whole.table.all)
    # An interrupted run has judged all that were simulated: only the others are, now, and what
    # violates the property once more.
    violating = resumed.table.counterexamples
    again = set(second.simulated) & set(first.simulated[:56])
    assert again <= set(violating["a"].astype(float).round(6))
    assert len(second.simulated) == 8 + len(violating)
    assert not (folder / JOURNAL).exists()


def test_journal_recalls_only_the_same_point(tmp_path):
    points = np.random.default_rng(0).random((3, 2)).astype(np.float32)
    journal = Journal(tmp_path)
    journal.add(7, points[1], RowVerdict(np.array([0.1, np.nan]), 1, np.array([True, False]), "é"))
    journal.settle(7)  # Nothing of the batch in flight is in the table yet.
    with open(journal.path, "ab") as file:
        file.write(journal.path.read_bytes()[:40])  # Where the process died.
    again = Journal(tmp_path)
    again.add(9, points[2], RowVerdict(np.array([0.5]), 0, np.array([True]), ""))
    again.settle(7)
    known = Journal(tmp_path).recall(6, points)
    assert list(known) == [1]
    assert known[1].message == "é"
    np.testing.assert_array_equal(known[1].rho, [0.1, np.nan])
    assert list(Journal(tmp_path).recall(7, points)) == [2]  # Row 7 is of another point.
    Journal(tmp_path).settle(10)
    assert not journal.path.exists()


def test_an_entry_of_the_journal_that_has_changed_is_none(tmp_path):
    point = np.array([[0.25, 0.5]], np.float32)
    journal = Journal(tmp_path)
    journal.add(0, point[0], RowVerdict(np.array([0.1234]), 0, np.array([True]), "x"))
    journal.settle(0)
    whole = journal.path.read_bytes()
    for at in range(len(whole)):
        journal.path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert Journal(tmp_path).recall(0, point) == {}
    journal.path.write_bytes(whole)
    assert Journal(tmp_path).recall(0, point)[0].rho == [0.1234]


def test_a_system_says_early_what_does_not_fit():
    class Picky(LockStep):
        def check(self, features):
            raise ValueError(f"no use for {sorted(features)}")

    with pytest.raises(ValueError, match=r"no use for \['a', 'b'\]"):
        problem_of(Picky()).check()

    class Told(LockStep):
        def abstract(self, features):
            return jax.eval_shape(lambda: Trace({"y": jnp.ones(5)}, dt=0.25))

    with pytest.raises(ValueError, match="the trace has no signal 'x'"):
        problem_of(Told()).check()


def test_zero_is_decided_by_the_comparator_without_another_simulation():
    system = OneByOne()
    problem = vj.Problem("edge", {"a": vj.Constant(0.0), "b": vj.Constant(0.5)}, system, "x > 0")
    rounds = Rounds(problem, Uniform(), 4, 0, ErrorTable(("a", "b")))
    rounds.compile()
    rounds.advance(4)
    assert rounds.tally.claimed == 4
    assert len(system.simulated) == 4


def one_row(function, spec="always x > 0", vectorised=False):
    problem = vj.Problem(
        "edge", {"a": vj.Box(0, 1)}, vj.blackbox(function, vectorised=vectorised), spec
    )
    return vj.falsify(problem, "uniform", budget=4, batch=4, confirm=False).table.all


@pytest.mark.parametrize("vectorised", [False, True])
def test_wide_integers_do_not_wrap(vectorised):
    def simulate(features):
        n = len(features["a"]) if vectorised else 1
        rows = np.full((n, 5), 2**40 + 5, np.int64)
        rows[:, 0] = 2**31
        stacked = vj.stack_traces({"x": rows}, dt=0.1)
        return stacked if vectorised else Trace({"x": rows[0]}, dt=0.1)

    rows = one_row(simulate, "always x > 6", vectorised)
    assert (rows.status == "ok").all()
    assert not rows.violated.any()
    assert (rows.rho == np.float32(2.0**31 - 6)).all()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"valid": 0}, "valid must be"),
        ({"valid": -1}, "valid must be"),
        ({"valid": 5}, "valid must be"),
        ({"status": 7}, "status must be"),
        ({"dt": None, "times": np.array([0.0, 1.0, 3.0, 4.0])}, "not evenly sampled"),
        ({"dt": None, "times": np.array([0.0, 1.0, 2.0, np.inf])}, "must be finite"),
    ],
)
def test_a_trace_with_wrong_codes_is_an_error_row(wrong, said):
    x = np.array([-1.0, 1.0, 1.0, 1.0])
    rows = one_row(lambda features: Trace({"x": x}, **{"dt": 0.1, **wrong}))
    assert (rows.status == "error").all()
    assert rows.message.str.contains(said).all()


def test_a_wrong_code_costs_its_own_row_of_a_batch_alone():
    def simulate(features):
        n = len(features["a"])
        x = np.tile([-1.0, 1.0, 1.0, 1.0], (n, 1))
        valid, status = np.full(n, 4), np.zeros(n, int)
        valid[0], status[1] = 0, 9
        times = np.tile(np.arange(4) * 0.5, (n, 1))
        return vj.stack_traces({"x": x}, times=times, valid=valid, status=status)

    rows = one_row(simulate, vectorised=True)
    assert list(rows.status) == ["error", "error", "ok", "ok"]
    assert list(rows.violated) == [False, False, True, True]
    assert rows.message[0].endswith("got 0")
    assert rows.message[1].endswith("got 9")


def test_even_sample_times_are_a_period():
    def simulate(features):
        return Trace({"x": np.array([1.0, 1.0, -1.0, 1.0])}, times=np.arange(4) * 0.5)

    problem = vj.Problem(
        "times", {"a": vj.Box(0, 1)}, vj.blackbox(simulate), "always[0, 0.5] x > 0"
    )
    run = vj.falsify(problem, "uniform", budget=2, batch=2)
    assert list(run.table.all.status) == ["ok", "ok"]
    assert not run.table.all.violated.any()
    assert run.replay(0).rho == {"spec": 1.0}
