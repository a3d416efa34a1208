"""Proposals for importance sampling: mixtures fitted to failures, in standard normal space.

    proposal = fitted(points, weight, family, rng)
    z, _ = proposal.sample(rng, 1000)
    ratio = proposal.ratio(z)                       # proposal density over prior density

Components of several kinds are fitted to one half of the failures, and weighed by what they do on
the other: the weights minimise the second moment of the importance weights, `E[p/q | failure]`,
which is convex in them. So the kind is not chosen, and a mode that no component covers costs most.

Sources: Rubinstein and Kroese, The cross-entropy method (2004), chapter 8; Papaioannou, Geyer and
Straub, Improved cross entropy-based importance sampling with a flexible mixture model, Reliability
Engineering and System Safety 191 (2019); Owen and Zhou, Safe and effective importance sampling,
JASA 95 (2000), for the defensive share.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int

MODES = (1, 2, 4, 8)
"""Clusters that are tried."""
MOST_POINTS = 1500
"""Failures that a half of the candidates is fitted to at most: more change the fit little."""
SWEEPS = 12
KERNELS = 400
CELLS = 48
TOGETHER = 0.3
LEAST_SHARE = 1e-3


class Component(Protocol):
    """A density over normal space."""

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        """Independent points."""
        ...

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Logarithm of this density over the standard normal one."""
        ...


@dataclass(frozen=True)
class Prior:
    """The prior itself: the defensive part."""

    dim: int

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        return rng.standard_normal((n, self.dim))

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        return np.zeros(len(z))


@dataclass(frozen=True)
class Gaussian:
    """A normal density: `mean [d]`, and axes `[d, d]` (columns) with their standard deviations."""

    mean: Float[np.ndarray, " d"]
    axes: Float[np.ndarray, "d d"]
    stds: Float[np.ndarray, " d"]

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        return self.mean + (rng.standard_normal((n, len(self.mean))) * self.stds) @ self.axes.T

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        white = (z - self.mean) @ self.axes / self.stds
        return (np.sum(z * z, axis=1) - np.sum(white * white, axis=1)) / 2 - np.sum(
            np.log(self.stds)
        )


@dataclass(frozen=True)
class Marginals:
    """Independent coordinates, each the prior times a step function of the coordinate.

    - `edges`: for each coordinate, borders of the steps in normal space, from -inf to inf.
    - `log_steps`: for each, the logarithm of the density over the prior's; `masses` of the steps.
    """

    edges: tuple[Float[np.ndarray, " k"], ...]
    log_steps: tuple[Float[np.ndarray, " k"], ...]
    masses: tuple[Float[np.ndarray, " k"], ...]

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        z = rng.standard_normal((n, len(self.edges)))
        for i, (edges, mass) in enumerate(zip(self.edges, self.masses, strict=True)):
            if len(mass) > 1:
                step = rng.choice(len(mass), n, p=mass)
                z[:, i] = _between(edges[step], edges[step + 1], rng.random(n))
        return z

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        total = np.zeros(len(z))
        for i, (edges, log) in enumerate(zip(self.edges, self.log_steps, strict=True)):
            if len(log) > 1:
                total += log[np.searchsorted(edges[1:-1], z[:, i], side="right")]
        return total


@dataclass(frozen=True)
class Copula:
    """Coordinates with these marginals, dependent as those of a normal vector.

    - `axes`, `stds`: of its correlation matrix: eigenvectors `[d, d]` and roots of eigenvalues.
    """

    marginals: Marginals
    axes: Float[np.ndarray, "d d"]
    stds: Float[np.ndarray, " d"]

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        from scipy.special import ndtr, ndtri

        v = (rng.standard_normal((n, len(self.stds))) * self.stds) @ self.axes.T
        z = v.copy()
        for i, (edges, mass) in enumerate(
            zip(self.marginals.edges, self.marginals.masses, strict=True)
        ):
            if len(mass) > 1:
                rank, total = ndtr(v[:, i]), np.append(0, np.cumsum(mass))
                step = np.clip(np.searchsorted(total, rank, side="right") - 1, 0, len(mass) - 1)
                within = (rank - total[step]) / mass[step]
                z[:, i] = _between(edges[step], edges[step + 1], within)
            else:
                z[:, i] = ndtri(ndtr(v[:, i]))
        return z

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        v = _scores(self.marginals, z)
        white = v @ self.axes / self.stds
        dependence = (np.sum(v * v, axis=1) - np.sum(white * white, axis=1)) / 2
        return self.marginals.log_ratio(z) + dependence - np.sum(np.log(self.stds))


