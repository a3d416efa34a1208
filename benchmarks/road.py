"""Simulations per second of the road world and of the intersection of Tempe.

    python benchmarks/road.py

Each problem's engine, all cores, robustness of every formula included, compilation left out: the
median of rounds that alternate between the problems. A simulated second is 25 steps of RK4.
"""

import argparse
import os
import statistics
import time

import jax
import numpy as np

from specs import road, tempe
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.evaluation.engine import engine_for

PROBLEMS = (
    *(road.platoon, road.cut_in, road.overtaking, road.pedestrian),
    *(tempe.accident, tempe.tempe, tempe.premise, tempe.seeing),
)


def main():
    """Measure and print one line a problem."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--batch", type=int, default=16_384, help="simulations a round")
    options = parser.parse_args()
    key = run_keys(0)[1]
    engines, points, seconds = {}, {}, {}
    for problem in PROBLEMS:
        engines[problem.name] = engine = engine_for(problem, options.batch)
        engine.compile()
        size = (options.batch, problem.space.dim)
        points[problem.name] = np.random.default_rng(0).random(size, dtype=np.float32)
        engine.evaluate(points[problem.name], key, 0)
        seconds[problem.name] = []
    for _ in range(options.rounds):
        for name, engine in engines.items():
            started = time.perf_counter()
            engine.evaluate(points[name], key, 0)
            seconds[name].append(time.perf_counter() - started)
    load = os.getloadavg()[0]
    print(f"jax {jax.__version__}, {os.cpu_count()} cores, load {load:.1f} as it ended;")
    print(f"{options.rounds} rounds of {options.batch} simulations")
    for problem in PROBLEMS:
        rates = [options.batch / value for value in seconds[problem.name]]
        print(
            f"  {problem.name:<12}{problem.duration:5.0f} s{statistics.median(rates):>10,.0f}"
            f" simulations/s ({min(rates):,.0f} to {max(rates):,.0f})"
        )


if __name__ == "__main__":
    main()
