"""Searches for failing regions, independent of each other and of splitting.

    exploration = explore(limit_state, rng, simulations=3000)
    exploration.points, exploration.chain_ids       # failures, and the chain of each
    exploration.nearest, exploration.regions        # least distant failure and region of each chain

In splitting all chains gather where the robustness falls fastest, so another region may be lost
even if it is probable. Here descents begin in many places and end at their first failure
(`descents`). Two failures with another failure between them count as one region. Each region gets
about the same number of chains: they move towards the origin, where failures are more probable
(`towards_origin`), find the deciding coordinates, and then walk among the failures by moves that
keep the prior (`walks`).

Sources: Breitung, The geometry of limit state functions and subset simulation, Reliability
Engineering and System Safety 182 (2019), for the weaknesses of splitting that this avoids; Hasofer
and Lind, Exact and invariant second-moment code format, Journal of the Engineering Mechanics
Division 100 (1974), for the least distant failure.
"""

from dataclasses import dataclass
from itertools import compress

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.addons.estimation.corners import approach_corner, cost_of_corner
from verifai_jax.addons.estimation.descents import Ends, descend_from_many
from verifai_jax.addons.estimation.normal_space import (
    LimitState,
    fails_at,
    farthest_first,
    squared_distances,
)
from verifai_jax.addons.estimation.towards_origin import (
    HALVINGS,
    NEAREST_STEPS,
    approach_origin,
    come_in,
    come_in_by_parts,
    redraw_by_parts,
)
from verifai_jax.addons.estimation.walks import walk_among_failures

DESCENTS = 0.6
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
"""Steps of a walk among the failures; the second half of its states is kept."""
FIRST_STEPS = 2
"""Steps to the least distant failure before it is known which coordinates decide."""
CORNERS = (4, 5)
"""Planes of a chain where limits meet, at most, and halvings of the ways to where they do."""
A_PART = 4
"""Simulations for each doubling of the coordinates, about, to find those that decide."""
IMPROBABLE = 20.0
"""A region whose log density under the prior is this much below the greatest is left out."""
MIN_CHAINS, MAX_CHAINS = 8, 256
"""Chains, at least, where there are as many ends, and at most."""
MERGES, NEIGHBOURS = 3, 4
"""Times that groups of ends are compared, and others with which each is, the nearest first."""
COMPARED, MAX_COMPARED = 0.4, 512
"""Ends that are compared with one another, in parts of the simulations for that, and at most."""


@dataclass(frozen=True)
class Exploration:
    """Failures found by independent chains.

    - `points`: failures `[n, d]`, several for each chain.
    - `chain_ids`: the chain `[n]` of each.
    - `nearest`: for each chain the failure `[m, d]` nearest to the origin.
    - `regions`: for each chain the number `[m]` of its region.
    - `normals`: for each chain the unit normals `[_, d]` of planes that touch its region near its
      failure nearest to the origin; empty without gradients.
    """

    points: Float[np.ndarray, "n d"]
    chain_ids: Int[np.ndarray, " n"]
    nearest: Float[np.ndarray, "m d"]
    regions: Int[np.ndarray, " m"]
    normals: tuple[Float[np.ndarray, "_ d"], ...] = ()


