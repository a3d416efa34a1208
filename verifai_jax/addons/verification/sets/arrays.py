"""Operations that move the elements of arrays, add them up or multiply matrices, on sets."""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from verifai_jax.addons.verification.sets import functions, whole
from verifai_jax.addons.verification.sets.form import Form, alike, padded, product, total, unknown
from verifai_jax.addons.verification.sets.interpreter import Equation, Interpreter, Params, rule
from verifai_jax.addons.verification.sets.values import Value, as_form, as_whole, constant
from verifai_jax.addons.verification.sets.whole import Whole

Move = Callable[[np.ndarray, int], np.ndarray]
"""A function of an array and the number of its leading axes."""


def _reshape(params: Params) -> Move:
    if params.get("dimensions") is not None and "new_sizes" in params:
        raise NotImplementedError("a reshape that permutes")
    return lambda array, lead: array.reshape(array.shape[:lead] + params["to"])


def _broadcast(params: Params) -> Move:
    to, kept = params["to"], params["broadcast_dimensions"]
    new = [axis for axis in range(len(to)) if axis not in kept]

    def spread(array: np.ndarray, lead: int) -> np.ndarray:
        wide = np.expand_dims(array, tuple(axis + lead for axis in new))
        return np.broadcast_to(wide, array.shape[:lead] + to)

    return spread


def _slice(params: Params) -> Move:
    strides = params["strides"] or (1,) * len(params["to"])
    cells = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    key = (..., *(slice(*each) for each in cells))
    return lambda array, lead: array[key]


_MOVES: dict[str, Callable[[Params], Move]] = {
    "reshape": _reshape, "squeeze": _reshape, "expand_dims": _reshape, "slice": _slice,
    "broadcast_in_dim": _broadcast,
    "transpose": lambda p: lambda a, n: a.transpose(*range(n), *np.add(p["permutation"], n)),
    "rev": lambda p: lambda a, lead: np.flip(a, tuple(axis + lead for axis in p["dimensions"])),
    "tile": lambda p: lambda a, lead: np.tile(a, (*(1,) * lead, *p["reps"])),
}  # fmt: skip
"""What primitives do with the elements of one array, behind leading axes, by their parameters."""


