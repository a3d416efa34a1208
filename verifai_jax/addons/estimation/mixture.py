"""Proposals for importance sampling: mixtures fitted to failures, in standard normal space.

    proposal = fit_mixture(points, weight, chain_ids, rng)
    z, _ = proposal.sample(rng, 1000)
    ratio = proposal.ratio(z)                       # proposal density over prior density

Components of several kinds are fitted to one half of the failures and weighted on the other half:
the weights minimise the second moment of the importance weights, `E[p/q | failure]`, which is
convex in them. So no kind has to be chosen in advance, and leaving a mode uncovered is penalised
most.

Sources: Rubinstein and Kroese, The cross-entropy method (2004), chapter 8; Papaioannou, Geyer and
Straub, Improved cross entropy-based importance sampling with a flexible mixture model, Reliability
Engineering and System Safety 191 (2019); Owen and Zhou, Safe and effective importance sampling,
JASA 95 (2000), for the defensive share.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.addons.estimation import fitting
from verifai_jax.addons.estimation.components import Component, Gaussian, Prior, log_ratios

MODES = (1, 2, 4, 8)
"""Numbers of clusters to try."""
MAX_POINTS = 1500
"""Failures that one half of the components is fitted to, at most: more change the fit little."""
TOGETHER = 0.3
"""Part of the shares that all points decide; points not fitted to decide the rest."""
MIN_SHARE = 5e-4
"""Share below which a component is dropped."""


@dataclass(frozen=True)
class Mixture:
    """A mixture of components; the first is the prior.

    - `components`: the densities.
    - `shares`: their probabilities, which sum to one.
    """

    components: tuple[Component, ...]
    shares: Float[np.ndarray, " k"]

    def sample(
        self, rng: np.random.Generator, n: int
    ) -> tuple[Float[np.ndarray, "n d"], Int[np.ndarray, " n"]]:
        """Draw points in random order; return them and the component of each.

        The counts of the components are as close to their shares as possible.
        """
        # Systematic: the counts are off by less than one, and right on average.
        borders = np.floor(n * np.append(0, np.cumsum(self.shares)) + rng.random())
        borders[0], borders[-1] = 0, n
        counts = np.diff(np.clip(borders, 0, n)).astype(int)
        z = np.concatenate(
            [c.sample(rng, k) for c, k in zip(self.components, counts.tolist(), strict=True)]
        )
        origin = np.repeat(np.arange(len(counts)), counts)
        order = rng.permutation(n)
        return z[order], origin[order]

    def join(self, other: "Mixture", share: float) -> "Mixture":
        """Mix this mixture with a `share` of another one."""
        shares = np.concatenate(
            [
                [(1 - share) * self.shares[0] + share * other.shares[0]],
                (1 - share) * self.shares[1:],
                share * other.shares[1:],
            ]
        )
        components = (*self.components, *other.components[1:])
        keep = np.append(True, shares[1:] >= MIN_SHARE)
        shares[1:] *= (1 - shares[0]) / max(shares[1:][keep[1:]].sum(), 1e-12)
        return Mixture(
            tuple(c for c, use in zip(components, keep, strict=True) if use), shares[keep]
        )

    def with_shares(self, shares: Float[np.ndarray, " k"]) -> "Mixture":
        """Return this mixture with new proportions of components; the prior keeps its share."""
        prior = float(self.shares[0])
        rest = shares * (1 - prior) / max(float(shares.sum()), 1e-12)
        return Mixture(self.components, np.append(prior, rest))

    def ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Return the proposal density over the prior's."""
        return np.exp(log_ratios(self.components, z)) @ self.shares

    def fitted_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Return the density over the prior's without the defensive part."""
        return np.exp(log_ratios(self.components[1:], z)) @ self.shares[1:]


