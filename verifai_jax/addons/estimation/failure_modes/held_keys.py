"""The failing regions of a system that draws random numbers, found under fixed keys.

    divided = divide_under_keys(limit_state, held_at, rng, samples, starts)
    divided.regions, divided.keys[row]              # each point fails under the key of its row

If each simulation draws new random numbers, points on a path fail only with a probability, and
paths do not define regions. Under a fixed key the system is a function of its features, and regions
are found as for any other system. The keys are those of failures: first a key under which half of
the failures fail, then one for half of the rest, and so on. A key under which all fail is avoided,
as it may join regions that are separate under other keys. Regions of two keys are merged if a path
under either key joins their likeliest points.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation.failure_modes.region_search import find_regions
from verifai_jax.addons.estimation.failure_modes.regions import Regions
from verifai_jax.addons.estimation.importance import ImportanceSamples
from verifai_jax.addons.estimation.normal_space import (
    LimitState,
    Spent,
    fails_at,
    squared_distances,
)
from verifai_jax.addons.estimation.paths import COST_OF_PATHS, connected

ASKED = 24
"""Failures whose keys are tried on one another, at most, in a sixth of the budget."""
MAX_KEYS = 4
"""Keys that are held, at most."""
ENOUGH = 0.9
"""Share of the failures from which on no further key is held."""
TYPICAL = 0.5
"""Share of the failures left that fail under the next key, at least."""
FOLLOWED = 300
"""Failures of which those that fail under a held key are followed to their regions, at most; they
are simulated in a fourth of the budget."""
Held = Callable[[int, int], LimitState]
"""From the number of a random key and a budget to the limit state under that key."""


@dataclass(frozen=True)
class Divided:
    """Failing regions under fixed random keys.

    - `regions`: the regions; each point fails under a key.
    - `keys`: the number `[m]` of the key of each point.
    - `joined`, `tried`: the number of failures that a path joins to a region, and of those tried.
    - `under`: share of the failures that fail under one of the keys.
    - `held`: number of keys.
    - `design`: row of the likeliest failure of each region; by default the failure nearest to the
      origin.
    - `failing`: for a system with its own random numbers, the number of failures in `times`
      simulations of each likeliest failure.
    """

    regions: Regions
    keys: Int[np.ndarray, " m"]
    joined: int
    tried: int
    under: float
    held: int
    design: tuple[int, ...] = ()
    failing: tuple[int, ...] = ()
    times: int = 0

    @property
    def design_rows(self) -> Int[np.ndarray, " k"]:
        """Row of the likeliest failure of each region."""
        return np.array(self.design or self.regions.design_rows, int)

    @property
    def note(self) -> str:
        """Return a note on these regions for the user."""
        which = "one random key" if self.held == 1 else f"{self.held} random keys"
        return (
            "the system draws random numbers, so that a point fails with a probability: the modes "
            f"are regions that fail under {which}, which is fixed. {self.under:.0%} of the "
            "failures fail under it; each of the others counts for the mode nearest to it. The "
            "likeliest failure of a mode fails under its own key, mode.random_key"
        )


def divide_under_keys(
    limit_state: LimitState, held: Held, rng: np.random.Generator, samples: ImportanceSamples,
    starts: Float[np.ndarray, "m d"],
) -> Divided | None:  # fmt: skip
    """Find the failing regions of a system that draws random numbers, within the remaining budget.

    **Arguments:**
    - `held`: the limit state under a fixed key.
    - `samples`: weighted samples, some of which fail.
    - `starts`: further points to start from.
    **Returns:** the regions; None if there are none.
    **Raises:** `Ended` when the time is over.
    """
    x = samples.x[samples.failing]
    asked = int(np.clip(np.sqrt(limit_state.left / 6), 1, ASKED))
    followed = int(np.clip(limit_state.left // (4 * MAX_KEYS), 1, FOLLOWED))
    rows = rng.choice(len(x), max(asked, followed), p=x / x.sum())
    keys = _choose_keys(
        limit_state, held, samples.keys[rows[:asked]], samples.failures[rows[:asked]]
    )
    z = samples.failures[rows[:followed]]
    regions, numbers = Regions(z[:0], np.zeros(0, int)), np.zeros(0, int)
    region, looked_at, under = np.full(len(z), -1), np.zeros(len(z), bool), np.zeros(len(z), bool)
    for turn, key in enumerate(keys):
        own = held(key, limit_state.left // (len(keys) - turn))
        failing = fails_at(own, z)
        under |= failing
        with suppress(Spent):
            new = np.flatnonzero(failing & (region < 0))
            if len(new):
                share = np.full(len(new), 1 / len(new))
                begin = starts[: own.left // 4]
                begin = begin[fails_at(own, begin)] if len(begin) else begin
                found = find_regions(own, rng, z[new], share, begin)
                new = new[: own.left // (2 * COST_OF_PATHS * max(1, found.count))]
                joined_to = _likeliest_of(own, found, z[new])
                same = _same_regions(own, held, regions, numbers, found, key)
                same = np.where(same >= 0, same, regions.count + np.cumsum(same < 0) - 1)
                joined = joined_to >= 0
                region[new[joined]] = same[joined_to[joined]]
                points = np.concatenate([found.design_points, z[new[joined]]])
                regions.add(points, np.append(same, region[new[joined]]).astype(int))
                numbers = np.append(numbers, np.full(len(points), key))
                looked_at[new] = True
        limit_state.simulations += own.simulations
    if not regions.count:
        return None
    joined, tried = int(np.sum(region >= 0)), int(looked_at.sum())
    return Divided(regions, numbers, joined, tried, float(under.mean()), len(keys))


def _likeliest_of(
    own: LimitState, found: Regions, z: Float[np.ndarray, "n d"]
) -> Int[np.ndarray, " n"]:
    """Return, for each failure, the region whose likeliest failure a path leads to; -1 for none.

    Under an unlucky key regions lie close together, with frequent failures between them. So a path
    to another failure of a region counts only if no path leads to a likeliest failure.
    """
    region, ends = np.full(len(z), -1), found.design_points
    nearest = np.argsort(squared_distances(z, ends), axis=1)
    candidates = [(ends[column], column) for column in nearest.T]
    candidates += [(found.points[rows], found.region[rows]) for rows in found.candidates(z).T]
    for points, number in candidates:
        left = np.flatnonzero(region < 0)
        joined = left[connected(own, z[left], points[left])] if len(left) else left
        region[joined] = number[joined]
    return region


def _choose_keys(
    limit_state: LimitState, held: Held, keys: Int[np.ndarray, " k"], z: Float[np.ndarray, "n d"]
) -> list[int]:
    """Choose keys of failures so that nearly all of these fail under one; see the module."""
    fails: dict[int, Bool[np.ndarray, " n"]] = {}
    for key in np.unique(keys).tolist():
        own = held(key, limit_state.left)
        fails[key] = fails_at(own, z)
        limit_state.simulations += own.simulations
    chosen: list[int] = []
    left = np.ones(len(z), bool)
    while len(chosen) < MAX_KEYS and left.mean() > 1 - ENOUGH:
        share = {key: float(np.mean(failing[left])) for key, failing in fails.items()}
        typical = [key for key in share if share[key] >= TYPICAL]
        key = min(typical, key=share.__getitem__) if typical else max(share, key=share.__getitem__)
        if not share[key]:
            break
        chosen.append(key)
        left &= ~fails[key]
    return chosen


def _same_regions(
    under: LimitState, held: Held, regions: Regions, numbers: Int[np.ndarray, " m"], found: Regions,
    key: int,
) -> Int[np.ndarray, " k"]:  # fmt: skip
    """Return for each region under a key the earlier one that it is, -1 where it is a new one."""
    same = np.full(found.count, -1)
    if not regions.count:
        return same
    rows, ends = regions.design_rows, found.design_points
    for number, row in enumerate(rows):
        others = np.flatnonzero(same < 0)
        there = np.repeat(regions.points[row][None], len(others), axis=0)
        for which in dict.fromkeys((key, int(numbers[row]))):
            own = held(which, max(0, under.left))
            with suppress(Spent):
                same[others[connected(own, ends[others], there)]] = number
            under.simulations += own.simulations
    return same