def _scores(marginals: Marginals, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Each coordinate as the standard normal number of the same rank."""
    from scipy.special import ndtr, ndtri

    v = z.copy()
    for i, (edges, mass) in enumerate(zip(marginals.edges, marginals.masses, strict=True)):
        if len(mass) > 1:
            borders = ndtr(edges)
            step = np.searchsorted(edges[1:-1], z[:, i], side="right")
            within = (ndtr(z[:, i]) - borders[step]) / (borders[step + 1] - borders[step])
            rank = np.append(0, np.cumsum(mass))[step] + within * mass[step]
            v[:, i] = ndtri(np.clip(rank, 1e-12, 1 - 1e-12))
    return v


@dataclass(frozen=True)
class Shell:
    """Every direction alike; the distance from the origin is the prior's times a step function.

    - `edges`: borders of the steps, in normal scores of the distance.
    """

    dim: int
    steps: Marginals

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        from scipy.special import gammainccinv, gammaincinv, ndtr

        score = self.steps.sample(rng, n)[:, 0]
        half = self.dim / 2
        square = np.where(
            score > 0, gammainccinv(half, ndtr(-score)), gammaincinv(half, ndtr(score))
        )
        direction = rng.standard_normal((n, self.dim))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return direction * np.sqrt(2 * square)[:, None]

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        return self.steps.log_ratio(radial_score(z)[:, None])


@dataclass(frozen=True)
class Mixture:
    """Components and their shares; the first is the prior."""

    components: tuple[Any, ...]
    shares: Float[np.ndarray, " k"]

    def sample(
        self, rng: np.random.Generator, n: int
    ) -> tuple[Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
        """Points in random order and the component of each; counts as near the shares as can be."""
        # Systematic: the counts are off by less than one, and right on average.
        borders = np.floor(n * np.append(0, np.cumsum(self.shares)) + rng.random())
        borders[0], borders[-1] = 0, n
        counts = np.diff(np.clip(borders, 0, n)).astype(int)
        z = np.concatenate([c.sample(rng, k) for c, k in zip(self.components, counts, strict=True)])
        origin = np.repeat(np.arange(len(counts)), counts)
        order = rng.permutation(n)
        return z[order], origin[order]

    def joined(self, other: "Mixture", share: float) -> "Mixture":
        """A mixture of both, with this share of the other."""
        shares = np.concatenate(
            [
                [(1 - share) * self.shares[0] + share * other.shares[0]],
                (1 - share) * self.shares[1:],
                share * other.shares[1:],
            ]
        )
        components = (*self.components, *other.components[1:])
        kept = np.append(True, shares[1:] >= LEAST_SHARE)
        shares[1:] *= (1 - shares[0]) / max(shares[1:][kept[1:]].sum(), 1e-12)
        return Mixture(
            tuple(c for c, keep in zip(components, kept, strict=True) if keep), shares[kept]
        )

    def ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Proposal density over the prior's."""
        return np.exp(ratios(self.components, z)) @ self.shares


def ratios(components: Any, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n k"]:
    """Logarithm of each component's density over the prior's; cut where it would overflow."""
    if not len(z):
        return np.zeros((0, len(components)))
    columns = [np.clip(component.log_ratio(z), -700, 700) for component in components]
    return np.stack(columns, axis=1)


def fitted(
    z: Float[np.ndarray, "n d"],
    weight: Float[np.ndarray, " n"],
    family: Int[np.ndarray, " n"],
    rng: np.random.Generator,
    defensive: float = 0.1,
) -> Mixture:
    """The mixture for these failures.

    **Arguments:**

    - `weight`: how much of the failures' distribution each stands for.
    - `family`: points of one chain have the same number: they are not split between the halves.
    - `defensive`: share of the prior at least.
    """
    d = z.shape[1]
    weight = weight / weight.sum()
    half = (rng.permutation(int(family.max()) + 1) % 2)[family].astype(bool)
    if min(_size(weight[half]), _size(weight[~half])) < 4:
        half = rng.random(len(z)) < 0.5
    # States of one chain are alike: a chain is worth two points rather than all of its states.
    of_families = _size(np.bincount(family, weight))
    alike_points = min(1.0, 2 * of_families / _size(weight))
    found: list[Any] = []
    crossed: list[float] = []
    for fit in (half, ~half):
        test = ~fit
        if not fit.any() or not test.any():
            continue
        made = candidates(*_thinned(z[fit], weight[fit], rng), rng, alike_points)
        table = np.exp(ratios(made, z[test]))
        crossed += list(stacked(table, weight[test] / weight[test].sum(), defensive))
        found += made
    # A mode that only one half has seen gets nothing from the other: so a part of the shares is
    # what all points together say.
    together = stacked(np.exp(ratios(found, z)), weight, defensive)
    share = np.array(crossed) / 2 * (1 - TOGETHER) + together * TOGETHER
    kept = np.flatnonzero(share >= LEAST_SHARE)
    shares = share[kept] / share[kept].sum() * (1 - defensive)
    return Mixture((Prior(d), *(found[i] for i in kept)), np.append(defensive, shares))


def stacked(
    table: Float[np.ndarray, "n k"], weight: Float[np.ndarray, " n"], defensive: float
) -> Float[np.ndarray, " k"]:
    """Shares, of sum one, of components that minimise the mean of prior over proposal density.

    - `table`: densities over the prior's, at failures; the defensive part (1) is not among them.

    By multiplicative steps, whose fixed points are the minima.
    """
    k = table.shape[1]
    share = np.full(k, 1 / k)
    for sweep in range(300):
        inverse = 1 / (defensive + (1 - defensive) * (table @ share))
        slope = (weight * inverse * inverse) @ table
        new = share * np.sqrt(slope)
        new /= new.sum()
        moved = np.abs(new - share).max()
        share = new
        if sweep > 20 and moved < 1e-4:
            break
    return share


def candidates(
    z: Float[np.ndarray, "n d"],
    weight: Float[np.ndarray, " n"],
    rng: np.random.Generator,
    worth: float = 1.0,
) -> list[Any]:
    """Components of all kinds, fitted to these points, each of which is worth so much."""
    d = z.shape[1]
    found: list[Any] = []
    size = _size(weight) * worth
    if d > 1:
        found += [shell(z, weight, worth), alike(z, weight, worth)]
    for modes in MODES:
        if modes > 1 and size < 6 * modes:
            break
        shares, gaussians, memberships = mixture_of_gaussians(z, weight, modes, rng, worth)
        for share, gaussian, member in zip(shares, gaussians, memberships.T, strict=True):
            if share * size < 3:
                continue
            found.append(gaussian)
            found.append(Gaussian(gaussian.mean, gaussian.axes, 1.3 * gaussian.stds))
            found.append(Gaussian(gaussian.mean, np.eye(d), np.ones(d)))
            if modes <= 2:
                own = member / member.sum()
                for wider in (1.0, 2.0):
                    steps = smooth(z, own, wider, worth)
                    linked = copula(z, own, steps, worth)
                    found.append(steps if linked is None else linked)
    return found


def _thinned(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, " m"]]:
    """Not too many of weighted points, of weight one in all."""
    if len(z) > MOST_POINTS:
        # The heaviest stay as they are: they are what a proposal must not miss.
        chance = np.minimum(1.0, MOST_POINTS * weight / weight.sum())
        chance = np.maximum(chance, 0.02)
        kept = rng.random(len(z)) < chance
        z, weight = z[kept], (weight / chance)[kept]
    return z, weight / weight.sum()


def _size(weight: Float[np.ndarray, " n"]) -> float:
    """How many equally weighted points these are worth."""
    return float(weight.sum() ** 2 / np.sum(weight * weight)) if len(weight) else 0.0


def gaussian(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], worth: float = 1.0
) -> Gaussian:
    """Mean and covariance, of which only what exceeds the noise of so few points is believed.

    Eigenvalues within the range that those of white noise have (Marchenko and Pastur, 1967) are
    replaced by their mean.
    """
    d = z.shape[1]
    size = max(_size(weight) * worth, 1.0)
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


