"""Exact shares of a forest's variance that each input explains.

A tree is constant on boxes, so integrals over the unit cube are sums over pairs of boxes. Source:
Hutter, Hoos and Leyton-Brown, An efficient approach for assessing hyperparameter importance (2014).
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesRegressor
_MAX_ENTRIES = 2**22
"""Pairs of boxes times inputs in one block of memory."""


class Boxes(NamedTuple):
    """A function on the unit cube: a sum of functions that are constant on a box, 0 elsewhere."""

    low: Float[np.ndarray, "m d"]
    high: Float[np.ndarray, "m d"]
    value: Float[np.ndarray, " m"]


class Shares(NamedTuple):
    """Shares of a function's variance, NaN for a constant one: for each input the share that
    vanishes when it is known (`first`), and that remains when all others are (`total`); the
    variance itself.
    """

    first: Float[np.ndarray, " d"]
    total: Float[np.ndarray, " d"]
    variance: float


def leaf_boxes(
    forest: "ExtraTreesRegressor", edges: Sequence[Float[np.ndarray, " _"] | None]
) -> Boxes:
    """Return the leaves of a fitted forest of scikit-learn over the unit cube.

    - `edges`: borders of the cells of each input, to which thresholds are rounded; None for a
      continuous input.
    """
    dimensions = len(edges)
    low, high, value = [], [], []
    for tree in forest.estimators_:
        nodes = tree.tree_
        stack = [(0, np.zeros(dimensions), np.ones(dimensions))]
        while stack:
            node, below, above = stack.pop()
            if nodes.children_left[node] < 0:
                low.append(below)
                high.append(above)
                value.append(float(nodes.value[node].ravel()[0]) / len(forest.estimators_))
                continue
            j = nodes.feature[node]
            at = float(np.clip(nodes.threshold[node], 0.0, 1.0))
            if (cells := edges[j]) is not None:
                at = float(cells[np.argmin(np.abs(cells - at))])
            left, right = above.copy(), below.copy()
            left[j], right[j] = min(above[j], at), max(below[j], at)
            stack.append((nodes.children_left[node], below, left))
            stack.append((nodes.children_right[node], right, above))
    return Boxes(np.array(low), np.array(high), np.array(value))


def variance_shares(boxes: Boxes) -> Shares:
    """Return first-order and total shares of inputs distributed uniformly on `[0, 1]`."""
    width = boxes.high - boxes.low
    full = (width > 0).all(axis=1)
    low, high, width = boxes.low[full], boxes.high[full], width[full]
    value = boxes.value[full]
    volume = width.prod(axis=1)
    mean = float(value @ volume)
    count, dimensions = low.shape
    without = np.stack([np.delete(width, j, axis=1).prod(axis=1) for j in range(dimensions)], 1)
    # Second moments of the function given all inputs, given one, and given all but one.
    everything, alone, others = 0.0, np.zeros(dimensions), np.zeros(dimensions)
    together = max(1, _MAX_ENTRIES // max(1, count * dimensions))
    for begin in range(0, count, together):
        part = slice(begin, begin + together)
        overlap = np.minimum(high[part, None], high[None]) - np.maximum(low[part, None], low[None])
        overlap = np.maximum(overlap, 0.0)
        everything += value[part] @ overlap.prod(axis=2) @ value
        for j in range(dimensions):
            one = value[part] * without[part, j]
            alone[j] += one @ overlap[:, :, j] @ (value * without[:, j])
            rest = np.delete(overlap, j, axis=2).prod(axis=2)
            others[j] += (value[part] * width[part, j]) @ rest @ (value * width[:, j])
    variance = max(0.0, float(everything) - mean**2)
    if variance <= 1e-12 * max(1.0, mean**2):
        return Shares(np.full(dimensions, np.nan), np.full(dimensions, np.nan), 0.0)
    first = np.clip((alone - mean**2) / variance, 0, 1)
    total = np.clip(1 - (others - mean**2) / variance, 0, 1)
    return Shares(first, total, variance)
