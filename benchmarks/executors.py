"""What it costs to send work to the workers of an executor, beside doing it in this process.

    VERIFAI_JAX_CORES=1 python benchmarks/executors.py
    VERIFAI_JAX_CORES=1 python benchmarks/executors.py pool dask --rounds 9

One worker with one core, so that nothing but the way there and back differs: the same rows are
evaluated in this process, and in blocks of about a second by a worker of a process pool, of Dask
and of Ray (those that are installed). Rounds alternate between the sides; the overhead is the
median of the ratios of neighbouring rounds. The black box sleeps for 5 ms a row and needs no core;
the cart-pole needs all of one. Compilation is excluded.
"""

import argparse
import contextlib
import dataclasses
import importlib.util
import multiprocessing
import statistics
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np

import verifai_jax as vj
from specs import cartpole
from verifai_jax.addons.clusters import RayExecutor
from verifai_jax.evaluation.evaluator import Evaluator

TARGET = "specs/cartpole.py:balance"


def sleep(features):
    """Sleep, as a simulator elsewhere would be waited for."""
    time.sleep(0.005)
    return vj.Trace({"x": features["a"] * np.ones(3)}, dt=0.1)


sleeper = vj.Problem("sleeper", {"a": vj.Box(0, 1)}, vj.blackbox(sleep), "always x < 0.9")
PROBLEMS = {
    "cart-pole": (cartpole.balance, 1024, "specs/cartpole.py:balance"),
    "black box": (sleeper, 256, "benchmarks/executors.py:sleeper"),
}


@contextlib.contextmanager
def pool():
    """Make a process pool of one worker."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as executor:
        yield executor


@contextlib.contextmanager
def dask():
    """Make a cluster of Dask with one worker process of one thread."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        yield client.get_executor()


@contextlib.contextmanager
def ray():
    """Make a cluster of Ray with one core."""
    import ray

    ray.init(address="local", num_cpus=1, include_dashboard=False, logging_level="warning")
    try:
        yield RayExecutor()
    finally:
        ray.shutdown()


EXECUTORS = {"pool": pool, "dask": dask, "ray": ray}


def seconds(evaluate, u):
    """Return the seconds of an evaluation."""
    started = time.perf_counter()
    evaluate(u, first=0)
    return time.perf_counter() - started


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("executors", nargs="*", help=f"of {', '.join(EXECUTORS)}; all by default")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=8.0, help="of a round, about")
    options = parser.parse_args()
    print("| work | executor | blocks | s here | s by the worker | overhead |")
    print("|---|---|---|---|---|---|")
    for kind in options.executors or EXECUTORS:
        make = EXECUTORS[kind]
        if kind in ("dask", "ray") and importlib.util.find_spec(kind) is None:
            print(f"{kind} is not installed: pip install 'verifai_jax[{kind}]'")
            continue
        with make() as executor:
            for work, (problem, batch, target) in PROBLEMS.items():
                here = Evaluator(problem, batch)
                sent = dataclasses.replace(problem, target=target)
                there = Evaluator(sent, batch, executor=executor)
                rng = np.random.default_rng(0)
                u = rng.random((4 * batch, problem.space.dim)).astype(np.float32)
                one, other = here(u, first=0), there(u, first=0)
                np.testing.assert_array_equal(one.rho, other.rho)
                rows = int(len(u) * options.seconds / seconds(here, u)) // batch * batch
                u = rng.random((max(rows, batch), problem.space.dim)).astype(np.float32)
                seconds(there, u)  # The size of a block settles.
                pairs = [(seconds(here, u), seconds(there, u)) for _ in range(options.rounds)]
                overhead = statistics.median(b / a for a, b in pairs) - 1
                print(
                    f"| {work} | {kind} | {len(u) / there.engine.block:.1f} "
                    f"| {statistics.median(a for a, _ in pairs):.2f} "
                    f"| {statistics.median(b for _, b in pairs):.2f} | {overhead:+.1%} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
