"""Boxes with many failures, proposed by decision trees over ordered and unordered columns.

Sources: trees and the best subsets of unordered values by Breiman, Friedman, Olshen and Stone,
Classification and regression trees (1984).
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.analysis.conditions import Region
from verifai_jax.addons.analysis.data.columns import Column

MAX_ONE_HOT = 30
MAX_ENTRIES = 500_000
"""Rows times columns that a tree is made from."""


def propose_regions(
    start: Region,
    values: Float[np.ndarray, "n k"],
    codes: Int[np.ndarray, "n m"],
    failing: Bool[np.ndarray, " n"],
    unordered: tuple[Column, ...],
    depth: int,
) -> list[Region]:
    """Propose parts of `start`: all nodes of trees with failing rows weighted evenly or not.

    The rows are those inside `start`.
    """
    if failing.all() or not failing.any():
        return []
    from sklearn.tree import DecisionTreeClassifier

    matrix, meanings = _encoded(values, codes, failing, unordered)
    if not matrix.shape[1]:
        return []
    rows = _limit_rows(failing, int(MAX_ENTRIES // matrix.shape[1]))
    leaf = int(np.clip(failing[rows].sum() // 10, 1, 5))
    regions: list[Region] = []
    for weight in (None, "balanced"):
        tree = DecisionTreeClassifier(
            max_depth=depth, min_samples_leaf=leaf, class_weight=weight, random_state=0
        )
        nodes = tree.fit(matrix[rows], failing[rows]).tree_
        stack = [(0, start)]
        while stack:
            node, region = stack.pop()
            if node:
                regions.append(region)
            if nodes.children_left[node] < 0:
                continue
            column, edge = meanings[nodes.feature[node]], nodes.threshold[node]
            stack.append((nodes.children_right[node], _part(region, column, edge, upper=True)))
            stack.append((nodes.children_left[node], _part(region, column, edge, upper=False)))
    return regions


def _limit_rows(failing: Bool[np.ndarray, " n"], maximum: int) -> Int[np.ndarray, " k"]:
    """Return rows to make trees from, `maximum` at most; rare verdicts are kept."""
    if len(failing) <= maximum:
        return np.arange(len(failing))
    parts = []
    for part in (np.flatnonzero(failing), np.flatnonzero(~failing)):
        parts.append(part[:: max(1, -(-2 * len(part) // maximum))])
    return np.concatenate(parts)


def _encoded(
    values: Float[np.ndarray, "n k"],
    codes: Int[np.ndarray, "n m"],
    failing: Bool[np.ndarray, " n"],
    unordered: tuple[Column, ...],
) -> tuple[Float[np.ndarray, "n e"], list[tuple[int, Any]]]:
    """Return columns that a tree can split, and the meaning of each.

    An ordered column stands for itself. An unordered one is given by a column for each choice, and
    by its choices ranked by their share of failures: a cut in that order is the best subset.
    """
    columns = list(values.T)
    meanings: list[tuple[int, Any]] = [(j, None) for j in range(values.shape[1])]
    for j, column in enumerate(unordered):
        count = len(column.choices)
        present = codes[:, j] >= 0
        counts = np.bincount(codes[present, j], minlength=count)
        bad = np.bincount(codes[present & failing, j], minlength=count)
        ranks = np.argsort(np.argsort(bad / np.maximum(counts, 1), kind="stable"), kind="stable")
        columns.append(np.where(present, ranks[np.maximum(codes[:, j], 0)], -1).astype(float))
        meanings.append((j, ranks))
        if count <= MAX_ONE_HOT:
            for index in range(count):
                columns.append((codes[:, j] == index).astype(float))
                meanings.append((j, (np.arange(count) == index).astype(int)))
    return np.stack(columns, axis=1) if columns else values, meanings


def _part(region: Region, column: tuple[int, Any], edge: float, *, upper: bool) -> Region:
    j, ranks = column
    if ranks is None:
        return region.bound(j, above=edge) if upper else region.bound(j, upto=edge)
    return region.restrict(j, frozenset(np.flatnonzero((ranks > edge) == upper).tolist()))
