"""The regions in which the failures of a table lie."""

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.falsification.run import Run
from verifai_jax.search.kinds import ENOUGH, REACH

MAX_FAILURES = 4096
"""Failures that regions are made of, at most: the first ones, which take a tenth of a second."""


def regions_of(u: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
    """Return the number of the region of each point, by the rule of `search/kinds.py`.

    Regions that have grown together count as one. Numbers follow the order of the points.
    """
    u, d = np.asarray(u, np.float32), max(u.shape[1], 1)
    low = high = u[:0]
    joined = np.zeros(len(u), int)
    for i, point in enumerate(u):
        gap = np.maximum(np.maximum(low - point, point - high), 0.0)
        far = np.sqrt(np.sum(gap**2, axis=1) / d)
        if not len(far) or far.min() > REACH:
            joined[i] = len(far)
            low, high = np.concatenate([low, point[None]]), np.concatenate([high, point[None]])
            continue
        joined[i] = nearest = int(far.argmin())
        low[nearest] = np.minimum(low[nearest], point)
        high[nearest] = np.maximum(high[nearest], point)
    root = np.arange(len(low))
    for i in range(len(low)):
        gap = np.maximum(np.maximum(low - high[i], low[i] - high), 0.0)
        touching = np.sqrt(np.sum(gap**2, axis=1) / d) <= REACH
        root[np.isin(root, root[touching])] = root[touching].min()
    return root[joined]


def describe_kinds(run: Run) -> tuple[str, ...]:
    """Write how many regions of failures a run has found, and how it divided its budget."""
    rows = run.table.violating.iloc[:MAX_FAILURES]
    if run.prior or run.problem is None or not len(rows):
        return ()
    regions = regions_of(run.problem.space.points(rows))
    numbers, counts = np.unique(regions, return_counts=True)
    known = numbers[counts >= ENOUGH]
    first = int(rows.index[0])
    if not len(known):
        return ()
    tenth = [int(rows.index[np.flatnonzero(regions == k)[ENOUGH - 1]]) for k in known]
    until = min(tenth)
    inside = int(np.isin(regions, known).sum())
    of = "" if run.table.counts.violating <= MAX_FAILURES else f" of the first {MAX_FAILURES:,}"
    these = "a region" if len(known) == 1 else f"{len(known)} regions"
    return (
        f"{these} with {ENOUGH} failures or more: {inside:,}{of}; {len(rows) - inside:,} elsewhere",
        f"{first + 1:,} simulations to the first failure, {until - first:,} more until a region "
        f"had {ENOUGH}, {run.simulations - until - 1:,} after that",
    )