def fit_mixture(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], chain_ids: Int[np.ndarray, " n"],
    rng: np.random.Generator, defensive: float = 0.1,
) -> Mixture:  # fmt: skip
    """Fit a mixture to weighted failures.

    **Arguments:**
    - `z`: failures `[n, d]` in normal space.
    - `weight`: share `[n]` of the failures' distribution that each represents.
    - `chain_ids`: the chain `[n]` of each; cross-validation keeps points of one chain in one half.
    - `defensive`: minimum share of the prior.
    """
    d = z.shape[1]
    weight = weight / weight.sum()
    half = (rng.permutation(int(chain_ids.max()) + 1) % 2)[chain_ids].astype(bool)
    if min(fitting.effective_size(weight[half]), fitting.effective_size(weight[~half])) < 4:
        half = rng.random(len(z)) < 0.5
    # States of one chain are alike: a chain is worth two points rather than all of its states.
    of_chains = fitting.effective_size(np.bincount(chain_ids, weight))
    alike_points = min(1.0, 2 * of_chains / fitting.effective_size(weight))
    components: list[Component] = []
    crossed: list[float] = []
    for fit in (half, ~half):
        test = ~fit
        if not fit.any() or not test.any():
            continue
        made = fit_components(*_thin(z[fit], weight[fit], rng), rng, alike_points)
        table = np.exp(log_ratios(made, z[test]))
        crossed += list(optimal_shares(table, weight[test] / weight[test].sum(), defensive))
        components += made
    # A mode that only one half has scores gets nothing from the other: so a part of the shares is
    # what all points together say.
    together = optimal_shares(np.exp(log_ratios(components, z)), weight, defensive)
    share = np.array(crossed) / 2 * (1 - TOGETHER) + together * TOGETHER
    keep = np.flatnonzero(share >= MIN_SHARE)
    shares = share[keep] / share[keep].sum() * (1 - defensive)
    return Mixture((Prior(d), *(components[i] for i in keep)), np.append(defensive, shares))


def optimal_shares(
    table: Float[np.ndarray, "n k"], weight: Float[np.ndarray, " n"], defensive: float
) -> Float[np.ndarray, " k"]:
    """Choose the components' shares to minimise the mean ratio of prior to proposal density.

    The fixed points of the multiplicative steps are the minima.

    **Arguments:**
    - `table`: densities of the components over the prior's, at failures; without the defensive
      part, which is 1.
    - `weight`: weights of the failures, which sum to one.
    - `defensive`: share of the defensive part.
    **Returns:** shares of the components, which sum to one.
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


def fit_components(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], rng: np.random.Generator,
    worth: float = 1.0,
) -> list[Component]:  # fmt: skip
    """Fit components of all kinds to points that are each worth `worth` independent ones."""
    d = z.shape[1]
    components: list[Component] = []
    size = fitting.effective_size(weight) * worth
    if d > 1:
        components += [
            fitting.fit_shell(z, weight, worth),
            fitting.fit_common_marginal(z, weight, worth),
        ]
    for modes in MODES:
        if modes > 1 and size < 6 * modes:
            break
        shares, gaussians, memberships = fitting.fit_gaussian_mixture(z, weight, modes, rng, worth)
        for share, gaussian, member in zip(shares, gaussians, memberships.T, strict=True):
            # Points too few for any component make one all the same, for there has to be one.
            if share * size < 3 and components:
                continue
            components.append(gaussian)
            components.append(Gaussian(gaussian.mean, gaussian.axes, 1.3 * gaussian.stds))
            components.append(Gaussian(gaussian.mean, np.eye(d), np.ones(d)))
            if modes <= 2:
                own = member / member.sum()
                for wider in (1.0, 2.0):
                    steps = fitting.fit_marginals(z, own, wider, worth)
                    linked = fitting.fit_copula(z, own, steps, worth)
                    components.append(steps if linked is None else linked)
    return components


def _thin(
    z: Float[np.ndarray, "n d"], weight: Float[np.ndarray, " n"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, " m"]]:
    """Thin out weighted points, and scale their weights to sum one."""
    if len(z) > MAX_POINTS:
        # The heaviest stay as they are: they are what a proposal must not miss.
        chance = np.minimum(1.0, MAX_POINTS * weight / weight.sum())
        chance = np.maximum(chance, 0.02)
        keep = rng.random(len(z)) < chance
        z, weight = z[keep], (weight / chance)[keep]
    return z, weight / weight.sum()
