"""Components fitted to weighted failures, each in its own way.

    fit_gaussian(z, weight)
    fit_across(z, weight, directions)
    marginals = fit_marginals(z, weight)
    fit_copula(z, weight, marginals)
    fit_shell(z, weight)

Points are `z [n, d]`; their weights `[n]` sum to one. `worth` is the number of independent points
that one point counts for; it is below one for the correlated states of a chain. A component differs
from the prior only as far as that number of points can prove.
"""

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.estimation.components import (
    Copula,
    Gaussian,
    Marginals,
    Shell,
    log_ratios,
    radial_score,
    rank_scores,
)

WIDER = 1.3
"""Factor on the standard deviations of Gaussians fitted to a single region."""
SWEEPS = 12
"""Iterations of expectation maximisation, at most."""
KERNELS = 400
"""Points that a kernel density is made from, at most."""
MANY = 16
"""Coordinates beyond which flat ones are skipped before kernels are fitted."""
CELLS = 48
"""Steps of the function that a kernel density is stored in."""


def effective_size(weight: Float[np.ndarray, " n"]) -> float:
    """Return the effective number of equally weighted points for these weights."""
    maximum = weight.max(initial=0.0)
    if not maximum > 0:
        return 0.0
    # Of the largest, so that squares of small ones do not all vanish.
    parts = weight / maximum
    return float(parts.sum() ** 2 / np.sum(parts * parts))


def weigh_together(
    states: int, worth: float, weight: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " k"]:
    """Weight states of chains and weighted samples of the same failures by their information.

    **Arguments:**
    - `states`: number of states, which are correlated.
    - `worth`: number of independent points that all of them are worth.
    - `weight`: the weight of the samples.
    **Returns:** weights of the states, then of the samples; more informative samples reduce the
    weights of the states.
    """
    fresh = effective_size(weight)
    worth *= worth / (worth + fresh)
    return np.concatenate([np.full(states, worth / states), fresh * weight / weight.sum()])


def fit_gaussian(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], worth: float = 1.0
) -> Gaussian:
    """Fit a Gaussian whose covariance differs from the prior's only beyond sampling noise.

    Eigenvalues within the range of white noise (Marchenko and Pastur, 1967) are replaced by their
    mean.
    """
    d = z.shape[1]
    size = max(effective_size(weight) * worth, 1.0)
    mean = weight @ z
    centred = z - mean
    values, axes = np.linalg.eigh((centred * weight[:, None]).T @ centred)
    ratio = d / max(size - 1, 1)
    level, inside = 1.0, np.ones(d, bool)
    for _ in range(20):
        low, high = level * max(0.0, 1 - np.sqrt(ratio)) ** 2, level * (1 + np.sqrt(ratio)) ** 2
        # With few coordinates the range is no range: then about three standard errors.
        low, high = low * (1 - 2 / np.sqrt(size)), high * (1 + 2 / np.sqrt(size))
        inside = (values >= low) & (values <= high)
        if not inside.any():
            break
        new = float(values[inside].mean())
        if abs(new - level) < 1e-6:
            break
        level = new
    if ratio >= 1:
        values, inside = np.full(d, float(values.mean())), np.ones(d, bool)
        level = float(values.mean())
    values = np.where(inside, level, values) if inside.any() else values
    return Gaussian(mean, axes, np.sqrt(np.clip(values, 1e-8, 25.0)))


def fit_diagonal(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], worth: float = 1.0
) -> Gaussian:
    """Fit a Gaussian without correlations, a little wider than the points.

    A coordinate that differs from the prior only by sampling noise keeps the prior.
    """
    size = max(effective_size(weight) * worth, 2.0)
    mean = weight @ z
    stds = np.maximum(np.sqrt(weight @ (z - mean) ** 2), 1e-9)
    noise = 3 / np.sqrt(size)
    free = (np.abs(mean) < noise) & (np.abs(np.log(stds)) < noise / np.sqrt(2))
    mean, stds = np.where(free, 0.0, mean), np.where(free, 1.0, WIDER * stds)
    return Gaussian(mean, np.eye(z.shape[1]), np.clip(stds, 1e-4, 5.0))


def fit_across(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"],
    directions: Float[np.ndarray, "d p"], worth: float = 1.0,
) -> Gaussian:  # fmt: skip
    """Fit a slightly widened Gaussian in orthonormal directions; across them it is the prior."""
    within = fit_gaussian(z @ directions, weight, worth)
    others = np.linalg.qr(directions, mode="complete")[0][:, directions.shape[1] :]
    axes = np.concatenate([directions @ within.axes, others], axis=1)
    stds = np.append(WIDER * within.stds, np.ones(others.shape[1]))
    return Gaussian(directions @ within.mean, axes, stds)


