"""Executors: the table of any number of workers, in any order, is the one of this machine alone."""

import concurrent.futures
import multiprocessing
import pickle
import random
import threading
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.addons.clusters.executor_engine import identity
from verifai_jax.addons.clusters.executors import (
    Shipment,
    WorkerError,
    count_workers,
    gather,
    ship,
)
from verifai_jax.addons.clusters.worker import evaluate_block
from verifai_jax.core.compute.executors import check_executor
from verifai_jax.core.user_code.targets import load_target
from verifai_jax.evaluation.evaluator import Evaluator


def line(features, key):
    times = jnp.arange(8.0)
    return vj.Trace({"x": jnp.sin(features["a"] * times) + features["b"]}, dt=0.1)


LINE = vj.Problem("line", {"a": vj.Box(0, 3), "b": vj.Box(-1, 1)}, line, "always x < 1.6")


def decay(features):
    if features["a"] > 0.99:
        raise ValueError("too large")
    return vj.Trace({"x": features["a"] * np.exp(-np.arange(5) * 0.1)}, dt=0.1)


DECAY = vj.Problem("decay", {"a": vj.Box(-1, 1)}, vj.blackbox(decay), "always x < 0.5")


class Disorder(ThreadPoolExecutor):
    """Works on what is queued in a random order, in this thread, when somebody looks for it."""

    def __init__(self, seed=0, dies_at=None):
        super().__init__(3)
        self.random, self.dies_at, self.count = random.Random(seed), dies_at, 0
        self.queue, self.calls = [], []

    def submit(self, function, /, *arguments):
        future = _Lazy(self)
        self.queue.append((future, function, arguments))
        return future

    def work(self):
        future, function, arguments = self.queue.pop(self.random.randrange(len(self.queue)))
        self.count += 1
        if self.dies_at is not None and self.count >= self.dies_at:
            future.set_exception(BrokenExecutor("a process was killed"))
        elif future.set_running_or_notify_cancel():
            self.calls.append(arguments[3])
            future.set_result(function(*arguments))


class _Lazy(Future):
    def __init__(self, executor):
        super().__init__()
        self.executor = executor

    def done(self):
        if not super().done() and self.executor.queue:
            self.executor.work()
        return super().done()


def equal(one, other):
    pd.testing.assert_frame_equal(one.table.all, other.table.all, check_exact=True)
    assert one.stopped == other.stopped
    assert one.notes == other.notes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("problem", "options"),
    [
        (LINE, {"search": "uniform", "budget": 5000, "batch": 512}),
        (LINE, {"search": "uniform", "budget": 5000, "batch": 512, "stop": vj.Stop(after=40)}),
        pytest.param(
            LINE,
            {"search": "cross_entropy", "budget": 600, "batch": 128},
            marks=pytest.mark.thorough,
        ),
        (DECAY, {"search": "uniform", "budget": 70, "batch": 20, "confirm": False}),
    ],
)
def test_the_table_is_the_one_of_one_machine_whatever_the_order(problem, options):
    equal(
        vj.falsify(problem, **options),
        vj.falsify(problem, **options, run_on=vj.RunOn(executor=Disorder(1))),
    )


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_with_workers_and_without(tmp_path):
    whole = vj.falsify(LINE, "uniform", 4000, batch=512)
    begun = vj.falsify(
        LINE,
        "uniform",
        4000,
        batch=512,
        stop=vj.Stop(after=1),
        folder=tmp_path / "run",
        run_on=vj.RunOn(executor=Disorder()),
    )
    assert 0 < begun.simulations < 4000
    assert begun.acceptance is None
    vj.resume(tmp_path / "run", LINE, budget=2048, run_on=vj.RunOn(executor=Disorder(2)))
    done = vj.resume(tmp_path / "run", LINE, budget=4000)
    pd.testing.assert_frame_equal(done.table.all, whole.table.all, check_exact=True)


@pytest.mark.slow
def test_a_constraint_is_kept_and_its_acceptance_is_that_of_the_rows_taken():
    space = vj.FeatureSpace(
        {"a": vj.Box(0, 3), "b": vj.Box(-1, 1)}, where=lambda f: f["a"] > f["b"] + 1
    )
    problem = vj.Problem("where", space, line, "always x < 1.6")
    options = {"search": "uniform", "budget": 3000, "batch": 256, "stop": vj.Stop(after=5)}
    one, other = (
        vj.falsify(problem, **options, run_on=vj.RunOn(executor=e)) for e in (None, Disorder())
    )
    equal(one, other)
    assert one.acceptance == other.acceptance


@pytest.mark.slow
def test_a_pool_that_loses_a_process_leaves_what_is_finished(tmp_path, monkeypatch):
    monkeypatch.setattr("verifai_jax.addons.clusters.executors.SECONDS", 0.0)
    options = {"search": "uniform", "budget": 70, "batch": 20, "confirm": False}
    whole = vj.falsify(DECAY, **options)
    with pytest.raises(vj.RunError, match="a process pool does not replace it") as broken:
        vj.falsify(
            DECAY,
            **options,
            folder=tmp_path / "run",
            run_on=vj.RunOn(executor=Disorder(3, dies_at=40)),
        )
    assert 0 < broken.value.run.simulations < 70
    again = vj.resume(tmp_path / "run", DECAY, run_on=vj.RunOn(executor=Disorder(4)))
    pd.testing.assert_frame_equal(again.table.all, whole.table.all, check_exact=True)


