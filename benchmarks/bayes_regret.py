"""`bayes` where no failure is near, beside a plain Gaussian process with expected improvement.

    python benchmarks/bayes_regret.py [--seeds 10] [--batch 1] [--reference FOLDER]

Branin's function and Hartmann's of six dimensions, raised so that their minimum is 10: nothing
fails. The regret is what the lowest robustness of all simulations lies above 10. `half` has no
verdict (NaN) in half of the space. The plain process is written here with NumPy and SciPy: Matern
5/2, length scales by the greatest evidence from three starts, expected improvement maximized from
the best of 2000 points by L-BFGS-B, one point a round; rows without a verdict it has with the
greatest value so far. Its regrets are kept in a folder, since it takes long; much less with
`OPENBLAS_NUM_THREADS=1` in the environment, as its matrices are small.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.stats import norm, qmc

from verifai_jax.addons.searches.bayes import Bayes
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations

RAISED = 10.0

A = np.array(
    [[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14],
     [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]]
)  # fmt: skip
P = 1e-4 * np.array(
    [[1312, 1696, 5569, 124, 8283, 5886], [2329, 4135, 8307, 3736, 1004, 9991],
     [2348, 1451, 3522, 2883, 3047, 6650], [4047, 8828, 8732, 5743, 1091, 381]]
)  # fmt: skip


def branin(u, xp=jnp):
    """Branin's function over the unit square, whose least value is 0."""
    x, y = 15 * u[..., 0] - 5, 15 * u[..., 1]
    valley = y - 5.1 / (4 * np.pi**2) * x**2 + 5 / np.pi * x - 6
    return valley**2 + 10 * (1 - 1 / (8 * np.pi)) * xp.cos(x) + 10 - 0.39788736


def hartmann(u, xp=jnp):
    """Hartmann's function over the cube of six dimensions, whose least value is 0."""
    inner = xp.sum(A * (u[..., None, :] - P) ** 2, axis=-1)
    return 3.32236801 - xp.exp(-inner) @ np.array([1.0, 1.2, 3.0, 3.2])


def half(function, u, xp=jnp):
    """The function, without a value in half of the space: where the second coordinate is great."""
    return xp.where(u[..., 1] < 0.5, function(u, xp), xp.nan)


CASES: dict[str, tuple[Callable, int, int]] = {
    "branin": (branin, 2, 60),
    "hartmann": (hartmann, 6, 150),
    "branin half": (partial(half, branin), 2, 60),
    "hartmann half": (partial(half, hartmann), 6, 150),
}


def matern(x, z, lengths):
    """Correlations by Matern 5/2, and -2 times their slopes along the squared scaled distance."""
    r = np.sqrt(5) * np.linalg.norm((x[:, None] - z[None]) / lengths, axis=2)
    decay = np.exp(-r)
    return (1 + r + r**2 / 3) * decay, 5 / 3 * (1 + r) * decay


def surprise(theta, x, z):
    """Minus the log evidence of a plain process, at its best variance, and its slope."""
    d, n = x.shape[1], len(z)
    k, bend = matern(x, x, np.exp(theta[:d]))
    k[np.diag_indices(n)] += np.exp(theta[d])
    try:
        factor = cho_factor(k, lower=True)
    except np.linalg.LinAlgError:
        return 1e9, np.zeros(d + 1)
    weights, inverse = cho_solve(factor, z), cho_solve(factor, np.eye(n))
    outer = 0.5 * (inverse - n * np.outer(weights, weights) / (z @ weights))
    square = ((x[:, None] - x[None]) / np.exp(theta[:d])) ** 2
    slope = np.append(np.einsum("ij,ijd->d", outer * bend, square), np.trace(outer))
    slope[d] *= np.exp(theta[d])
    return 0.5 * n * np.log(z @ weights / n) + np.sum(np.log(np.diag(factor[0]))), slope


