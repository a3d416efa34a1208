"""Failing regions of standard normal space, told apart by their least distant failures.

    regions = find_regions(limit_state, rng, failures, weights, nearest)
    regions.assign(failures)                        # the region [n] of each failure
    regions.design_points                           # [k, d], the likeliest failure of each

A region is what paths of failures join to one local least distant failure, which is the likeliest
point under the prior (the design point of structural reliability). Candidates are taken from the
nearest to the farthest: one that a path of failures joins to a region already there belongs to it,
another one begins a region. So regions that touch far out stay apart.

Source: Der Kiureghian and Dakessian, Multiple design points in first and second-order reliability,
Structural Safety 20 (1998).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.estimation.exploration import approach_origin
from verifai_jax.estimation.normal_space import LimitState
from verifai_jax.estimation.paths import connected

CANDIDATES = 40
"""Failures that are moved to the least distant ones near them, at most, at a time."""
SAME = 0.05
"""Distance below which two least distant failures are one, in parts of the first one's."""
NEIGHBOURS = 5
"""Points of regions to which paths are tried, the nearest first."""
LOOKED_AT = 150
"""Failures from which paths to their region are tried, at a time."""
WHOLE_EFFORT = 4500
"""Simulations left from which so many are looked at; with fewer, as many fewer are."""
A_LOOK = 8
"""Simulations that a look at a failure takes, about."""
ROUNDS = 3
"""Times that failures without a path are looked at for further regions."""
SHRINKING = 60
"""Steps towards the origin without gradients."""