def mixture_of_gaussians(
    z: Float[np.ndarray, "n d"],
    weight: Float[np.ndarray, " n"],
    modes: int,
    rng: np.random.Generator,
    worth: float = 1.0,
) -> tuple[list[float], list[Gaussian], Float[np.ndarray, "n modes"]]:
    """Expectation maximisation from spread-out centres, with the covariances of `gaussian`."""
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
    shares, found = [1.0], []
    for sweep in range(SWEEPS if modes > 1 else 1):
        kept = member.sum(axis=0) > 1e-9
        member = member[:, kept]
        shares = list(member.sum(axis=0) / member.sum())
        found = [gaussian(z, column / column.sum(), worth) for column in member.T]
        if modes == 1 or sweep == SWEEPS - 1:
            break
        logs = ratios(found, z) + np.log(shares)
        logs -= logs.max(axis=1, keepdims=True)
        new = np.exp(logs)
        new *= (weight / new.sum(axis=1))[:, None]
        moved = np.abs(new - member).sum()
        member = new
        if moved < 0.01:
            break
    return shares, found, member


_INNER = np.array([1e-6, 1e-5, 1e-4, 5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.04, 0.07])


def _borders() -> list[Float[np.ndarray, " k"]]:
    """Borders of steps to choose from, as probabilities: even ones, and ones fine at both ends."""
    even = [np.linspace(0, 1, k + 1) for k in (2, 4, 8, 16, 32)]
    middle = np.linspace(0.1, 0.9, 9)
    tails = np.concatenate([[0], _INNER, middle, 1 - _INNER[::-1], [1]])
    coarse = np.concatenate([[0, 1e-4, 2e-3, 0.02], [0.1, 0.3, 0.5, 0.7, 0.9]])
    coarse = np.concatenate([coarse, [0.98, 0.998, 1 - 1e-4, 1]])
    return [*even, coarse, tails]


