"""The search for failing regions, which are distinguished by their least distant failures.

    regions = find_regions(limit_state, rng, failures, weights, nearest)
    joined, tried = share_explained(limit_state, rng, regions, failures, weights)

A region contains all failures that paths of failures join to a local least distant failure, its
likeliest point under the prior (the design point of structural reliability). Candidates are tried
from the nearest to the farthest: a candidate joins an existing region if a path of failures leads
there, else it begins a new one. So regions that touch only far out stay separate.

Source: Der Kiureghian and Dakessian, Multiple design points in first and second-order reliability,
Structural Safety 20 (1998).
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation.corners import approach_corner, cost_of_corner
from verifai_jax.addons.estimation.failure_modes.regions import Regions
from verifai_jax.addons.estimation.normal_space import LimitState, Spent, fails_at, farthest_first
from verifai_jax.addons.estimation.paths import connected
from verifai_jax.addons.estimation.towards_origin import approach_origin, come_in_by_parts

CANDIDATES = 40
"""Failures that are moved to the least distant ones near them, at most, at a time."""
SAME = 0.05
"""Distance below which two least distant failures are one, in parts of the first one's."""
LOOKED_AT = 150
"""Failures from which paths to their region are tried, at a time."""
FULL_SEARCH = 4500
"""Simulations left from which so many are looked at; with fewer, as many fewer are."""
A_LOOK = 8
"""Simulations that a look at a failure takes, about."""
A_PAIR = 3
"""Simulations that tell two regions apart, about."""
ROUNDS = 3
"""Times that failures without a path are looked at for further regions."""
SHRINKING = 60
"""Steps towards the origin without gradients."""


def find_regions(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "n d"],
    share: Float[np.ndarray, " n"], nearest: Float[np.ndarray, "m d"],
) -> Regions:  # fmt: skip
    """Find the failing regions that contain weighted failures.

    **Arguments:**
    - `z`: failures `[n, d]`.
    - `share`: the share `[n]` of the failure probability that each represents; they sum to one.
    - `nearest`: further failures `[m, d]`, such as those of searches.
    **Raises:** `Ended` when the time is over, or if the budget is spent before a region was found.
    """
    regions = Regions(np.zeros((0, limit_state.dim)), np.zeros(0, int))
    try:
        _find(limit_state, rng, regions, z, share, nearest)
    except Spent:
        if not regions.count:
            raise
    return regions