@rule(*_MOVES)
def _moved(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    params = {**step.params, "to": step.outvars[0].aval.shape}
    return [inputs[0].moved(_MOVES[step.primitive.name](params))]


def together(values: Sequence[Value], join: Callable[[list[np.ndarray], int], np.ndarray]) -> Value:
    """Combine arrays into one; `join(arrays, leading)` performs the combination."""

    def leading(arrays: list[np.ndarray], lead: int) -> np.ndarray:
        fronts = {array.shape[:lead] for array in arrays}
        if len(fronts) > 1:
            front = np.broadcast_shapes(*fronts)
            arrays = [np.broadcast_to(a, (*front, *a.shape[lead:])) for a in arrays]
        return join(arrays, lead)

    if isinstance(values[0], Whole):
        parts = [as_whole(value) for value in values]
        low, high = ([getattr(p, end) for p in parts] for end in ("low", "high"))
        return Whole(leading(low, 1), leading(high, 1), parts[0].dtype)
    forms, frame, count = alike([as_form(value) for value in values])
    slopes = None
    if count:
        slopes = leading([
            np.zeros((count, *f.centre.shape)) if f.slopes is None else padded(f, count)
            for f in forms
        ], 2)  # fmt: skip
    low = high = None
    if all(f.low is not None for f in forms) or not all(np.isfinite(f.radius).all() for f in forms):
        ends = [f.bounds() for f in forms]
        low, high = (leading([end[side] for end in ends], 1) for side in (0, 1))
    return Form(
        leading([f.centre for f in forms], 1), slopes, leading([f.radius for f in forms], 1),
        leading([f.size for f in forms], 1), forms[0].dtype, low, high, frame,
    )  # fmt: skip


@rule("concatenate", "stack")
def _joined(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    stacks = step.primitive.name == "stack"
    join, axis = (np.stack, "axis") if stacks else (np.concatenate, "dimension")
    return [together(inputs, lambda arrays, lead: join(arrays, step.params[axis] + lead))]


@rule("unstack", "split")
def _split(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    axis, (value,) = step.params["axis"], inputs
    sizes = step.params.get("sizes", (1,) * value.shape[axis])

    def cut(cells: range, array: np.ndarray, lead: int) -> np.ndarray:
        part = array.take(cells, axis + lead)
        return part.squeeze(axis + lead) if step.primitive.name == "unstack" else part

    ranges = [range(end - size, end) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
    return [value.moved(functools.partial(cut, cells)) for cells in ranges]


@rule("reduce_sum")
def _sum(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    return [add_up(inputs[0], step.params["axes"])]


def add_up(value: Value, axes: Sequence[int]) -> Value:
    """Return the sum over axes."""
    return total(value, axes) if isinstance(value, Form) else whole.total(value, axes)


def times_each(a: Value, b: Value) -> Value:
    """Return the products of numbers of one kind."""
    if isinstance(a, Form):
        return product(a, as_form(b))
    return whole.OPERATIONS["mul"](a, as_whole(b))


@rule("reduce_max", "reduce_min", "reduce_and", "reduce_or")
def _extreme(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    (value,), axes = inputs, tuple(axis + 1 for axis in step.params["axes"])
    extreme, initial = (
        (np.min, np.inf) if step.primitive.name in ("reduce_min", "reduce_and") else
        (np.max, -np.inf)
    )  # fmt: skip
    if isinstance(value, Whole):
        if value.dtype != np.bool_ and step.primitive.name in ("reduce_and", "reduce_or"):
            return t.concrete(step, inputs)
        first = whole.limits(value.dtype)[initial > 0]
        low, high = (extreme(end, axes, initial=first) for end in (value.low, value.high))
        return [Whole(low, high, value.dtype)]
    low, high = value.bounds()
    nothing = unknown(low, high).any(axes)
    low, high = extreme(low, axes, initial=initial), extreme(high, axes, initial=initial)
    return [Form.between(np.where(nothing, -np.inf, low), np.where(nothing, np.inf, high),
                         value.dtype)]  # fmt: skip


@rule("reduce_prod")
def _product(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    value = inputs[0]
    for axis in sorted(step.params["axes"], reverse=True):
        one = constant(np.ones(value.shape[:axis] + value.shape[axis + 1 :]), value.dtype)
        value = functools.reduce(times_each, _rows(value, axis) or [one])
    return [value]


def _rows(value: Value, axis: int) -> list[Value]:
    return [
        value.moved(lambda array, lead, i=i: array.take(i, axis + lead))
        for i in range(value.shape[axis])
    ]


_ACCUMULATED: dict[str, Callable[[Any, Any], Value]] = {
    "cumprod": times_each, "cummax": functions.greater, "cummin": functions.lesser,
}  # fmt: skip


@rule("cumsum", *_ACCUMULATED)
def _cumulative(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    axis, name = step.params["axis"], step.primitive.name
    order = slice(None, None, -1 if step.params["reverse"] else 1)
    rows = _rows(inputs[0], axis)[order]
    if not rows:
        return inputs
    if name == "cumsum":
        # Whatever the order of the additions: XLA adds up in a tree.
        sums = [add_up(together(rows[: i + 1], np.stack), (0,)) for i in range(len(rows))]
    else:
        extreme = whole.OPERATIONS.get(name.removeprefix("cum"))
        each = extreme if extreme and isinstance(rows[0], Whole) else _ACCUMULATED[name]
        sums = list(itertools.accumulate(rows, each))
    return [together(sums[order], lambda arrays, lead: np.stack(arrays, axis + lead))]


@rule("argmax", "argmin")
def _argument(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    (value,), (axis,) = inputs, step.params["axes"]
    low, high = value.bounds() if isinstance(value, Form) else (1.0 * value.low, 1.0 * value.high)
    if step.primitive.name == "argmin":
        low, high = -high, -low
    best = low.max(axis + 1, keepdims=True)
    possible = high >= best
    possible |= unknown(low, high).any(axis + 1, keepdims=True)
    count = value.shape[axis]
    number = np.arange(count).reshape([-1 if i == axis + 1 else 1 for i in range(low.ndim)])
    first = np.where(possible, number, count).min(axis + 1)
    last = np.where(possible, number, -1).max(axis + 1)
    return [Whole(first, last, np.dtype(step.outvars[0].aval.dtype))]
