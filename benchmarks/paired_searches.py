"""The default search of two versions of the package on the same seeds: none should be slower.

    PYTHONPATH=OTHER python benchmarks/paired_searches.py --save FOLDER
    PYTHONPATH=. python benchmarks/paired_searches.py --beside FOLDER
    python benchmarks/paired_searches.py mixed fresh --searches portfolio plain cross_entropy

Rows of the ARCH competition one simulation a round, Rosenbrock's function in ten dimensions, spaces
of choices and numbers (`mixed_spaces`), and landscapes. Of each search the seeds that found a
failure, and their median of simulations to the first one, a differentiated one as two. Next to it
the ratio of the means to those in the folder, with its 95 % interval (bootstrap over seeds); a seed
without a failure counts as 1.2 times the budget. `plain` is the default search without gradients.
"""

import argparse
import math
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from arch import BUDGETS, ratio, requirements
from mixed_spaces import FRESH, PROBLEMS, SHARES
from small_problems import landscape

import verifai_jax as vj
from benchmarks.seeds import first_failures

ARCH = (
    *("at1", "at2", "at6a", "cc1", "cc2", "cc3", "cc4", "cc5", "ccx", "nn", "f16a", "afc27"),
    *("sc_instance1", "nnx_instance1"),
)
VALLEYS = {"rosenbrock": (-5.0, 5.0), "rosenbrock_near": (-2.048, 2.048)}
FEW = ("ball", "ridge", "corner", "ripples", "mixed", "few_of_many")
SEARCHES = {
    "portfolio": vj.search.Portfolio(),
    "plain": vj.search.Portfolio(gradients=False),
    "cross_entropy": vj.search.CrossEntropy(),
}


def valley(name: str) -> vj.Problem:
    """Return Rosenbrock's function in ten dimensions, which fails below 1."""
    low, high = VALLEYS[name]

    def system(features, key):
        x = features["x"]
        value = jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)
        return vj.Trace({"out": value[None]}, dt=0.1)

    return vj.Problem(name, {"x": vj.Box([low] * 10, [high] * 10)}, system, "always out > 1")


def rows(groups: list[str]) -> list[tuple[str, vj.Problem, int, int]]:
    """Return the name, problem, budget and batch of each row."""
    found: list[tuple[str, vj.Problem, int, int]] = []
    if "arch" in groups:
        problems = requirements()
        found += [(name, problems[name], BUDGETS.get(name, 300), 1) for name in ARCH]
    if "valleys" in groups:
        found += [(f"{name}/{b}", valley(name), 1500, b) for name in VALLEYS for b in (1, 16)]
    if "mixed" in groups:
        found += [(name, problem, 1500, 16) for name, problem in PROBLEMS.items()]
    if "fresh" in groups:
        found += [(name, problem, 1500, 16) for name, problem in FRESH.items()]
    if "landscapes" in groups:
        found += [(f"landscape {name}", landscape(name), 1500, 16) for name in FEW]
    return found


def main() -> None:
    """Measure and print one line a row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "groups", nargs="*", default=["arch", "valleys", "mixed", "fresh", "landscapes"]
    )
    parser.add_argument("--searches", nargs="+", default=["portfolio"], choices=list(SEARCHES))
    parser.add_argument("--only", nargs="+", help="names of rows")
    parser.add_argument("--first", type=int, default=1000, help="the first seed")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--save", type=Path)
    parser.add_argument("--beside", type=Path)
    chosen = parser.parse_args()
    seeds = range(chosen.first, chosen.first + chosen.seeds)
    for name, problem, budget, batch in rows(chosen.groups):
        if chosen.only and name not in chosen.only:
            continue
        cells = [name]
        if name in SHARES:
            cells.append(f"{math.log(2) / SHARES[name]:.0f}")
        for search in chosen.searches:
            began = time.process_time()
            cost = first_failures(problem, SEARCHES[search], budget, batch, seeds).cost
            cost = np.where(cost <= budget, cost, np.inf)
            found = int(np.isfinite(cost).sum())
            median = np.median(np.where(np.isfinite(cost), cost, 1.2 * budget))
            cells.append(f"{search} {found}/{len(seeds)} {median:.0f}")
            file = f"{name.replace('/', '.').replace(' ', '.')}.{search}.npy"
            if chosen.save:
                chosen.save.mkdir(parents=True, exist_ok=True)
                np.save(chosen.save / file, cost)
            if chosen.beside and (chosen.beside / file).exists():
                before = np.load(chosen.beside / file)[: len(seeds)]
                shown = np.median(np.where(np.isfinite(before), before, 1.2 * budget))
                cells.append(f"before {np.isfinite(before).sum()} {shown:.0f}")
                cells.append(ratio(cost, before, budget))
            cells.append(f"{time.process_time() - began:.0f} s")
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