def fit_gaussian_mixture(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], modes: int,
    rng: np.random.Generator, worth: float = 1.0,
) -> tuple[list[float], list[Gaussian], Float[np.ndarray, "n modes"]]:  # fmt: skip
    """Fit a mixture of Gaussians by expectation maximisation from spread-out centres.

    **Returns:** shares, components, and memberships `[n, modes]` times weight; covariances are
    those of `fit_gaussian`.
    """
    n = len(z)
    centre = z[rng.choice(n, p=weight)]
    distance = np.sum((z - centre) ** 2, axis=1)
    centres = [centre]
    for _ in range(1, modes):
        chance = weight * distance
        if chance.sum() <= 0:
            break
        centres.append(z[rng.choice(n, p=chance / chance.sum())])
        distance = np.minimum(distance, np.sum((z - centres[-1]) ** 2, axis=1))
    gaps = np.stack([np.sum((z - c) ** 2, axis=1) for c in centres], axis=1)
    member = np.eye(len(centres))[gaps.argmin(axis=1)] * weight[:, None]
    shares, components = [1.0], []
    for sweep in range(SWEEPS if modes > 1 else 1):
        keep = member.sum(axis=0) > 1e-9
        member = member[:, keep]
        shares = list(member.sum(axis=0) / member.sum())
        components = [fit_gaussian(z, column / column.sum(), worth) for column in member.T]
        if modes == 1 or sweep == SWEEPS - 1:
            break
        logs = log_ratios(components, z) + np.log(shares)
        logs -= logs.max(axis=1, keepdims=True)
        new = np.exp(logs)
        new *= (weight / new.sum(axis=1))[:, None]
        moved = np.abs(new - member).sum()
        member = new
        if moved < 0.01:
            break
    return shares, components, member


_INNER = np.array([1e-6, 1e-5, 1e-4, 5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.04, 0.07])


def _borders() -> list[Float[np.ndarray, " k"]]:
    """Return borders of steps to choose from, as probabilities: even ones, and fine ends."""
    even = [np.linspace(0, 1, k + 1) for k in (2, 4, 8, 16, 32)]
    middle = np.linspace(0.1, 0.9, 9)
    tails = np.concatenate([[0], _INNER, middle, 1 - _INNER[::-1], [1]])
    coarse = np.concatenate([[0, 1e-4, 2e-3, 0.02], [0.1, 0.3, 0.5, 0.7, 0.9]])
    coarse = np.concatenate([coarse, [0.98, 0.998, 1 - 1e-4, 1]])
    return [*even, coarse, tails]


_BORDERS = _borders()
_FINEST = np.unique(np.concatenate(_BORDERS))
_AMONG = [np.searchsorted(_FINEST, border) for border in _BORDERS]


def fit_copula(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], steps: Marginals,
    worth: float = 1.0,
) -> Copula | None:  # fmt: skip
    """Join marginals by their correlations beyond sampling noise; None if there are none."""
    d, size = z.shape[1], effective_size(weight) * worth
    v = rank_scores(steps, z)
    centred = v - weight @ v
    cross = (centred * weight[:, None]).T @ centred
    spread = np.sqrt(np.maximum(np.diag(cross), 1e-12))
    correlation = cross / np.outer(spread, spread)
    noise = 2.5 / np.sqrt(size)
    keep = np.where(np.abs(correlation) > noise, correlation * (1 - 1 / max(size, 2)), 0.0)
    np.fill_diagonal(keep, 1.0)
    if np.count_nonzero(keep) == d:
        return None
    values, axes = np.linalg.eigh(keep)
    values = np.clip(values, 0.02, None)
    return Copula(steps, axes, np.sqrt(values))


