"""What units of layers have in common, so that sums of them do not add up what cancels.

What a linear function of units misses is a symbol of each unit: where the next layer adds units up,
symbols may cancel. They are not kept as arrays of symbols. Each form remembers the layers it came
through, and `refined` goes back through them from a result, as backward linear relaxation does.

Source: H. Zhang et al., Efficient neural network robustness certification with general activation
functions, NeurIPS (2018).
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

SLACK = 2.0**-45
"""Share of a number by which a result is widened for the rounding of its own bounds."""
LARGEST = 2**21
"""Numbers of a matrix at most for its layer to be remembered."""
DEEPEST = 16
"""Layers that are remembered one after another at most."""
TOGETHER = 32
"""Boxes that go back at once: their rows then fit the cache."""
_NUMBERS = itertools.count(1)


class Layer(NamedTuple):
    """Sums `units @ matrix`, whose units vary by `own` and by what is common to them.

    - `matrix`: `[units, sums]`; `own`: `[boxes, units]`.
    """

    number: int
    matrix: np.ndarray
    own: np.ndarray
    before: "tuple[Term, ...]"
    depth: int


class Term(NamedTuple):
    """A layer whose sums count with a `scale`, `[boxes, sums]`."""

    layer: Layer
    scale: np.ndarray


class Common(NamedTuple):
    """A radius in parts: `own`, `[boxes, *shape]`, and the sums of layers, in order of elements."""

    own: np.ndarray
    terms: tuple[Term, ...]


def through_layer(
    matrix: np.ndarray, radius: np.ndarray, common: Common | None, own: np.ndarray
) -> Common | None:
    """Return the parts of the radius of `units @ matrix`, which itself is off by `own`."""
    terms = () if common is None else common.terms
    depth = 1 + max((term.layer.depth for term in terms), default=0)
    if matrix.size > LARGEST or depth > DEEPEST:
        return None
    units = radius if common is None else common.own
    units = units.reshape(len(units), -1)
    layer = Layer(next(_NUMBERS), matrix, units, terms, depth)
    return Common(own, (Term(layer, np.ones((1, matrix.shape[1]))),))


def summed(
    radius: np.ndarray, parts: Sequence[tuple[Any, np.ndarray | float]]
) -> Common | None:
    """Return the parts of a radius of a sum of forms times factors; what else it has is its own."""
    if all(form.common is None for form, _ in parts):
        return None
    rest, own, terms = radius * (1 + SLACK), 0.0, dict[int, Term]()
    for form, factor in parts:
        size = np.abs(factor)
        common = Common(form.radius, ()) if form.common is None else form.common
        rest, own = rest - size * form.radius * (1 - SLACK), own + size * common.own
        factor = np.broadcast_to(factor, np.broadcast_shapes(np.shape(factor), (1, *form.shape)))
        factor = factor.reshape(len(factor), -1)
        for layer, scale in common.terms:
            old = terms.get(layer.number)
            scale = scale * factor
            terms[layer.number] = Term(layer, scale if old is None else old.scale + scale)
    return Common(own + np.maximum(rest, 0), tuple(terms.values()))


def picked(common: Common, own: np.ndarray, numbers: np.ndarray) -> Common | None:
    """Return the parts for elements with these numbers, `own` rearranged already."""
    count = common.terms[0].layer.matrix.shape[1]
    if len(numbers) == count and (numbers == np.arange(count)).all():
        return Common(own, common.terms)
    if any(len(t.layer.matrix) * len(numbers) > LARGEST for t in common.terms):
        return None
    return Common(own, tuple(
        Term(layer._replace(number=next(_NUMBERS), matrix=layer.matrix[:, numbers]),
             scale[:, numbers])
        for layer, scale in common.terms
    ))  # fmt: skip


def refined(radius: np.ndarray, common: Common) -> np.ndarray:
    """Return a radius of which what layers have in common counts once."""
    flat = radius.reshape(len(radius), -1)
    own = common.own.reshape(len(common.own), -1)
    boxes = max(len(flat), *(len(t.scale) for t in _all(common.terms)),
                *(len(t.layer.own) for t in _all(common.terms)))  # fmt: skip
    blocks = [slice(i, i + TOGETHER) for i in range(0, boxes, TOGETHER)]
    sums = np.concatenate([_back(common.terms, block, flat.shape[1]) for block in blocks])
    # Rounding of the rows is relative to what they are without cancellation, as the radius is.
    found = own + sums * (1 + SLACK) + SLACK * flat
    return np.where(found < flat, found, flat).reshape(-1, *radius.shape[1:])


def _all(terms: Sequence[Term]) -> list[Term]:
    return [each for t in terms for each in (t, *_all(t.layer.before))]


def _back(terms: Sequence[Term], block: slice, count: int) -> np.ndarray:
    """Return how much layers add to each of so many results, `[boxes, results]`."""

    def cut(array: np.ndarray) -> np.ndarray:
        return array if len(array) == 1 else array[block]

    left = {t.layer.number: (t.layer, cut(t.scale)[:, :, None] * t.layer.matrix.T) for t in terms}
    total: np.ndarray | float = 0.0
    while left:
        # Layers have greater numbers than those they came through.
        layer, rows = left.pop(max(left))
        total = total + (np.abs(rows) @ cut(layer.own)[:, :, None])[:, :, 0]
        for before, scale in layer.before:
            more = (rows * cut(scale)[:, None]) @ before.matrix.T
            old = left.get(before.number)
            left[before.number] = before, more if old is None else old[1] + more
    return np.asarray(total)
