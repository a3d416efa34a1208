"""The accuracy of `estimate` and of its intervals: closed forms through real problems, and AT6b.

python benchmarks/estimation.py                     # everything, 20 seeds: about 20 minutes
python benchmarks/estimation.py --seeds 100 --dims 2 10 --levels 1e-6
python benchmarks/estimation.py --only at6b --truth 1000000
python benchmarks/estimation.py --only limit-states   # traps of the literature: 15 minutes

For each problem, dimension and probability: how many of the 95 % intervals hold the truth, the
standard deviation of estimate over truth, the worst factor, and the methods taken.
"""

import argparse
import math
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2, ncx2, norm

import verifai_jax as vj
from verifai_jax.addons.estimation import estimate

# The probability that AT6b fails, by Monte Carlo: failures and simulations of `--truth`.
AT6B = (1_059, 1_302_528)


def features(dim: int) -> dict[str, vj.Normal]:
    """Standard normal features."""
    return {f"x{i}": vj.Normal(0.0, 1.0) for i in range(dim)}


def problem(name: str, space: dict, robustness: Callable) -> vj.Problem:
    """A system of one sample whose only signal is the robustness."""

    def system(features, key):
        x = jnp.stack([features[f"x{i}"] for i in range(len(space))])
        return vj.Trace({"margin": robustness(x)[None]}, dt=1.0)

    return vj.Problem(name, space, system, "margin >= 0")


def half_space(dim: int, p: float) -> vj.Problem:
    """One side of a plane in a random direction."""
    a = np.random.default_rng(dim).standard_normal(dim)
    a = jnp.asarray(a / np.linalg.norm(a), jnp.float32)
    return problem("half-space", features(dim), lambda x: norm.isf(p) - a @ x)


def sphere(dim: int, p: float) -> vj.Problem:
    """Farther from the origin than r."""
    r = math.sqrt(chi2.isf(p, dim))
    return problem("sphere", features(dim), lambda x: r - jnp.linalg.norm(x))


def ball(dim: int, p: float) -> vj.Problem:
    """Nearer than r to a point two standard deviations out."""
    centre, r = np.full(dim, 2 / math.sqrt(dim), np.float32), math.sqrt(ncx2.ppf(p, dim, 4.0))
    return problem("ball", features(dim), lambda x: jnp.linalg.norm(x - centre) - r)


def two_modes(dim: int, p: float) -> vj.Problem:
    """Two opposite half-spaces, one four times as probable as the other."""
    a = np.random.default_rng(dim).standard_normal(dim)
    a = jnp.asarray(a / np.linalg.norm(a), jnp.float32)
    near, far = norm.isf(0.8 * p), norm.isf(0.2 * p)
    return problem("two modes", features(dim), lambda x: jnp.minimum(near - a @ x, far + a @ x))


def corner(dim: int, p: float) -> vj.Problem:
    """A corner of a box, cut off by a plane: a simplex of side (p dim!)^(1/dim)."""
    side = (p * math.factorial(dim)) ** (1 / dim)
    if side > 1:
        raise ValueError("the simplex does not fit into the box")
    space = {f"x{i}": vj.Box(0.0, 1.0) for i in range(dim)}
    return problem("corner", space, lambda x: jnp.sum(x) - side)


def metaballs(x):
    """Two smooth hills; the failures lie around both (Breitung, 2019)."""
    a, b = x
    first = 30 / ((4 * (a + 2) ** 2 / 9 + b**2 / 25) ** 2 + 1)
    return first + 20 / (((a - 2.5) ** 2 / 4 + (b - 0.5) ** 2 / 25) ** 2 + 1) - 5


def four_branch(k: float) -> Callable:
    """Four failing regions, two curved and two flat (Waarts, 2000)."""

    def robustness(x):
        a, b = x
        root = math.sqrt(2.0)
        curved = 3 + 0.1 * (a - b) ** 2 - jnp.abs(a + b) / root
        return jnp.minimum(curved, k / root - jnp.abs(a - b))

    return robustness


