"""The failing regions of a system whose own random numbers no key controls.

    divided = divide_by_chance(limit_state, rng, samples)
    divided.failing[k], divided.times           # simulations of the likeliest failure that fail

Such a system has no random key to fix, so no point fails for certain, and single simulations on a
path show nothing. Points and paths are therefore simulated several times. The centre of each group
of failures is moved outwards until about half of the simulations fail. Two groups are one region if
the failure rate does not drop much along a path between these points.
"""

import warnings

import numpy as np
from jaxtyping import Float, Int
from scipy.cluster.vq import kmeans2
from scipy.stats import binom

from verifai_jax.addons.estimation.failure_modes.held_keys import FOLLOWED, Divided
from verifai_jax.addons.estimation.failure_modes.regions import Regions
from verifai_jax.addons.estimation.importance import ImportanceSamples
from verifai_jax.addons.estimation.normal_space import Ended, LimitState, fails_at, farthest_first
from verifai_jax.addons.estimation.paths import arc, straight

GROUPS = 6
"""Groups that failures are divided into at first, at most."""
HANDED_OUT = 3
"""Simulations of each likeliest failure that are kept for its row and its cause."""
MIN_TIMES, MAX_TIMES = 8, 50
"""Simulations of a point."""
POINTS = 70
"""Points that are simulated so often, about."""
OUTWARD = np.array([1.0, 1.15, 1.3, 1.5, 1.8])
"""Factors by which a centre is moved outwards."""
FRACTIONS = (0.5, 0.25, 0.75)
"""Places of a path that are simulated, the middle first."""
AS_OFTEN = 0.7
"""Share of the failures of an end that has to remain all along a path."""
SURELY_LESS = 0.05
"""Probability below which so few failures are not due to luck."""


def divide_by_chance(
    limit_state: LimitState, rng: np.random.Generator, samples: ImportanceSamples
) -> Divided:
    """Find the failing regions of a system with hidden randomness, within the remaining budget.

    **Arguments:**
    - `limit_state`: the limit state; a part of its budget is reserved for the answer.
    - `samples`: weighted samples, some of which fail.
    """
    limit_state.budget -= HANDED_OUT * GROUPS
    x = samples.x[samples.failing]
    z = samples.failures[rng.choice(len(x), FOLLOWED, p=x / x.sum())]
    group = _groups(z, min(GROUPS, max(1, limit_state.left * GROUPS // (MIN_TIMES * POINTS))))
    middles = [_centre(z, np.flatnonzero(group == k)) for k in range(group.max() + 1)]
    tried = np.concatenate([factor * z[middles] for factor in OUTWARD])
    times = int(np.clip(limit_state.left // POINTS, MIN_TIMES, MAX_TIMES))
    region = np.arange(len(middles))
    failing = np.full(len(tried), 0)
    try:
        failing = _count(limit_state, tried, times)
        # The first point of each group at which half of the simulations fail, or its centre.
        step = (2 * failing >= times).reshape(len(OUTWARD), -1).argmax(axis=0)
        ends = step * len(middles) + region
        _join(limit_state, tried[ends], failing[ends], times, region)
    except Ended:
        pass  # Regions that were not compared remain apart.
    region = np.unique(region, return_inverse=True)[1]
    of_tried = np.tile(region, len(OUTWARD))
    # The density of failures is that of the prior times the probability of failing.
    density = np.log((failing + 0.5) / (times + 1)) - np.sum(tried**2, axis=1) / 2
    likeliest = [
        int(max(np.flatnonzero(of_tried == k), key=density.__getitem__))
        for k in range(region.max() + 1)
    ]
    return Divided(
        Regions(np.concatenate([z, tried]), np.append(region[group], of_tried)),
        np.zeros(len(z) + len(tried), int), joined=0, tried=0, under=1.0, held=0,
        design=tuple(len(z) + row for row in likeliest),
        failing=tuple(int(failing[row]) for row in likeliest), times=times,
    )  # fmt: skip


def _groups(z: Float[np.ndarray, "n d"], max_groups: int) -> Int[np.ndarray, " n"]:
    # As far from one another as can be, so that a small region has a group of its own.
    start = z[farthest_first(0, lambda row: np.linalg.norm(z - z[row], axis=1), max_groups)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # About a group that has become empty.
        group = kmeans2(z, start, minit="matrix")[1]
    return np.unique(group, return_inverse=True)[1]


def _centre(z: Float[np.ndarray, "n d"], rows: Int[np.ndarray, " k"]) -> int:
    """Return the row of the failure nearest to the mean of a group."""
    return int(rows[np.sum((z[rows] - z[rows].mean(axis=0)) ** 2, axis=1).argmin()])


def _count(
    limit_state: LimitState, z: Float[np.ndarray, "n d"], times: int
) -> Int[np.ndarray, " n"]:
    """Simulate points several times, and count their failures."""
    if limit_state.left < times * len(z):
        raise Ended
    return fails_at(limit_state, np.repeat(z, times, axis=0)).reshape(-1, times).sum(axis=1)


def _join(
    limit_state: LimitState, ends: Float[np.ndarray, "k d"], failing: Int[np.ndarray, " k"],
    times: int, region: Int[np.ndarray, " k"],
) -> None:  # fmt: skip
    """Give one number to groups that a path joins, the least distant ones first."""
    placed: list[int] = []
    for i in np.argsort(np.sum(ends**2, axis=1)).tolist():
        # One that lies between two regions joins the nearer one, and does not make them one.
        for j in sorted(placed, key=lambda j: float(np.sum((ends[i] - ends[j]) ** 2))):
            if _connected(limit_state, ends, failing, times, i, j):
                region[i] = region[j]
                break
        placed.append(i)
    first = np.unique(region)
    for i, j in zip(*(first[rows] for rows in np.triu_indices(len(first), 1)), strict=True):
        if region[i] != region[j] and _connected(limit_state, ends, failing, times, i, j):
            region[region == region[j]] = region[i]


def _connected(
    limit_state: LimitState, ends: Float[np.ndarray, "k d"], failing: Int[np.ndarray, " k"],
    times: int, i: int, j: int,
) -> bool:  # fmt: skip
    """Return whether one of two paths fails all along about as often as its ends."""
    lower = int(min(failing[i], failing[j]))
    ways = ([path(ends[[i]], ends[[j]], at) for at in FRACTIONS] for path in (straight, arc))
    return any(
        all(_as_often(_count(limit_state, z, times)[0], lower, times) for z in way) for way in ways
    )


def _as_often(count: int, lower: int, times: int) -> bool:
    """Return whether a point may fail about as often as the end with fewer failures."""
    return count >= AS_OFTEN * lower or bool(binom.cdf(count, times, lower / times) > SURELY_LESS)
