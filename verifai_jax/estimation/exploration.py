"""Searches for failing regions that do not depend on one another, nor on splitting.

    exploration = explore(limit_state, rng, simulations=3000)
    exploration.points, exploration.chain_ids       # failures, and the chain of each
    exploration.nearest, exploration.regions        # least distant failure and region of each chain

Splitting follows the robustness as a population: where it falls fastest, all chains gather, and a
region that the robustness leads to more slowly is left behind, however probable it is. Here
descents begin in many places and end at their first failure (`descents`). Failures between which
another one lies count as one region, and each region has about as many chains as any other: they
come in towards the origin, where failures are more probable, and then walk among the failures by
moves that keep the prior.

Sources: Breitung, The geometry of limit state functions and subset simulation, Reliability
Engineering and System Safety 182 (2019), for the failures of splitting that this mends; Hasofer and
Lind, Exact and invariant second-moment code format, Journal of the Engineering Mechanics Division
100 (1974), and Rackwitz and Fiessler, Structural reliability under combined random load sequences,
Computers and Structures 9 (1978), for the least distant failure and the steps to it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.estimation.descents import (
    BEYOND,
    HALVINGS,
    Ends,
    come_in,
    descend_from_many,
    scores_of,
)
from verifai_jax.estimation.normal_space import LimitState
from verifai_jax.estimation.splitting import ACCEPTED

DESCENTS = 0.55
"""Share of the simulations for descents."""
TELLING_APART = 0.1
"""Share of the simulations for points between ends, which tell regions apart."""
SAME = 0.01
"""Distance of ends below which they are one."""
APART = 1.0
"""Distance from which least distant failures belong to different regions."""
LINKS = 2
"""Ends with which another one is compared, the nearest first."""
WALK = 24
"""Steps of a walk among the failures, half of them where gradients have led there; the second half
of its states is kept."""
FALL = -0.5
"""Change of the logarithm of a walk's step that is refused, until one is taken."""
NEAREST_STEPS = 6
"""Steps to the least distant failure, at most, where there are gradients."""
IMPROBABLE = 20.0
"""Logarithm of the prior's density beside the greatest, below which a region is left out."""
FEWEST_CHAINS = 8
"""Chains, at least, where there are as many ends."""


@dataclass(frozen=True)
class Exploration:
    """Failures found by independent chains.

    - `points`: failures `[n, d]`, several of each chain.
    - `chain_ids`: the chain `[n]` of each.
    - `nearest`: for each chain the failure `[m, d]` nearest to the origin.
    - `regions`: for each chain the number `[m]` of its region.
    """

    points: Float[np.ndarray, "n d"]
    chain_ids: Int[np.ndarray, " n"]
    nearest: Float[np.ndarray, "m d"]
    regions: Int[np.ndarray, " m"]


