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


def propose_regions(
    start: Region,
    values: Float[np.ndarray, "n k"],
    codes: Int[np.ndarray, "n m"],
    failing: Bool[np.ndarray, " n"],
    weights: Float[np.ndarray, " n"],
    unordered: tuple[Column, ...],
    depth: int,
) -> list[Region]:
    """Propose parts of `start`: all nodes of trees with failing rows weighted evenly or not.

    The rows are those inside `start`, and each stands for as many as its weight says.
    """
    if failing.all() or not failing.any():
        return []
    from sklearn.tree import DecisionTreeClassifier

    matrix, meanings = _encoded(values, codes, failing, unordered)
    if not matrix.shape[1]:
        return []
    leaf = int(np.clip(failing.sum() // 10, 1, 5))
    regions: list[Region] = []
    even = weights * np.where(failing, weights[~failing].sum() / weights[failing].sum(), 1.0)
    for each in (weights, even):
        tree = DecisionTreeClassifier(max_depth=depth, min_samples_leaf=leaf, random_state=0)
        nodes = tree.fit(matrix, failing, each).tree_
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


def _encoded(
    values: Float[np.ndarray, "n k"], codes: Int[np.ndarray, "n m"],
    failing: Bool[np.ndarray, " n"], unordered: tuple[Column, ...],
) -> tuple[Float[np.ndarray, "n e"], list[tuple[int, Any]]]:  # fmt: skip
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
