"""Rare failures by 500 simulations: 20 problems of reliability, and pairs with a cheap model.

python benchmarks/slow_simulations.py                        # surrogate, 20 seeds: about two hours
python benchmarks/slow_simulations.py --methods auto monte_carlo splitting importance --seeds 20
python benchmarks/slow_simulations.py --useless              # surrogates that are wrong everywhere
python benchmarks/slow_simulations.py --pairs                # with and without a cheap model

Problems whose name begins with RP are those of the reliability challenge of TNO (Rozsas and Slobbe,
2019), as OpenTURNS has them. True probabilities in two dimensions are by quadrature on a grid of
0.003, the others by 2e7 weighted samples (relative error below 1 %) or exact.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.special import ndtr, ndtri
from scipy.stats import chi2, norm

from verifai_jax.addons.estimation import gaussian_surrogate, surrogate
from verifai_jax.addons.estimation.answers import (
    Plan,
    chains_for,
    estimate_by_monte_carlo,
    estimate_by_splitting,
)
from verifai_jax.addons.estimation.methods import (
    SHARE_OF_LEVEL,
    estimate_automatically,
    estimate_by_importance_sampling,
)
from verifai_jax.addons.estimation.normal_space import LimitState

ROOT = np.sqrt(2)


def lognormal(z, mean, std):
    variance = np.log1p((std / mean) ** 2)
    return np.exp(np.log(mean) - variance / 2 + np.sqrt(variance) * z)


def gumbel(z, mean, std):
    scale = std * np.sqrt(6) / np.pi
    return (
        mean - 0.5772156649 * scale - scale * np.log(-np.log(np.clip(ndtr(z), 1e-300, 1 - 1e-16)))
    )


def rp24(a, b):
    a, b = 10 + 3 * a, 10 + 3 * b
    return 2.5 - 0.2357 * (a - b) + 0.00463 * (a + b - 20) ** 4


def rp35(a, b):
    return np.minimum(2 - b + np.exp(-0.1 * a * a) + (0.2 * a) ** 4, 4.5 - a * b)


def trap(a, b):
    first = np.where(a > 3.5, 4 - a, 0.85 - 0.1 * a)
    return np.minimum(first, np.where(b > 2, 0.5 - 0.1 * b, 2.3 - b))


def metaballs(a, b):
    first = 30 / ((4 * (a + 2) ** 2 / 9 + b**2 / 25) ** 2 + 1)
    return first + 20 / (((a - 2.5) ** 2 / 4 + (b - 0.5) ** 2 / 25) ** 2 + 1) - 5


def branches(k):
    def robustness(a, b):
        curved = 3 + 0.1 * (a - b) ** 2 - np.abs(a + b) / ROOT
        return np.minimum(curved, k / ROOT - np.abs(a - b))

    return robustness


def ring(a, b):
    angle, far = np.array([0, 1, 2.2, 3.5, 5.0]), np.linspace(4.2, 4.5, 5)
    return (
        np.min(np.hypot(a[:, None] - far * np.cos(angle), b[:, None] - far * np.sin(angle)), 1)
        - 0.5
    )


def rp14(a, b, c, d, e):
    length, moment = 400 + 0.1 * d, 250_000 + 35_000 * e
    force = np.sqrt(gumbel(c, 1342, 272.9) ** 2 * length**2 / 16 + moment**2)
    return 70 + 10 * ndtr(a) - 32 / (np.pi * (39 + 0.1 * b) ** 3) * force


def rp8(a, b, c, d, e, f):
    strong = [lognormal(z, 120, 12) for z in (a, b, c, d)]
    return (
        strong[0]
        + 2 * strong[1]
        + 2 * strong[2]
        + strong[3]
        - 5 * (lognormal(e, 50, 10) + lognormal(f, 40, 8))
    )


def oscillator(a, b, c, d, e, f):
    mass = 1 + 0.05 * c
    w = np.sqrt(np.abs((1.1 + 0.1 * a + 0.01 * b) / mass))
    swing = 2 * (0.6 + 0.1 * f) / (mass * w**2) * np.sin(w * (1 + 0.2 * e) / 2)
    return 3 * (0.5 + 0.05 * d) - np.abs(swing)


def truss(a, b, c, d, e, f):
    load, length = 20_000 * (1 + 0.07 * a), 12 * (1 + 0.01 * b)
    steel = 9.82e-4 * (1 + 0.06 * c) * 1e11 * (1 + 0.06 * e)
    concrete = 0.04 * (1 + 0.12 * d) * 2e10 * (1 + 0.06 * f)
    return 0.03 - load * length**2 / 2 * (3.81 / concrete + 1.13 / steel)


def plane(*z):
    a = np.random.default_rng(10).standard_normal(10)
    return norm.isf(1e-4) - np.stack(z, axis=1) @ (a / np.linalg.norm(a))


PROBLEMS: dict[str, tuple[int, Callable, float]] = {
    "RP22": (2, lambda a, b: 2.5 - (a + b) / ROOT + 0.1 * (a - b) ** 2, 4.2073e-3),
    "RP24": (2, rp24, 2.8605e-3),
    "RP25": (2, lambda a, b: np.maximum(a * a - 8 * b + 16, b - 16 * a + 32), 4.1465e-5),
    "RP31": (2, lambda a, b: 2 - b + 256 * a**4, 3.2265e-3),
    "RP35": (2, rp35, 3.4787e-3),
    "RP75": (2, lambda a, b: 3 - a * b, 9.8202e-3),
    "RP110": (2, trap, 3.2090e-5),
    "metaballs": (2, metaballs, 1.1288e-5),
    "four branches, 6": (2, branches(6), 4.4517e-3),
    "four branches, 7": (2, branches(7), 2.2241e-3),
    "ring": (2, ring, 8.5040e-5),
    "R - S": (2, lambda a, b: 5 + a - b, 2.0375e-4),
    "RP33": (3, lambda a, b, c: np.minimum(3 * 3**0.5 - a - b - c, 3 - c), 2.5765e-3),
    "sphere": (5, lambda *z: np.sqrt(chi2.isf(1e-3, 5)) - np.linalg.norm(z, axis=0), 1e-3),
    "RP14": (5, rp14, 9.94e-5),
    "RP8": (6, rp8, 7.92e-4),
    "oscillator": (6, oscillator, 9.15e-6),
    "roof truss": (6, truss, 9.362e-3),
    "plane": (10, plane, 1e-4),
    "parabola": (10, lambda a, *z: 4.05 - a - 0.05 * np.sum(np.square(z), 0), 2.319e-4),
}
METHODS = {
    "surrogate": surrogate.estimate_by_surrogate,
    "auto": estimate_automatically,
    "monte_carlo": estimate_by_monte_carlo,
    "importance": estimate_by_importance_sampling,
    "splitting": estimate_by_splitting,
}


def limit_state(dim, robustness, budget):
    def evaluate(u):
        z = ndtri(np.clip(u, 1e-300, 1 - 1e-16))
        rho = robustness(*z.T)
        return rho, rho < 0, np.isfinite(rho)

    return LimitState(evaluate, dim, budget, batch=budget)


def run(name, method, seed, budget, **plan):
    dim, robustness, truth = PROBLEMS[name]
    state = limit_state(dim, robustness, budget)
    chosen = Plan(0.95, chains_for(budget, SHARE_OF_LEVEL), np.zeros(dim, bool), **plan)
    answer = METHODS[method](state, np.random.default_rng(seed), chosen)
    high = answer.high if answer.probability is not None else answer.prior.upper_bound(0.95)
    ratio = (answer.probability or np.nan) / truth
    return ratio, answer.low <= truth <= high, high / max(answer.low, 1e-12), state.simulations


def table(method, names, seeds, budget):
    good, covered = 0, []
    for name in names:
        began = time.time()
        rows = np.array([run(name, method, seed, budget) for seed in range(seeds)], float)
        within = (rows[:, 0] > 0.5) & (rows[:, 0] < 2)
        good += within.mean() > 0.5
        covered += list(rows[:, 1])
        spread = np.nanstd(rows[:, 0]) if np.isfinite(rows[:, 0]).any() else np.nan
        print(
            f"{method:11} {name:18} P {PROBLEMS[name][2]:.3g} factor 2 {within.mean():.2f} covered "
            f"{rows[:, 1].mean():.2f} sd {spread:.2f} high/low {np.median(rows[:, 2]):.2f} "
            f"{(time.time() - began) / seeds:.1f} s",
            flush=True,
        )
    print(
        f"{method}: {good} of {len(names)} within a factor of two; covered {np.mean(covered):.3f}"
    )


def distorted(robustness):
    """A cheap model: the robustness at another scale, bent and moved by a tenth of a deviation."""
    return lambda u: (lambda z: 1.3 * robustness(*(z + 0.1).T) + 0.05 * np.sin(2 * z[:, 0]))(
        ndtri(np.clip(u, 1e-300, 1 - 1e-16))
    )


def pairs(names, seeds):
    for name in names:
        counts = {}
        for kind, cheap in (("alone", None), ("cheap", distorted(PROBLEMS[name][1]))):
            rows = [run(name, "surrogate", s, 500, within=1.5, cheap=cheap) for s in range(seeds)]
            counts[kind] = np.mean([row[3] for row in rows])
            covered = np.mean([row[1] for row in rows])
            print(
                f"{name:18} {kind} {counts[kind]:.0f} simulations, covered {covered:.2f}",
                flush=True,
            )
        print(f"{name:18} {counts['alone'] / counts['cheap']:.1f} times fewer", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--methods", nargs="*", default=["surrogate"], choices=METHODS)
    parser.add_argument("--problems", nargs="*", default=[*PROBLEMS])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--budget", type=int, default=500)
    parser.add_argument("--useless", action="store_true")
    parser.add_argument("--pairs", action="store_true")
    options = parser.parse_args()
    if options.pairs:
        pairs(options.problems, options.seeds)
        return
    if options.useless:

        def wrong(self, z):
            wave = np.sin(z @ np.random.default_rng(z.shape[1]).standard_normal((z.shape[1], 5)))
            return wave.sum(axis=1) + 1.5, np.full(len(z), 0.3)

        gaussian_surrogate.Surrogate.predict = wrong
    for method in options.methods:
        table(method, options.problems, options.seeds, options.budget)


if __name__ == "__main__":
    main()