_BORDERS = _borders()
_FINEST = np.unique(np.concatenate(_BORDERS))
_AMONG = [np.searchsorted(_FINEST, border) for border in _BORDERS]


def copula(
    z: Float[np.ndarray, "n d"],
    weight: Float[np.ndarray, " n"],
    steps: Marginals,
    worth: float = 1.0,
) -> Copula | None:
    """These marginals with the correlations that are no noise; None where there are none."""
    d, size = z.shape[1], _size(weight) * worth
    v = _scores(steps, z)
    centred = v - weight @ v
    cross = (centred * weight[:, None]).T @ centred
    spread = np.sqrt(np.maximum(np.diag(cross), 1e-12))
    correlation = cross / np.outer(spread, spread)
    noise = 2.5 / np.sqrt(size)
    kept = np.where(np.abs(correlation) > noise, correlation * (1 - 1 / max(size, 2)), 0.0)
    np.fill_diagonal(kept, 1.0)
    if np.count_nonzero(kept) == d:
        return None
    values, axes = np.linalg.eigh(kept)
    values = np.clip(values, 0.02, None)
    return Copula(steps, axes, np.sqrt(values))


def smooth(
    z: Float[np.ndarray, "n d"],
    weight: Float[np.ndarray, " n"],
    wider: float = 1.0,
    worth: float = 1.0,
) -> Marginals:
    """The density of each coordinate by kernels, reflected at the ends, in fine steps.

    - `wider`: than Silverman's rule (Density estimation, 1986, equation 3.31) has the kernels.
    """
    from scipy.special import ndtr, ndtri

    size = _size(weight) * worth
    if len(z) > KERNELS:
        # Equally many points in each part of the weight: the same density with less work.
        places = (np.arange(KERNELS) + 0.5) / KERNELS
        rows = np.searchsorted(np.cumsum(weight), places * weight.sum())
        z, weight = z[np.minimum(rows, len(z) - 1)], np.full(KERNELS, 1 / KERNELS)
    edges, logs, masses = [], [], []
    for column in ndtr(z).T:
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


