"""The falsification benchmarks of the ARCH competition: how often, and in how many simulations.

    python benchmarks/arch.py                           # instance 2, all requirements: 20 minutes
    python benchmarks/arch.py at1 at6b --searches portfolio gradient
    python benchmarks/arch.py --instance 1
    python benchmarks/arch.py sb1 sb2 sb3 sb4 sb5 --lstm FOLDER --budget 1000 --searches portfolio

For each requirement and search, from 50 seeds, one simulation a round: the falsification rate FR,
and the mean number of simulations S of the seeds that falsify, where a simulation that was
differentiated counts as one and as two; the median of the latter. `claimed`: how many of the first
failures are confirmed by replays in double precision, at a third and at a quarter of the step
(`vj.confirm`), which is what `falsify` claims. Next to them a published FR and mean S with its
tool: the lowest that could be read for these models, which leaves out tools whose numbers for each
requirement could not (FReaK of 2024 reports fewer simulations than all participants of 2022 on most
of them). `trace_surrogate` runs one seed after the other, in batches of two, and only its claimed
failures count. Other solvers, other seeds, partly freer inputs. SB's networks carry no licence:
they are read from a folder (`specs/arch/lstm.py`).

    python benchmarks/arch.py --searches portfolio --save FOLDER
    python benchmarks/arch.py --searches portfolio --beside FOLDER

`--save` writes what each seed took, gradients as two, infinite without a failure, and `--beside`
compares: the ratio of the means over the same seeds to those of the folder, with its 95 % interval
(bootstrap over seeds), where a seed without a failure counts as 1.2 times the budget.
"""

import argparse
import importlib
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import verifai_jax as vj
from benchmarks.seeds import FirstFailures, first_failures
from specs.arch.lstm import from_folder

MODELS = (
    "automatic_transmission",
    "chasing_cars",
    "neural_network_controller",
    "f16",
    "pacemaker",
    "steam_condenser",
    "fuel_control",
)
PUBLISHED = {
    "at1": "50/50 2.3 zlscheck 2020",
    "at2": "50/50 9.2 zlscheck 2020",
    "at51": "50/50 8.7 zlscheck 2020",
    "at52": "50/50 5.0 SOAR 2019",
    "at53": "50/50 3.8 SOAR 2019",
    "at6a": "50/50 42.9 zlscheck 2020",
    "at6b": "10/10 600 FalCAuN 2023, instance 1",
    "at6c": "449 FalCAuN 2026, instance 1",
    "at6abc": "616 FalCAuN 2026, instance 1",
    "cc1": "50/50 8.8 zlscheck 2020",
    "cc2": "50/50 4.7 zlscheck 2020",
    "cc3": "50/50 23.4 zlscheck 2020",
    "cc4": "10/10 474 FalCAuN 2026",
    "cc5": "50/50 2.0 zlscheck 2020",
    "ccx": "0/10 FalCAuN 2026",
    "nn": "10/10 48 Moonlight and TuRBO 2024",
    "f16a": "10/10 21 Moonlight and TuRBO 2024",
    "afc27": "29/50 39 S-TaLiRo 2017, of at most 100",
}
PUBLISHED_1 = {
    "sc": "50/50 2.1 zlscheck 2020",
    "nn": "10/10 26.8 Moonlight and TuRBO 2024",
    "nnx": "9/10 142.7 Moonlight and TuRBO 2024",
}
BUDGETS = {"cc4": 1500, "pm": 300}
INSTANCE_2 = (*PUBLISHED, "afc29", "afc33", "at54", "nnx", "sc", "pm")


def requirements() -> dict[str, vj.Problem]:
    """Every requirement by name."""
    modules = [importlib.import_module(f"specs.arch.{model}") for model in MODELS]
    return {
        name: problem
        for module in modules
        for name, problem in vars(module).items()
        if isinstance(problem, vj.Problem)
    }


def claimed(problem: vj.Problem, found: FirstFailures) -> str:
    """Return how many of the first failures are confirmed, as text."""
    if not found.falsified:
        return "-"
    points = found.points[np.isfinite(found.number)]
    features = jax.vmap(problem.space.unflatten)(jnp.asarray(points))
    rows = pd.DataFrame(problem.space.rows(features))
    checked = vj.confirm(vj.simulate(problem, rows, batch=64, progress=False))
    return f"{checked.counts.get('confirmed', 0)}/{len(points)}"


