"""Simulations until a fault that needs three events in order is found: `vj.fuzz` against uniform.

    python benchmarks/fuzzing.py                        # 20 seeds each, then one is shrunk

Both draw from the automaton of `specs/handover.py`, a black box in Python, and stop at the first
counterexample. Uniform sequences are cut off at `MAX_SIMULATIONS` simulations, which counts as the
number.
"""

import argparse
import time

import numpy as np

import verifai_jax as vj
from specs.handover import MODES, handover

MAX_SIMULATIONS = 100_000
"""Simulations of a run at most."""


def fuzzed(seed: int) -> int:
    """Return the number of simulations until `vj.fuzz` finds the fault."""
    run = vj.fuzz(
        handover, MAX_SIMULATIONS, cells=MODES, seed=seed, stop=vj.Stop(after=1), progress=False
    )
    return first_failure(run)


def sampled(seed: int) -> int:
    """Return the number of simulations until uniform sequences have it."""
    run = vj.falsify(
        handover,
        "uniform",
        MAX_SIMULATIONS,
        seed=seed,
        stop=vj.Stop(after=1),
        batch=1024,
        progress=False,
    )
    return first_failure(run)


def first_failure(run: vj.Run) -> int:
    """Return the number of the first failing simulation, from 1, or `MAX_SIMULATIONS`."""
    violated = run.table.all["violated"].to_numpy()
    return int(violated.argmax()) + 1 if violated.any() else MAX_SIMULATIONS


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    seeds = range(parser.parse_args().seeds)
    for name, find in (("vj.fuzz", fuzzed), ("uniform", sampled)):
        started = time.perf_counter()
        counts = np.array([find(seed) for seed in seeds])
        seconds = time.perf_counter() - started
        print(
            f"{name:<8} median {np.median(counts):,.0f}, mean {counts.mean():,.0f}, from "
            f"{counts.min():,} to {counts.max():,} simulations; {seconds:.0f} s",
            flush=True,
        )
        print(" ", sorted(counts.tolist()), flush=True)
    lengths = []
    for seed in seeds:
        run = vj.fuzz(
            handover, MAX_SIMULATIONS, cells=MODES, seed=seed, stop=vj.Stop(after=1), progress=False
        )
        small = vj.shrink(run)
        lengths.append(int(small.features["events"].length))
    print("events after vj.shrink:", lengths)
    print(small)


if __name__ == "__main__":
    main()
