"""Means of scores that come in clusters, such as the episodes of one training seed.

    interval = clustered_mean(scores, clusters, tasks)      # each task counts the same

Episodes of one seed share what that seed has learned, so 5 seeds of 100 episodes are not 500
independent samples: the interval rests on the spread of the clusters. Tasks are fixed: what one is
harder than another adds nothing to it.

`anytime_mean` holds after any number of samples, whatever decided when to stop.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class ClusteredMean:
    """A mean over tasks with its variance: `count` clusters, `freedom` degrees of freedom."""

    mean: float
    variance: float
    freedom: float
    count: int

    def interval(self, confidence: float) -> tuple[float, float]:
        """Return the bounds of Student's t."""
        from scipy.stats import t

        half = float(t.ppf((1 + confidence) / 2, self.freedom)) * math.sqrt(self.variance)
        return self.mean - half, self.mean + half


def clustered_mean(
    scores: Float[np.ndarray, " n"], clusters: Int[np.ndarray, " n"], tasks: Int[np.ndarray, " n"]
) -> ClusteredMean:
    """Compute the mean over tasks of the means of scores, and its variance between clusters.

    **Arguments:**
    - `clusters`: the number of each score's cluster; clusters are independent of each other.
    - `tasks`: the number of each score's task. Tasks are fixed strata where each has two clusters
      at least, otherwise a sample like the clusters.
    **Raises:** `ValueError` for fewer than two clusters.

    Source: Liang and Zeger, Longitudinal data analysis using generalized linear models, Biometrika
    73, 1986, with the correction `G / (G - 1)` for the `G` clusters of each task.
    """
    count = len(np.unique(clusters))
    if count < 2:
        raise ValueError(
            "an interval needs two clusters at least, such as seeds or runs, whose spread it rests "
            f"on; got {count}"
        )
    members = [np.unique(clusters[tasks == task]) for task in np.unique(tasks)]
    if min(map(len, members)) < 2:
        tasks, members = np.zeros_like(tasks), [np.unique(clusters)]
    sums, mean = np.zeros(int(clusters.max()) + 1), 0.0
    for task, own in zip(np.unique(tasks), members, strict=True):
        of_task = tasks == task
        centre, each = scores[of_task].mean(), np.sqrt(len(own) / (len(own) - 1)) / of_task.sum()
        np.add.at(sums, clusters[of_task], each * (scores[of_task] - centre) / len(members))
        mean += float(centre) / len(members)
    apart = count == sum(map(len, members))  # No cluster meets two tasks.
    freedom = count - len(members) if apart else min(map(len, members)) - 1
    return ClusteredMean(mean, float(np.sum(sums**2)), freedom, count)


def difference(one: ClusteredMean, other: ClusteredMean) -> ClusteredMean:
    """Return the second mean minus the first, of independent clusters.

    With the fewer degrees of freedom of both, its interval is never too narrow (Hsu, Contributions
    to the theory of Student's t-test as applied to the problem of two samples, 1938).
    """
    freedom = min(one.freedom, other.freedom)
    variance, count = one.variance + other.variance, min(one.count, other.count)
    return ClusteredMean(other.mean - one.mean, variance, freedom, count)


def anytime_mean(values: Float[np.ndarray, " n"], confidence: float) -> tuple[float, float]:
    """Compute an interval of the mean of values from 0 to 1, in their order, valid at any time.

    Source: Waudby-Smith and Ramdas, Estimating means of bounded random variables by betting,
    Journal of the Royal Statistical Society B 86, 2024: the predictable empirical-Bernstein
    confidence sequence.
    """
    x, n = np.asarray(values, float), len(values)
    times, limit = np.arange(1, n + 1), math.log(2 / (1 - confidence))
    means = (0.5 + np.cumsum(x)) / (times + 1)
    spread = (0.25 + np.cumsum((x - means) ** 2)) / (times + 1)
    before, mean_before = np.r_[0.25, spread[:-1]], np.r_[0.5, means[:-1]]
    bets = np.minimum(np.sqrt(2 * limit / (before * times * np.log(1 + times))), 0.5)
    growth = 4 * (x - mean_before) ** 2 * (-np.log1p(-bets) - bets) / 4
    centres = np.cumsum(bets * x) / np.cumsum(bets)
    radii = (limit + np.cumsum(growth)) / np.cumsum(bets)
    # All of them hold together, so the narrowest ends do.
    return float(np.max(centres - radii).clip(0, 1)), float(np.min(centres + radii).clip(0, 1))
