"""The common variation of the units of layers, so that sums of them do not add up what cancels.

What a linear function of units misses is a symbol of each unit: where a later layer adds units up,
symbols may cancel. They are not kept as arrays of symbols. Each form knows the way back through its
layers, and `refined` takes it from a result, as backward linear relaxation does.

Source: H. Zhang et al., Efficient neural network robustness certification with general activation
functions, NeurIPS (2018).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

SLACK = 2.0**-45
"""Share of a number by which a result is widened for the rounding of its own bounds."""
LARGEST, DEEPEST = 2**21, 16
"""Numbers of a matrix at most, and layers one after another, that are remembered."""
TOGETHER = 32
"""Boxes that go back at once: their rows then fit the cache."""


class Common(NamedTuple):
    """The radius of a form in parts.

    - `own`: how much each number varies by itself, `[boxes, *shape]`.
    - `back`: from factors `[boxes, results, numbers]` and a block of boxes to how much the sums of
      the numbers with these factors vary by what those have in common, `[boxes, results]`.
    - `depth`: the layers one after another.
    """

    own: np.ndarray
    back: Callable[[np.ndarray, slice], np.ndarray]
    depth: int


def _cut(array: np.ndarray, block: slice) -> np.ndarray:
    return array if len(array) == 1 else array[block]


def through_layer(matrix: np.ndarray, units: Any, own: np.ndarray) -> Common | None:
    """Return the parts of the radius of sums of a form's `units`, which are off by `own`."""
    before = units.common or Common(units.radius, lambda *_: np.zeros(1), 0)
    if matrix.size > LARGEST or before.depth == DEEPEST:
        return None
    each = before.own.reshape(len(before.own), -1, 1)

    def back(rows: np.ndarray, block: slice) -> np.ndarray:
        rows = rows @ matrix.T
        own = (np.abs(rows) @ _cut(each, block))[..., 0] * (1 + len(matrix) * SLACK)
        return own + before.back(rows, block)

    return Common(own, back, before.depth + 1)


def summed(radius: np.ndarray, parts: Sequence[tuple[Any, np.ndarray | float]]) -> Common | None:
    """Return the parts of a radius of a sum of forms times factors; what else it has is its own."""
    if all(form.common is None for form, _ in parts):
        return None
    rest, own, ways = radius * (1 + SLACK), 0.0, list[tuple[Common, np.ndarray]]()
    for form, factor in parts:
        rest = rest - np.abs(factor) * form.radius * (1 - SLACK)
        own = own + np.abs(factor) * (form.radius if form.common is None else form.common.own)
        if form.common is not None:
            shape = np.broadcast_shapes(np.shape(factor), (1, *form.shape))
            factor = np.broadcast_to(factor, shape)
            ways.append((form.common, factor.reshape(len(factor), 1, -1)))

    def back(rows: np.ndarray, block: slice) -> np.ndarray:
        found = (common.back(rows * _cut(factor, block), block) for common, factor in ways)
        return sum(found, start=np.zeros(1))

    return Common(own + np.maximum(rest, 0), back, max(common.depth for common, _ in ways))


def picked(common: Common, own: np.ndarray, numbers: np.ndarray, count: int) -> Common:
    """Return the parts for these of so many elements, `own` rearranged already."""
    if np.array_equal(numbers, np.arange(count)):
        return common._replace(own=own)

    def back(rows: np.ndarray, block: slice) -> np.ndarray:
        whole = np.zeros((*rows.shape[:2], count))
        np.add.at(whole.transpose(2, 0, 1), numbers, rows.transpose(2, 0, 1))
        return common.back(whole, block)

    return common._replace(own=own, back=back)


def refined(radius: np.ndarray, common: Common) -> np.ndarray:
    """Return a radius of which what layers have in common counts once."""
    flat, own = (each.reshape(len(each), -1) for each in (radius, common.own))
    boxes, count = flat.shape
    if common.depth == 1:
        return radius
    rows = np.eye(count)[None]
    blocks = [slice(i, i + TOGETHER) for i in range(0, boxes, TOGETHER)]
    sums = [np.broadcast_to(common.back(rows, b), flat[b].shape) for b in blocks]
    found = own + np.concatenate(sums) + SLACK * flat
    return np.where(found < flat, found, flat).reshape(radius.shape)
