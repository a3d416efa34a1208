"""The cost of a fault that is off: the same rows of `balance` with each fault and without.

    python benchmarks/idle_faults.py [--engine native] [--rows 8192] [--pairs 40]

Processor time of both, by turns; the median of the ratios of pairs, and the ratio of the minima.
"""

import argparse
import time

import numpy as np

import verifai_jax as vj
from specs.cartpole import balance
from verifai_jax.addons import faults
from verifai_jax.counterexamples.nominal import Nominal
from verifai_jax.evaluation.evaluator import Evaluator

WINDOW = {"onset": vj.Box(0, 4), "duration": vj.Box(0, 4)}
OBSERVED = "observation"
FAULTS = [
    faults.Bias(OBSERVED, offset=vj.Box(0, 0.1), **WINDOW),
    faults.Noise(OBSERVED, std=vj.Box(0, 0.1), **WINDOW),
    faults.Spikes(OBSERVED, height=vj.Box(0, 1), **WINDOW),
    faults.Delay(OBSERVED, seconds=vj.Box(0, 0.2), **WINDOW),
    faults.ClockJitter("action", jitter=vj.Box(0, 0.2), **WINDOW),
    faults.PacketLoss(OBSERVED, loss=vj.Box(0, 1), **WINDOW),
    faults.HeldAction(hold=vj.Box(0, 0.2), **WINDOW),
    faults.LossOfAuthority(loss=vj.Box(0, 1), **WINDOW),
    faults.Quantisation(OBSERVED, step=vj.Box(0, 0.2), **WINDOW),
    faults.Noise(OBSERVED, std=vj.Box(0, 0.1), name="noise_throughout"),
]


def seconds(evaluate, points):
    began = time.process_time()
    evaluate(points)
    return time.process_time() - began


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--engine", choices=("xla", "native"), default="xla")
    parser.add_argument("--rows", type=int, default=8192)
    parser.add_argument("--pairs", type=int, default=40)
    args = parser.parse_args()
    options = {"batch": 4096, "engine": args.engine, "budget": 10**9}
    alone, dim = Evaluator(balance, **options), balance.space.dim
    points = np.random.default_rng(0).random((args.rows, dim), dtype=np.float32)
    for _ in range(3):
        expected = alone(points).rho
    print(f"{args.rows / seconds(alone, points):,.0f} simulations a processor second without")
    for fault in FAULTS:
        problem = balance.with_faults(fault)
        off = np.tile(Nominal.of(problem).u.astype(np.float32), (args.rows, 1))
        off[:, :dim] = points
        faulty = Evaluator(problem, **options)
        same = [np.array_equal(faulty(off).rho, expected) for _ in range(3)][-1]
        pairs = []
        for turn in range(args.pairs):
            order = [(0, alone, points), (1, faulty, off)][:: 1 if turn % 2 else -1]
            pairs.append([taken for _, taken in sorted((i, seconds(e, u)) for i, e, u in order)])
        taken = np.array(pairs)
        ratio, least = np.median(taken[:, 1] / taken[:, 0]), np.divide(*taken.min(axis=0)[::-1])
        print(f"  {fault.name:<28} {ratio:.2f}, by minima {least:.2f}; same bits: {same}")


if __name__ == "__main__":
    main()
