"""k-modes and k-prototypes: k-means for choices, and for numbers and choices together.

Huang, Extensions to the k-means algorithm for clustering large data sets with categorical values,
Data Mining and Knowledge Discovery 2(3), 1998 (k-modes); Huang, Clustering large data sets with
mixed numeric and categorical values, PAKDD 1997 (k-prototypes). Seeds are spread as in Arthur and
Vassilvitskii, k-means++: the advantages of careful seeding, SODA 2007.
"""

import numpy as np
from jaxtyping import Float, Int

RESTARTS = 8
ROUNDS = 100


def prototypes(
    coordinates: Float[np.ndarray, "n p"], codes: Int[np.ndarray, "n m"], count: int,
    rng: np.random.Generator,
) -> Int[np.ndarray, " n"]:  # fmt: skip
    """Return the cluster of each row, from 0; the best of 8 starts.

    The cost is a sum over rows: the squared distance of the coordinates from the cluster's mean,
    plus the number of codes that differ from the cluster's most frequent ones.
    """
    runs = [_run(coordinates, codes, count, rng) for _ in range(RESTARTS)]
    return min(runs, key=lambda run: run[1])[0]


def _run(
    coordinates: np.ndarray, codes: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    seeds = _seeds(coordinates, codes, count, rng)
    means, modes = coordinates[seeds], codes[seeds]
    labels = np.full(len(codes), -1)
    costs = np.zeros(len(codes))
    for _ in range(ROUNDS):
        squared = _squared(coordinates, codes, means, modes)
        new = np.argmin(squared, axis=1)
        costs = squared[np.arange(len(new)), new]
        for empty in np.setdiff1d(np.arange(count), new):
            # An empty cluster starts again at the row that fits worst.
            worst = int(np.argmax(costs))
            new[worst], costs[worst] = empty, 0.0
        if (new == labels).all():
            break
        labels = new
        means, modes = _centres(coordinates, codes, labels, count)
    return labels, float(costs.sum())


def _seeds(
    coordinates: np.ndarray, codes: np.ndarray, count: int, rng: np.random.Generator
) -> list[int]:
    seeds = [int(rng.integers(len(codes)))]
    nearest = np.full(len(codes), np.inf)
    while len(seeds) < count:
        last = seeds[-1:]
        squared = _squared(coordinates, codes, coordinates[last], codes[last])[:, 0]
        nearest = np.minimum(nearest, squared)
        total = nearest.sum()
        chances = nearest / total if total > 0 else None
        seeds.append(int(rng.choice(len(codes), p=chances)))
    return seeds


def _squared(
    coordinates: np.ndarray, codes: np.ndarray, means: np.ndarray, modes: np.ndarray
) -> Float[np.ndarray, "n count"]:
    squared = np.empty((len(codes), len(means)))
    for i, (mean, mode) in enumerate(zip(means, modes, strict=True)):
        squared[:, i] = ((coordinates - mean) ** 2).sum(axis=1) + (codes != mode).sum(axis=1)
    return squared


def _centres(
    coordinates: np.ndarray, codes: np.ndarray, labels: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    sizes = np.maximum(np.bincount(labels, minlength=count), 1)
    means = np.zeros((count, coordinates.shape[1]))
    for j, column in enumerate(coordinates.T):
        means[:, j] = np.bincount(labels, column, count) / sizes
    modes = np.zeros((count, codes.shape[1]), codes.dtype)
    for j, column in enumerate(codes.T):
        # An absent entry has the code -1.
        lowest, kinds = column.min(), column.max() - column.min() + 1
        counts = np.bincount(labels * kinds + column - lowest, minlength=count * kinds)
        modes[:, j] = np.argmax(counts.reshape(count, kinds), axis=1) + lowest
    return means, modes