@pytest.mark.slow
def test_finished_rows_of_a_slow_black_box_are_not_simulated_again(tmp_path, monkeypatch):
    monkeypatch.setattr("verifai_jax.addons.clusters.executors.SECONDS", 0.0)
    monkeypatch.setattr("verifai_jax.addons.clusters.executor_engine.WORTH_KEEPING", 0.0)
    options = {"search": "uniform", "budget": 70, "batch": 70, "confirm": False}
    with pytest.raises(vj.RunError):
        vj.falsify(
            DECAY,
            **options,
            folder=tmp_path / "run",
            run_on=vj.RunOn(executor=Disorder(3, dies_at=30)),
        )
    second = Disorder(5)
    run = vj.resume(tmp_path / "run", DECAY, run_on=vj.RunOn(executor=second))
    assert 0 < len(second.calls) < 70
    equal(run, vj.falsify(DECAY, **options))


def test_an_interruption_cancels_what_is_queued():
    executor = Disorder()

    def interrupted():
        executor.dies_at = None
        if executor.count == 2:
            raise KeyboardInterrupt
        Disorder.work(executor)

    executor.work = interrupted
    run = vj.falsify(LINE, "uniform", 100_000, batch=512, run_on=vj.RunOn(executor=executor))
    assert run.stopped == "interrupted"
    assert executor.queue
    assert all(future.cancelled() for future, _, _ in executor.queue)


@pytest.mark.slow
def test_estimates_and_comparisons_are_those_of_one_machine():
    one, other = (
        vj.estimate(LINE, "monte_carlo", 2000, run_on=vj.RunOn(executor=e))
        for e in (None, Disorder())
    )
    assert (one.probability, one.interval, one.simulations) == (
        other.probability, other.interval, other.simulations,
    )  # fmt: skip
    lower = vj.Problem("lower", LINE.space, line, "always x < 1.5")
    compared = [
        vj.compare(LINE, lower, budget=2000, run_on=vj.RunOn(executor=e))
        for e in (None, Disorder())
    ]
    assert compared[0].simulations == compared[1].simulations
    assert compared[0]["lower"].rates == compared[1]["lower"].rates


@pytest.mark.thorough
def test_features_that_were_chosen_are_simulated_on_workers():
    rows = [{"a": 0.1 * i, "b": 0.0} for i in range(20)]
    equal(vj.simulate(LINE, rows), vj.simulate(LINE, rows, run_on=vj.RunOn(executor=Disorder())))


def test_threads_are_workers_too():
    with ThreadPoolExecutor(2) as executor:
        assert count_workers(executor) == 2
        equal(
            vj.falsify(LINE, "uniform", 3000, batch=512),
            vj.falsify(LINE, "uniform", 3000, batch=512, run_on=vj.RunOn(executor=executor)),
        )


def test_what_is_no_executor_or_cannot_work_is_refused_before_anything_compiles():
    with pytest.raises(TypeError, match=r"must have concurrent.futures' submit"):
        check_executor("dask://somewhere")
    fork = multiprocessing.get_context("fork")
    with (
        concurrent.futures.ProcessPoolExecutor(1, mp_context=fork) as pool,
        pytest.raises(ValueError, match="get_context\\('spawn'\\)"),
    ):
        check_executor(pool)
    with concurrent.futures.ProcessPoolExecutor(
        1, mp_context=multiprocessing.get_context("spawn")
    ) as pool:
        local = vj.Problem("local", LINE.space, lambda f, k: line(f, k), "always x < 1.6")
        with pytest.raises(ValueError, match=r"name it, Problem\(..., target='specs/FILE.py:NAME'"):
            vj.falsify(local, run_on=vj.RunOn(executor=pool))


SPEC = """
import verifai_jax as vj
from test_executors import line

wide = vj.Problem("wide", {"a": vj.Box(0, 3), "b": vj.Box(-1, 1)}, line, "always x < 1.6")
low = vj.Problem("low", {"a": vj.Box(0, 3), "b": vj.Box(-1, 1)}, line, "always x < 1.5")
"""


def test_a_worker_keeps_what_it_was_sent_and_loads_what_it_was_told_the_name_of(tmp_path):
    file = tmp_path / "wide.py"
    file.write_text(SPEC)
    wide = load_target(f"{file}:wide", vj.Problem)
    shipped = Shipment(wide, f"{file}:wide", identity)
    once, again = (pickle.loads(pickle.dumps(shipped)) for _ in range(2))
    assert once is again
    assert once.thing is not wide
    assert once.thing.name == "wide"
    other = Shipment(wide, f"{file}:low", identity)
    with pytest.raises(
        ValueError, match="on the worker differs from the one here: its name is low"
    ):
        pickle.loads(pickle.dumps(other))
    sent = pickle.loads(pickle.dumps(ship(LINE, object())))
    assert sent.thing.name == LINE.name
    assert sent.thing.programs is not LINE.programs


