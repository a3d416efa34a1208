"""Elements of arrays by numbers that a simulation computes."""

from collections.abc import Sequence

import numpy as np

from verifai_jax.addons.native.native_code.translation import Translator, rule
from verifai_jax.addons.native.native_code.values import (
    Element,
    Elements,
    Equation,
    Memory,
    Untranslatable,
    Value,
    constant,
    elements,
    kind_of,
)

CHAIN = 16
"""Elements of an array up to which one of them is found by comparing its number."""


def _bounded(t: Translator, index: Element, highest: int) -> Element:
    low, high = constant(0, index.kind), constant(highest, index.kind)
    return t.compute("clamp", {}, [low, index, high], index.kind)


def element_at(
    t: Translator, array: Value, strides: Sequence[int], index: Sequence[Element], base: int
) -> Element:
    """Return the element of a flat array at `base` plus the sum of numbers times strides."""
    fixed = base + sum(
        int(i.value) * s for i, s in zip(index, strides, strict=True) if i.value is not None
    )
    moving = [
        (t.compute("convert_element_type", {}, [i], "i"), s)
        for i, s in zip(index, strides, strict=True)
        if i.value is None
    ]
    if not moving:
        return elements(array).ravel()[fixed]
    if len(moving) == 1 and not moving[0][0].uniform and array.size <= CHAIN:
        one, stride = moving[0]
        if not is_table(array):
            return _chosen(t, elements(array).ravel()[fixed::stride], one)
    memory = t.in_memory(array)
    cell = " + ".join([str(fixed), *(f"{i.text} * {s}" for i, s in moving)])
    if all(i.uniform for i, _ in moving):
        return t.code.define(memory.at(f"({cell})"), memory.kind, memory.uniform)
    vector = t.code.define(cell, "i", False)
    begin = f"{memory.name} + {memory.offset}" if memory.offset else memory.name
    size = str(memory.size) if memory.uniform else "k"
    return t.code.define(f"looked_up({begin}, {size}, {vector.text})", memory.kind, False)


def is_table(value: Value) -> bool:
    """Return whether a value consists of constants."""
    if isinstance(value, Memory):
        return value.uniform
    return all(each.value is not None for each in value.ravel())


def _chosen(t: Translator, options: Elements, index: Element) -> Element:
    """Return one of a few elements, by a number for each simulation."""
    result = options[0]
    for i, option in enumerate(options[1:], 1):
        here = t.compute("eq", {}, [index, constant(i, "i")], "b")
        result = t.compute("select_n", {}, [here, result, option], option.kind)
    return result


