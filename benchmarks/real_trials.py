"""Failure rates of 1000 synthetic worlds from few trials, with simulators that are wrong.

python benchmarks/real_trials.py                    # about twenty minutes on one core

In each world some share of the trials is predicted to fail; those fail with one probability, and
the others with another one, which say how wrong the simulator is. A world has 30 to 100 trials
from the prior, and 10 000 simulations of it. Trials that the interval saves are those that Clopper
and Pearson would need for one as short, by its worth.
"""

import argparse

import numpy as np

from verifai_jax.addons.estimation.stratified_rate import stratified_rate

TRIALS = (30, 50, 100)
KINDS = {
    # Failures among trials that are predicted to hold, and to fail, from random numbers.
    "good": lambda rng: (rng.uniform(0.0, 0.03), rng.uniform(0.9, 1.0)),
    "optimistic": lambda rng: (rng.uniform(0.1, 0.3), rng.uniform(0.8, 1.0)),
    "pessimistic": lambda rng: (rng.uniform(0.0, 0.05), rng.uniform(0.2, 0.6)),
    "contrary": lambda rng: (rng.uniform(0.5, 0.9), rng.uniform(0.0, 0.2)),
    "useless": lambda rng: (rng.uniform(0.02, 0.6),) * 2,
}
"""Ways in which a simulator is wrong; the last one knows nothing."""


def world(kind: str, rng: np.random.Generator) -> tuple[bool, float]:
    """Return whether the interval covers in a world, and trials of it for one that is saved."""
    share, (q0, q1) = rng.uniform(0.1, 0.5), KINDS[kind](rng)
    n = int(rng.choice(TRIALS))
    predicted = rng.binomial(n, share)
    failures = rng.binomial([n - predicted, predicted], [q0, q1]).tolist()
    simulated = int(rng.binomial(10_000, share))
    counts = zip(failures, (n - predicted, predicted), strict=True)
    found = stratified_rate(*((k, int(m)) for k, m in counts), share=(simulated, 10_000))
    truth = (1 - share) * q0 + share * q1
    return found.low <= truth <= found.high, n / found.worth


def main() -> None:
    """Print a row for each kind of world."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    covered = []
    for number, kind in enumerate(KINDS):
        rng = np.random.default_rng((options.seed, number))
        rows = [world(kind, rng) for _ in range(options.worlds // len(KINDS))]
        covered += [row[0] for row in rows]
        share, needed = np.mean([row[0] for row in rows]), np.array([row[1] for row in rows])
        print(
            f"{kind:12} {len(rows)} worlds, covered {share:z.3f}, trials needed, as a share of "
            f"those of Clopper and Pearson: mean {needed.mean():z.2f}, median "
            f"{np.median(needed):z.2f}, greatest {needed.max():z.2f}",
            flush=True,
        )
    print(f"all: covered {np.mean(covered):z.3f}")


if __name__ == "__main__":
    main()
