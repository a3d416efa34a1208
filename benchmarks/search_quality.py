"""Simulations until the first failure of the trained cart-pole controller, search by search.

    python benchmarks/search_quality.py [--seeds 20] [--problem rare]

The failure rate is measured first, with uniform samples. Each search then runs once a seed until
its first counterexample; what counts is the number of the simulation that found it. A gradient is
counted as one simulation, and in the last column as two.
"""

import argparse
import statistics
import time

import numpy as np

import verifai_jax as vj
from verifai_jax.targets import load_target

BATCH = {"uniform": 512, "halton": 512, "cross_entropy": 16, "gradient": 8}

# Unscrambled, Halton has one sequence for all seeds.
SEARCH = {name: vj.search.named(name) for name in BATCH} | {
    "halton": vj.search.Halton(scramble=True)
}


def first_failure(problem, name, seed, budget):
    """Number of the first failing simulation, counted from 1; the budget where there is none."""
    run = vj.falsify(
        problem, SEARCH[name], budget, batch=BATCH[name], seed=seed, stop_after=1, progress=False
    )
    failing = np.flatnonzero(run.table.all["violated"])
    return (int(failing[0]) + 1, True) if len(failing) else (budget, False)


def main():
    """Measure and print one line a search."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--budget", type=int, default=10_000)
    parser.add_argument("--problem", default="rare", help="name of a problem in specs/cartpole.py")
    options = parser.parse_args()

    problem = load_target(f"specs/cartpole.py:{options.problem}")
    rate = vj.falsify(problem, "uniform", 200_000, batch=8192, seed=999, progress=False)
    print(f"{problem}\n  failure rate {rate.failure_rate}")
    print(
        f"{'search':<15}{'batch':>6}{'found':>8}{'median':>9}{'quartiles':>16}"
        f"{'uniform /':>11}{'gradient as 2':>15}{'seconds':>9}"
    )
    uniform = None
    for name in BATCH:
        started = time.perf_counter()
        results = [first_failure(problem, name, s, options.budget) for s in range(options.seeds)]
        seconds = time.perf_counter() - started
        counts = [count for count, _ in results]
        median = statistics.median(counts)
        uniform = uniform or median
        low, high = np.percentile(counts, [25, 75])
        doubled = f"{uniform / (2 * median):.1f}x" if name == "gradient" else ""
        print(
            f"{name:<15}{BATCH[name]:>6}{sum(f for _, f in results):>5}/{options.seeds}"
            f"{median:>9.0f}{f'{low:.0f} - {high:.0f}':>16}{uniform / median:>10.1f}x"
            f"{doubled:>15}{seconds:>9.1f}"
        )


if __name__ == "__main__":
    main()
