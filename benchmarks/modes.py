"""Planted modes of failure: how many `vj.modes` finds, and how right their numbers are.

python benchmarks/modes.py                          # everything, 20 seeds: an hour
python benchmarks/modes.py --seeds 3 --dims 2 10

Half-spaces in directions at right angles, whose robustness falls at very different speeds, so that
a population that follows it gathers in few of them. Masses and distances are known. A line says in
how many runs every mode of at least 0.5 % of the probability was found, how many 95 % intervals
hold the true mass, and the greatest ratio of the distance of a likeliest point to the true one.
"""

import argparse
import time

import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

import verifai_jax as vj

LEAST = 0.005
"""Part of the probability from which a mode has to be found."""


def planted(dim: int, count: int, seed: int = 0) -> tuple[vj.Problem, np.ndarray, np.ndarray]:
    """A problem with modes planted in normal space, their directions and their distances."""
    random = np.random.default_rng(1000 * dim + count + seed)
    axes = np.linalg.qr(random.standard_normal((dim, dim)))[0].T
    directions = np.concatenate([axes, -axes])[:count]
    distances = np.sort(random.uniform(3.7, 4.6, count))
    speeds = np.exp(random.uniform(-2, 2, count))
    normals, offsets = jnp.asarray(directions, jnp.float32), jnp.asarray(distances, jnp.float32)
    factors = jnp.asarray(speeds, jnp.float32)

    def system(features, key):
        margin = jnp.min((offsets - normals @ features["x"]) * factors)
        return vj.Trace({"margin": margin[None]}, dt=1.0)

    space = {"x": vj.Array(vj.Normal(0.0, 1.0), dim)}
    return vj.Problem(f"planted_{dim}_{count}", space, system, "margin >= 0"), directions, distances


def measure(dim: int, count: int, budget: int, seeds: int) -> str:
    """One line of the table."""
    problem, directions, distances = planted(dim, count)
    masses = norm.sf(distances)
    wanted = np.flatnonzero(masses >= LEAST * masses.sum())
    complete = covered = intervals = extra = 0
    farthest, started = 1.0, time.perf_counter()
    for seed in range(seeds):
        found = vj.modes(problem, budget, seed=seed, progress=False)
        own: dict[int, vj.Mode] = {}
        for mode in found:
            x = np.array([mode.features[f"x[{i}]"] for i in range(dim)])
            number = int(np.argmax(directions @ x - distances))
            extra += number in own
            own.setdefault(number, mode)
        complete += all(number in own for number in wanted)
        for number in set(wanted.tolist()) & set(own):
            mode = own[number]
            intervals += 1
            covered += mode.low <= masses[number] <= mode.high
            farthest = max(farthest, mode.distance / distances[number])
    seconds = (time.perf_counter() - started) / seeds
    return (
        f"| {dim} | {count} | {complete}/{seeds} | {extra} | {covered}/{intervals} | "
        f"{farthest:.4f} | {seconds:.0f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--budget", type=int, default=50_000)
    parser.add_argument("--dims", type=int, nargs="+", default=[2, 5, 10, 20, 50])
    parser.add_argument("--counts", type=int, nargs="+", default=[2, 4, 8])
    options = parser.parse_args()
    print("| d | modes | all found | split in two | masses in intervals | distance / true | s |")
    print("|---|---|---|---|---|---|---|")
    for dim in options.dims:
        for count in options.counts:
            if count <= 2 * dim:
                print(measure(dim, count, options.budget, options.seeds), flush=True)


if __name__ == "__main__":
    main()
