"""Sorting, on sets: each position has the hull of the elements that may stand there."""

import numpy as np

from verifai_jax.addons.verification.sets import functions
from verifai_jax.addons.verification.sets.arrays import together
from verifai_jax.addons.verification.sets.form import Form, chosen, negative, rounding, unknown
from verifai_jax.addons.verification.sets.interpreter import Equation, Interpreter, rule
from verifai_jax.addons.verification.sets.values import Value, as_form, constant
from verifai_jax.addons.verification.sets.whole import Whole

LONGEST = 256
"""Numbers that are sorted at most: each pair of them is compared."""
SHORT = 6
"""Numbers that are sorted by maxima and minima of pairs, which keep what they depend on."""


@rule("sort")
def _sort(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    params = step.params
    if params["num_keys"] != 1:
        raise NotImplementedError("a sort by several keys")
    return _sorted(inputs, params["dimension"], params["is_stable"])


@rule("top_k")
def _top(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    value, count = as_form(inputs[0]), step.params["k"]
    axis = step.params.get("axis", len(value.shape) - 1) % len(value.shape)
    shape = [-1 if i == axis else 1 for i in range(len(value.shape))]
    number = np.broadcast_to(np.arange(value.shape[axis]).reshape(shape), value.shape)
    numbers = constant(number, np.dtype(step.outvars[1].aval.dtype))
    greatest, which = _sorted([negative(value), numbers], axis, stable=True)
    both = negative(as_form(greatest)), which
    return [v.moved(lambda array, lead: array.take(range(count), axis + lead)) for v in both]


def _sorted(values: list[Value], axis: int, stable: bool) -> list[Value]:
    """Return arrays in the order of the first one, from the least number to the greatest."""
    count = values[0].shape[axis]
    if count > LONGEST:
        raise NotImplementedError(f"a sort of more than {LONGEST} numbers")
    last = [v.moved(lambda a, lead: np.moveaxis(a, lead + axis, -1)) for v in values]
    key, boxes = last[0], max(len(_ends(value)[0]) for value in values)
    low, high = (np.broadcast_to(end, (boxes, *end.shape[1:])) for end in _ends(key))
    before = high[..., :, None] < low[..., None, :]
    if isinstance(key, Whole):
        # Equal whole numbers keep their order. Floats that the machine takes for equal may not be.
        ties = np.triu(np.ones((count, count), bool), 1) & stable
        before |= (high[..., :, None] <= low[..., None, :]) & ties
        nothing = np.zeros(low.shape[:-1], bool)
    else:
        tiny = rounding(key.dtype).smallest
        before &= high[..., :, None] + 2 * tiny < low[..., None, :]
        # NaN stands last, wherever it came from.
        nothing = np.asarray(unknown(low, high).any(-1))
    first = before.sum(-2)
    final = count - 1 - before.sum(-1)
    first, final = (np.where(nothing[..., None], end, each)
                    for end, each in ((0, first), (count - 1, final)))  # fmt: skip
    position = np.arange(count)
    possible = (first[..., None] <= position) & (position <= final[..., None])
    found = [_placed(value, possible) for value in last]
    found[0] = _by_pairs(key, found[0], nothing)
    return [v.moved(lambda a, lead: np.moveaxis(a, -1, lead + axis)) for v in found]


def _ends(value: Value) -> tuple[np.ndarray, np.ndarray]:
    return value.bounds() if isinstance(value, Form) else (value.low, value.high)


def _placed(value: Value, possible: np.ndarray) -> Value:
    """Return for each position the hull of the elements that may stand there.

    **Arguments:**
    - `possible`: `[boxes, ..., element, position]`.
    """
    low, high = _ends(value)
    bottom, top = low.min(initial=0), high.max(initial=0)
    lowest = np.where(possible, low[..., :, None], top).min(-2)
    highest = np.where(possible, high[..., :, None], bottom).max(-2)
    if isinstance(value, Whole):
        return Whole(lowest, highest, value.dtype)
    lost = np.asarray(unknown(low, high).any(-1, keepdims=True))
    lowest, highest = np.where(lost, -np.inf, lowest), np.where(lost, np.inf, highest)
    hull = Form.between(lowest, highest, value.dtype)
    single = possible.sum(-2) == 1
    if not single.any() or value.slopes is None:
        return hull
    which = possible.argmax(-2)

    def pick(array: np.ndarray, lead: int) -> np.ndarray:
        array = np.broadcast_to(array, (*array.shape[: lead - 1], *which.shape))
        index = np.broadcast_to(which, array.shape)
        return np.take_along_axis(array, index, -1)

    return chosen([single, ~single], [value.moved(pick), hull])


def _by_pairs(key: Value, placed: Value, nothing: np.ndarray) -> Value:
    """Return sorted numbers within the order of their ends, as minima and maxima if they are few.

    At least k of the numbers are at most the k-th greatest of their upper ends.
    """
    low, high = (np.sort(end, -1) for end in _ends(key))
    if isinstance(key, Whole):
        return Whole(low, high, key.dtype)
    tiny = rounding(key.dtype).smallest
    form, count = placed, key.shape[-1]
    if key.slopes is not None and 1 < count <= SHORT:
        rows = [key.moved(lambda array, lead, i=i: array[..., i]) for i in range(count)]
        for phase in range(count):
            for i in range(phase % 2, count - 1, 2):
                a, b = as_form(rows[i]), as_form(rows[i + 1])
                rows[i : i + 2] = [functions.lesser(a, b), functions.greater(a, b)]
        form = together(rows, lambda arrays, lead: np.stack(arrays, -1))
    form = as_form(form).moved(lambda array, lead: array)
    first, final = form.bounds()
    # Numbers that the machine takes for zero may stand in any order.
    low = np.where(np.abs(low) < tiny, -tiny, low)
    high = np.where(np.abs(high) < tiny, tiny, high)
    shape = np.broadcast_shapes(first.shape, low.shape)
    form.low = np.broadcast_to(np.maximum(first, low), shape)
    form.high = np.broadcast_to(np.minimum(final, high), shape)
    form._bounds = None
    form.forget(np.broadcast_to(nothing[..., None], np.broadcast_shapes(shape, form.radius.shape)))
    return form