def pooled_decay(features):
    return decay(features)


def test_arrays_and_pools_of_black_boxes_can_be_sent():
    space = vj.FeatureSpace({"a": vj.Array(vj.Box(0, 1), 3), "b": vj.Array(vj.Box(0, 1), (1, 2))})
    again = pickle.loads(pickle.dumps(space))
    assert again.columns == space.columns
    assert again.root == space.root
    pooled = vj.Problem(
        "pooled", DECAY.space, vj.blackbox(pooled_decay, workers=1, timeout=30), "always x < 0.5"
    )
    sent = pickle.loads(pickle.dumps(pooled))
    assert (sent.system.pool.workers, sent.system.pool.timeout) == (1, 30)
    assert sent.system.pool._setup == pooled.system.pool._setup


@pytest.mark.addons
@pytest.mark.slow
def test_every_problem_of_the_project_can_be_sent():
    cloudpickle = pytest.importorskip("cloudpickle")
    pytest.importorskip("mujoco")
    from specs import ball, cartpole, cones, hopper, lane_keeping, mujoco_cartpole, road, sway

    count = 0
    for module in (ball, cartpole, cones, hopper, lane_keeping, mujoco_cartpole, road, sway):
        for problem in [value for value in vars(module).values() if isinstance(value, vj.Problem)]:
            for backend in problem.system.backends or (None,):
                chosen = problem if backend is None else problem.on_backend(backend)
                sent = cloudpickle.loads(cloudpickle.dumps(chosen))
                assert identity(sent) == identity(chosen)
                count += 1
    assert count > 30


@pytest.mark.slow
def test_native_mujoco_gives_the_same_rows_from_workers():
    pytest.importorskip("mujoco")
    from specs import mujoco_cartpole

    def run(executor=None):
        on = vj.RunOn(backend="native", executor=executor)
        return vj.falsify(
            mujoco_cartpole.balance, "uniform", 300, batch=256, confirm=False, run_on=on
        )

    here = run()
    equal(here, run(Disorder(1)))
    # In one process its batches of MuJoCo are used by one block at a time.
    with ThreadPoolExecutor(2) as executor:
        equal(here, run(executor))


def test_rows_of_another_processor_are_said_to_be():
    evaluate = Evaluator(LINE, 64, executor=Disorder())

    def elsewhere(*arguments):
        return evaluate_block(*arguments) | {"processor": "an abacus with JAX 0.0"}

    inner = evaluate.engine.executor
    evaluate.engine.executor = type(
        "E", (), {"submit": lambda _, f, *a: inner.submit(elsewhere, *a), "_max_workers": 2}
    )()
    verdicts = evaluate(np.full((5, 2), 0.5, np.float32))
    assert len(verdicts.status) == 5
    assert "simulated on an abacus with JAX 0.0, which is not the kind" in evaluate.notes[0]


def test_a_module_that_a_worker_lacks_is_named():
    failed = Future()
    failed.set_exception(ModuleNotFoundError("No module named 'specs.mine'"))
    with pytest.raises(WorkerError, match=r"a worker has no module 'specs.mine': workers need"):
        gather([failed], lambda place, result: None)


def test_what_failed_is_raised_when_what_ended_has_been_reported():
    done, failed, waiting = Future(), Future(), Future()
    done.set_result(1)
    failed.set_exception(RuntimeError("no"))
    seen = []
    with pytest.raises(RuntimeError, match="no"):
        gather([failed, done, waiting], lambda place, result: seen.append((place, result)))
    assert seen == [(1, 1)]
    assert waiting.cancelled()
    late = Future()
    threading.Timer(0.05, late.set_result, [2]).start()
    gather([late], lambda place, result: seen.append((place, result)))
    assert seen[-1] == (0, 2)


class Confused(ThreadPoolExecutor):
    """Gives the answers of the first two calls in each other's place."""

    def __init__(self):
        super().__init__(1)
        self.first = None

    def submit(self, function, /, *arguments):
        future = Future()
        result = function(*arguments)
        if self.first is None:
            self.first = future, result
            return future
        if self.first != ():
            (earlier, other), self.first = self.first, ()
            earlier.set_result(result)
            result = other
        future.set_result(result)
        return future


@pytest.mark.slow
def test_an_answer_to_another_call_is_dropped_and_asked_again():
    options = {"search": "uniform", "budget": 64, "batch": 64, "confirm": False, "progress": False}
    alone = vj.falsify(DECAY, **options)
    run = vj.falsify(DECAY, run_on=vj.RunOn(executor=Confused()), **options)
    assert run.table.all.equals(alone.table.all)
    assert "2 answers of workers belonged to other calls and were dropped" in run.notes