def _find(
    limit_state: LimitState, rng: np.random.Generator, regions: Regions,
    z: Float[np.ndarray, "n d"], share: Float[np.ndarray, " n"], nearest: Float[np.ndarray, "m d"],
) -> None:  # fmt: skip
    """Add the regions that are found."""
    maximum = _scaled(limit_state, CANDIDATES)
    near = z[np.argsort(np.sum(z * z, axis=1))[: max(1, maximum // 4)]]
    drawn = z[rng.choice(len(z), maximum // 2, p=share)]
    _extend(limit_state, rng, regions, np.concatenate([_spread(nearest, maximum), near, drawn]))
    for _ in range(ROUNDS):
        count = _scaled(limit_state, LOOKED_AT)
        rows, joined = _look(limit_state, rng, regions, z, share, count)
        if joined.all():
            break
        _extend(limit_state, rng, regions, z[rows[~joined]][: _scaled(limit_state, CANDIDATES)])
    _merge(limit_state, regions)
    if limit_state.gradient is not None:
        _approach_corners(limit_state, regions)


def share_explained(
    limit_state: LimitState, rng: np.random.Generator, regions: Regions,
    z: Float[np.ndarray, "n d"], share: Float[np.ndarray, " n"],
) -> tuple[int, int]:  # fmt: skip
    """Draw failures; return the number that paths join to a region, and the total."""
    count = min(LOOKED_AT, max(2, limit_state.left // A_LOOK))
    _, joined = _look(limit_state, rng, regions, z, share, count)
    return int(joined.sum()), len(joined)


def _scaled(limit_state: LimitState, maximum: int) -> int:
    """Return how many to look at, at least two."""
    return max(2, round(maximum * min(1.0, _left(limit_state) / FULL_SEARCH)))


def _left(limit_state: LimitState) -> int:
    """Return the simulations left after reserving those of `share_explained`."""
    return limit_state.left - min(A_LOOK * LOOKED_AT, limit_state.left // 4)


def _spread(points: Float[np.ndarray, "m d"], maximum: int) -> Float[np.ndarray, "_ d"]:
    """Choose points that are far from one another, beginning with the least distant one."""
    if len(points) <= maximum:
        return points
    nearest = int(np.sum(points**2, axis=1).argmin())
    rows = farthest_first(
        nearest, lambda row: np.linalg.norm(points - points[row], axis=1), maximum
    )
    return points[rows]


def _look(
    limit_state: LimitState, rng: np.random.Generator, regions: Regions,
    z: Float[np.ndarray, "n d"], share: Float[np.ndarray, " n"], count: int,
) -> tuple[Int[np.ndarray, " k"], Bool[np.ndarray, " k"]]:  # fmt: skip
    """Draw failures by their share; return their rows, and which a path joins to a region.

    These are points of their regions from then on, so that others are assigned by more of them.
    """
    rows = rng.choice(len(z), count, p=share)
    order = regions.candidates(z[rows])
    region = np.full(len(rows), -1)
    for column in order.T:
        left = np.flatnonzero(region < 0)
        if not len(left):
            break
        joined = left[connected(limit_state, z[rows[left]], regions.points[column[left]])]
        region[joined] = regions.region[column[joined]]
    joined = region >= 0
    # One that was drawn twice is one point.
    new = joined & np.isin(np.arange(len(rows)), np.unique(rows, return_index=True)[1])
    regions.add(z[rows[new]], region[new])
    return rows, joined


def _extend(
    limit_state: LimitState, rng: np.random.Generator, regions: Regions,
    candidates: Float[np.ndarray, "n d"],
) -> None:  # fmt: skip
    """Move candidates towards the origin, and add them to their regions, or as regions."""
    if limit_state.gradient is not None:
        candidates = approach_origin(limit_state, candidates, 15)
    candidates = come_in_by_parts(limit_state, rng, candidates)
    candidates = _shrink(limit_state, rng, candidates)
    for point in candidates[np.argsort(np.sum(candidates**2, axis=1))]:
        if not len(regions.points):
            regions.add(point[None], 0)
            continue
        gaps = np.linalg.norm(regions.points - point, axis=1)
        nearest = int(gaps.argmin())
        if gaps[nearest] < SAME * float(np.linalg.norm(point)):
            if np.sum(point**2) < np.sum(regions.points[nearest] ** 2):
                regions.points[nearest] = point
            continue
        order = regions.candidates(point[None])[0]
        others = regions.points[order]
        joined = connected(limit_state, np.repeat(point[None], len(others), axis=0), others)
        first = np.flatnonzero(joined)
        number = int(regions.region[order[first[0]]]) if len(first) else regions.count
        regions.add(point[None], number)


def _merge(limit_state: LimitState, regions: Regions) -> None:
    """Merge regions whose likeliest failures a path joins: not all were compared as they began."""
    ends = regions.design_points
    one, other = np.triu_indices(len(ends), 1)
    if A_PAIR * len(one) > limit_state.left // 2:
        return
    joined = connected(limit_state, ends[one], ends[other])
    number = np.arange(len(ends))
    for i, j in zip(one[joined], other[joined], strict=True):
        number[number == number[j]] = number[i]
    regions.region = np.unique(number, return_inverse=True)[1][regions.region]


def _approach_corners(limit_state: LimitState, regions: Regions) -> None:
    """Move likeliest failures on to where several limits meet, as far as simulations are left."""
    ends = regions.design_points
    likeliest = np.argsort(np.sum(ends**2, axis=1), kind="stable")
    rows = likeliest[: max(0, _left(limit_state)) // cost_of_corner()]
    regions.add(approach_corner(limit_state, ends[rows])[0], rows)


def _shrink(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "n d"]:
    """Move failures towards the origin by random steps that still fail and lie nearer.

    Coordinates that are zero, because they do not decide, remain so.
    """
    # Few steps where gradients have led there already.
    steps = SHRINKING if limit_state.gradient is None else SHRINKING // 6
    z, deciding = z.copy(), z != 0
    length = np.full(len(z), 0.3 if limit_state.gradient is None else 0.03)
    for _ in range(steps):
        # A turn about the origin, and a part of the way in.
        size = np.linalg.norm(z, axis=1, keepdims=True)
        turned = z + rng.standard_normal(z.shape) * length[:, None] * deciding
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)
        moved = turned * size * (1 - 0.3 * length[:, None] * rng.random((len(z), 1)))
        fails = fails_at(limit_state, moved)
        z = np.where(fails[:, None], moved, z)
        length = np.clip(length * np.where(fails, 1.3, 0.85), 1e-4, 1.0)
    return z
