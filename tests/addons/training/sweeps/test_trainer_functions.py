"""Functions that train, of any framework: each call in a process of its own."""

import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from drifting import Point, closed_loop
from misbehaving_training import train_badly
from numpy_training import (
    Gain,
    seed_of,
    study,
    sweep,
    train,
    train_anew,
    train_reporting,
    train_towards,
    trained,
)

import verifai_jax as vj
from verifai_jax.addons.training.sweeps import StudyError
from verifai_jax.addons.training.sweeps.clock import Clock
from verifai_jax.addons.training.sweeps.function_runs import (
    FunctionRuns,
    Reports,
    reported_steps,
    train_once,
)
from verifai_jax.core.store.cache import Cache

HERE = Path(__file__).parent


def numbers(found):
    return {n: c.astype(str) for n, c in found.record.columns.items() if n != "training_seconds"}


def check_same_tables(one, other):
    for name, column in numbers(one).items():
        np.testing.assert_array_equal(column, numbers(other)[name], err_msg=name)


def test_what_is_wrong_is_said_before_anything_trains():
    with pytest.raises(StudyError, match=r"train is a training function: give example="):
        vj.Trainer(train, steps=8)
    with pytest.raises(StudyError, match=r"must be train\(key, hyperparameters, steps=\.\.\."):
        vj.Trainer(lambda key, values: None, steps=8, example=lambda o: o)
    with pytest.raises(StudyError, match="example belongs to a function that trains"):
        vj.Trainer(Point(), example=lambda o: o)

    def inner(key, hyperparameters, steps):
        return None

    trainer = vj.Trainer(inner, steps=8, example=lambda o: o[:1])
    with pytest.raises(StudyError, match="inner runs in processes of its own"):
        trainer.check(study(train).space)
    study(train).check()
    assert "trains: train, 8 steps" in str(study(train))


def test_a_policy_of_another_form_than_the_examples():
    trained = vj.policy(HERE.parents[1] / "rl" / "policies" / "files" / "mlp.onnx")
    for size, words in ((2, None), (3, "actions of shape [2], and example= of the trainer, with")):
        trainer = vj.Trainer(train, steps=8, example=lambda o, size=size: jnp.zeros(size))
        why = FunctionRuns._why_not_of_the_form(SimpleNamespace(_trainer=trainer), trained)
        assert not why if words is None else words in why


@pytest.mark.slow
def test_killed_and_resumed_it_is_the_undisturbed_table(tmp_path):
    # Three sweeps of four processes each.
    undisturbed = sweep(train)
    assert undisturbed.record.complete
    assert len(undisturbed.table) == 4
    assert set(undisturbed.table["verdict"]) <= {"safe@0.01", "unsafe", "undecided"}
    assert undisturbed.table["nominal_return"].notna().all()
    environment = {**os.environ, "PYTHONPATH": f"{HERE.parents[3]}:{HERE}", "KILL_ONCE": "once"}
    script = HERE / "numpy_training.py"
    killed = subprocess.run([sys.executable, script], cwd=tmp_path, env=environment, check=False)
    assert killed.returncode == -9
    resumed = sweep(train, tmp_path / "killed")
    assert resumed.reuse["train"] == (2, 4)
    check_same_tables(undisturbed, resumed)
    assert not list((tmp_path / "killed" / "trainings").glob("*"))
    # Stored, loaded again, and drawn as all sweeps are.
    resumed.save(tmp_path / "stored")
    loaded = vj.load_sweep(tmp_path / "stored")
    observation = jnp.array([0.3, 1.0])
    for row in range(len(loaded.table)):
        one, other = (each.policy(row).act(observation) for each in (resumed, loaded))
        np.testing.assert_array_equal(one, other)
    assert "best" in str(loaded)
    assert loaded.plot() is not None