@rule("dynamic_slice")
def _dynamic_slice(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    array, sizes = inputs[0], step.params["slice_sizes"]
    starts = [
        _bounded(t, elements(v).item(), n - size)
        for v, n, size in zip(inputs[1:], array.shape, sizes, strict=True)
    ]
    return [_window(t, array, starts, sizes)]


def _strides(shape: Sequence[int]) -> list[int]:
    return [int(np.prod(shape[i + 1 :], dtype=np.int64)) for i in range(len(shape))]


def _window(t: Translator, array: Value, starts: list[Element], sizes: Sequence[int]) -> Elements:
    strides = _strides(array.shape)
    out = np.empty(sizes, object)
    if array.size > CHAIN and any(start.value is None for start in starts):
        array = t.in_memory(array)
    for cell in np.ndindex(out.shape):
        base = sum(i * s for i, s in zip(cell, strides, strict=True))
        out[cell] = element_at(t, array, strides, starts, base)
    return out


@rule("dynamic_update_slice")
def _dynamic_update_slice(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    array, update = elements(inputs[0]), elements(inputs[1])
    kind = kind_of(step.outvars[0].aval.dtype)
    starts = [
        _bounded(t, elements(v).item(), n - size)
        for v, n, size in zip(inputs[2:], array.shape, update.shape, strict=True)
    ]
    out: Elements = np.array(array)
    for cell in np.ndindex(array.shape):
        for inside in np.ndindex(update.shape):
            hits = constant(True, "b")
            for start, here, i in zip(starts, cell, inside, strict=True):
                if here < i:
                    hits = constant(False, "b")
                    break
                equal = t.compute("eq", {}, [start, constant(here - i, start.kind)], "b")
                hits = t.compute("and", {}, [hits, equal], "b")
            if hits.value is None or hits.value:
                out[cell] = t.compute("select_n", {}, [hits, out[cell], update[inside]], kind)
    return [out]


@rule("gather")
def _gather(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    array, indices = inputs[0], elements(inputs[1])
    numbers, sizes = step.params["dimension_numbers"], step.params["slice_sizes"]
    mode = str(step.params["mode"])
    batched = tuple(getattr(numbers, "operand_batching_dims", ()))
    if batched:
        raise Untranslatable("a gather in batches")
    shape, strides = step.outvars[0].aval.shape, _strides(array.shape)
    kind = kind_of(step.outvars[0].aval.dtype)
    kept = [axis for axis in range(len(array.shape)) if axis not in numbers.collapsed_slice_dims]
    out = np.empty(shape, object)
    rows: dict[tuple[int, ...], tuple[list[Element], Element]] = {}
    if array.size > CHAIN and any(each.value is None for each in indices.ravel()):
        array = t.in_memory(array)
    for cell in np.ndindex(shape):
        batch = tuple(i for axis, i in enumerate(cell) if axis not in numbers.offset_dims)
        offset = [cell[axis] for axis in numbers.offset_dims]
        if batch not in rows:
            starts: list[Element] = [constant(0, "i")] * len(array.shape)
            inside = constant(True, "b")
            for axis, index in zip(numbers.start_index_map, indices[batch], strict=True):
                bounded = _bounded(t, index, array.shape[axis] - sizes[axis])
                if "FILL" in mode:
                    here = t.compute("eq", {}, [bounded, index], "b")
                    inside = t.compute("and", {}, [inside, here], "b")
                starts[axis] = bounded
            rows[batch] = (starts, inside)
        starts, inside = rows[batch]
        base = sum(i * strides[axis] for i, axis in zip(offset, kept, strict=True))
        value = element_at(t, array, strides, starts, base)
        if inside.value is None or not inside.value:
            filler = step.params.get("fill_value")
            if filler is None:
                filler = {"f": np.nan, "i": -(2**31), "u": 2**32 - 1, "b": True}[kind]
            value = t.compute("select_n", {}, [inside, constant(filler, kind), value], kind)
        out[cell] = value
    return [out]


_SCATTERED = {"add": "add", "mul": "mul", "min": "min", "max": "max", "sub": "sub", "": ""}


@rule("scatter", "scatter-add", "scatter_add", "scatter-mul", "scatter_mul", "scatter-sub",
      "scatter_min", "scatter_max", "scatter-min", "scatter-max")  # fmt: skip
def _scatter(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    array, indices, updates = (elements(value) for value in inputs)
    numbers, mode = step.params["dimension_numbers"], str(step.params["mode"])
    kind = kind_of(step.outvars[0].aval.dtype)
    joins = step.primitive.name.replace("-", "_").removeprefix("scatter").removeprefix("_")
    if tuple(getattr(numbers, "operand_batching_dims", ())):
        raise Untranslatable("a scatter in batches")
    windows = numbers.update_window_dims
    kept = [axis for axis in range(array.ndim) if axis not in numbers.inserted_window_dims]
    out: Elements = np.array(array)
    for cell in np.ndindex(updates.shape):
        batch = tuple(i for axis, i in enumerate(cell) if axis not in windows)
        offset = np.zeros(array.ndim, int)
        offset[kept] = [cell[axis] for axis in windows]
        size = np.ones(array.ndim, int)
        size[kept] = [updates.shape[axis] for axis in windows]
        starts: list[Element] = [constant(0, "i")] * array.ndim
        for axis, index in zip(numbers.scatter_dims_to_operand_dims, indices[batch], strict=True):
            starts[axis] = index
            if "CLIP" in mode:
                starts[axis] = _bounded(t, index, array.shape[axis] - int(size[axis]))
        for target in np.ndindex(array.shape):
            begin = [int(a - o) for a, o in zip(target, offset, strict=True)]
            fits = zip(begin, array.shape, size, strict=True)
            if not all(0 <= b <= n - int(k) for b, n, k in fits):
                continue
            hits = constant(True, "b")
            for start, b in zip(starts, begin, strict=True):
                equal = t.compute("eq", {}, [start, constant(b, start.kind)], "b")
                hits = t.compute("and", {}, [hits, equal], "b")
            if hits.value is None or hits.value:
                old, new = out[target], updates[cell]
                new = t.compute(_SCATTERED[joins], {}, [old, new], kind) if joins else new
                out[target] = t.compute("select_n", {}, [hits, old, new], kind)
    return [out]
