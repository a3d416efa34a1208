"""Simulators that raise what is no `Exception`, talk without end, fork, or answer twice."""

import os
import pickle
import time
from multiprocessing import Pipe

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.simulators.remote import wire
from verifai_jax.addons.simulators.remote_client import answer
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.systems.base import Outcome, outcome_of
from verifai_jax.systems.blackbox import blackbox, workers

SPACE = {"a": vj.Box(0, 2)}


class NoExceptionAtAll(BaseException):
    """What a simulator may raise all the same."""


class Mute(Exception):
    def __str__(self):
        raise RuntimeError("no text")


TROUBLES = {
    1: lambda: NoExceptionAtAll("odd"),
    2: lambda: GeneratorExit(),
    3: lambda: Mute("x"),
    4: lambda: ValueError("m" * 10_000_000),
    5: lambda: SystemExit(3),
    6: lambda: ValueError("bad \ud800 \x1b[2J"),
    7: lambda: StopIteration(7),
}


def troubled(features, seed=0):
    number = int(features["a"])
    if number in TROUBLES:
        raise TROUBLES[number]()
    return Trace({"x": np.full(3, features["a"])}, dt=1.0)


def forking(features):
    """Fork, and fail in the copy, where the feature is large, as before an `exec` that fails."""
    if features["a"] > 1.7 and os.fork() == 0:
        os.execv("/not/there", ["x"])
    return Trace({"x": np.full(4, features["a"])}, dt=0.1)


def returning_twice(features):
    if features["a"] > 1.7:
        os.fork()
    return Trace({"x": np.full(4, features["a"])}, dt=0.1)


@pytest.fixture(scope="module")
def pooled():
    system = blackbox(troubled, workers=1, retries=0)
    yield system
    system.close()


@pytest.mark.slow
def test_every_exception_is_the_same_row_in_every_path(pooled):
    features = [{"a": float(number)} for number in (0, *TROUBLES)]
    plain = [outcome_of(lambda each=each: blackbox(troubled)(each)) for each in features]
    elsewhere = [each for _, each in sorted(pooled.simulate_each(features, [0] * len(features)))]
    assert [each.message for each in elsewhere] == [each.message for each in plain]
    assert [each.status for each in plain] == [Status.OK, *[Status.ERROR] * len(TROUBLES)]
    for each in plain:
        each.message.encode()
        assert len(each.message) < 700
    assert "NoExceptionAtAll: odd (" in plain[1].message
    assert "Mute: (Mute whose text cannot be written) (" in plain[3].message
    assert "ValueError: bad \\ud800 " in plain[6].message
    for number, outcome in zip(TROUBLES, plain[1:], strict=True):
        point = {"id": 1, "features": {"a": float(number)}, "seed": 0}
        (message,) = wire.Frames(1 << 20).feed(answer(point, troubled))
        kind = outcome.message.partition(":")[0].partition(" ")[0]
        said = wire.printable(message.header["error"], 2000)
        assert said.startswith(kind)
        assert len(said) < 700
        said.encode()


def test_codes_of_many_simulations_are_an_error_of_the_row():
    def simulate(features):
        return Trace({"x": np.ones(5)}, dt=1.0, valid=np.array([3, 4]))

    outcome = outcome_of(lambda: blackbox(simulate)({"a": 1.0}))
    assert outcome.status == Status.ERROR
    assert "valid must be one number for a simulation; got shape [2]" in outcome.message


def test_ctrl_c_is_no_row():
    def interrupted(features):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        outcome_of(lambda: blackbox(interrupted)({}))


@pytest.mark.slow
@pytest.mark.parametrize("workers", [None, 1])
def test_a_message_that_utf8_cannot_hold_is_stored(tmp_path, workers):
    system = blackbox(troubled, workers=workers)
    space = {"a": vj.DiscreteBox(6, 8)}
    problem = vj.Problem("odd", space, system, "always x <= 1.9")
    run = vj.falsify(problem, "grid", 3, folder=tmp_path / "run", confirm=False, progress=False)
    rows = vj.load(tmp_path / "run", problem).table.all
    assert rows.equals(run.table.all)
    assert rows.loc[rows["a"] == 6, "message"].str.startswith("ValueError: bad \\ud800").all()
    assert len(vj.resume(tmp_path / "run", problem, budget=4).table.all) >= 3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("simulate", [forking, returning_twice])
@pytest.mark.parametrize("workers", [None, 1])
def test_a_simulator_that_forks_gives_each_row_once(tmp_path, simulate, workers):
    def fork(step, values):
        if step == 20:
            os.fork()

    system = blackbox(simulate, workers=workers, timeout=None if workers is None else 20.0)
    problem = vj.Problem("forks", SPACE, system, "always x <= 1.9")
    run = vj.falsify(
        problem, "uniform", 40, batch=20, folder=tmp_path / "run", confirm=False, progress=False,
        callbacks=[] if workers else [fork],
    )  # fmt: skip
    rows = run.table.all
    assert (rows["a"] > 1.7).any()
    np.testing.assert_allclose(rows["rho"], 1.9 - rows["a"], atol=1e-6)
    assert (rows["status"] == "ok").all()
    time.sleep(0.2)  # Whoever came back twice would write by now.
    loaded = vj.load(tmp_path / "run", problem)
    assert not loaded.damage
    assert loaded.table.all.equals(rows)


def test_an_answer_to_another_question_is_dropped_and_told():
    worker = workers._Worker.__new__(workers._Worker)
    worker.pipe, theirs = Pipe()
    worker.asked = worker.dropped = 0
    worker.process = None
    right = Outcome(Trace({"x": np.ones(2)}, dt=1.0))
    for number, outcome in ((7, Outcome(None, Status.ERROR, "stray")), (1, right)):
        theirs.send_bytes(pickle.dumps((number, outcome)))
    found = worker.simulate(({"a": 1.0}, 0), None)
    assert found.status == Status.OK
    assert found.trace.notes == {workers.DROPPED: 1}
    assert theirs.recv() == (1, {"a": 1.0}, 0)
    # What somebody else has written into the pipe is no answer.
    theirs.send_bytes(b"nonsense")
    assert worker.simulate(({"a": 1.0}, 0), None) is None