@pytest.mark.slow
def test_one_that_cannot_resume_trains_anew_and_one_that_raises_is_a_row(caplog):
    found = sweep(train_anew)
    assert (
        "train_anew has neither an argument resume nor checkpoint: it trains anew up to each"
        in caplog.text
    )
    wrong = found.table[found.table["rate"] == 0.5]
    assert all("the rate is too great" in status for status in wrong["status"])
    assert (found.table.loc[found.table["rate"] < 0.5, "status"] == "trained").all()


def test_a_training_reports_its_checkpoints_and_how_far_it_is(tmp_path):
    call = {"values": {"rate": 0.1}, "steps": 8, "folder": str(tmp_path / "8.part")}
    seen = np.zeros(2)
    with unchecked():  # The pool passes the arrays on as if they were a trace.
        found = train_once(train_reporting, seen, {**call, "checkpoints": [4]}, seed=3)
    rng = np.random.default_rng(seed_of(jax.random.key(3)))
    weights, returns = trained(rng, np.zeros(2), {"rate": 0.1}, 8)
    np.testing.assert_array_equal(found["steps"], np.arange(1, 9))
    np.testing.assert_array_equal(found["mean_return"], returns)
    at_four = np.load(tmp_path / "8.4.npz")
    np.testing.assert_array_equal(at_four["mean_return"], returns[:4])
    again, _ = trained(
        np.random.default_rng(seed_of(jax.random.key(3))), np.zeros(2), {"rate": 0.1}, 4
    )
    for arrays, expected in ((found, weights), (at_four, again)):
        held = [a for n, a in arrays.items() if n.startswith("array/")]
        assert any(np.array_equal(np.ravel(a), np.float32(expected)) for a in held)
    assert reported_steps(tmp_path / "8.part") == 8
    assert reported_steps(tmp_path / "other.part") == 0
    with (
        unchecked(),
        pytest.raises(ValueError, match="checkpoint was not called at 4 steps or after them"),
    ):
        train_once(train_reporting, seen, {**call, "values": {"rate": 0.5}, "checkpoints": [4]}, 3)


def test_what_a_training_reported_before_it_failed_is_a_row_of_its_own(tmp_path):
    runs = FunctionRuns(study(train_reporting), Cache(tmp_path), Clock("by_hand", None, False))
    number = runs.add({"rate": 0.3}, 3)
    assert runs._begins(number, 1)
    folder = runs._folder_of(number, 1).with_suffix(".part")
    reports = Reports([4], folder, np.zeros(2))
    reports(5, Gain(np.float32([2.0, 0.0])), np.float32(7.0))
    runs._take_reported(number, 1)
    taken = runs.checkpoint(number, 0)
    assert taken.training_return == 7.0
    np.testing.assert_array_equal(taken.policy.act(jnp.float32([1.0, 3.0])), [2.0])
    assert [file.name for file in folder.parent.iterdir()] == ["8.part", "8.steps"]
    reports(6, Gain(np.float32([np.nan, 0.0])), 7.0)
    with pytest.raises(ValueError, match="called at 6 steps after 6 steps"):
        reports(6, None)
    for steps in ("7", 7.5, -7):
        with (
            unchecked(),
            pytest.raises(ValueError, match="steps of a checkpoint must be an integer"),
        ):
            reports(steps, None)
    # Another call begins without them.
    Reports([4], folder, np.zeros(2))(4, Gain(np.float32([2.0, 0.0])), 7.0)
    assert runs._begins(number, 1)
    assert [file.name for file in folder.parent.glob("*.npz")] == []
    # Files that cannot be copied are an error of this training.
    other = runs.add({"rate": 0.1}, 3)
    runs._folder_of(other, 0).mkdir(parents=True)
    os.mkfifo(runs._folder_of(other, 0) / "pipe")
    assert not runs._begins(other, 1)
    assert runs.errors[other].startswith("its files in resume cannot be copied: ")


