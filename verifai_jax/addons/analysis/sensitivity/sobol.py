"""Sobol indices: shares of the variance due to a feature alone, and including interactions."""

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.analysis.sensitivity import sensitivity
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count
from verifai_jax.problem.problem import Problem

NOISE = "(simulation noise)"


@shows_progress("finding Sobol indices of")
def sobol_indices(
    problem: Problem, samples: int = 4096, *, seed: int = 0, batch: int = 1024,
    of: str | None = None, progress: bool | None = None,
) -> sensitivity.Sensitivity:  # fmt: skip
    """Compute each feature's share of the robustness's variance, alone and with interactions.

    `first` is the share of the variance that vanishes when the feature is known; `total` is the
    share that remains when all other features are known, so it includes interactions. A feature
    with a total of 0 has no influence at all.

    - `samples`: number `N` of base points, best a power of two. It takes `N (d + 2)` simulations
      for `d` coordinates, and `N` more if simulations are random.
    - `of`: name of the formula; when left out, the least robustness over all.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.

    Sources: first-order estimator of Saltelli et al., Variance based sensitivity analysis of model
    output, Computer Physics Communications 181 (2010); total of Jansen, Analysis of variance
    designs for model output, Computer Physics Communications 117 (1999); points of a scrambled
    Sobol sequence.

    **Raises:** `ValueError` for a space with a constraint, whose features are not independent; for
    fewer than 16 samples; if no simulation has a verdict or the robustness never varies.
    """
    sensitivity.check_problem(problem, "Sobol indices", of)
    check_count("samples", samples, 16)
    names = sensitivity.coordinates_of(problem).names
    d = len(names)
    from scipy.stats import qmc

    exponent = int(np.ceil(np.log2(samples)))
    points = qmc.Sobol(2 * d, rng=seed).random_base2(exponent)[:samples].astype(np.float32)
    simulate = sensitivity.Simulator(problem, seed, min(batch, samples), of)
    a, b = points[:, :d], points[:, d:]
    # One base point has one random key, and its partner another: noise is a further coordinate.
    f_a, f_b = simulate(a, 0), simulate(b, samples)
    swapped = []
    for i in range(d):
        mixed = a.copy()
        mixed[:, i] = b[:, i]
        swapped.append(simulate(mixed, 0))
    probe = min(batch, samples)
    noisy = not np.array_equal(simulate(a[:probe], samples), f_a[:probe], equal_nan=True)
    if noisy:
        swapped.append(simulate(a, samples))
        names = (*names, NOISE)
    f_ab = np.stack(swapped, axis=1)
    proper = np.isfinite(f_a) & np.isfinite(f_b)
    variance = sensitivity.variance_of(np.concatenate([f_a, f_b]), problem)
    first, total = _sobol_estimates(f_a, f_b, f_ab, proper)
    generator = np.random.default_rng(seed)
    again = []
    for _ in range(sensitivity.RESAMPLES):
        rows = generator.integers(samples, size=samples)
        again.append(_sobol_estimates(f_a[rows], f_b[rows], f_ab[rows], proper[rows]))
    low, high = np.nanpercentile(np.array(again), [2.5, 97.5], axis=0)
    table = sensitivity.ranked(
        names,
        {
            "first": first,
            "first_low": low[0],
            "first_high": high[0],
            "total": total,
            "total_low": low[1],
            "total_high": high[1],
            "pairs": np.sum(proper[:, None] & np.isfinite(f_ab), axis=0),
        },
        by="total",
    )
    return sensitivity.Sensitivity(
        "Sobol indices", problem.name, table, simulate.done, simulate.dropped, variance
    )


def _sobol_estimates(
    f_a: Float[np.ndarray, " n"], f_b: Float[np.ndarray, " n"], f_ab: Float[np.ndarray, "n d"],
    proper: Bool[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:  # fmt: skip
    pairs = proper[:, None] & np.isfinite(f_ab)
    count = np.maximum(pairs.sum(axis=0), 1)
    both = np.concatenate([f_a[proper], f_b[proper]])
    variance, mean = (np.var(both), np.mean(both)) if len(both) else (np.nan, 0.0)
    variance = variance or np.nan
    # Without the mean the products have less variance; the expectation is the same.
    a, b = np.where(pairs, f_a[:, None] - mean, 0), np.where(pairs, f_b[:, None] - mean, 0)
    ab = np.where(pairs, f_ab - mean, 0)
    first = np.sum(b * (ab - a), axis=0) / count / variance
    total = np.sum((a - ab) ** 2, axis=0) / (2 * count) / variance
    return first, total
