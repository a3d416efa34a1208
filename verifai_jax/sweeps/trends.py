"""Rank correlations of single inputs with an outcome, and how great they get by chance.

A weak trend shows in few configurations, from which no model of several inputs can be learned.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

SHUFFLES = 1000


class Trends(NamedTuple):
    """Spearman's rank correlation of each input with the outcome; NaN for one that is constant.

    `chance`: what the greatest of all of them stays below in 95 % of shuffled outcomes, so that
    one beyond it is a finding however many inputs there are.
    """

    correlation: Float[np.ndarray, " d"]
    chance: float


def trends(
    inputs: Float[np.ndarray, "n d"],
    outcome: Float[np.ndarray, " n"],
    groups: Int[np.ndarray, " n"],
    seed: int = 0,
) -> Trends:
    """Trends over groups of rows, which count once, with their means."""
    distinct, member = np.unique(groups, return_inverse=True)
    counts = np.bincount(member)
    means = np.stack(
        [np.bincount(member, column) / counts for column in (outcome, *inputs.T)], axis=1
    )
    ranks = _ranked(means)
    result, columns = ranks[:, 0], ranks[:, 1:]
    rng = np.random.default_rng(seed)
    shuffled = np.stack([result, *(rng.permutation(result) for _ in range(SHUFFLES))])
    with np.errstate(invalid="ignore"):
        found = shuffled @ columns / len(distinct)
    constant = (columns == 0).all(axis=0)
    greatest = np.abs(found[1:, ~constant]).max(axis=1, initial=0.0)
    correlation = np.where(constant, np.nan, found[0])
    return Trends(correlation, float(np.quantile(greatest, 0.95)))


def _ranked(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Ranks of each column, equal ones sharing theirs, with mean 0 and deviation 1 (or all 0)."""
    ranks = np.empty(values.shape)
    for j, column in enumerate(values.T):
        _, place, counts = np.unique(column, return_inverse=True, return_counts=True)
        last = np.cumsum(counts)
        ranks[:, j] = (last - (counts - 1) / 2)[place]
    ranks -= ranks.mean(axis=0)
    deviation = ranks.std(axis=0)
    return ranks / np.where(deviation > 0, deviation, 1.0)
