"""Mixture components around the regions found by searches; every proposal keeps them.

anchors = anchors_of(explorations, defensive=0.1)
anchors.fit()                                   # a mixture, of about equal parts for all regions
anchors.fit(WeightedFailures(failures, weights))    # the same, fitted to samples as well
anchors.owners(failures)                        # the region [n] of each
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation import fitting
from verifai_jax.addons.estimation.components import (
    Component,
    Gaussian,
    Marginals,
    Prior,
    log_ratios,
)
from verifai_jax.addons.estimation.exploration import Exploration
from verifai_jax.addons.estimation.mixture import Mixture

ONE = 0.25
"""Distance below which the least distant failures of two searches count as the same."""
MAX_CENTRES = 16
"""Regions that get components of their own, at most."""
CHAINS_WORTH = 1.5
"""Effective number of independent failures among the states of one chain."""
FAR_WIDER = 3.0
"""Factor on a component's deviations, to cover parts of a region that few chains missed."""
MAX_DIRECTIONS = 8
"""Maximum number of deciding directions; a region with more is bounded on all sides."""
DIRECTION = 0.3
"""Part of the greatest singular value of the normals from which a direction counts."""
MIN_WEIGHT = 0.02
"""Least weight of a chain or a centre, in parts of the greatest."""
Around: TypeAlias = tuple[Gaussian, Gaussian, *tuple[Gaussian | Marginals, ...]]
"""Components fitted to the failures of a region: the second without correlations."""


class WeightedFailures(NamedTuple):
    """Failures `z` `[n, d]`, and the share `[n]` of all failures that each represents."""

    z: Float[np.ndarray, "n d"]
    weight: Float[np.ndarray, " n"]

    def of(self, rows: Bool[np.ndarray, " n"]) -> "WeightedFailures":
        """Return the failures at these indices."""
        return WeightedFailures(self.z[rows], self.weight[rows])


