"""Operations that move the elements of arrays, add them up or multiply matrices, on sets."""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.verification.sets import functions, whole
from verifai_jax.addons.verification.sets.elementwise import of_rank, select
from verifai_jax.addons.verification.sets.form import (
    Form,
    alike,
    is_point,
    padded,
    product,
    rounded,
    total,
    unknown,
)
from verifai_jax.addons.verification.sets.frames import FEW, of_layer
from verifai_jax.addons.verification.sets.interpreter import (
    Equation,
    Interpreter,
    Params,
    Value,
    as_form,
    as_whole,
    constant,
    rule,
)
from verifai_jax.addons.verification.sets.whole import Whole

WINDOWS = 1024
"""Positions of an array that an index may have in a box."""
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
    front = array.shape[:lead]
    return np.broadcast_to(array.reshape(*front, *shape), (*front, *params["to"]))


@_moving("transpose")
def _transpose(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    return np.transpose(array, (*range(lead), *(axis + lead for axis in params["permutation"])))


@_moving("rev")
def _reverse(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    return np.flip(array, tuple(axis + lead for axis in params["dimensions"]))


@_moving("slice")
def _slice(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    strides = params["strides"] or (1,) * len(params["to"])
    cells = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return array[(..., *(slice(*each) for each in cells))]


@_moving("tile")
def _tile(params: Params, array: np.ndarray, lead: int) -> np.ndarray:
    return np.tile(array, (*(1,) * lead, *params["reps"]))


def together(values: Sequence[Value], join: Callable[[list[np.ndarray], int], np.ndarray]) -> Value:
    """Combine arrays into one; `join(arrays, leading)` performs the combination."""

    def leading(arrays: list[np.ndarray], lead: int) -> np.ndarray:
        front = np.broadcast_shapes(*(array.shape[:lead] for array in arrays))
        return join([np.broadcast_to(a, (*front, *a.shape[lead:])) for a in arrays], lead)

    if isinstance(values[0], Whole):
        parts = [as_whole(value) for value in values]
        low, high = ([getattr(p, end) for p in parts] for end in ("low", "high"))
        return Whole(leading(low, 1), leading(high, 1), parts[0].dtype)
    forms, frame, count = alike([as_form(value) for value in values])
    slopes = None
    if count:
        slopes = leading(
            [np.broadcast_to(padded(f, count), (count, *(
                f.centre.shape if f.slopes is None else f.slopes.shape[1:]
            ))) for f in forms], 2,
        )  # fmt: skip
    low = high = None
    if all(f.low is not None for f in forms) or not all(np.isfinite(f.radius).all() for f in forms):
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

    def cut(cells: range, array: np.ndarray, lead: int) -> np.ndarray:
        part = array.take(cells, axis + lead)
        return part.squeeze(axis + lead) if step.primitive.name == "unstack" else part

    ranges = [range(end - size, end) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
    return [value.moved(functools.partial(cut, cells)) for cells in ranges]


@rule("dynamic_slice")
def _dynamic_slice(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    """Return the window, or the hull of all windows where the index varies in a box."""
    array, sizes = inputs[0], step.params["slice_sizes"]
    ends = []
    for start, n, size in zip(inputs[1:], array.shape, sizes, strict=True):
        start = as_whole(start)
        ends.append((np.clip(start.low, 0, n - size), np.clip(start.high, 0, n - size)))
    ranges = [range(int(low.min()), int(high.max()) + 1) for low, high in ends]
    if np.prod([len(each) for each in ranges]) > WINDOWS:
        raise NotImplementedError(f"an index of more than {WINDOWS} values in a box")
    result: Value | None = None
    for cell in itertools.product(*ranges):
        window = tuple(slice(i, i + size) for i, size in zip(cell, sizes, strict=True))
        part = array.moved(lambda a, lead, window=window: a[(..., *window)])
        certain, possible = np.ones(1, bool), np.ones(1, bool)
        for i, (low, high) in zip(cell, ends, strict=True):
            certain = certain & (low == i) & (high == i)
            possible = possible & (low <= i) & (i <= high)
        # A box in which the first window is out of reach has another one for certain.
        which = Whole(certain.astype(np.int64), possible.astype(np.int64), np.dtype(bool))
        result = part if result is None else select(of_rank(which, part), [result, part])
    assert result is not None
    return [result]


_MOVED = {"gather": (0,), "dynamic_update_slice": (0, 1), "scatter": (0, 2), "pad": (0, 1)}
"""Operands whose elements are moved; the others are indices, and what stands where nothing is."""


@rule(*_MOVED)
def _by_index(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    """Apply a step that only moves elements to the numbers of the elements, and move them so."""
    arrays, start, flat = [], 0, []
    for number, value in enumerate(inputs):
        if number in _MOVED[step.primitive.name]:
            size = int(np.prod(value.shape, dtype=np.int64))
            arrays.append(np.arange(start, start + size, dtype=np.int32).reshape(value.shape))
            start += size
            flat.append(value.moved(lambda a, lead: a.reshape(*a.shape[:lead], -1)))
        elif (common := as_whole(value).common) is not None:
            arrays.append(common)
        else:
            raise NotImplementedError("indices that depend on the features")
    params = dict(step.params)
    if "fill_value" in params:
        params["fill_value"] = -1
    positions = np.asarray(step.primitive.bind(*map(jnp.asarray, arrays), **params))
    if (positions < 0).any():
        raise NotImplementedError("an index outside of its array")
    whole = together(flat, lambda arrays, lead: np.concatenate(arrays, lead))
    return [whole.moved(lambda array, lead: array[..., positions])]


# Sums, products, extremes


@rule("reduce_sum")
def _sum(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    return [_total(inputs[0], step.params["axes"])]


def _total(value: Value, axes: Sequence[int]) -> Value:
    return total(value, axes) if isinstance(value, Form) else whole.total(value, axes)


def _times_each(a: Value, b: Value) -> Value:
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
        value = functools.reduce(_times_each, _rows(value, axis) or [one])
    return [value]


def _rows(value: Value, axis: int) -> list[Value]:
    return [
        value.moved(lambda array, lead, i=i: array.take(i, axis + lead))
        for i in range(value.shape[axis])
    ]


_ACCUMULATED: dict[str, Callable[[Any, Any], Value]] = {
    "cumprod": _times_each, "cummax": functions.greater, "cummin": functions.lesser,
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
        sums = [_total(together(rows[: i + 1], np.stack), (0,)) for i in range(len(rows))]
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


@rule("dot_general")
def _dot(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    (contracted, batched), (a, b) = step.params["dimension_numbers"], inputs
    dtype = np.dtype(step.outvars[0].aval.dtype)
    letters = iter("abcdefghijklmnopqrstuvw")
    joint = [next(letters) for _ in batched[0]], [next(letters) for _ in contracted[0]]
    names: list[str] = []
    for value, outer, inner in zip((a, b), batched, contracted, strict=True):
        known = dict(zip((*outer, *inner), (*joint[0], *joint[1]), strict=True))
        names.append("".join(known.get(i) or next(letters) for i in range(len(value.shape))))
    free = ["".join(c for c in name if c not in joint[0] + joint[1]) for name in names]
    result = "".join(joint[0]) + free[0] + free[1]
    for form, other, (own, its) in ((a, b, names), (b, a, names[::-1])):
        if isinstance(form, Whole) or isinstance(other, Whole):
            continue
        if is_point(other) and np.isfinite(other.centre).all():
            text = f"...{own},{its}->...{result}"
            terms = int(np.prod([form.shape[own.index(c)] for c in joint[1]], dtype=np.int64))
            few = np.prod(step.outvars[0].aval.shape, dtype=np.int64) < FEW
            if not few and len(form.shape) == 1:
                form = of_layer(form, t.features)
            sums = _times(form, other.centre[0], text, dtype, terms)
            return [sums.unframed(lambda frame: not frame.of_layer) if few else sums]
    axes = result + "".join(joint[1])

    def spread(name: str, array: np.ndarray, lead: int) -> np.ndarray:
        order = sorted(range(len(name)), key=lambda i: axes.index(name[i]))
        sizes = {name[i]: array.shape[lead + i] for i in range(len(name))}
        array = array.transpose(*range(lead), *(lead + i for i in order))
        return array.reshape(*array.shape[:lead], *(sizes.get(c, 1) for c in axes))

    a, b = (
        value.moved(functools.partial(spread, name))
        for value, name in zip((a, b), names, strict=True)
    )
    if isinstance(a, Whole) and isinstance(b, Whole):
        a, b = (Whole(each.low, each.high, dtype) for each in (a, b))
    return [_total(_times_each(a, b), range(len(result), len(axes)))]


def _times(a: Form, numbers: np.ndarray, names: str, dtype: np.dtype, terms: int) -> Form:
    """Return sums of so many products of a form and exact numbers, as einsum names them."""
    times = functools.partial(np.einsum, names, optimize=["einsum_path", (0, 1)])
    slopes = None if a.slopes is None else times(a.slopes, numbers)
    size = np.abs(numbers)
    return rounded(
        times(a.centre, numbers), slopes, times(a.radius, size), times(a.size, size), dtype,
        None, a.frame, units=terms + 1.0,
    )  # fmt: skip