def alike(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], worth: float = 1.0
) -> Marginals:
    """One step function for all coordinates, from all of them together."""
    from scipy.special import ndtr

    d = z.shape[1]
    found = _steps(ndtr(z).ravel(), np.repeat(weight, d) / d, _size(weight) * worth * d)
    return Marginals(*((part,) * d for part in found))


def _steps(
    u: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"], size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Borders, logarithmic heights and masses, with the borders that Akaike's criterion prefers."""
    from scipy.special import ndtri

    best = 0.0
    chosen = (np.array([-np.inf, np.inf]), np.zeros(1), np.ones(1))
    # Counted once, in the finest borders, of which the others are sums.
    place = np.clip(np.searchsorted(_FINEST, u, side="right") - 1, 0, len(_FINEST) - 2)
    fine = np.append(0, np.cumsum(np.bincount(place, weight, len(_FINEST) - 1)))
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


def radial_score(z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """The distance from the origin as a standard normal number: its quantile among the prior's."""
    from scipy.special import gammainc, gammaincc, ndtri

    half, square = z.shape[1] / 2, np.sum(z * z, axis=1) / 2
    above = gammaincc(half, square)
    outer = -ndtri(np.maximum(above, 1e-300))
    return np.where(above < 0.5, outer, ndtri(np.maximum(gammainc(half, square), 1e-300)))


def shell(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], worth: float = 1.0
) -> Shell:
    """Shells of the distances that these points have, in steps narrow in probability."""
    from scipy.special import ndtr

    score = radial_score(z)
    size = _size(weight) * worth
    order = np.argsort(score)
    total = np.cumsum(weight[order])
    steps = int(np.clip(size // 20, 2, 12))
    inner = np.unique(np.interp(np.arange(1, steps) / steps, total, score[order]))
    low, high = score.min() - 0.05, score.max() + 0.3
    edges = np.unique(np.concatenate([[-np.inf, low], inner, [high, np.inf]]))
    place = np.clip(np.searchsorted(edges, score, side="right") - 1, 0, len(edges) - 2)
    below, above = edges[:-1], edges[1:]
    width = np.where(below > 0, ndtr(-below) - ndtr(-above), ndtr(above) - ndtr(below))
    width = np.maximum(width, 1e-300)
    mass = (np.bincount(place, weight, len(width)) * size + 0.5) / (size + 0.5 * len(width))
    # Outside of all that was seen the prior's own density is enough.
    mass[0], mass[-1] = min(mass[0], width[0]), min(mass[-1], max(width[-1], 0.01))
    mass = mass / mass.sum()
    steps_of = Marginals((edges,), (np.log(mass / width),), (mass,))
    return Shell(z.shape[1], steps_of)


def _between(low: np.ndarray, high: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Standard normal numbers between two borders, exact in both tails."""
    from scipy.special import ndtr, ndtri

    mirrored = low > 0
    a, b = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    rank = np.where(mirrored, 1 - uniform, uniform)  # It must still grow with the result.
    z = ndtri(np.clip(ndtr(a) + rank * (ndtr(b) - ndtr(a)), 1e-300, 1 - 1e-16))
    return np.where(mirrored, -z, z)