@dataclass(frozen=True)
class Anchors:
    """Mixture components around the regions that explorations found, kept in every proposal.

    Regions have about equal shares, so that samples of this mixture estimate the probability of
    each region independently of earlier samples. A region keeps its share even if it turns out to
    be improbable.

    - `chains`: all explorations together.
    - `regions`: the chains of each region.
    - `defensive`: share of the prior.
    """

    chains: Exploration
    regions: tuple[Int[np.ndarray, " _"], ...]
    defensive: float

    def fit(self, samples: WeightedFailures | None = None) -> Mixture:
        """Fit the components to the states of chains, and to samples if there are any.

        **Returns:** the mixture; every fit has the same kinds of components in the same order.
        """
        d, of_chain = self.chains.nearest.shape[1], weigh_chains(self.chains)
        fitted = list(self._by_chains)
        if samples is not None and len(samples.z):
            owner = self.owners(samples.z)
            for number in np.unique(owner).tolist():
                fitted[number] = self._around(number, samples.of(owner == number))
        components: list[Component] = []
        shares: list[float] = []
        for chains, around in zip(self.regions, fitted, strict=True):
            # As wide as the prior at the likeliest failure, and wider than the failures found: few
            # chains may know a part of the region only.
            row = chains[np.linalg.norm(self.chains.nearest[chains], axis=1).argmin()]
            components.append(Gaussian(self.chains.nearest[row], np.eye(d), np.ones(d)))
            components += [around[1].widened(FAR_WIDER), *around]
            shares += [float(of_chain[row]) ** 0.5] * (2 + len(around))
        share = np.array(shares) / sum(shares) * (1 - self.defensive)
        return Mixture((Prior(d), *components), np.append(self.defensive, share))

    def owners(self, z: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
        """Return the region `[n]` whose chains make each failure most probable."""
        return np.argmax([log_ratios(each, z).max(axis=1) for each in self._by_chains], axis=0)

    @cached_property
    def _directions(self) -> tuple[Float[np.ndarray, "d p"] | None, ...]:
        """Orthonormal directions that decide in each region; None if there are many, or none."""
        if not self.chains.normals:
            return (None,) * len(self.regions)
        return tuple(
            _span(np.concatenate([self.chains.normals[chain] for chain in chains]))
            for chains in self.regions
        )

    @cached_property
    def _by_chains(self) -> tuple[Around, ...]:
        return tuple(self._around(number) for number in range(len(self.regions)))

    def _around(self, number: int, samples: WeightedFailures | None = None) -> Around:
        """Fit components to a region's chains, and to samples where there are any.

        In many dimensions a few chains cannot show correlations, only the spread of each
        coordinate.
        """
        chains = self.regions[number]
        points = self.chains.points[np.isin(self.chains.chain_ids, chains)]
        worth = CHAINS_WORTH * len(chains)
        part, each = np.full(len(points), 1 / len(points)), min(1.0, worth / len(points))
        if samples is not None:
            # Of the greatest, since these densities may be tiny.
            part = fitting.weigh_together(len(points), worth, samples.weight / samples.weight.max())
            points, part, each = np.concatenate([points, samples.z]), part / part.sum(), 1.0
        gaussian = fitting.fit_gaussian(points, part)
        directions = self._directions[number]
        return (
            Gaussian(gaussian.mean, gaussian.axes, fitting.WIDER * gaussian.stds),
            fitting.fit_diagonal(points, part, each),
            fitting.fit_marginals(points, part, worth=each),
            *(() if directions is None else (fitting.fit_across(points, part, directions, each),)),
        )


def _span(normals: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "d p"] | None:
    """Return orthonormal directions that span normals; None if they are many, or none."""
    _, size, rows = np.linalg.svd(normals, full_matrices=False)
    rank = int(np.sum(size > DIRECTION * size.max(initial=0.0)))
    return rows[:rank].T if 0 < rank <= min(MAX_DIRECTIONS, normals.shape[1] - 1) else None


def anchors_of(explorations: Sequence[Exploration], defensive: float) -> Anchors:
    """Return the anchors of explorations: their regions; of many, those nearest to the origin."""
    joined = join_explorations(explorations)
    return Anchors(joined, tuple(_regions(joined)[:MAX_CENTRES]), defensive)


def join_explorations(explorations: Sequence[Exploration]) -> Exploration:
    """Put the chains of several explorations together."""
    counts = np.array([len(one.nearest) for one in explorations])
    first = np.append(0, np.cumsum(counts)[:-1])
    return Exploration(
        np.concatenate([one.points for one in explorations]),
        np.concatenate([one.chain_ids + k for one, k in zip(explorations, first, strict=True)]),
        np.concatenate([one.nearest for one in explorations]),
        # A chain's number is above its region's, so regions stay apart as well.
        np.concatenate([one.regions + k for one, k in zip(explorations, first, strict=True)]),
        tuple(normals for one in explorations for normals in one.normals),
    )


def _regions(exploration: Exploration) -> list[Int[np.ndarray, " chains"]]:
    """Return the chains of each region, the least distant first.

    Regions with the same least distant failure are merged.
    """
    norms = np.linalg.norm(exploration.nearest, axis=1)
    found: list[Int[np.ndarray, " chains"]] = []
    centres: list[int] = []
    for row in np.argsort(norms):
        if any(row in chains for chains in found):
            continue
        chains = np.flatnonzero(exploration.regions == exploration.regions[row])
        gaps = np.linalg.norm(exploration.nearest[centres] - exploration.nearest[row], axis=1)
        if len(centres) and gaps.min() < ONE:
            found[int(gaps.argmin())] = np.union1d(found[int(gaps.argmin())], chains)
            continue
        centres.append(int(row))
        found.append(chains)
    return found


def weigh_chains(exploration: Exploration) -> Float[np.ndarray, " m"]:
    """Weight chains by the prior at their failure nearest to the origin, bounded below."""
    norms = np.sum(exploration.nearest**2, axis=1)
    return np.maximum(np.exp((norms.min() - norms) / 4), MIN_WEIGHT)