def explore(limit_state: LimitState, rng: np.random.Generator, simulations: int) -> Exploration:
    """Search for failures, by descents and by chains among what they find.

    **Arguments:**

    - `simulations`: number of them, about.

    **Returns:** the failures; none where no descent found one.

    **Raises:** `Ended` where time is over.
    """
    begin = limit_state.simulations
    ends = descend_from_many(limit_state, rng, round(DESCENTS * simulations))
    if not len(ends.points):
        none, no_chain = np.zeros((0, limit_state.dim)), np.zeros(0, int)
        return Exploration(none, no_chain, none, no_chain)
    differentiates = limit_state.gradient is not None
    steps = WALK // 2 if differentiates else WALK
    cost = steps + (HALVINGS + 4 * NEAREST_STEPS) * differentiates
    telling = round(TELLING_APART * simulations)
    left = simulations - telling - (limit_state.simulations - begin)
    chains = min(max(FEWEST_CHAINS, left // cost), len(ends.points))
    rows = _choose_ends(limit_state, ends, chains, telling)
    z = ends.points[rows]
    if differentiates:
        z = come_in(limit_state, z)
    states, nearest = _walk_alone(limit_state, rng, z, steps)
    if differentiates:
        nearest = approach_origin(limit_state, nearest)
    square = np.sum(nearest**2, axis=1)
    probable = square < square.min() + 2 * IMPROBABLE
    nearest, states = nearest[probable], [state[probable] for state in states]
    chain_ids = np.tile(np.arange(len(nearest)), len(states))
    regions = _regions_of(limit_state, nearest)
    return Exploration(np.concatenate(states), chain_ids, nearest, regions)


def _choose_ends(
    limit_state: LimitState, ends: Ends, chains: int, simulations: int
) -> Int[np.ndarray, " chains"]:
    """Choose ends for chains, in turn from each region; one with few ends has some of them twice.

    Ends belong together where the point between them fails; each is compared with the nearest of
    those before it.
    """
    rows = _spread_out(ends, max(chains, simulations // LINKS))
    gaps = _gaps(ends, rows, rows)
    gaps[np.triu_indices(len(rows))] = np.inf
    group = _joined(limit_state, ends.points[rows], np.argsort(gaps, axis=1)[:, :LINKS])
    # The nearest to the origin comes first, then those far apart, should there be several regions.
    norms = np.linalg.norm(ends.points[rows], axis=1)
    members = []
    for number in range(group.max() + 1):
        own = np.flatnonzero(group == number)
        members.append(np.append(own[norms[own].argmin()], np.delete(own, norms[own].argmin())))
    members.sort(key=lambda own: norms[own[0]])
    turns = [own[turn % len(own)] for turn in range(chains) for own in members]
    return rows[np.array(turns[:chains])]


def _regions_of(
    limit_state: LimitState, nearest: Float[np.ndarray, "m d"]
) -> Int[np.ndarray, " m"]:
    """Return the region `[m]` of chains: of one are near ones between which another point fails."""
    order = np.argsort(np.linalg.norm(nearest, axis=1))
    z = nearest[order]
    gaps = np.linalg.norm(z[:, None] - z[None], axis=2)
    gaps[np.triu_indices(len(z))] = np.inf
    others = np.argsort(gaps, axis=1)[:, :LINKS]
    near = np.take_along_axis(gaps, others, axis=1) < APART
    own = np.arange(len(z))[:, None]
    region = np.empty(len(z), int)
    region[order] = _joined(limit_state, z, np.where(near, others, own))
    return region


def _joined(
    limit_state: LimitState, z: Float[np.ndarray, "k d"], others: Int[np.ndarray, "k links"]
) -> Int[np.ndarray, " k"]:
    """Return numbers `[k]` of groups of failures: joined to others where the middle fails."""
    group, places = np.arange(len(z)), np.arange(len(z))
    for other in others.T:
        tried = np.flatnonzero((other < places) & (group[other] != group))
        middle = (z[tried] + z[other[tried]]) / 2
        for row in tried[scores_of(limit_state, middle) == -np.inf]:
            group[group == group[row]] = group[other[row]]
    return np.unique(group, return_inverse=True)[1]


def _spread_out(ends: Ends, most: int) -> Int[np.ndarray, " k"]:
    """Return ends far from one another, the least distant first; no two that are one."""
    everything = np.arange(len(ends.points))
    chosen = [int(np.linalg.norm(ends.points, axis=1).argmin())]
    gap = _gaps(ends, everything, np.array(chosen))[:, 0]
    while len(chosen) < min(most, len(everything)) and gap.max() > SAME:
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, _gaps(ends, everything, np.array(chosen[-1:]))[:, 0])
    return np.array(chosen)


def _gaps(
    ends: Ends, rows: Int[np.ndarray, " n"], others: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "n m"]:
    """Return distances of ends: of the points or of the feet, whichever is less."""
    points, feet = (
        np.linalg.norm(part[rows][:, None] - part[others][None], axis=2)
        for part in (ends.points, ends.feet)
    )
    return np.minimum(points, feet)


def _walk_alone(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "n d"], steps: int
) -> tuple[list[Float[np.ndarray, "n d"]], Float[np.ndarray, "n d"]]:
    """Walk among the failures, each chain by moves of its own size that keep the prior.

    **Returns:** the states of the second half, and the state of each chain nearest to the origin.
    """
    scale, states, nearest = np.full(len(z), 0.5), [], z.copy()
    moving = np.zeros(len(z), bool)
    for step in range(1, steps + 1):
        moved = np.sqrt(1 - scale**2)[:, None] * z
        moved += scale[:, None] * rng.standard_normal(z.shape)
        take = scores_of(limit_state, moved) == -np.inf
        z = np.where(take[:, None], moved, z)
        moving |= take
        # Gains fall with the steps, so that the sizes settle. In a small region no step is taken
        # until it is small as well.
        gain = np.where(take, 1 - ACCEPTED, -ACCEPTED) / np.sqrt(1 + step / 8)
        gain = np.where(moving, gain, FALL)
        scale = np.clip(scale * np.exp(gain), 1e-4, 0.95)
        closer = np.sum(z * z, axis=1) < np.sum(nearest * nearest, axis=1)
        nearest = np.where(closer[:, None], z, nearest)
        if step > steps // 2:
            states.append(z)
    return states, nearest


def approach_origin(
    limit_state: LimitState, z: Float[np.ndarray, "n d"], steps: int = NEAREST_STEPS
) -> Float[np.ndarray, "n d"]:
    """Move failures to the least distant ones near them, by the gradient.

    A step goes towards the point nearest to the origin where the linearised robustness is just
    below zero (Rackwitz and Fiessler, 1978). Where that does not fail, as on a limit state that
    bends away, Newton's step leads back to it; where it is no nearer, the next step is half as far.

    **Returns:** failures `[n, d]`, none farther from the origin than its start.
    """
    best = z.copy()
    share = np.ones(len(z))
    for _ in range(steps):
        _, rho, gradient = limit_state.linearize(best)
        square = np.sum(gradient * gradient, axis=1)
        usable = np.isfinite(rho) & (square > 0)
        normal = gradient / np.where(usable, square, 1.0)[:, None]
        inner = np.sum(gradient * best, axis=1) - np.where(usable, rho, 0.0)
        target = inner[:, None] * normal * (1 + 1e-3)
        moved = np.where(usable[:, None], best + share[:, None] * (target - best), best)
        score = scores_of(limit_state, moved)
        safe = np.flatnonzero(usable & (score > -np.inf) & np.isfinite(score))
        moved[safe] -= (1 + BEYOND) * score[safe, None] * normal[safe]
        score[safe] = scores_of(limit_state, moved[safe])
        closer = (score == -np.inf) & (np.sum(moved**2, axis=1) < np.sum(best**2, axis=1))
        best = np.where(closer[:, None], moved, best)
        share = np.where(closer, np.minimum(1.0, 1.5 * share), share / 2)
    return best
