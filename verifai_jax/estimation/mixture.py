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
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.estimation.components import Gaussian, Prior, ratios
from verifai_jax.estimation.fitting import (
    alike,
    copula,
    mixture_of_gaussians,
    shell,
    size_of,
    smooth,
)

MODES = (1, 2, 4, 8)
"""Clusters that are tried."""
MOST_POINTS = 1500
"""Failures that a half of the candidates is fitted to at most: more change the fit little."""
TOGETHER = 0.3
"""Of the shares, by all points; the rest by those that a component was not fitted to."""
LEAST_SHARE = 1e-3
"""Below which a component is dropped."""


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
    if min(size_of(weight[half]), size_of(weight[~half])) < 4:
        half = rng.random(len(z)) < 0.5
    # States of one chain are alike: a chain is worth two points rather than all of its states.
    of_families = size_of(np.bincount(family, weight))
    alike_points = min(1.0, 2 * of_families / size_of(weight))
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
    size = size_of(weight) * worth
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