def explore(limit_state: LimitState, rng: np.random.Generator, simulations: int) -> Exploration:
    """Search for failures with descents, and with chains that start from the failures found.

    **Arguments:**
    - `simulations`: approximate number of simulations.
    **Returns:** the failures; empty if no descent found one.
    **Raises:** `Ended` when the time is over.
    """
    begin = limit_state.simulations
    ends = descend_from_many(limit_state, rng, round(DESCENTS * simulations))
    if not len(ends.points):
        none, no_chain = np.zeros((0, limit_state.dim)), np.zeros(0, int)
        return Exploration(none, no_chain, none, no_chain)
    differentiates = limit_state.gradient is not None
    cost = WALK + round(A_PART * np.log2(1 + limit_state.dim))
    # A corner ends as soon as no plane is new, mostly after one.
    corners = cost_of_corner(1, CORNERS[1])
    cost += (HALVINGS + 3 * (FIRST_STEPS + NEAREST_STEPS) + corners) * differentiates
    telling = round(TELLING_APART * simulations)
    left = simulations - telling - (limit_state.simulations - begin)
    chains = min(max(MIN_CHAINS, left // cost), MAX_CHAINS, len(ends.points))
    rows, groups = _choose_ends(limit_state, ends, chains, telling)
    z = ends.points[rows]
    if differentiates:
        z = approach_origin(limit_state, come_in(limit_state, z), FIRST_STEPS)
    z = come_in_by_parts(limit_state, rng, z)
    groups = _regions_of(limit_state, z, groups)
    redrawn, deciding = redraw_by_parts(limit_state, rng, z)
    whole = deciding.all(axis=1)
    if differentiates and whole.any():
        # Oblique to the features all of them decide, far out as well; walks begin on the way in.
        z[whole], _ = approach_corner(limit_state, z[whole], *CORNERS)
        middle = (z[whole] + redrawn[whole]) / 2
        fails = fails_at(limit_state, middle)[:, None]
        redrawn[whole] = np.where(fails, middle, redrawn[whole])
    states, walked = walk_among_failures(limit_state, rng, redrawn, deciding, groups, WALK)
    nearest, normals = np.where(_squares(walked) < _squares(z), walked, z), []
    if differentiates:
        nearest = approach_origin(limit_state, nearest)
        nearest, normals = approach_corner(limit_state, nearest, *CORNERS)
    square = _squares(nearest)[:, 0]
    probable = square < square.min() + 2 * IMPROBABLE
    nearest, states = nearest[probable], [state[probable] for state in states]
    chain_ids = np.tile(np.arange(len(nearest)), len(states))
    regions = _regions_of(limit_state, nearest)
    touching = tuple(compress(normals, probable))
    return Exploration(np.concatenate(states), chain_ids, nearest, regions, touching)


def _choose_ends(
    limit_state: LimitState, ends: Ends, chains: int, simulations: int
) -> tuple[Int[np.ndarray, " chains"], Int[np.ndarray, " chains"]]:
    """Choose ends for chains, in turn from each region; one with few ends has some of them twice.

    Ends belong together where the point between them fails; each is compared with the nearest of
    those before it.

    **Returns:** rows of ends, and the region of each.
    """
    maximum = max(chains, round(COMPARED * simulations))
    rows = spread_out(ends, min(maximum, MAX_COMPARED))
    gaps = _gaps(ends, rows, rows)
    gaps[np.triu_indices(len(rows))] = np.inf
    group = _joined(limit_state, ends.points[rows], np.argsort(gaps, axis=1)[:, :LINKS])
    group = _merge(limit_state, ends.points[rows], group)
    # The nearest to the origin comes first, then those far apart, should there be several regions.
    norms = np.linalg.norm(ends.points[rows], axis=1)
    members = []
    for number in range(group.max() + 1):
        own = np.flatnonzero(group == number)
        members.append(np.append(own[norms[own].argmin()], np.delete(own, norms[own].argmin())))
    members.sort(key=lambda own: norms[own[0]])
    turns = [own[turn % len(own)] for turn in range(chains) for own in members]
    return rows[np.array(turns[:chains])], np.arange(chains) % len(members)


def _merge(
    limit_state: LimitState, z: Float[np.ndarray, "k d"], group: Int[np.ndarray, " k"]
) -> Int[np.ndarray, " k"]:
    """Join groups `[k]` of failures where the middle between their least distant ones fails.

    The nearest of others may all be of other regions; so each group is compared with several.
    """
    norms = np.linalg.norm(z, axis=1)
    for _ in range(MERGES):
        count = group.max() + 1
        if count < 2:
            break
        ends = np.array(
            [np.flatnonzero(group == k)[norms[group == k].argmin()] for k in range(count)]
        )
        gaps = squared_distances(z[ends], z[ends])
        # Each pair once.
        gaps[np.triu_indices(count)] = np.inf
        others = np.argsort(gaps, axis=1)[:, :NEIGHBOURS]
        joined = _joined(limit_state, z[ends], others)
        if joined.max() + 1 == count:
            break
        group = joined[group]
    return group


def _regions_of(
    limit_state: LimitState, nearest: Float[np.ndarray, "m d"],
    known: Int[np.ndarray, " m"] | None = None,
) -> Int[np.ndarray, " m"]:  # fmt: skip
    """Return the region `[m]` of chains: of one are near ones between which another point fails.

    Those that are `known` to belong together do so.
    """
    order = np.argsort(np.linalg.norm(nearest, axis=1))
    z = nearest[order]
    gaps = squared_distances(z, z)
    gaps[np.triu_indices(len(z))] = np.inf
    others = np.argsort(gaps, axis=1)[:, :LINKS]
    near = np.take_along_axis(gaps, others, axis=1) < APART**2
    own = np.arange(len(z))[:, None]
    region = np.empty(len(z), int)
    links = np.where(near, others, own)
    region[order] = _joined(limit_state, z, links, None if known is None else known[order])
    return region


def _joined(
    limit_state: LimitState, z: Float[np.ndarray, "k d"], others: Int[np.ndarray, "k links"],
    known: Int[np.ndarray, " k"] | None = None,
) -> Int[np.ndarray, " k"]:  # fmt: skip
    """Return numbers `[k]` of groups of failures: joined to others where the middle fails."""
    indices = np.arange(len(z))
    group = indices.copy() if known is None else known.copy()
    for other in others.T:
        tried = np.flatnonzero((other < indices) & (group[other] != group))
        middle = (z[tried] + z[other[tried]]) / 2
        for row in tried[fails_at(limit_state, middle)]:
            group[group == group[row]] = group[other[row]]
    return np.unique(group, return_inverse=True)[1]


def spread_out(ends: Ends, maximum: int) -> Int[np.ndarray, " k"]:
    """Return distinct ends that are far from one another, nearest to the origin first."""
    everything = np.arange(len(ends.points))
    nearest = int(np.linalg.norm(ends.points, axis=1).argmin())

    def gaps_from(row: int) -> Float[np.ndarray, " n"]:
        return _gaps(ends, everything, np.array([row]))[:, 0]

    return farthest_first(nearest, gaps_from, maximum, SAME)


def _squares(z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n 1"]:
    """Return the squared distances of points from the origin."""
    return np.sum(z**2, axis=1, keepdims=True)


def _gaps(
    ends: Ends, rows: Int[np.ndarray, " n"], others: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "n m"]:
    """Return distances of ends: of the points or of the planes, whichever is less."""
    parts = (ends.points, ends.planes)
    gaps = (squared_distances(part[rows], part[others]) for part in parts)
    return np.sqrt(np.maximum(np.minimum(*gaps), 0.0))
