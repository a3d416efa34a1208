"""Sums, products and the like over the elements of arrays, and matrix products."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from verifai_jax.addons.native.native_code.translation import SINGLE, Translator, rule
from verifai_jax.addons.native.native_code.values import (
    Element,
    Elements,
    Equation,
    Memory,
    Untranslatable,
    Value,
    constant,
    elements,
    filled,
    kind_of,
)

SIDE_BY_SIDE = 4
"""Sums that a loop makes at the same time, since each addition waits for the one before."""
PRODUCTS = 512
"""Products up to which a matrix product is written out: more make a compiler slow."""
SIDE = 8
"""Rows of a matrix that a loop multiplies at the same time."""
_JOINED = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
    "reduce_xor": "xor",
}


@rule(*_JOINED)
def _reduce(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    value, axes = inputs[0], tuple(sorted(step.params["axes"]))
    name, form = _JOINED[step.primitive.name], step.outvars[0].aval
    kind = kind_of(form.dtype)
    if isinstance(value, Memory) and value.size > SINGLE >= math.prod(form.shape):
        ndim = len(value.shape)
        count = value.size // max(math.prod(form.shape), 1)
        many = count > SIDE_BY_SIDE
        if many and axes == tuple(range(ndim - len(axes), ndim)):
            return [_in_loops(t, name, value, form.shape, count, count, 1)]
        if many and axes == tuple(range(len(axes))):
            return [_in_loops(t, name, value, form.shape, count, 1, value.size // count)]
    array = elements(value)
    rest = [axis for axis in range(array.ndim) if axis not in axes]
    rows = array.transpose(*rest, *axes).reshape(*form.shape, -1)
    out = np.empty(form.shape, object)
    neutral = {"add": 0, "mul": 1, "and": True, "or": False, "xor": False}
    for cell in np.ndindex(form.shape):
        parts = list(rows[cell])
        if not parts:
            if name not in neutral:
                raise Untranslatable(f"{step.primitive.name} of nothing")
            parts = [constant(neutral[name], kind)]
        out[cell] = joined(t, name, parts, kind)
    return [out]


def _in_loops(
    t: Translator, name: str, value: Memory, shape: tuple[int, ...], count: int, one: int, by: int
) -> Elements:
    """Join `count` elements that are `by` apart, from each of those that are `one` apart."""
    out = np.empty(math.prod(shape), object)
    for number in range(len(out)):
        first = number * one
        parts = [t.code.fresh(value.kind, value.uniform) for _ in range(SIDE_BY_SIDE)]
        i = t.code.name("i")
        lines = []
        for j, part in enumerate(parts):
            lines.append(f"{part.text} = {value.at(first + j * by)};")
        lines.append(f"for (int {i} = {SIDE_BY_SIDE}; {i} < {count}; {i} += {SIDE_BY_SIDE}) {{")
        for j, part in enumerate(parts):
            at = Element(value.at(f"{first} + ({i} + {j}) * {by}"), value.kind, value.uniform)
            line = f"{part.text} = {t.text(name, {}, [part, at], value.kind)};"
            lines.append(line if j == 0 else f"if ({i} + {j} < {count}) {line}")
        t.line(" ".join([*lines, "}"]), value.uniform)
        out[number] = joined(t, name, parts, value.kind)
    return out.reshape(shape)


def joined(t: Translator, name: str, parts: list[Element], kind: str) -> Element:
    """Combine numbers by an operation, recursively by halves."""
    while len(parts) > 1:
        half = [t.compute(name, {}, parts[i : i + 2], kind) for i in range(0, len(parts) - 1, 2)]
        parts = half + parts[len(parts) // 2 * 2 :]
    return parts[0]


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulative(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    names = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
    name, axis = names[step.primitive.name], step.params["axis"]
    kind = kind_of(step.outvars[0].aval.dtype)
    rows = np.moveaxis(elements(inputs[0]), axis, 0).copy()
    order = range(len(rows))[:: -1 if step.params["reverse"] else 1]
    for before, i in itertools.pairwise(order):
        for cell in np.ndindex(rows.shape[1:]):
            pair = [rows[(before, *cell)], rows[(i, *cell)]]
            rows[(i, *cell)] = t.compute(name, {}, pair, kind)
    return [np.moveaxis(rows, 0, axis)]


@rule("argmax", "argmin")
def _arg(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    (axis,) = step.params["axes"]
    rows = np.moveaxis(elements(inputs[0]), axis, 0)
    kind, better = (
        kind_of(step.params["index_dtype"]),
        "gt" if "max" in step.primitive.name else "lt",
    )
    out = np.empty(rows.shape[1:], object)
    for cell in np.ndindex(out.shape):
        best, at = rows[(0, *cell)], constant(0, kind)
        for i in range(1, len(rows)):
            other = rows[(i, *cell)]
            wins = t.compute(better, {}, [other, best], "b")
            if other.kind == "f":
                # The first NaN wins.
                missing = t.compute("ne", {}, [other, other], "b")
                good = t.compute("eq", {}, [best, best], "b")
                new = t.compute("and", {}, [missing, good], "b")
                wins = t.compute("or", {}, [wins, new], "b")
                wins = t.compute("and", {}, [wins, good], "b")
            best = t.compute("select_n", {}, [wins, best, other], other.kind)
            at = t.compute("select_n", {}, [wins, at, constant(i, kind)], kind)
        out[cell] = at
    return [out]


@rule("dot_general")
def _dot(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    (left_sum, right_sum), (left_batch, right_batch) = step.params["dimension_numbers"]
    form = step.outvars[0].aval
    if kind_of(form.dtype) != "f" or any(_kind(v) != "f" for v in inputs):
        raise Untranslatable("a matrix product of whole numbers")

    def arranged(
        value: Value, batch: Sequence[int], summed: Sequence[int]
    ) -> tuple[Value, tuple[int, ...]]:
        ndim = len(value.shape)
        free = [axis for axis in range(ndim) if axis not in (*batch, *summed)]
        order = [*batch, *free, *summed]
        count = [int(np.prod([value.shape[a] for a in axes])) for axes in (batch, free, summed)]
        if order == list(range(ndim)) and isinstance(value, Memory):
            return value._replace(shape=tuple(count)), tuple(count)
        if isinstance(value, Memory) and value.values is not None:
            return t.constant(value.values.transpose(order).reshape(count)), tuple(count)
        return elements(value).transpose(order).reshape(count), tuple(count)

    left, (batches, rows, summed) = arranged(inputs[0], left_batch, left_sum)
    right, (_, columns, _) = arranged(inputs[1], right_batch, right_sum)
    if batches * rows * columns * summed == 0:
        return [filled(form.shape, constant(0, "f"))]
    if batches * rows * columns * summed <= PRODUCTS:
        one, other = (
            # What is used more than once is not computed more than once.
            elements(t.in_memory(v) if isinstance(v, Memory) and uses > 1 else v)
            for v, uses in ((left, columns), (right, rows))
        )
        out = np.empty((batches, rows, columns), object)
        for b, i, j in np.ndindex(out.shape):
            terms = zip(one[b, i], other[b, j], strict=True)
            text = " + ".join(f"{x.text} * {y.text}" for x, y in terms)
            uniform = all(e.uniform for e in (*one[b, i], *other[b, j]))
            out[b, i, j] = t.code.define(text, "f", uniform)
        return [out.reshape(form.shape)]
    return [_large_dot(t, left, right, (batches, rows, columns, summed), form.shape)]


def _kind(value: Value) -> str:
    if isinstance(value, Memory):
        return value.kind
    return value.flat[0].kind if value.size else "f"


def _large_dot(
    t: Translator, left: Value, right: Value, sizes: tuple[int, ...], shape: tuple[int, ...]
) -> Memory:
    """Multiply two matrices in a loop, eight results of two vectors at a time.

    Each number that is read then serves several products, as many as there are registers for.
    """
    a, b = t.in_memory(left), t.in_memory(right)
    batches, rows, columns, summed = sizes
    uniform = a.uniform and b.uniform
    out = t.code.memory(shape, "f", uniform)
    swapped = rows > columns
    outer, inner, many, few = (a, b, rows, columns) if swapped else (b, a, columns, rows)
    n, i, o, s = (t.code.name("i") for _ in range(4))
    form = "float" if uniform else "F"
    second = lambda text: text.replace("[k]", "[k + PAIR - 1]")  # noqa: E731
    lines = [f"for (int {n} = 0; {n} < {batches}; {n}++)"]
    lines.append(f"for (int {i} = 0; {i} < {few}; {i}++) {{")
    whole = many // SIDE * SIDE
    for begin, end, size in ((0, whole, SIDE), (whole, many, 1)):
        if begin == end:
            continue
        lines.append(f"for (int {o} = {begin}; {o} < {end}; {o} += {size}) {{ {form} y, z, ")
        lines.append(", ".join(f"x{j} = {form}(), z{j} = x{j}" for j in range(size)) + ";")
        each = inner.at(f"(({n} * {few} + {i}) * {summed} + {s})")
        lines.append(f"for (int {s} = 0; {s} < {summed}; {s}++) {{ y = {each}; z = {second(each)};")
        for j in range(size):
            other = outer.at(f"(({n} * {many} + {o} + {j}) * {summed} + {s})")
            lines.append(f"x{j} += {other} * y; if (PAIR > 1) z{j} += {second(other)} * z;")
        lines.append("}")
        for j in range(size):
            row, column = (f"({o} + {j})", i) if swapped else (i, f"{o} + {j}")
            cell = out.at(f"(({n} * {rows} + {row}) * {columns} + {column})")
            lines.append(f"{cell} = x{j}; if (PAIR > 1) {second(cell)} = z{j};")
        lines.append("}")
    lines.append("}")
    if uniform:
        t.line(" ".join(["{ const int PAIR = 1;", *lines, "}"]), True)
    else:
        t.code.control(" ".join(["for (int k = 0; k < K; k += PAIR) {", *lines, "}"]))
    return out