@pytest.mark.parametrize(("lost", "at"), [(0, 1), (1, 1), (None, None)])
def test_a_call_is_made_again_where_the_cache_has_lost_any_of_its_checkpoints(
    lost, at, monkeypatch, tmp_path
):
    runs = FunctionRuns(study(train_reporting), Cache(tmp_path), Clock("by_hand", None, False))
    number, calls = runs.add({"rate": 0.3}, 3), []
    runs._checkpoints = {(number, rung): None for rung in range(2) if rung != lost}
    monkeypatch.setattr(runs, "_recall", lambda *_: None)
    monkeypatch.setattr(runs, "_call", lambda *call: calls.append(call))
    runs.train([number], 1)
    assert calls == ([] if at is None else [([number], at)])


def test_a_call_leaves_the_next_one_its_folder_and_a_curve_that_is_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call = {"values": {}, "steps": 8, "folder": str(tmp_path / "8.part"), "checkpoints": []}

    def moving(key, hyperparameters, steps):
        os.chdir("/")
        return Gain(np.float32([2.0, 0.0])), {"steps": [2, 1], "mean_return": [0.0, 0.0]}

    with pytest.raises(ValueError, match=r"which are positive and increase; got 2 steps and 2"):
        train_once(moving, np.zeros(2), call, 0)
    assert Path.cwd() == tmp_path


@pytest.mark.slow
def test_one_call_of_a_training_gives_all_its_rows():
    reported, anew = sweep(train_reporting), sweep(train_anew)
    wrong = reported.table[reported.table["rate"] == 0.5]
    assert all("checkpoint was not called at 4 steps" in status for status in wrong["status"])
    for name in ("steps", "failures", "simulations", "verdict"):
        rows = [found.table.loc[found.table["rate"] < 0.4, name] for found in (reported, anew)]
        np.testing.assert_array_equal(*rows)
    for halving, weight in ((None, -0.5), (vj.Halving(2), -1.0)):
        at_four = sweep(train_towards, halving=halving).configuration(0)
        assert (at_four.steps, at_four.called) == (4, 8 if halving is None else 4)
        for policy in (at_four.policy, at_four.train(study(train_towards))):
            assert policy.act(jnp.float32([1.0, 0.0])) == weight


@pytest.mark.slow
def test_whatever_a_training_function_does_is_a_row(tmp_path):
    ends = {
        "good": "trained", "print": "trained", "fork": "trained", "child": "trained",
        "hang": "error: the training took longer than 15 s",
        "crash": "error: the worker process was killed by SIGSEGV",
        "exit": "error: the worker process ended with exit code 0",
        "leave": "error: SystemExit: bye", "none": "error: PolicyError: a policy is a file",
        "two": "error: the trained policy returns actions of shape [2], and example= of the",
        "three": "error: ValueError", "nan": "nonfinite",
    }  # fmt: skip

    def found(kinds, **options):
        times = {n: options.pop(n) for n in ("timeout",) if n in options}
        trainer = vj.Trainer(
            train_badly, steps=8, example=lambda o: o[:1], observation=np.zeros(2), **times
        )
        space = {"kind": vj.Categorical(*kinds), "file": vj.Categorical(str(tmp_path / "pids"))}
        swept = vj.sweep(
            vj.Study("odd", space, trainer, closed_loop), "grid", len(kinds), progress=False,
            certification=vj.Certification(samples=16, attack_simulations=0), **options,
        )  # fmt: skip
        return swept, dict(zip(swept.table["kind"], swept.table["status"], strict=True))

    swept, statuses = found(ends, timeout=15.0)
    assert swept.record.complete
    assert {*statuses} == {*ends}
    for kind, status in statuses.items():
        assert status.startswith(ends[kind]), (kind, status)
    # Only what hung, crashed or exited cost a process.
    processes = {*(tmp_path / "pids").read_text().split()}
    assert len(processes) <= 3 + (os.cpu_count() or 1)
    began = time.monotonic()
    swept, statuses = found(["hang", "good"], stop=vj.Stop(seconds=45.0))
    assert time.monotonic() - began < 60
    # Time for training is two thirds of all: whether `good` comes in it depends on the machine.
    assert statuses.pop("good", "trained") == "trained"
    assert statuses == {"hang": "error: the training was ended, as all time was over"}
    assert not swept.record.complete
