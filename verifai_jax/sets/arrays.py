"""Operations that move the elements of arrays, add them up or multiply matrices, on sets."""

import itertools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.sets import functions, whole
from verifai_jax.sets.form import Form, is_point, product, rounded, total
from verifai_jax.sets.interpreter import (
    Equation,
    Interpreter,
    Params,
    Value,
    as_form,
    as_whole,
    rule,
)
from verifai_jax.sets.elementwise import select
from verifai_jax.sets.whole import Whole

Move = Callable[[Params, np.ndarray, int], np.ndarray]
"""A function of the parameters of a step, an array and the number of its leading axes."""


def _moving(*names: str) -> Callable[[Move], Move]:
    """Register a function that moves the elements of one array, behind leading axes."""

    def register(function: Move) -> Move:
        def apply(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
            params = {**step.params, "to": step.outvars[0].aval.shape}
            return [inputs[0].moved(lambda array, lead: function(params, array, lead))]

        rule(*names)(apply)
        return function

    return register


@_moving("reshape", "squeeze", "expand_dims")
def _reshape(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    if params.get("dimensions") is not None and "new_sizes" in params:
        raise NotImplementedError("a reshape that permutes")
    return array.reshape(*array.shape[:lead], *params["to"])


@_moving("broadcast_in_dim")
def _broadcast(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    shape = [1] * len(params["to"])
    for axis, size in zip(params["broadcast_dimensions"], array.shape[lead:], strict=True):
        shape[axis] = size
    return np.broadcast_to(
        array.reshape(*array.shape[:lead], *shape), (*array.shape[:lead], *params["to"])
    )


@_moving("transpose")
def _transpose(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    return np.transpose(array, (*range(lead), *(axis + lead for axis in params["permutation"])))


@_moving("rev")
def _reverse(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    return np.flip(array, [axis + lead for axis in params["dimensions"]])


@_moving("slice")
def _slice(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    strides = params["strides"] or (1,) * len(params["to"])
    cells = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return array[(..., *(slice(*each) for each in cells))]


@_moving("tile")
def _tile(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    return np.tile(array, (*(1,) * lead, *params["reps"]))


def together(values: Sequence[Value], join: Callable[[list[np.ndarray], int], np.ndarray]) -> Value:
    """Return one array of several; `join(arrays, leading)` puts arrays together."""

    def leading(arrays: list[np.ndarray], lead: int) -> np.ndarray:
        front = np.broadcast_shapes(*(array.shape[:lead] for array in arrays))
        return join([np.broadcast_to(a, (*front, *a.shape[lead:])) for a in arrays], lead)

    if isinstance(values[0], Whole):
        parts = [as_whole(value) for value in values]
        low, high = ([getattr(p, end) for p in parts] for end in ("low", "high"))
        return Whole(leading(low, 1), leading(high, 1), parts[0].dtype)
    forms = [as_form(value) for value in values]
    newest = max((f.frame.number for f in forms if f.frame is not None), default=0)
    forms = [f if f.frame is None or f.frame.number == newest else f.unframed() for f in forms]
    frame = next((f.frame for f in forms if f.frame is not None), None)
    count = max((len(f.slopes) for f in forms if f.slopes is not None), default=0)
    slopes = None
    if count:
        padded = []
        for form in forms:
            own = np.zeros((count, *form.centre.shape))
            if form.slopes is not None:
                own = np.zeros((count, *form.slopes.shape[1:]))
                own[: len(form.slopes)] = form.slopes
            padded.append(own)
        slopes = leading(padded, 2)
    low = high = None
    if all(f.low is not None for f in forms):
        ends = [f.bounds() for f in forms]
        low, high = (leading([end[side] for end in ends], 1) for side in (0, 1))
    elif not all(np.isfinite(f.radius).all() for f in forms):
        ends = [f.bounds() for f in forms]
        low, high = (leading([end[side] for end in ends], 1) for side in (0, 1))
    return Form(
        leading([f.centre for f in forms], 1), slopes, leading([f.radius for f in forms], 1),
        leading([f.size for f in forms], 1), forms[0].dtype, low, high, frame,
    )  # fmt: skip


@rule("concatenate")
def _concatenate(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    axis = step.params["dimension"]
    return [together(inputs, lambda arrays, lead: np.concatenate(arrays, axis + lead))]


@rule("stack")
def _stack(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    axis = step.params["axis"]
    return [together(inputs, lambda arrays, lead: np.stack(arrays, axis + lead))]


@rule("unstack", "split")
def _split(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    axis, (value,) = step.params["axis"], inputs
    sizes = step.params.get("sizes", (1,) * value.shape[axis])
    ends = np.cumsum(sizes)
    parts = []
    for size, end in zip(sizes, ends, strict=True):

        def cut(array: np.ndarray, lead: int, begin: int = end - size, end: int = end) -> np.ndarray:
            part = array.take(range(begin, end), axis + lead)
            return part.squeeze(axis + lead) if step.primitive.name == "unstack" else part

        parts.append(value.moved(cut))
    return parts


def _taken(value: Value, positions: np.ndarray) -> Value:
    """Return the elements at these positions of the flat array."""
    return value.moved(
        lambda array, lead: array.reshape(*array.shape[:lead], -1)[..., positions]
    )


def _positions(t: Interpreter, step: Equation, inputs: list[Value], of: int) -> np.ndarray:
    """Apply a step that only moves elements to the numbers of the elements themselves."""
    arrays, start = [], 0
    for number, value in enumerate(inputs):
        if number < of:
            size = int(np.prod(value.shape, dtype=np.int64))
            arrays.append(np.arange(start, start + size, dtype=np.int32).reshape(value.shape))
            start += size
            continue
        common = as_whole(value).common
        if common is None:
            raise NotImplementedError("indices that depend on the features")
        arrays.append(common)
    params = dict(step.params)
    if "fill_value" in params:
        params["fill_value"] = -1
    return np.asarray(step.primitive.bind(*map(jnp.asarray, arrays), **params))


def _in_reach(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value] | None:
    """Return the hull over all values of the one index of a slice that varies; None if it is fixed.
    """
    starts = [as_whole(value) for value in inputs[1:]]
    array, sizes = inputs[0], step.params["slice_sizes"]
    if all(start.common is not None for start in starts):
        return None
    result: Value | None = None
    tops = [n - size for n, size in zip(array.shape, sizes, strict=True)]
    ranges = [
        range(int(np.clip(s.low.min(), 0, top)), int(np.clip(s.high.max(), 0, top)) + 1)
        for s, top in zip(starts, tops, strict=True)
    ]
    if np.prod([len(each) for each in ranges]) > 1024:
        raise NotImplementedError("an index of more than 1024 values in a box")
    rank = (1,) * len(sizes)
    for cell in itertools.product(*ranges):
        window = tuple(slice(i, i + size) for i, size in zip(cell, sizes, strict=True))
        part = array.moved(lambda a, lead, window=window: a[(..., *window)])
        if result is None:
            result = part
            continue
        low = np.ones(1, bool)
        high = np.ones(1, bool)
        for i, start, top in zip(cell, starts, tops, strict=True):
            least, most = np.clip(start.low, 0, top), np.clip(start.high, 0, top)
            high = high & (least <= i) & (i <= most)
            low = low & (least == i) & (i == most)
        which = Whole(
            low.astype(np.int64).reshape(-1, *rank), high.astype(np.int64).reshape(-1, *rank),
            np.dtype(bool),
        )  # fmt: skip
        # A box in which the first window is out of reach has another one for certain.
        result = select(which, [result, part])
    assert result is not None
    return [result]


@rule("dynamic_slice")
def _dynamic_slice(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    varying = _in_reach(t, step, inputs)
    if varying is not None:
        return varying
    cells = []
    for start, n, size in zip(inputs[1:], inputs[0].shape, step.params["slice_sizes"], strict=True):
        common = as_whole(start).common
        assert common is not None
        begin = int(np.clip(int(common), 0, n - size))
        cells.append(slice(begin, begin + size))
    return [inputs[0].moved(lambda array, lead: array[(..., *cells)])]


@rule("gather")
def _gather(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    positions = _positions(t, step, inputs, 1)
    if (positions < 0).any():
        raise NotImplementedError("an index outside of its array")
    return [_taken(inputs[0], positions)]


@rule("dynamic_update_slice")
def _update(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    positions = _positions(t, step, inputs, 2)
    return [_taken(_flat(inputs[:2]), positions)]


@rule("scatter")
def _scatter(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    array, index, update = inputs
    common = as_whole(index).common
    if common is None:
        raise NotImplementedError("indices that depend on the features")
    size = int(np.prod(array.shape, dtype=np.int64))
    numbers = jnp.arange(size, dtype=jnp.int32).reshape(array.shape)
    more = jnp.arange(size, size + int(np.prod(update.shape, dtype=np.int64)), dtype=jnp.int32)
    found = step.primitive.bind(
        numbers, jnp.asarray(common), more.reshape(update.shape), **step.params
    )
    return [_taken(_flat([array, update]), np.asarray(found))]


@rule("pad")
def _pad(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    return [_taken(_flat(inputs), _positions(t, step, inputs, 2))]


def _flat(values: Sequence[Value]) -> Value:
    flat = [v.moved(lambda a, lead: a.reshape(*a.shape[:lead], -1)) for v in values]
    return together(flat, lambda arrays, lead: np.concatenate(arrays, lead))


# Sums, products, extremes


@rule("reduce_sum")
def _sum(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    (value,), axes = inputs, step.params["axes"]
    if isinstance(value, Form):
        return [total(value, axes)]
    lead = tuple(axis + 1 for axis in axes)
    return [Whole(value.low.sum(lead), value.high.sum(lead), value.dtype)]


@rule("reduce_max", "reduce_min", "reduce_and", "reduce_or")
def _extreme(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    (value,), axes = inputs, tuple(axis + 1 for axis in step.params["axes"])
    least = step.primitive.name in ("reduce_min", "reduce_and")
    extreme = np.min if least else np.max
    initial = None
    if isinstance(value, Whole):
        if value.dtype == bool:
            initial = 1 if least else 0
        low, high = (extreme(end, axes, initial=initial) if initial is not None else
                     extreme(end, axes) for end in (value.low, value.high))  # fmt: skip
        return [Whole(low, high, value.dtype)]
    low, high = value.bounds()
    nothing = ((low == -np.inf) & (high == np.inf)).any(axes)
    initial = np.inf if least else -np.inf
    low, high = extreme(low, axes, initial=initial), extreme(high, axes, initial=initial)
    return [Form.between(np.where(nothing, -np.inf, low), np.where(nothing, np.inf, high),
                         value.dtype)]  # fmt: skip


@rule("reduce_prod")
def _product(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    value = as_form(inputs[0])
    for axis in sorted(step.params["axes"], reverse=True):
        rows = _rows(value, axis)
        result = rows[0]
        for row in rows[1:]:
            result = product(result, row)
        value = result
    return [value]


def _rows(value: Form, axis: int) -> list[Form]:
    return [
        value.moved(lambda array, lead, i=i: array.take(i, axis + lead))
        for i in range(value.shape[axis])
    ]


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulative(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    axis, name = step.params["axis"], step.primitive.name
    if isinstance(inputs[0], Whole):
        return t.concrete(step, inputs)
    rows = _rows(inputs[0], axis)
    if step.params["reverse"]:
        rows = rows[::-1]
    if name == "cumsum":
        # Of sums of any order of additions: XLA adds up in a tree.
        sums = [
            total(together(rows[: i + 1], lambda arrays, lead: np.stack(arrays, lead)), (0,))
            for i in range(len(rows))
        ]
    else:
        operation = {
            "cumprod": product, "cummax": functions.greater, "cummin": functions.lesser
        }[name]  # fmt: skip
        sums = list(itertools.accumulate(rows, operation))
    if step.params["reverse"]:
        sums = sums[::-1]
    return [together(sums, lambda arrays, lead: np.stack(arrays, axis + lead))]


@rule("argmax", "argmin")
def _argument(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    if isinstance(inputs[0], Whole):
        return t.concrete(step, inputs)
    value = inputs[0] if step.primitive.name == "argmax" else _minus(inputs[0])
    (axis,) = step.params["axes"]
    low, high = value.bounds()
    best = low.max(axis + 1, keepdims=True)
    possible = high >= best
    possible |= ((low == -np.inf) & (high == np.inf)).any(axis + 1, keepdims=True)
    count = value.shape[axis]
    number = np.arange(count).reshape([-1 if i == axis + 1 else 1 for i in range(low.ndim)])
    first = np.where(possible, number, count).min(axis + 1)
    last = np.where(possible, number, -1).max(axis + 1)
    return [Whole(first, last, np.dtype(step.outvars[0].aval.dtype))]


def _minus(value: Value) -> Form:
    from verifai_jax.sets.form import negative

    return negative(as_form(value))


@rule("dot_general")
def _dot(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    if isinstance(inputs[0], Whole):
        return t.concrete(step, inputs)
    (contracted, batched) = step.params["dimension_numbers"]
    sides = []
    for value, inner, outer in zip(inputs, contracted, batched, strict=True):
        form = as_form(value)
        free = [a for a in range(len(form.shape)) if a not in inner and a not in outer]
        order = (*outer, *free, *inner)
        shape = form.shape
        sizes = [tuple(shape[a] for a in axes) for axes in (outer, free, inner)]
        flat = tuple(int(np.prod(size, dtype=np.int64)) for size in sizes)

        def arrange(
            array: np.ndarray, lead: int, order: tuple[int, ...] = order,
            flat: tuple[int, ...] = flat,
        ) -> np.ndarray:  # fmt: skip
            axes = (*range(lead), *(axis + lead for axis in order))
            return array.transpose(axes).reshape(*array.shape[:lead], *flat)

        sides.append((form.moved(arrange), sizes))
    (a, sizes), (b, others) = sides
    to = step.outvars[0].aval.shape
    dtype = np.dtype(step.outvars[0].aval.dtype)
    if is_point(b) and np.isfinite(b.centre).all():
        result = _times(a, b.centre[0], dtype)
    elif is_point(a) and np.isfinite(a.centre).all():
        swapped = _times(b, a.centre[0], dtype)
        result = swapped.moved(lambda array, lead: np.swapaxes(array, -1, -2))
    else:
        left = a.moved(lambda array, lead: np.expand_dims(array, lead + 2))
        right = b.moved(lambda array, lead: np.expand_dims(array, lead + 1))
        result = total(product(left, right), (3,))
    return [result.moved(lambda array, lead: array.reshape(*array.shape[:lead], *to))]


def _times(a: Form, matrix: np.ndarray, dtype: np.dtype) -> Form:
    """Return products `[batch, rows, columns]` of a form and exact numbers `[batch, columns, k]`."""
    other = np.swapaxes(matrix, -1, -2)
    count = matrix.shape[-1]

    def multiplied(array: np.ndarray, by: np.ndarray) -> np.ndarray:
        if len(by) == 1 and array.shape[-3] == 1:
            flat = np.ascontiguousarray(array).reshape(-1, array.shape[-1]) @ by[0]
            return flat.reshape(*array.shape[:-1], by.shape[-1])
        return array @ by

    size = np.abs(other)
    slopes = None if a.slopes is None else multiplied(a.slopes, other)
    with np.errstate(invalid="ignore"):
        return rounded(
            multiplied(a.centre, other), slopes, multiplied(a.radius, size),
            multiplied(a.size, size), dtype, None, a.frame, units=count + 1.0,
        )  # fmt: skip


