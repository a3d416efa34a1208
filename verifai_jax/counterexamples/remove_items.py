"""The first step of shrinking: make the items of a failure, such as events, those of nominal.

    u = remove_items(candidates, u)                     # a failing point, often of fewer items

Fewer additional items make a failure easier to understand. So items that nominal lacks are removed,
and missing items of nominal are restored. Up to `EXHAUSTIVE` items all subsets are tried; for more
items, consecutive runs, pairs and single items are tried repeatedly (delta debugging: Zeller and
Hildebrandt, Simplifying and isolating failure-inducing input, IEEE Transactions on Software
Engineering 28(2), 2002).
"""

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.compute.compilation import power_of_two
from verifai_jax.counterexamples.candidates import Candidates

EXHAUSTIVE = 8
"""Maximum number of items for which all subsets are tried."""


def remove_items(candidates: Candidates, u: Float[np.ndarray, " d"]) -> Float[np.ndarray, " d"]:
    """Remove items from a failing point, or put nominal's back, as long as it fails.

    **Arguments:**
    - `candidates`: simulates points, and remembers which failed.
    **Returns:** the failing point found whose items differ least from nominal's.
    """
    nominal = candidates.nominal
    while candidates.left > 0 and (own := nominal.items(u[None])[0]):
        points = nominal.restored(u)
        present = _present(candidates, u)
        drops = np.zeros((0, nominal.space.items), bool)
        for removed in item_sets(present):
            row = np.zeros((1, nominal.space.items), bool)
            row[0, removed] = True
            drops = np.concatenate([drops, row])
        if len(drops):
            points = np.concatenate([points, _without(candidates, u, drops)])
        points = points[nominal.items(points) < own]
        points = points[np.argsort(nominal.items(points), kind="stable")]
        rho, failing = candidates(points)
        if not failing.any():
            return u
        items = nominal.items(points)
        # The fewest items, and of those the failure that is the surest.
        u = points[np.lexsort((rho, items, ~failing))[0]]
    return u


def _present(candidates: Candidates, u: Float[np.ndarray, " d"]) -> Int[np.ndarray, " k"]:
    """Return the indices of the items that are present: removing one changes the point."""
    single = np.eye(candidates.nominal.space.items, dtype=bool)
    changed = np.any(_without(candidates, u, single) != candidates.nominal.settle(u[None]), axis=1)
    return np.flatnonzero(changed)


def _without(
    candidates: Candidates, u: Float[np.ndarray, " d"], drops: Bool[np.ndarray, "n items"]
) -> Float[np.ndarray, "n d"]:
    nominal, count = candidates.nominal, len(drops)
    # Powers of two, so that few shapes are compiled.
    padded = np.zeros((power_of_two(count), drops.shape[1]), bool)
    padded[:count] = drops
    points = np.repeat(u[None].astype(np.float32), len(padded), axis=0)
    return nominal.settle(np.asarray(nominal.space.without_items(points, padded)))[:count]


def item_sets(present: Int[np.ndarray, " k"]) -> list[list[int]]:
    """Return sets of items to remove; one of them is the set of all."""
    removed = present.tolist()
    count = len(removed)
    if count <= EXHAUSTIVE:
        return [list(chosen) for n in range(count, 0, -1) for chosen in combinations(removed, n)]
    runs = [
        removed[begin : begin + length]
        for length in range(count, 0, -1)
        for begin in range(0, count - length + 1, max(1, length // 4))
    ]
    return runs + [list(pair) for pair in combinations(removed, 2)]
