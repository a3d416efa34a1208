"""The first proposal: what splitting and the independent explorations found, each in its place.

    proposals = [proposal_from(exploration, rng) for exploration in explorations]
    initial = mix(proposals)
    agreement = compare_explorations(limit_state, rng, failures, weights, proposals, found)
    agreement.unseen                                # share of the failures that all may have missed

A failing region that one exploration reached keeps a part of the proposal, however few chains are
there, so that fresh samples can say how probable it is. These samples also tell how much of the
probability each exploration had reached by itself. What only one of several has reached is a
measure of what none has, as species seen once are of those not seen yet.

Source: Good, The population frequencies of species and the estimation of population parameters,
Biometrika 40 (1953); Burnham and Overton, Robust estimation of population size when capture
probabilities vary among animals, Ecology 60 (1979), equation 4, for the first-order jackknife.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.estimation.components import Component, Gaussian, Prior
from verifai_jax.estimation.exploration import Exploration
from verifai_jax.estimation.fitting import effective_size, fit_gaussian
from verifai_jax.estimation.mixture import Mixture, fit_mixture
from verifai_jax.estimation.normal_space import Ended, LimitState
from verifai_jax.estimation.paths import COST_OF_PATHS, connected

ONE = 0.25
"""Distance below which two least distant failures of different searches count as one."""
MOST_CENTRES = 16
"""Regions that get components of their own, at most."""
WIDER = 1.3
"""Factor on the standard deviations of a region's own component."""
CHAINS_WORTH = 1.5
"""Independent failures that the states of one chain are worth."""
LEAST_WEIGHT = 0.02
"""Least weight of a chain or a centre, in parts of the greatest."""
REACHED = 0.01
"""Part of the whole proposal's density that an exploration needs, to have reached a point."""
WORTH_PATHS = 0.01
"""Share of the probability that only one exploration seems to have reached, from which paths are
tried."""
PATHS = 48
"""Failures from which paths are tried, at most."""
TRIED, SPACING = 3, 4
"""Points of an exploration to which paths are tried: the nearest, the fifth, the ninth."""
MOST_UNSEEN = 0.9
"""Share of the failures that may count as missed by all explorations, at most."""


@dataclass(frozen=True)
class Agreement:
    """Agreement of explorations about where the failures are.

    - `reached`: for each exploration the share `[k]` of the failure probability that it reached.
    - `alone`: share of the probability that no more than one exploration reached.
    - `unseen`: estimated share of the failures that none of them has reached.
    """

    reached: Float[np.ndarray, " k"]
    alone: float
    unseen: float


def proposal_from(exploration: Exploration, rng: np.random.Generator, defensive: float) -> Mixture:
    """Make a proposal of an exploration's failures: fitted ones, and some around each region."""
    weight = _weigh_chains(exploration)[exploration.chain_ids]
    fitted = fit_mixture(exploration.points, weight, exploration.chain_ids, rng, defensive)
    return fitted.join(anchors_of([exploration], defensive).fit(), 0.5)


@dataclass(frozen=True)
class Anchors:
    """Components around the regions that explorations found, one part of every proposal.

    Regions have about equal parts, so that samples of this mixture say how probable each of them
    is, whatever the first ones said; and a region keeps its own, however small it turns out.

    - `chains`: all explorations together.
    - `regions`: the chains of each region.
    - `defensive`: share of the prior.
    """

    chains: Exploration
    regions: tuple[Int[np.ndarray, " _"], ...]
    defensive: float

    def fit(
        self,
        z: Float[np.ndarray, "n d"] | None = None,
        weight: Float[np.ndarray, " n"] | None = None,
    ) -> Mixture:
        """Fit the components to the states of chains, and to weighted failures where given.

        **Arguments:**

        - `z`: failures `[n, d]`; each belongs to the region with the nearest state of a chain.
        - `weight`: parts `[n]` of the failures' distribution that they stand for.
        """
        nearest, of_chain = self.chains.nearest, _weigh_chains(self.chains)
        d = nearest.shape[1]
        states = [np.isin(self.chains.chain_ids, chains) for chains in self.regions]
        owner = None if z is None else self._owners(z, states)
        components: list[Component] = []
        shares: list[float] = []
        for number, chains in enumerate(self.regions):
            row = chains[np.linalg.norm(nearest[chains], axis=1).argmin()]
            around: list[Component] = [Gaussian(nearest[row], np.eye(d), np.ones(d))]
            own = self.chains.points[states[number]]
            part = np.full(len(own), 1 / len(own))
            if z is not None and weight is not None and np.any(owner == number):
                own, part = _together(
                    own, CHAINS_WORTH * len(chains), z[owner == number], weight[owner == number]
                )
            if len(own) > 2:
                gaussian = fit_gaussian(own, part)
                around.append(Gaussian(gaussian.mean, gaussian.axes, WIDER * gaussian.stds))
                around.append(Gaussian(gaussian.mean, np.eye(d), np.ones(d)))
            components += around
            shares += [float(of_chain[row]) ** 0.5 / len(around)] * len(around)
        share = np.array(shares) / sum(shares) * (1 - self.defensive)
        return Mixture((Prior(d), *components), np.append(self.defensive, share))

    def _owners(
        self, z: Float[np.ndarray, "n d"], states: Sequence[Bool[np.ndarray, " m"]]
    ) -> Int[np.ndarray, " n"]:
        gaps = [
            np.min(_squares(z, self.chains.points[own]), axis=1, initial=np.inf) for own in states
        ]
        return np.argmin(gaps, axis=0)