def breitung_trap(x):
    """A robustness that leads away from the probable failures (Breitung, 2019)."""
    a, b = x
    first = jnp.where(a > 3.5, 4 - a, 0.85 - 0.1 * a)
    return jnp.minimum(first, jnp.where(b > 2, 0.5 - 0.1 * b, 2.3 - b))


def ring(x):
    """Five discs around the origin, of unequal distances."""
    angle = jnp.array([0.0, 1.0, 2.2, 3.5, 5.0])
    far = jnp.linspace(4.2, 4.5, 5)
    centres = far[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    return jnp.min(jnp.linalg.norm(x - centres, axis=1)) - 0.5


def oscillator(x):
    """Rest after a rectangular pulse (Bucher and Bourgund, 1990), rarer."""
    c1, c2, m, r = 1 + 0.1 * x[0], 0.1 + 0.01 * x[1], 1 + 0.05 * x[2], 0.5 + 0.05 * x[3]
    duration, force = 1 + 0.2 * x[4], 0.6 + 0.1 * x[5]
    w = jnp.sqrt((c1 + c2) / m)
    return 3 * r - jnp.abs(2 * force / (m * w**2) * jnp.sin(w * duration / 2))


def parabola(x):
    """A curved surface in many dimensions."""
    return 4 - x[0] - 0.02 * (jnp.sum(x[1:] ** 2) - 39)


def hat(x):
    """A narrow brim (Schoebi, Sudret and Marelli, 2017)."""
    return 20 - (x[0] - x[1]) ** 2 - 8 * (x[0] + x[1] - 4) ** 3


def himmelblau(x):
    """Four wells of unequal depths; modified as in the literature on subset simulation."""
    a, b = 0.75 * x[0] - 0.5, 0.75 * x[1] - 1.5
    return (a**2 / 1.81 + b - 11) ** 2 + (a + b**2 / 1.81 - 7) ** 2 - 45


def product(x):
    """Four equal regions beside the diagonals."""
    return 8 - jnp.abs(x[0] * x[1])


def two_discs(x):
    """Two discs of unequal sizes."""
    first = jnp.linalg.norm(x - jnp.array([3.5, 3.5])) - 1
    return jnp.minimum(first, jnp.linalg.norm(x - jnp.array([-4.0, 2.0])) - 0.7)


def slow_and_fast(x):
    """Two flat regions, to the likelier of which the robustness falls slowly."""
    return jnp.minimum(60 * (4.6 - x[0]), 0.05 * (4.3 - x[1]))


LIMIT_STATES: dict[str, tuple[Callable, int, float | None]] = {
    "four-branch, k = 6": (four_branch(6), 2, None),
    "four-branch, k = 7": (four_branch(7), 2, None),
    "four-branch, k = 9": (four_branch(9), 2, None),
    "metaballs": (metaballs, 2, None),
    "Breitung's trap": (breitung_trap, 2, None),
    "ring of five": (ring, 2, None),
    "oscillator": (oscillator, 6, 9.133e-6),  # Importance sampling, known to 0.04 %.
    "parabola": (parabola, 40, 4.2005e-5),  # By an integral over the sum of squares.
    "hat": (hat, 2, None),
    "Himmelblau": (himmelblau, 2, None),
    "product": (product, 2, None),
    "two discs": (two_discs, 2, None),
    "slow and fast": (slow_and_fast, 2, None),
}
"""Robustness, dimension, and the probability; None where a grid gives it."""


def by_grid(robustness: Callable, step: float = 0.002, end: float = 8.5) -> float:
    """The probability that a limit state in two dimensions fails, by the midpoint rule."""
    positions = np.arange(-end, end, step) + step / 2
    mass = norm.pdf(positions) * step
    rows = jax.jit(jax.vmap(jax.vmap(lambda a, b: robustness(jnp.stack([a, b])) < 0, (None, 0)),
                            (0, None)))  # fmt: skip
    total = 0.0
    for start in range(0, len(positions), 250):
        block = slice(start, start + 250)
        total += mass[block] @ (np.asarray(rows(positions[block], positions)) @ mass)
    return float(total)


def limit_state(name: str, budget: int, seeds: int) -> None:
    """One line of the table, of a limit state of the literature."""
    robustness, dim, p = LIMIT_STATES[name]
    p = by_grid(robustness) if p is None else p
    measured(name, problem(name, features(dim), robustness), dim, p, budget, seeds)


PROBLEMS = {
    "half-space": half_space,
    "sphere": sphere,
    "ball": ball,
    "two modes": two_modes,
    "corner": corner,
}


def closed_form(name: str, dim: int, p: float, budget: int, seeds: int) -> None:
    """One line of the table."""
    try:
        known = PROBLEMS[name](dim, p)
    except ValueError:
        return
    measured(name, known, dim, p, budget, seeds)


def measured(name: str, known: vj.Problem, dim: int, p: float, budget: int, seeds: int) -> None:
    """Estimate with many seeds, and print a line of the table."""
    started, covered, ratio, methods = time.perf_counter(), 0, [], set()
    for seed in range(seeds):
        found = estimate(known, budget=budget, seed=seed, progress=False)
        covered += found.low <= p <= found.high
        ratio.append((found.probability or math.nan) / p)
        methods.add(found.method)
    seconds = (time.perf_counter() - started) / seeds
    line(name, dim, p, budget, covered, np.array(ratio), methods, seconds)


def line(name, dim, p, budget, covered, ratio, methods, seconds) -> None:
    """Print it."""
    worst = np.exp(np.nanmax(np.abs(np.log(ratio))))
    print(
        f"| {name} | {dim} | {p:.3g} | {budget:,} | {covered}/{len(ratio)} | "
        f"{np.nanmean(ratio):.3f} | {100 * np.nanstd(ratio):.1f} % | {worst:.2f} | "
        f"{', '.join(sorted(map(str, methods)))} | {seconds:.1f} |",
        flush=True,
    )


def at6b(seeds: int, truth: int | None) -> None:
    """AT6b in 10 000 simulations against Monte Carlo."""
    from specs.arch.automatic_transmission import at6b as transmission

    failures, simulations = AT6B
    if truth:
        counted = estimate(transmission, "monte_carlo", truth, batch=2048, seed=12345)
        failures, simulations = counted.prior_failures, counted.prior_simulations
        print(f"\nAT6b by Monte Carlo: {failures} of {simulations:,}")
    p = failures / simulations
    started, covered, ratio, methods = time.perf_counter(), 0, [], set()
    for seed in range(seeds):
        found = estimate(transmission, budget=10_000, seed=seed, progress=False)
        covered += found.low <= p <= found.high
        ratio.append((found.probability or math.nan) / p)
        methods.add(found.method)
    ratio = np.array(ratio)
    seconds = (time.perf_counter() - started) / seeds
    line("AT6b", 12, p, 10_000, covered, ratio, methods, seconds)
    within = int(np.sum(np.abs(ratio / np.median(ratio) - 1) <= 0.1))
    print(f"\nAT6b: {within} of {seeds} within 10 % of their median {p * np.median(ratio):.3e}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--budget", type=int, default=50_000)
    parser.add_argument("--dims", type=int, nargs="+", default=[2, 10, 50])
    parser.add_argument("--levels", type=float, nargs="+", default=[1e-2, 1e-4, 1e-6, 1e-7])
    parser.add_argument("--only", nargs="+", default=[*PROBLEMS, "limit-states", "at6b"])
    parser.add_argument("--truth", type=int, help="Simulations of AT6b by Monte Carlo.")
    options = parser.parse_args()
    print("| problem | d | p | simulations | covered | mean | sd | worst | methods | s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in options.only:
        for trap in LIMIT_STATES if name == "limit-states" else ():
            limit_state(trap, options.budget, options.seeds)
        if name in PROBLEMS:
            for dim in options.dims:
                for p in options.levels:
                    closed_form(name, dim, p, options.budget, options.seeds)
    if "at6b" in options.only:
        at6b(options.seeds, options.truth)


if __name__ == "__main__":
    main()