@dataclass
class Regions:
    """Regions of failures.

    - `points`: failures `[m, d]` near the origin, several of a region.
    - `region`: the region `[m]` of each.
    """

    points: Float[np.ndarray, "m d"]
    region: Int[np.ndarray, " m"]

    @property
    def count(self) -> int:
        """Number of regions."""
        return int(self.region.max()) + 1 if len(self.region) else 0

    @property
    def design_points(self) -> Float[np.ndarray, "k d"]:
        """The least distant failure of each region."""
        norms = np.linalg.norm(self.points, axis=1)
        rows = [
            np.flatnonzero(self.region == k)[norms[self.region == k].argmin()]
            for k in range(self.count)
        ]
        return self.points[rows]

    def assign(self, z: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
        """Return the region of each failure: that of the nearest point."""
        return self.region[_by_distance(z, self.points)[:, 0]]

    def _add(self, point: Float[np.ndarray, " d"], region: int) -> None:
        self.points = np.concatenate([self.points, point[None]])
        self.region = np.append(self.region, region)


def find_regions(
    limit_state: LimitState,
    rng: np.random.Generator,
    z: Float[np.ndarray, "n d"],
    share: Float[np.ndarray, " n"],
    nearest: Float[np.ndarray, "m d"],
) -> Regions:
    """Find the failing regions behind weighted failures.

    **Arguments:**

    - `z`: failures `[n, d]`.
    - `share`: the part `[n]` of the failure probability that each stands for, of sum one.
    - `nearest`: further failures `[m, d]`, such as those of searches.

    **Raises:** `Ended` where time is over.
    """
    d = limit_state.dim
    most = _scaled(limit_state, CANDIDATES)
    regions = Regions(np.zeros((0, d)), np.zeros(0, int))
    near = z[np.argsort(np.sum(z * z, axis=1))[: max(1, most // 4)]]
    drawn = z[rng.choice(len(z), most // 2, p=share)]
    _extend(limit_state, rng, regions, np.concatenate([_spread(nearest, most), near, drawn]))
    for _ in range(ROUNDS):
        count = _scaled(limit_state, LOOKED_AT)
        rows, joined = _look(limit_state, rng, regions, z, share, count)
        if joined.all():
            break
        _extend(limit_state, rng, regions, z[rows[~joined]][: _scaled(limit_state, CANDIDATES)])
    return regions


def share_explained(
    limit_state: LimitState,
    rng: np.random.Generator,
    regions: Regions,
    z: Float[np.ndarray, "n d"],
    share: Float[np.ndarray, " n"],
) -> tuple[int, int]:
    """Draw failures, and count those that a path of failures joins to a region; return both."""
    count = min(LOOKED_AT, max(2, limit_state.left // A_LOOK))
    _, joined = _look(limit_state, rng, regions, z, share, count)
    return int(joined.sum()), len(joined)


def _scaled(limit_state: LimitState, most: int) -> int:
    """Return how many to look at, at least two; those that share_explained looks at are kept."""
    left = limit_state.left - min(A_LOOK * LOOKED_AT, limit_state.left // 4)
    return max(2, round(most * min(1.0, left / WHOLE_EFFORT)))


def _spread(points: Float[np.ndarray, "m d"], most: int) -> Float[np.ndarray, "_ d"]:
    """Choose points that are far from one another, beginning with the least distant one."""
    if len(points) <= most:
        return points
    chosen = [int(np.sum(points**2, axis=1).argmin())]
    gaps = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < most:
        chosen.append(int(gaps.argmax()))
        gaps = np.minimum(gaps, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def _look(
    limit_state: LimitState,
    rng: np.random.Generator,
    regions: Regions,
    z: Float[np.ndarray, "n d"],
    share: Float[np.ndarray, " n"],
    count: int,
) -> tuple[Int[np.ndarray, " k"], Bool[np.ndarray, " k"]]:
    """Draw failures by their share; return their rows, and which a path joins to a region.

    These are points of their regions from then on, so that others are assigned by more of them.
    """
    rows = rng.choice(len(z), count, p=share)
    order = _by_distance(z[rows], regions.points)[:, :NEIGHBOURS]
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
    regions.points = np.concatenate([regions.points, z[rows[new]]])
    regions.region = np.append(regions.region, region[new])
    return rows, joined


def _extend(
    limit_state: LimitState,
    rng: np.random.Generator,
    regions: Regions,
    candidates: Float[np.ndarray, "n d"],
) -> None:
    """Move candidates towards the origin, and add them to their regions, or as regions."""
    if limit_state.gradient is not None:
        candidates = approach_origin(limit_state, candidates, 15)
    candidates = _shrink(limit_state, rng, candidates)
    for point in candidates[np.argsort(np.sum(candidates**2, axis=1))]:
        if not len(regions.points):
            regions._add(point, 0)
            continue
        order = _by_distance(point[None], regions.points)[0]
        gap = float(np.linalg.norm(regions.points[order[0]] - point))
        if gap < SAME * float(np.linalg.norm(point)):
            if np.sum(point**2) < np.sum(regions.points[order[0]] ** 2):
                regions.points[order[0]] = point
            continue
        others = regions.points[order[:NEIGHBOURS]]
        joined = connected(limit_state, np.repeat(point[None], len(others), axis=0), others)
        first = np.flatnonzero(joined)
        number = int(regions.region[order[first[0]]]) if len(first) else regions.count
        regions._add(point, number)


def _shrink(
    limit_state: LimitState, rng: np.random.Generator, z: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "n d"]:
    """Move failures towards the origin by random steps that still fail and lie nearer."""
    # Few steps where gradients have led there already.
    steps = SHRINKING if limit_state.gradient is None else SHRINKING // 6
    z = z.copy()
    length = np.full(len(z), 0.3 if limit_state.gradient is None else 0.03)
    for _ in range(steps):
        # A turn about the origin, and a part of the way in.
        size = np.linalg.norm(z, axis=1, keepdims=True)
        turned = z + rng.standard_normal(z.shape) * length[:, None]
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)
        moved = turned * size * (1 - 0.3 * length[:, None] * rng.random((len(z), 1)))
        fits = limit_state.accepts(moved)
        fails = np.zeros(len(z), bool)
        fails[fits] = limit_state(moved[fits]).failing
        z = np.where(fails[:, None], moved, z)
        length = np.clip(length * np.where(fails, 1.3, 0.85), 1e-4, 1.0)
    return z


def _by_distance(
    z: Float[np.ndarray, "n d"], points: Float[np.ndarray, "m d"]
) -> Int[np.ndarray, "n m"]:
    """Return for each row of `z` the points in the order of their distance."""
    gaps = np.sum(points**2, axis=1)[None] - 2 * z @ points.T
    return np.argsort(gaps, axis=1)
