"""Rank correlations of single inputs with an outcome, and how great they get by chance.

A weak trend shows in few configurations, from which no model of several inputs can be learned.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

SHUFFLES = 1000
"""Shuffled outcomes that decide what chance can do."""


class Trends(NamedTuple):
    """Rank correlations of inputs with an outcome.

    - `correlation`: Spearman's, of each input; NaN for one that is constant.
    - `chance`: limit below which the greatest of all correlations stays in 95 % of shuffled
      outcomes; one beyond it is significant, however many inputs there are.
    """

    correlation: Float[np.ndarray, " d"]
    chance: float


def trends(
    inputs: Float[np.ndarray, "n d"],
    outcome: Float[np.ndarray, " n"],
    groups: Int[np.ndarray, " n"],
    seed: int = 0,
) -> Trends:
    """Correlate inputs with an outcome over groups of rows, each of which counts by its mean."""
    distinct, member = np.unique(groups, return_inverse=True)
    counts = np.bincount(member)
    means = np.stack(
        [np.bincount(member, column) / counts for column in (outcome, *inputs.T)], axis=1
    )
    ranks = _rank(means)
    result, columns = ranks[:, 0], ranks[:, 1:]
    rng = np.random.default_rng(seed)
    shuffled = np.stack([result, *(rng.permutation(result) for _ in range(SHUFFLES))])
    with np.errstate(invalid="ignore"):
        correlations = shuffled @ columns / len(distinct)
    constant = (columns == 0).all(axis=0)
    greatest = np.abs(correlations[1:, ~constant]).max(axis=1, initial=0.0)
    correlation = np.where(constant, np.nan, correlations[0])
    return Trends(correlation, float(np.quantile(greatest, 0.95)))


def _rank(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Return ranks of columns with mean 0 and deviation 1 (or all 0); equal values share one."""
    ranks = np.empty(values.shape)
    for j, column in enumerate(values.T):
        _, index, counts = np.unique(column, return_inverse=True, return_counts=True)
        last = np.cumsum(counts)
        ranks[:, j] = (last - (counts - 1) / 2)[index]
    ranks -= ranks.mean(axis=0)
    deviation = ranks.std(axis=0)
    return ranks / np.where(deviation > 0, deviation, 1.0)
