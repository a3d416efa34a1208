"""The row with the nearest neighbours, among many, over numbers and choices.

Rows with the same choices form a group, searched by a k-d tree (Bentley, Multidimensional binary
search trees used for associative searching, CACM 18(9), 1975). A row of another group is at least
1 away, which bounds what the others can add: nearly always the tree alone decides.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int

_MAX_DIMENSIONS = 20
"""Dimensions beyond which a k-d tree looks at nearly every point."""
_ENTRIES = 20_000_000
"""Entries of the arrays of a block at most."""


def tightest(coordinates: Float[np.ndarray, "n p"], codes: Int[np.ndarray, "n m"], k: int) -> int:
    """Return the index of a row whose `k` nearest, itself included, have the least summed distance.

    The squared distance is that of the coordinates plus the number of different codes.
    """
    # Equal rows are one with a weight: they would all lie in one leaf of a tree.
    joined = np.concatenate([coordinates, codes.astype(np.float64)], axis=1)
    _, first, weights = np.unique(joined, axis=0, return_index=True, return_counts=True)
    coordinates, codes = coordinates[first], codes[first]
    groups = list(_groups(codes))
    bound, exact = np.empty(len(first)), np.empty(len(first), bool)
    for members in groups:
        bound[members], exact[members] = _within(
            coordinates[members], weights[members], k, alone=len(groups) == 1
        )
    best = np.min(bound[exact], initial=np.inf)
    left = np.flatnonzero(~exact & (bound < best))
    left = left[np.lexsort((first[left], bound[left]))]
    size = max(1, min(256, _ENTRIES // len(first)))
    for start in range(0, len(left), size):
        some = left[start : start + size]
        if bound[some[0]] >= best:
            break
        far, which = _nearest_of_all(coordinates, codes, some, min(k, len(first)))
        bound[some], exact[some] = (far * _taken(weights[which], k)).sum(axis=1), True
        best = min(best, bound[some].min())
    sums = np.where(exact, bound, np.inf)
    return int(first[sums == sums.min()].min())


def _groups(codes: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the indices of rows with the same codes, group by group."""
    if codes.shape[1] == 0:
        yield np.arange(len(codes))
        return
    _, group = np.unique(codes, axis=0, return_inverse=True)
    group = group.reshape(-1)
    order = np.argsort(group, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def _within(
    coordinates: np.ndarray, weights: np.ndarray, k: int, alone: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Bound the sums of distances of the rows of a group; return whether the bounds are exact.

    Unless the group is `alone`, neighbours farther than 1, and those that it lacks, may be rows of
    other groups at a distance of 1.
    """
    n = len(weights)
    tree = _tree(coordinates) if n > 1 and coordinates.shape[1] <= _MAX_DIMENSIONS else None
    count = min(k, n)
    size = max(1, min(1024, _ENTRIES // (count if tree is not None else n)))
    bounds, exact = np.empty(n), np.empty(n, bool)
    for start in range(0, n, size):
        some = np.arange(start, min(start + size, n))
        if tree is None:
            far, which = _nearest_of_all(coordinates, np.zeros((n, 0), np.int64), some, count)
        else:
            far, which = tree.query(
                coordinates[some], k=np.arange(1, count + 1), workers=-1 if n > 10_000 else 1
            )
        taken = _taken(weights[which], k)
        lowest = far if alone else np.minimum(far, 1.0)
        lacking = k - taken.sum(axis=1)
        bounds[some] = (lowest * taken).sum(axis=1) + lacking
        exact[some] = (lacking == 0) & ~((far > lowest) & (taken > 0)).any(axis=1)
    return bounds, exact


def _taken(weights: Int[np.ndarray, "n k"], k: int) -> Int[np.ndarray, "n k"]:
    """Count how many of each neighbour, the nearest first, are among the `k` nearest rows."""
    before = np.cumsum(weights, axis=1) - weights
    return np.clip(k - before, 0, weights)


def _tree(coordinates: np.ndarray) -> Any:
    from scipy.spatial import KDTree

    return KDTree(coordinates)


def _nearest_of_all(
    coordinates: np.ndarray, codes: np.ndarray, some: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances and indices of the `k` nearest rows of `some`, compared with all rows."""
    # From the middle of the cloud, so that large coordinates cost no digits.
    centred = coordinates - coordinates.mean(axis=0)
    squares = (centred**2).sum(axis=1)
    squared = squares[some, None] + squares - 2 * centred[some] @ centred.T
    for code in codes.T:
        squared += code[some, None] != code
    which = np.argpartition(squared, k - 1, axis=1)[:, :k]
    exact = np.zeros(which.shape)
    for column in coordinates.T:
        exact += (column[some, None] - column[which]) ** 2
    for code in codes.T:
        exact += code[some, None] != code[which]
    order = np.argsort(exact, axis=1, kind="stable")
    return (
        np.sqrt(np.take_along_axis(exact, order, axis=1)),
        np.take_along_axis(which, order, axis=1),
    )