def anchors_of(explorations: Sequence[Exploration], defensive: float) -> Anchors:
    """Return the anchors of explorations: their regions, the least distant ones if many."""
    joined = join_explorations(explorations)
    return Anchors(joined, tuple(_regions(joined)[:MOST_CENTRES]), defensive)


def _together(
    states: Float[np.ndarray, "m d"],
    worth: float,
    z: Float[np.ndarray, "n d"],
    weight: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, " k"]]:
    """Return states of chains and weighted failures together, each for what they are worth."""
    weight = weight / weight.max()
    fresh = effective_size(weight)
    worth *= worth / (worth + fresh)
    part = np.concatenate(
        [np.full(len(states), worth / len(states)), fresh * weight / weight.sum()]
    )
    return np.concatenate([states, z]), part / part.sum()


def _squares(
    z: Float[np.ndarray, "n d"], points: Float[np.ndarray, "m d"]
) -> Float[np.ndarray, "n m"]:
    return np.sum(points**2, axis=1)[None] - 2 * z @ points.T + np.sum(z * z, axis=1)[:, None]


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
    )


def _regions(exploration: Exploration) -> list[Int[np.ndarray, " chains"]]:
    """Return the chains of each region, the least distant first.

    Regions whose least distant failures are one are one.
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


def _weigh_chains(exploration: Exploration) -> Float[np.ndarray, " m"]:
    """Weigh chains by the prior at their least distant failure, tempered and bounded below."""
    norms = np.sum(exploration.nearest**2, axis=1)
    return np.maximum(np.exp((norms.min() - norms) / 4), LEAST_WEIGHT)


def mix(proposals: Sequence[Mixture]) -> Mixture:
    """Mix proposals in equal parts."""
    mixed = proposals[0]
    for count, proposal in enumerate(proposals[1:], start=2):
        mixed = mixed.join(proposal, 1 / count)
    return mixed


def compare_explorations(
    limit_state: LimitState,
    rng: np.random.Generator,
    z: Float[np.ndarray, "n d"],
    x: Float[np.ndarray, " n"],
    proposals: Sequence[Mixture],
    found: Sequence[Float[np.ndarray, "_ d"]],
) -> Agreement:
    """Compare what each exploration had reached by itself.

    A failure counts as reached where the exploration's own proposal is dense, or where a path of
    failures leads to what it found; the second is simulated, within what is left of the budget.

    **Arguments:**

    - `z`: failures `[n, d]`, drawn from the final proposal.
    - `x`: their weights `[n]`, prior over proposal density.
    - `proposals`: one of each exploration.
    - `found`: failures `[m, d]` of each exploration.
    """
    share = x / x.sum()
    near = np.stack([p.fitted_ratio(z) * x >= REACHED for p in proposals], axis=1)
    count, reached = len(proposals), share @ near
    lonely = near.sum(axis=1) <= 1
    alone = float(share @ lonely)
    most = limit_state.left // (count * TRIED * COST_OF_PATHS)
    if count > 1 and alone > WORTH_PATHS and most:
        rows = rng.choice(len(z), min(most, PATHS), p=np.where(lonely, share, 0.0) / alone)
        joined = near[rows]
        with suppress(Ended):  # Then the paths that were simulated count.
            for number, points in enumerate(found):
                far = np.flatnonzero(~joined[:, number])
                joined[far, number] = _leads_to(limit_state, z[rows[far]], points)
        reached = reached + alone * (joined.mean(axis=0) - near[rows].mean(axis=0))
        alone *= float(np.mean(joined.sum(axis=1) <= 1))
    unseen = min(MOST_UNSEEN, (count - 1) / count * alone)
    return Agreement(np.clip(reached, 0.0, 1.0), alone, unseen)


def _leads_to(
    limit_state: LimitState, z: Float[np.ndarray, "n d"], points: Float[np.ndarray, "m d"]
) -> Bool[np.ndarray, " n"]:
    """Return whether a path of failures leads from each failure to one of the points nearest it."""
    leads = np.zeros(len(z), bool)
    if not len(z):
        return leads
    nearest = np.argsort(_squares(z, points), axis=1)[:, : TRIED * SPACING : SPACING]
    for column in nearest.T:
        rows = np.flatnonzero(~leads)
        leads[rows] = connected(limit_state, z[rows], points[column[rows]])
    return leads
