"""Real clusters on one machine: the same tables, also where a worker is killed in the middle."""

import os
import signal
import threading
import time

import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.addons.clusters import RayExecutor, connect
from verifai_jax.core.messages.errors import MissingExtra, UnknownNameError
from verifai_jax.core.user_code.targets import load_target

ROWS = 100_000


def black_box():
    def decay(features):
        # Workers have no module of this name.
        import time

        import numpy as np

        import verifai_jax as vj

        time.sleep(0.001)
        return vj.Trace({"x": features["a"] * np.exp(-np.arange(5) * 0.1)}, dt=0.1)

    return vj.Problem("decay", {"a": vj.Box(-1, 1)}, vj.blackbox(decay), "always x < 0.5")


@pytest.fixture(scope="module")
def cartpole():
    problem = load_target("specs/cartpole.py:balance", vj.Problem)
    return problem, vj.falsify(problem, "uniform", ROWS).table.all


@pytest.fixture(scope="module")
def decaying():
    problem = black_box()
    return problem, vj.falsify(problem, "uniform", 2000).table.all


@pytest.fixture(scope="module")
def dask():
    """Three worker processes of one thread each; one that is killed is started again."""
    distributed = pytest.importorskip("distributed", reason="needs the extra dask")
    with (
        distributed.LocalCluster(
            n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def ray():
    """Three nodes on this machine."""
    ray = pytest.importorskip("ray", reason="needs the extra ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, logging_level="warning")
    yield ray
    ray.shutdown()
    cluster.shutdown()


def kill_when(busy):
    """Kill the process that `busy` finds, as soon as it finds one; returns the thread."""

    def watch():
        for _ in range(3000):
            if (found := busy()) is not None:
                os.kill(found, signal.SIGKILL)
                killed.append(found)
                return
            time.sleep(0.01)

    killed: list[int] = []
    thread = threading.Thread(target=watch)
    thread.killed = killed
    thread.start()
    return thread


# Clusters close their sockets when they please, and fork before they execute.
quiet = pytest.mark.filterwarnings("ignore")


# Over a minute: three workers, and one more for that which is killed, each import JAX and compile.
@quiet
@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole", "decaying"])
def test_dask_gives_the_table_of_one_machine_also_when_a_worker_is_killed(dask, name, request):
    problem, expected = request.getfixturevalue(name)
    executor = dask.get_executor()
    whole = vj.falsify(problem, "uniform", len(expected), run_on=vj.RunOn(executor=executor))
    pd.testing.assert_frame_equal(whole.table.all, expected, check_exact=True)
    pids = dask.run(os.getpid)

    def busy():
        working = [pids.get(worker) for worker, keys in dask.processing().items() if keys]
        return next((pid for pid in working if pid is not None), None)

    watching = kill_when(busy)
    run = vj.falsify(problem, "uniform", len(expected), run_on=vj.RunOn(executor=executor))
    watching.join()
    assert watching.killed
    pd.testing.assert_frame_equal(run.table.all, expected, check_exact=True)


@quiet
@pytest.mark.slow
def test_dask_gives_the_sweep_of_one_machine(dask):
    from drifting import drifting

    options = {"configurations": 3}
    options["certification"] = vj.Certification(samples=128, attack_simulations=64)
    here = vj.sweep(drifting(seeds=2), **options)
    there = vj.sweep(drifting(seeds=2), **options, run_on=vj.RunOn(executor=dask.get_executor()))
    for name in set(here.record.columns) - {"training_seconds"}:
        np.testing.assert_array_equal(here.record.columns[name], there.record.columns[name], name)


@quiet
@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole", "decaying"])
def test_ray_gives_the_table_of_one_machine_also_when_a_worker_is_killed(ray, name, request):
    problem, expected = request.getfixturevalue(name)
    executor = RayExecutor()
    whole = vj.falsify(problem, "uniform", len(expected), run_on=vj.RunOn(executor=executor))
    pd.testing.assert_frame_equal(whole.table.all, expected, check_exact=True)
    import psutil

    def busy():
        for process in psutil.process_iter(["name", "cmdline"]):
            title = " ".join(process.info["cmdline"] or [process.info["name"] or ""])
            if title.startswith("ray::evaluate_block"):
                return process.pid
        return None

    watching = kill_when(busy)
    run = vj.falsify(problem, "uniform", len(expected), run_on=vj.RunOn(executor=executor))
    watching.join()
    assert watching.killed
    pd.testing.assert_frame_equal(run.table.all, expected, check_exact=True)


@quiet
@pytest.mark.slow
def test_a_cluster_is_reached_by_its_address(dask, cartpole):
    problem, expected = cartpole
    address = dask.scheduler.address.removeprefix("tcp://")
    with connect(f"dask://{address}") as executor:
        run = vj.falsify(problem, "uniform", 5000, batch=1024, run_on=vj.RunOn(executor=executor))
    pd.testing.assert_frame_equal(
        run.table.all.drop(columns="verdict"),
        expected.head(5000).drop(columns="verdict"),
        check_exact=True,
    )


def test_an_address_that_is_none_is_refused():
    with pytest.raises(UnknownNameError, match="did you mean 'dask'"), connect("dsk://a:1"):
        pass
    with pytest.raises(ValueError, match=r"dask://HOST:PORT, ray://HOST:PORT"), connect("dask:"):
        pass


def test_what_is_not_installed_is_named(monkeypatch):
    import sys

    for module, extra, address in (
        ("distributed", "dask", "dask://127.0.0.1:1"),
        ("ray", "ray", "ray://auto"),
        ("submitit", "slurm", "slurm"),
    ):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtra, match=rf"verifai_jax\[{extra}\]"), connect(address):
            pass
