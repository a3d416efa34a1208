"""What units of layers have in common, so that sums of them do not add up what cancels.

What a linear function of units misses is a symbol of each unit: where a later layer adds units up,
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
LARGEST, DEEPEST = 2**21, 16
"""Numbers of a matrix at most, and layers one after another, that are remembered."""
FEW, FINE_BOXES = 8, 64
"""Results that go back at most if there are more boxes than these: those are small, and lose less
by what they do not know of layers between than they would take time."""
TOGETHER = 32
"""Boxes that go back at once: their rows then fit the cache."""
_NUMBERS = itertools.count(1)


class Layer(NamedTuple):
    """Sums `units @ matrix`, whose units vary by `own` each and by layers before them.

    - `matrix`: `[units, sums]`; `own`: `[boxes, units]`.
    - `gross`: how much the sums vary if nothing cancels in this layer, `[boxes, sums]`.
    """

    number: int
    matrix: np.ndarray
    own: np.ndarray
    gross: np.ndarray
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
    matrix: np.ndarray, units: Any, own: np.ndarray, gross: np.ndarray
) -> Common | None:
    """Return the parts of the radius of sums of a form's `units`, which are off by `own`."""
    terms = () if units.common is None else units.common.terms
    depth = 1 + max((term.layer.depth for term in terms), default=0)
    if matrix.size > LARGEST or depth > DEEPEST:
        return None
    each = units.radius if units.common is None else units.common.own
    each = each.reshape(len(each), -1)
    for before, scale in terms:
        # The rounding of rows that go back through it.
        each = each + len(matrix) * SLACK * np.abs(scale) * before.gross
    gross = gross.reshape(len(gross), -1)
    layer = Layer(next(_NUMBERS), matrix, each, gross, terms, depth)
    return Common(own, (Term(layer, np.ones((1, matrix.shape[1]))),))


def summed(radius: np.ndarray, parts: Sequence[tuple[Any, np.ndarray | float]]) -> Common | None:
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
    count = common.terms[0].scale.shape[1]
    if len(numbers) == count and (numbers == np.arange(count)).all():
        return Common(own, common.terms)
    if any(len(term.layer.matrix) * len(numbers) > LARGEST for term in common.terms):
        return None
    terms = list[Term]()
    for layer, scale in common.terms:
        matrix, gross = layer.matrix[:, numbers], layer.gross[:, numbers]
        part = layer._replace(number=next(_NUMBERS), matrix=matrix, gross=gross)
        terms.append(Term(part, scale[:, numbers]))
    return Common(own, tuple(terms))


def refined(radius: np.ndarray, common: Common) -> np.ndarray:
    """Return a radius of which what layers have in common counts once."""
    flat, own = (each.reshape(len(each), -1) for each in (radius, common.own))
    if not any(term.layer.before for term in common.terms):
        return radius
    boxes = max(len(each) for each in (flat, *_arrays(common.terms)))
    if boxes > FINE_BOXES and flat.shape[1] > FEW:
        return radius
    blocks = [slice(i, i + TOGETHER) for i in range(0, boxes, TOGETHER)]
    sums = np.concatenate([_back(common.terms, block) for block in blocks])
    found = own + sums + SLACK * flat
    return np.where(found < flat, found, flat).reshape(-1, *radius.shape[1:])


def _arrays(terms: Sequence[Term]) -> list[np.ndarray]:
    return [array for layer, scale in terms for array in (scale, layer.own, *_arrays(layer.before))]


def _back(terms: Sequence[Term], block: slice) -> np.ndarray:
    """Return how much layers add to each result of some boxes."""

    def cut(array: np.ndarray) -> np.ndarray:
        return array if len(array) == 1 else array[block]

    left = {layer.number: (layer, cut(s)[:, :, None] * layer.matrix.T) for layer, s in terms}
    total = np.zeros((1, 1))
    while left:
        # Layers have greater numbers than those they came through.
        layer, rows = left.pop(max(left))
        total = total + (np.abs(rows) @ cut(layer.own)[:, :, None])[:, :, 0] * (1 + SLACK)
        for before, scale in layer.before:
            more = (rows * cut(scale)[:, None]) @ before.matrix.T
            old = left.get(before.number)
            left[before.number] = before, more if old is None else old[1] + more
    return total