def fit_marginals(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], wider: float = 1.0,
    worth: float = 1.0,
) -> Marginals:  # fmt: skip
    """Fit each coordinate's density by kernels with reflected ends, as a fine step function.

    **Arguments:**
    - `wider`: factor on the kernels' width by Silverman's rule (Density estimation, 1986, equation
      3.31).
    """
    from scipy.special import ndtr, ndtri

    size = effective_size(weight) * worth
    if len(z) > KERNELS:
        # Equally many points in each part of the weight: the same density with less work.
        quantiles = (np.arange(KERNELS) + 0.5) / KERNELS
        rows = np.searchsorted(np.cumsum(weight), quantiles * weight.sum())
        z, weight = z[np.minimum(rows, len(z) - 1)], np.full(KERNELS, 1 / KERNELS)
    edges, logs, masses = [], [], []
    flat = (np.array([-np.inf, np.inf]), np.zeros(1), np.ones(1))
    for column in ndtr(z).T:
        if z.shape[1] > MANY:
            share = np.bincount((column * 8).astype(int).clip(0, 7), weight, 8) + 1e-12
            if size * float(share @ np.log(8 * share)) < 5.0:
                # As flat as noise: most of many coordinates are, and kernels take their time.
                edges.append(flat[0])
                logs.append(flat[1])
                masses.append(flat[2])
                continue
        order = np.argsort(column)
        total = np.cumsum(weight[order])
        quarter, three = np.interp([0.25, 0.75], total, column[order])
        middle = weight @ column
        std = float(np.sqrt(weight @ (column - middle) ** 2))
        width = max(0.9 * min(std, (three - quarter) / 1.34 + 1e-9) * size**-0.2, 1e-9) * wider
        low, high = max(0.0, column.min() - 3 * width), min(1.0, column.max() + 3 * width)
        border = np.unique(np.concatenate([[0.0], np.linspace(low, high, CELLS + 1), [1.0]]))
        mass = np.zeros(len(border) - 1)
        for mirror in (column, -column, 2 - column):
            mass += weight @ np.diff(ndtr((border[None] - mirror[:, None]) / width), axis=1)
        prior = np.diff(border)
        mass = (mass * size + 2 * prior) / (mass.sum() * size + 2)
        if size * float(mass @ np.log(mass / prior)) < 4.0:
            border, prior, mass = np.array([0.0, 1.0]), np.ones(1), np.ones(1)
        edges.append(ndtri(border))
        logs.append(np.log(mass / prior))
        masses.append(mass / mass.sum())
    return Marginals(tuple(edges), tuple(logs), tuple(masses))


def fit_common_marginal(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], worth: float = 1.0
) -> Marginals:
    """Fit one step function to all coordinates together."""
    from scipy.special import ndtr

    d = z.shape[1]
    steps = _steps(ndtr(z).ravel(), np.repeat(weight, d) / d, effective_size(weight) * worth * d)
    return Marginals(*((part,) * d for part in steps))


def _steps(
    u: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"], size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return borders, logarithmic heights and masses; Akaike's criterion chooses the borders."""
    from scipy.special import ndtri

    best = 0.0
    chosen = (np.array([-np.inf, np.inf]), np.zeros(1), np.ones(1))
    # Counted once, in the finest borders, of which the others are sums.
    index = np.clip(np.searchsorted(_FINEST, u, side="right") - 1, 0, len(_FINEST) - 2)
    fine = np.append(0, np.cumsum(np.bincount(index, weight, len(_FINEST) - 1)))
    for border, among in zip(_BORDERS, _AMONG, strict=True):
        k = len(border) - 1
        if k > size:
            continue
        width, share = np.diff(border), np.diff(fine[among])
        # Two points spread as the prior is, so that no step is empty.
        mass = (share * size + 2 * width) / (size + 2)
        gain = size * float(share @ np.log(mass / width)) - 1.5 * (k - 1)
        if gain > best:
            best = gain
            chosen = (ndtri(border), np.log(mass / width), mass / mass.sum())
    return chosen


def fit_shell(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], worth: float = 1.0
) -> Shell:
    """Fit shells to the points' distances from the origin, in steps of small probability."""
    from scipy.special import ndtr

    score = radial_score(z)
    size = effective_size(weight) * worth
    order = np.argsort(score)
    total = np.cumsum(weight[order])
    steps = int(np.clip(size // 20, 2, 12))
    inner = np.unique(np.interp(np.arange(1, steps) / steps, total, score[order]))
    low, high = score.min() - 0.05, score.max() + 0.3
    edges = np.unique(np.concatenate([[-np.inf, low], inner, [high, np.inf]]))
    index = np.clip(np.searchsorted(edges, score, side="right") - 1, 0, len(edges) - 2)
    below, above = edges[:-1], edges[1:]
    width = np.where(below > 0, ndtr(-below) - ndtr(-above), ndtr(above) - ndtr(below))
    width = np.maximum(width, 1e-300)
    mass = (np.bincount(index, weight, len(width)) * size + 0.5) / (size + 0.5 * len(width))
    # Outside of all points the prior's own density is enough.
    mass[0], mass[-1] = min(mass[0], width[0]), min(mass[-1], max(width[-1], 0.01))
    mass = mass / mass.sum()
    steps_of = Marginals((edges,), (np.log(mass / width),), (mass,))
    return Shell(z.shape[1], steps_of)
