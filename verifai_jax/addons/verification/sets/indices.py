"""Reading and writing at indices, on sets: one result for each index that a box contains.

An index that is the same for all boxes only moves elements. One that varies within a box gives the
hull of what each of its values gives, so a table of constants has the bounds of the cells in reach.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from verifai_jax.addons.verification.sets import whole
from verifai_jax.addons.verification.sets.arrays import together
from verifai_jax.addons.verification.sets.elementwise import select
from verifai_jax.addons.verification.sets.form import Form, add
from verifai_jax.addons.verification.sets.interpreter import Equation, Interpreter, rule
from verifai_jax.addons.verification.sets.values import Value, as_form, as_whole, constant
from verifai_jax.addons.verification.sets.whole import Whole

WINDOWS = 1024
"""Positions of an array that an index may have in the boxes of a batch."""
_MOVED = {
    "dynamic_slice": (0,), "gather": (0,), "dynamic_update_slice": (0, 1), "scatter": (0, 2),
    "scatter-add": (0, 2), "pad": (0, 1),
}  # fmt: skip
"""Operands whose elements are moved; the others are indices."""
_WRITING = frozenset({"dynamic_update_slice", "scatter", "scatter-add"})


class _Cell(NamedTuple):
    """One value of all indices: the arrays, and which boxes and rows may have it, or surely do."""

    indices: list[np.ndarray]
    possible: np.ndarray
    certain: np.ndarray


@rule(*_MOVED)
def _by_index(t: Interpreter, step: Equation, inputs: list[Value]) -> list[Value]:
    """Apply a step that only moves elements to the numbers of the elements, and move them so."""
    name = step.primitive.name
    values = [inputs[i] for i in _MOVED[name]]
    indices = [as_whole(v) for i, v in enumerate(inputs) if i not in _MOVED[name]]
    if name == "scatter-add":
        indices = _apart(step, indices, inputs)
        values = [constant(np.zeros(inputs[0].shape), inputs[0].dtype), inputs[2]]
    indices, outside = _within(step, indices, inputs)
    rows = indices[0].shape[:-1] if name in ("gather", "scatter", "scatter-add") else ()
    flat = together(
        [value.moved(lambda a, lead: a.reshape(*a.shape[:lead], -1)) for value in values],
        lambda arrays, lead: np.concatenate(arrays, lead),
    )
    numbers, start = list[np.ndarray](), 0
    for value in values:
        size = int(np.prod(value.shape, dtype=np.int64))
        numbers.append(np.arange(start, start + size, dtype=np.int32).reshape(value.shape))
        start += size
    if name in _WRITING and int(np.prod(rows)) > 1 and any(v.common is None for v in indices):
        raise NotImplementedError("several indices that depend on the features")
    result, begun = None, np.zeros(1, bool)
    for cell in _cells(indices, rows):
        positions = _positions(step, numbers, cell.indices)
        part = flat.moved(lambda array, lead, positions=positions: array[..., positions])
        possible, certain = (_spread(step, each, part) for each in cell[1:])
        if result is None:
            result, begun = part, possible
            continue
        # The first position in reach of a box is not joined with those that are out of reach.
        sure = certain | (possible & ~begun)
        which = Whole(sure.astype(np.int64), possible.astype(np.int64), np.dtype(bool))
        result, begun = select(which, [result, part]), begun | possible
    assert result is not None
    if name == "gather" and outside.any():
        result = _forgotten(result, _spread(step, outside, result))
    if name == "scatter-add":
        before = inputs[0]
        if isinstance(before, Form):
            return [add(before, as_form(result))]
        return [whole.OPERATIONS["add"](before, as_whole(result))]
    return [result]


def _cells(indices: Sequence[Whole], rows: tuple[int, ...]) -> Iterator[_Cell]:
    """Return all values of the indices that some box may have."""
    if not indices:
        yield _Cell([], np.ones((1, *rows), bool), np.ones((1, *rows), bool))
        return
    # One axis of components: of several indices of a slice, or the last one of an array of them.
    low, high = (
        np.stack(np.broadcast_arrays(*(getattr(v, end) for v in indices)), -1)
        if len(indices) > 1 or not indices[0].shape else getattr(indices[0], end)
        for end in ("low", "high")
    )  # fmt: skip
    first, last = low.min(0), high.max(0)
    spans = (last - first).reshape(-1, low.shape[-1]).max(0, initial=0)
    if np.prod(spans + 1.0) > WINDOWS:
        raise NotImplementedError(f"an index of more than {WINDOWS} values in a box")
    for offset in itertools.product(*(range(int(span) + 1) for span in spans)):
        at = first + np.array(offset, np.int64)
        possible = ((low <= at) & (at <= high)).all(-1)
        if not possible.any():
            continue
        certain = ((low == at) & (at == high)).all(-1)
        at = np.minimum(at, last)
        apart = len(indices) > 1 or not indices[0].shape
        arrays = [at[..., i] for i in range(len(indices))] if apart else [at]
        yield _Cell([np.asarray(each, np.int32) for each in arrays], possible, certain)


def _positions(step: Equation, numbers: list[np.ndarray], indices: list[np.ndarray]) -> np.ndarray:
    """Return the numbers of the elements that stand in the result."""
    operands: list[np.ndarray] = [numbers[0], *indices, *numbers[1:]]
    params = dict(step.params)
    match step.primitive.name:
        case "dynamic_update_slice" | "pad":
            operands = [*numbers, *indices]
        case "gather":
            params["fill_value"] = -1
        case "scatter-add":
            form = params["dimension_numbers"], params["mode"]
            into, at, new = map(jnp.asarray, operands)
            return np.asarray(lax.scatter(into, at, new, form[0], mode=form[1]))
    return np.asarray(step.primitive.bind(*map(jnp.asarray, operands), **params))


def _spread(step: Equation, mask: np.ndarray, result: Value) -> np.ndarray:
    """Return a mask of boxes and rows of indices, with the axes of the result."""
    if step.primitive.name != "gather":
        mask = np.asarray(mask.reshape(len(mask), -1).all(1))
        return mask.reshape(len(mask), *(1,) * len(result.shape))
    offsets = step.params["dimension_numbers"].offset_dims
    sizes = iter(mask.shape[1:])
    shape = [1 if i in offsets else next(sizes) for i in range(len(result.shape))]
    return mask.reshape(len(mask), *shape)


def _forgotten(value: Value, where: np.ndarray) -> Value:
    """Return a set that is anything at some numbers: what XLA fills in is NaN, or an extreme."""
    shape = np.broadcast_shapes(where.shape, (1, *value.shape))
    if isinstance(value, Form):
        shape = np.broadcast_shapes(shape, value.radius.shape)
        form = value.moved(lambda array, lead: array)
        form.forget(np.broadcast_to(where, shape))
        return form
    lower, upper = whole.limits(value.dtype)
    low, high = np.where(where, lower, value.low), np.where(where, upper, value.high)
    return Whole(low, high, value.dtype)


def _within(
    step: Equation, indices: list[Whole], inputs: list[Value]
) -> tuple[list[Whole], np.ndarray]:
    """Return indices as XLA clips them, and where one that is not clipped may be outside."""
    params, name, shape = step.params, step.primitive.name, inputs[0].shape
    if name in ("dynamic_slice", "dynamic_update_slice"):
        sizes = params["slice_sizes"] if name == "dynamic_slice" else inputs[1].shape
        limits = [n - size for n, size in zip(shape, sizes, strict=True)]
        pairs = zip(indices, limits, strict=True)
        return [_clipped(each, 0, limit) for each, limit in pairs], np.zeros(1, bool)
    if name == "pad":
        return [], np.zeros(1, bool)
    (index,), numbers, mode = indices, params["dimension_numbers"], params["mode"]
    if name == "gather":
        axes, sizes = numbers.start_index_map, params["slice_sizes"]
    else:
        axes, sizes = numbers.scatter_dims_to_operand_dims, _window(numbers, shape, inputs[2].shape)
    limits = np.array([shape[axis] - sizes[axis] for axis in axes], np.int64)
    outside = np.asarray(((index.low < 0) | (index.high > limits)).any(-1))
    kinds = lax.GatherScatterMode
    if mode not in (kinds.CLIP, kinds.FILL_OR_DROP, kinds.PROMISE_IN_BOUNDS):
        raise NotImplementedError(f"indices of mode {mode}")
    if name != "gather" and mode == kinds.PROMISE_IN_BOUNDS and outside.any():
        raise NotImplementedError("an index that may be outside of its array")
    if name != "gather" and mode == kinds.FILL_OR_DROP:
        # Just outside is as far as any: nothing is written.
        return [_clipped(index, -1, limits + 1)], outside
    return [_clipped(index, 0, limits)], outside & np.array(mode == kinds.FILL_OR_DROP)


def _clipped(index: Whole, low: int, high: int | np.ndarray) -> Whole:
    ends = np.clip(index.low, low, high), np.clip(index.high, low, high)
    return Whole(*ends, np.dtype(np.int64))


def _window(numbers: lax.ScatterDimensionNumbers, shape: Sequence[int], of: Sequence[int]) -> list:
    """Return the size of the window that each row of updates fills, along each axis."""
    single = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
    sizes = iter([of[axis] for axis in numbers.update_window_dims])
    return [1 if axis in single else next(sizes) for axis in range(len(shape))]


def _apart(step: Equation, indices: list[Whole], inputs: list[Value]) -> list[Whole]:
    """Return indices of an addition, of which no two are added to one number."""
    (index,), form = indices, step.params["dimension_numbers"]
    if int(np.prod(index.shape[:-1])) > 1:
        if index.common is None:
            raise NotImplementedError("several indices that depend on the features")
        ones = jnp.ones(inputs[2].shape, jnp.int32)
        counts = lax.scatter_add(
            jnp.zeros(inputs[0].shape, jnp.int32), jnp.asarray(index.common), ones, form,
            mode=step.params["mode"],
        )  # fmt: skip
        if int(counts.max()) > 1:
            raise NotImplementedError("several additions to one number of an array")
    return indices
