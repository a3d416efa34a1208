"""The first proposal, fitted to the failures of splitting and of the independent explorations.

    proposals = [proposal_from(exploration, rng) for exploration in explorations]
    initial = mix(proposals)
    agreement = compare_explorations(limit_state, rng, failures, weights, proposals, found)
    agreement.unseen                                # share of the failures that all may have missed

A failing region reached by one exploration keeps a part of the proposal even if only few chains are
there, so that fresh samples can estimate its probability. These samples also show the share of the
probability that each exploration reached by itself. The share that only one of them reached
estimates the share that none reached, just as species seen once estimate the unseen ones.

Source: Good, The population frequencies of species and the estimation of population parameters,
Biometrika 40 (1953); Burnham and Overton, Robust estimation of population size when capture
probabilities vary among animals, Ecology 60 (1979), equation 4, for the first-order jackknife.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.estimation.anchors import anchors_of, weigh_chains
from verifai_jax.addons.estimation.exploration import Exploration
from verifai_jax.addons.estimation.mixture import Mixture, fit_mixture
from verifai_jax.addons.estimation.normal_space import Ended, LimitState, squared_distances
from verifai_jax.addons.estimation.paths import COST_OF_PATHS, connected

REACHED = 0.01
"""Part of the whole proposal's density that an exploration needs, to have reached a point."""
WORTH_PATHS = 0.01
"""Share of the probability that only one exploration seems to have reached, from which paths are
tried."""
PATHS = 48
"""Failures from which paths are tried, at most."""
TRIED, SPACING = 3, 4
"""Points of an exploration to which paths are tried: the nearest, the fifth, the ninth."""
MAX_UNSEEN = 0.9
"""Share of the failures that may count as missed by all explorations, at most."""


@dataclass(frozen=True)
class Agreement:
    """Agreement of explorations on where the failures are.

    - `reached`: for each exploration the share `[k]` of the failure probability that it reached.
    - `alone`: share of the probability that at most one exploration reached.
    - `unseen`: estimated share of the failures that none of them has reached.
    """

    reached: Float[np.ndarray, " k"]
    alone: float
    unseen: float


def proposal_from(exploration: Exploration, rng: np.random.Generator, defensive: float) -> Mixture:
    """Make a proposal from an exploration's failures, with components around each region."""
    weight = weigh_chains(exploration)[exploration.chain_ids]
    fitted = fit_mixture(exploration.points, weight, exploration.chain_ids, rng, defensive)
    return fitted.join(anchors_of([exploration], defensive).fit(), 0.5)


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
    """Compare what each exploration reached on its own.

    A failure counts as reached if the exploration's own proposal is dense there, or if a path of
    failures leads to one of its failures; the path is simulated within the remaining budget.

    **Arguments:**
    - `z`: failures `[n, d]`, drawn from the final proposal.
    - `x`: their weights `[n]`, prior over proposal density.
    - `proposals`: the proposal of each exploration.
    - `found`: failures `[m, d]` of each exploration.
    """
    share = x / x.sum()
    near = np.stack([p.fitted_ratio(z) * x >= REACHED for p in proposals], axis=1)
    count, reached = len(proposals), share @ near
    lonely = near.sum(axis=1) <= 1
    alone = float(share @ lonely)
    maximum = limit_state.left // (count * TRIED * COST_OF_PATHS)
    if count > 1 and alone > WORTH_PATHS and maximum:
        rows = rng.choice(len(z), min(maximum, PATHS), p=np.where(lonely, share, 0.0) / alone)
        joined = near[rows]
        with suppress(Ended):  # Then the paths that were simulated count.
            for number, points in enumerate(found):
                far = np.flatnonzero(~joined[:, number])
                joined[far, number] = _leads_to(limit_state, z[rows[far]], points)
        reached = reached + alone * (joined.mean(axis=0) - near[rows].mean(axis=0))
        alone *= float(np.mean(joined.sum(axis=1) <= 1))
    unseen = min(MAX_UNSEEN, (count - 1) / count * alone)
    return Agreement(np.clip(reached, 0.0, 1.0), alone, unseen)


def _leads_to(
    limit_state: LimitState, z: Float[np.ndarray, "n d"], points: Float[np.ndarray, "m d"]
) -> Bool[np.ndarray, " n"]:
    """Return whether a path of failures leads from each failure to one of the points nearest it."""
    leads = np.zeros(len(z), bool)
    if not len(z):
        return leads
    nearest = np.argsort(squared_distances(z, points), axis=1)[:, : TRIED * SPACING : SPACING]
    for column in nearest.T:
        rows = np.flatnonzero(~leads)
        leads[rows] = connected(limit_state, z[rows], points[column[rows]])
    return leads