def falsified_one_by_one(problem: vj.Problem, search: str, budget: int, seeds: int) -> np.ndarray:
    """Return the first claimed failure of each seed, infinite without one, in batches of two."""
    first = np.full(seeds, np.inf)
    for seed in range(seeds):
        run = vj.falsify(
            problem, search, budget, batch=2, seed=seed, stop=vj.Stop(after=1), progress=False
        )
        claimed = np.flatnonzero(run.table.all["verdict"] == "confirmed")
        if len(claimed):
            first[seed] = claimed[0] + 1
    return first


def ratio(costs: np.ndarray, before: np.ndarray, budget: int) -> str:
    """Return the ratio of the means over the same seeds and its 95 % interval, as text."""
    pairs = [np.where(np.isfinite(each), each, 1.2 * budget) for each in (costs, before)]
    rows = np.random.default_rng(0).integers(0, len(costs), (20_000, len(costs)))
    means = [each[rows].mean(axis=1) for each in pairs]
    low, high = np.quantile(means[0] / means[1], [0.025, 0.975])
    return f"{pairs[0].mean() / pairs[1].mean():.2f} ({low:.2f} to {high:.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--searches", nargs="+", default=["portfolio", "cross_entropy", "uniform"])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--budget", type=int)
    parser.add_argument("--instance", type=int, choices=[1, 2], default=2)
    parser.add_argument("--lstm", help="folder with the networks of SB1 to SB5")
    parser.add_argument("--save", type=Path, help="folder for what each seed took")
    parser.add_argument("--beside", type=Path, help="folder of an earlier --save")
    chosen = parser.parse_args()
    problems = requirements()
    if chosen.lstm:
        problems |= {problem.name: problem for problem in from_folder(chosen.lstm)}
    names = chosen.names or [
        name if chosen.instance == 2 else f"{name}_instance1"
        for name in INSTANCE_2
        if chosen.instance == 2 or not name.startswith(("f16", "afc"))
    ]
    print("| requirement | search | FR | S, gradients as 1 | as 2 | median | claimed | published |")
    print("|---|---|---|---|---|---|---|---|")
    for name in names:
        problem = problems[name]
        for search in chosen.searches:
            began = time.perf_counter()
            budget = chosen.budget or BUDGETS.get(name.removesuffix("_instance1"), 300)
            if search == "trace_surrogate":
                first = falsified_one_by_one(problem, search, budget, chosen.seeds)
                first = first[np.isfinite(first)]
                mean, median = "-", "-"
                if len(first):
                    mean, median = f"{first.mean():.1f}", f"{np.median(first):.0f}"
                rate, confirmed = f"{len(first)}/{chosen.seeds}", f"{len(first)}/{len(first)}"
                line = " | ".join([name, search, rate, mean, mean, median, confirmed, ""])
                print(f"| {line} |", flush=True)
                continue
            found = first_failures(problem, search, budget, 1, range(chosen.seeds))
            cost = found.cost
            file = f"{name}.{search}.npy"
            if chosen.save:
                chosen.save.mkdir(parents=True, exist_ok=True)
                np.save(chosen.save / file, cost)
            if chosen.beside:
                print(f"<!-- ratio {ratio(cost, np.load(chosen.beside / file), budget)} -->")
            finite = cost[np.isfinite(cost)]
            counts = ["-"] * 3
            if len(finite):
                number = found.number[np.isfinite(found.number)]
                counts = [f"{number.mean():.1f}", f"{finite.mean():.1f}"]
                counts.append(f"{np.median(finite):.0f}")
            confirmed = claimed(problem, found)
            published = PUBLISHED_1 if name.endswith("_instance1") else PUBLISHED
            best = published.get(name.removesuffix("_instance1"), "")
            best = best if search == "portfolio" else ""
            rate = f"{found.falsified}/{chosen.seeds}"
            line = " | ".join([name, search, rate, *counts, confirmed, best])
            print(f"| {line} |", flush=True)
            # Progress; not part of the table.
            print(f"<!-- {time.perf_counter() - began:.0f} s -->", flush=True)


if __name__ == "__main__":
    main()