def plain(function: Callable, d: int, budget: int, seed: int) -> np.ndarray:
    """Return the values that a plain process with expected improvement finds."""
    rng = np.random.default_rng(seed)
    x = qmc.Sobol(d, seed=seed).random(16)[:12]
    y = function(x, np)
    theta = np.append(np.full(d, np.log(0.5)), -9.0)
    bounds, box = [(-4, 3)] * d + [(-14, -2)], [(0, 1)] * d
    while len(y) < budget:
        known = np.where(np.isnan(y), np.nanmax(y), y)
        z = (known - known.mean()) / known.std()
        if len(y) % 5 == 2 or len(y) < 30:
            starts = [theta, *(np.append(rng.uniform(-2.5, 1, d), -9.0) for _ in range(2))]
            fits = [
                minimize(surprise, s, (x, z), jac=True, bounds=bounds, options={"maxiter": 30})
                for s in starts
            ]
            theta = min(fits, key=lambda fit: fit.fun).x
        lengths = np.exp(theta[:d])
        k = matern(x, x, lengths)[0] + np.exp(theta[d]) * np.eye(len(x))
        factor = cho_factor(k, lower=True)
        weights = cho_solve(factor, z)
        scale = z @ weights / len(z)

        def gain(u, lengths=lengths, factor=factor, weights=weights, scale=scale, x=x, z=z):
            c, bend = matern(np.atleast_2d(u), x, lengths)
            solved = cho_solve(factor, c.T).T
            std = np.sqrt(np.maximum(scale * (1 - np.sum(c * solved, axis=1)), 1e-14))
            t = (z.min() - c @ weights) / std
            worth = np.maximum(std * (t * norm.cdf(t) + norm.pdf(t)), 1e-30)
            if u.ndim == 2:
                return worth
            turn = -bend[0][:, None] * (u - x) / lengths**2
            slope = -norm.cdf(t[0]) * (weights @ turn)
            slope -= norm.pdf(t[0]) * scale * (solved[0] @ turn) / std[0]
            return -np.log(worth[0]), -slope / worth[0]

        near = np.clip(x[z.argmin()] + 0.05 * rng.normal(size=(500, d)), 0, 1)
        candidates = np.concatenate([rng.random((1500, d)), near])
        order = np.argsort(-gain(candidates))[:4]
        tops = [minimize(gain, candidates[i], jac=True, bounds=box) for i in order]
        best = min(tops, key=lambda found: found.fun).x
        x, y = np.vstack([x, best]), np.append(y, function(best, np))
    return y


def ours(search: Bayes, function: Callable, d: int, budget: int, batch: int, seeds: range):
    """Return the values that the search finds from each seed, `[seeds, budget]`."""
    cube = Cube((0,) * d)

    def play(state, _):
        u, state = search.ask(state, cube, batch)
        rho = function(u).astype(jnp.float32) + RAISED
        told = Observations(u, rho, jnp.ones(batch, bool))
        return search.tell(state, cube, told), rho - RAISED

    def one(key):
        return jax.lax.scan(play, search.init(key, cube, batch), None, length=-(-budget // batch))[
            1
        ]

    keys = jnp.stack([jax.random.key(seed) for seed in seeds])
    return np.asarray(jax.jit(partial(jax.lax.map, one))(keys)).reshape(len(seeds), -1)[:, :budget]


def main() -> None:
    """Print a line a case: medians and quartiles of the regret."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 8])
    parser.add_argument("--rules", nargs="+", default=["thompson", "expected_improvement"])
    parser.add_argument("--reference", type=Path, help="folder with regrets of the plain process")
    parser.add_argument("--cases", nargs="+", default=list(CASES))
    chosen = parser.parse_args()
    for name in chosen.cases:
        function, d, budget = CASES[name]
        seeds, cells = range(1000, 1000 + chosen.seeds), [name]
        file = chosen.reference / f"{name.replace(' ', '_')}.npy" if chosen.reference else None
        values = np.full((1, 1), np.nan)
        if file and file.exists():
            values = np.load(file)
        elif file:
            values = np.array([plain(function, d, budget, seed) for seed in seeds])
            file.parent.mkdir(parents=True, exist_ok=True)
            np.save(file, values)
        sides = {"plain": values}
        for batch in chosen.batches:
            for rule in chosen.rules:
                sides[f"{rule}, {batch} a round"] = ours(
                    Bayes(rule), function, d, budget, batch, seeds
                )
        for side, values in sides.items():
            low, median, high = np.quantile(np.nanmin(values, axis=1), [0.25, 0.5, 0.75])
            print(side, np.array2string(np.sort(np.nanmin(values, axis=1)), precision=2))
            cells.append(f"{side}: {median:.2g} ({low:.2g} to {high:.2g})")
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
