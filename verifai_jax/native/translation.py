"""The translator: a program that JAX traced for one simulation, as code for blocks of them.

    source = translated(jaxpr, inputs)                  # C++, or `Untranslatable`

What moves elements of arrays is done here; only what computes with them becomes code. Small arrays
are single variables, large ones lie in memory and are computed in loops.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.extend.core
import numpy as np

from verifai_jax.native import elementary
from verifai_jax.native.code import Code
from verifai_jax.native.values import (
    DTYPES,
    KEY,
    Element,
    Elements,
    Memory,
    Untranslatable,
    Value,
    constant,
    elements,
    filled,
    kind_of,
    same,
)

SINGLE = 32
"""Elements of an array up to which each is a variable of its own."""
PRODUCTS = 512
"""Products up to which a matrix product is written out."""
CHAIN = 16
"""Elements of an array up to which one of them is found by comparing its number."""

Rule = Callable[["Translator", Any, list[Value]], list[Value]]
RULES: dict[str, Rule] = {}
"""How each primitive is translated that is not elementary."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Register a function for primitives of these names."""

    def register(function: Rule) -> Rule:
        for name in names:
            RULES[name] = function
        return function

    return register


class Translator:
    """Translates programs into the lines of `code`."""

    def __init__(self) -> None:
        self.code = Code()

    def program(self, program: Any, constants: Sequence[Any], inputs: Sequence[Value]) -> Any:
        """Translate the steps of a `Jaxpr`, and return its results.

        **Raises:** `Untranslatable` for a part that is unknown.
        """
        values: dict[Any, Value] = {}
        for variable, value in zip(program.constvars, constants, strict=True):
            values[variable] = self.constant(value)
        values.update(zip(program.invars, inputs, strict=True))

        def read(each: Any) -> Value:
            if isinstance(each, jax.extend.core.Literal):
                return self.constant(each.val, each.aval)
            return values[each]

        for step in program.eqns:
            results = self.step(step, [read(each) for each in step.invars])
            values.update(zip(step.outvars, results, strict=True))
        return [read(each) for each in program.outvars]

    def closed(self, program: Any, inputs: Sequence[Value]) -> list[Value]:
        """Translate a program with its constants, or one without."""
        inner = getattr(program, "jaxpr", program)
        return self.program(inner, getattr(program, "consts", ()), inputs)

    def step(self, step: Any, inputs: list[Value]) -> list[Value]:
        """Translate one step."""
        name = step.primitive.name
        if name in RULES:
            return RULES[name](self, step, inputs)
        out = step.outvars[0].aval
        return [self.elementwise(name, step.params, inputs, kind_of(out.dtype), out.shape)]

    def constant(self, value: Any, form: Any = None) -> Value:
        """Return a constant of a program."""
        kind = kind_of(jax.numpy.result_type(value) if form is None else form.dtype)
        if kind == KEY:
            raise Untranslatable("a random key that is a constant")
        array = np.asarray(value, DTYPES[kind])
        if array.size <= SINGLE:
            out = np.empty(array.shape, object)
            for place in np.ndindex(array.shape):
                out[place] = constant(array[place], kind)
            return out
        if np.all(array == array.ravel()[0]):
            return filled(array.shape, constant(array.ravel()[0], kind))
        return Memory(self.code.table(array, kind), kind, True, array.shape, values=array)

    def elementwise(
        self, name: str, params: Any, inputs: list[Value], kind: str, shape: tuple[int, ...]
    ) -> Value:
        """Apply an operation on single numbers to arrays of one shape, or single numbers."""
        if kind == KEY or any(self._is_key(value) for value in inputs):
            return self._of_keys(name, params, inputs, shape)
        size = int(np.prod(shape, dtype=np.int64))
        flat = [self._operand(value, size) for value in inputs]
        if all(isinstance(value, Element) for value in flat):
            return filled(shape, self.compute(name, params, flat, kind))
        if size <= SINGLE:
            arrays = [v if isinstance(v, Element) else elements(v).ravel() for v in flat]
            out = np.empty(size, object)
            for i in range(size):
                some = [v if isinstance(v, Element) else v[i] for v in arrays]
                out[i] = self.compute(name, params, some, kind)
            return out.reshape(shape)
        flat = [v if isinstance(v, Element) else self.in_memory(v) for v in flat]
        uniform = all(v.uniform for v in flat)
        result = self.code.memory(shape, kind, uniform)
        index = self.code.name("i")
        some = [
            v if isinstance(v, Element) else Element(v.at(index), v.kind, v.uniform) for v in flat
        ]
        text = self.text(name, params, some, kind)
        line = f"for (int {index} = 0; {index} < {size}; {index}++) {result.at(index)} = {text};"
        self.line(line, uniform)
        return result

    def line(self, text: str, uniform: bool = False) -> None:
        """Add a line of code."""
        piece = self.code.piece
        (piece.together if uniform else piece.each).append(text)

    def compute(self, name: str, params: Any, operands: list[Element], kind: str) -> Element:
        """Return the result of an operation on single numbers."""
        if all(each.value is not None for each in operands):
            folded = elementary.fold(name, kind, [each.value for each in operands], params)
            if folded is not None:
                return constant(folded, kind)
        if name == "and" and kind == "b" and any(e.value is not None for e in operands):
            known = next(i for i, e in enumerate(operands) if e.value is not None)
            return operands[1 - known] if operands[known].value else operands[known]
        if name == "select_n" and operands[0].value is not None:
            return operands[1 + int(operands[0].value)]
        if name in ("copy", "copy_p", "stop_gradient", "optimization_barrier"):
            return operands[0]
        if name == "convert_element_type" and operands[0].kind == kind:
            return operands[0]
        text = self.text(name, params, operands, kind)
        return self.code.define(text, kind, all(each.uniform for each in operands))

    def text(self, name: str, params: Any, operands: list[Element], kind: str) -> str:
        """Return the C expression of an operation on single numbers."""
        template, alike = elementary.expression(name, params, [e.kind for e in operands], kind)
        texts = [each.text for each in operands]
        mixed = len({each.uniform for each in operands}) > 1
        if name == "select_n" and operands[0].kind == "b" and operands[0].uniform:
            mixed = len({each.uniform for each in operands[1:]}) > 1
            texts[1:] = [f"wide({e.text})" if mixed and e.uniform else e.text for e in operands[1:]]
        elif alike and mixed:
            texts = [f"wide({e.text})" if e.uniform else e.text for e in operands]
        return template.format(*texts)

    def in_memory(self, value: Value) -> Memory:
        """Return a value as an array in memory, its elements one after another."""
        if isinstance(value, Memory):
            return value
        flat = value.ravel()
        kind = flat[0].kind
        if all(each.value is not None for each in flat):
            array = np.array([each.value for each in flat], DTYPES[kind]).reshape(value.shape)
            return Memory(self.code.table(array, kind), kind, True, value.shape, values=array)
        memory = self.code.memory(value.shape, kind, all(each.uniform for each in flat))
        for i, each in enumerate(flat):
            self.code.store(memory.at(i), each, memory.uniform)
        return memory

    def _operand(self, value: Value, size: int) -> "Element | Value":
        if isinstance(value, Memory):
            return elements(value).item() if value.shape == () else value
        one = same(value)
        if one is not None and (value.size == 1 or value.size == size):
            return one
        return value

    @staticmethod
    def _is_key(value: Value) -> bool:
        return (
            isinstance(value, np.ndarray)
            and value.size > 0
            and not isinstance(value.flat[0], Element)
        )

    def _of_keys(self, name: str, params: Any, inputs: list[Value], shape: Any) -> Value:
        """Apply an operation that only moves or chooses random keys, word by word."""
        if name not in ("select_n", "copy", "stop_gradient", "optimization_barrier"):
            raise Untranslatable(f"the operation {name} on random keys")
        words = []
        for word in (0, 1):
            parts = [words_of(v, word) if self._is_key(v) else v for v in inputs]
            words.append(elements(self.elementwise(name, params, parts, "u", shape)))
        return pairs(*words)


def words_of(keys: Elements, word: int) -> Elements:
    """Return the first or the second word of each random key."""
    out = np.empty(keys.shape, object)
    for place in np.ndindex(keys.shape):
        out[place] = keys[place][word]
    return out


def pairs(high: Elements, low: Elements) -> Elements:
    """Return the random keys of these words."""
    out = np.empty(high.shape, object)
    for place in np.ndindex(high.shape):
        out[place] = (high[place], low[place])
    return out


# Calls


@rule("jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint", "custom_lin")
def _call(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    return t.closed(step.params.get("jaxpr", step.params.get("call_jaxpr")), inputs)


@rule("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr", "custom_vmap_call")
def _custom(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    for name in ("call_jaxpr", "fun_jaxpr", "call"):
        if name in step.params:
            return t.closed(step.params[name], inputs)
    raise Untranslatable(f"the operation {step.primitive.name}")


@rule("optimization_barrier")
def _barrier(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    return inputs


# Arrays


def moved(*names: str) -> Callable[[Callable[[Any, Elements], Elements]], Any]:
    """Register a function of NumPy that moves the elements of one array."""

    def register(function: Callable[[Any, Elements], Elements]) -> Any:
        def apply(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
            return [function(step.params, elements(inputs[0]))]

        rule(*names)(apply)
        return function

    return register


@rule("reshape", "squeeze", "expand_dims")
def _reshape(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    shape = step.outvars[0].aval.shape
    if step.params.get("dimensions") is not None and step.primitive.name == "reshape":
        raise Untranslatable("a reshape that permutes")
    value = inputs[0]
    if isinstance(value, Memory):
        values = None if value.values is None else value.values.reshape(shape)
        return [value._replace(shape=shape, values=values)]
    return [value.reshape(shape)]


@moved("broadcast_in_dim")
def _broadcast(params: Any, array: Elements) -> Elements:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], array.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(array.reshape(shape), params["shape"])


@moved("transpose")
def _transpose(params: Any, array: Elements) -> Elements:
    return np.transpose(array, params["permutation"])


@moved("rev")
def _reverse(params: Any, array: Elements) -> Elements:
    return np.flip(array, params["dimensions"])


@moved("slice")
def _slice(params: Any, array: Elements) -> Elements:
    strides = params["strides"] or (1,) * array.ndim
    limits = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return array[tuple(slice(*each) for each in limits)]


@rule("concatenate")
def _concatenate(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    return [np.concatenate([elements(v) for v in inputs], step.params["dimension"])]


@rule("stack")
def _stack(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    return [np.stack([elements(v) for v in inputs], step.params["axis"])]


@rule("unstack", "split")
def _split(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    array, axis = elements(inputs[0]), step.params["axis"]
    if step.primitive.name == "unstack":
        return list(np.moveaxis(array, axis, 0))
    return np.split(array, np.cumsum(step.params["sizes"])[:-1], axis)


@rule("pad")
def _pad(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    array, filler = elements(inputs[0]), elements(inputs[1]).item()
    out = filled(step.outvars[0].aval.shape, filler)
    places = []
    for size, total, (low, _, inside) in zip(
        array.shape, out.shape, step.params["padding_config"], strict=True
    ):
        at = low + np.arange(size) * (inside + 1)
        places.append((at, (at >= 0) & (at < total)))
    kept = array[np.ix_(*[np.flatnonzero(good) for _, good in places])] if places else array
    out[np.ix_(*[at[good] for at, good in places])] = kept
    return [out]


@rule("iota")
def _iota(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    shape, axis = step.params["shape"], step.params["dimension"]
    kind = kind_of(step.params["dtype"])
    along = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return [t.constant(np.broadcast_to(along, shape).astype(DTYPES[kind]))]


@rule("split_key", "create_token")
def _unknown(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    raise Untranslatable(f"the operation {step.primitive.name}")


# Sums and the like

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
def _reduce(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    array, axes = elements(inputs[0]), tuple(step.params["axes"])
    name, form = _JOINED[step.primitive.name], step.outvars[0].aval
    kind = kind_of(form.dtype)
    rest = [axis for axis in range(array.ndim) if axis not in axes]
    rows = array.transpose(*rest, *axes).reshape(*form.shape, -1)
    out = np.empty(form.shape, object)
    neutral = {"add": 0, "mul": 1, "and": True, "or": False, "xor": False}
    for place in np.ndindex(form.shape):
        parts = list(rows[place])
        if not parts:
            if name not in neutral:
                raise Untranslatable(f"{step.primitive.name} of nothing")
            parts = [constant(neutral[name], kind)]
        out[place] = joined(t, name, parts, kind)
    return [out]


def joined(t: Translator, name: str, parts: list[Element], kind: str) -> Element:
    """Join numbers by an operation, the halves of them each on their own."""
    while len(parts) > 1:
        half = [t.compute(name, {}, parts[i : i + 2], kind) for i in range(0, len(parts) - 1, 2)]
        parts = half + parts[len(parts) // 2 * 2 :]
    return parts[0]


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulative(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    names = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
    name, axis = names[step.primitive.name], step.params["axis"]
    kind = kind_of(step.outvars[0].aval.dtype)
    rows = np.moveaxis(elements(inputs[0]), axis, 0).copy()
    order = range(len(rows))[:: -1 if step.params["reverse"] else 1]
    for before, i in zip(order, order[1:], strict=False):
        for place in np.ndindex(rows.shape[1:]):
            pair = [rows[before][place], rows[i][place]]
            rows[(i, *place)] = t.compute(name, {}, pair, kind)
    return [np.moveaxis(rows, 0, axis)]


@rule("argmax", "argmin")
def _arg(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    (axis,) = step.params["axes"]
    rows = np.moveaxis(elements(inputs[0]), axis, 0)
    kind, better = (
        kind_of(step.params["index_dtype"]),
        "gt" if "max" in step.primitive.name else "lt",
    )
    out = np.empty(rows.shape[1:], object)
    for place in np.ndindex(out.shape):
        best, at = rows[0][place], constant(0, kind)
        for i in range(1, len(rows)):
            other = rows[i][place]
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
        out[place] = at
    return [out]


@rule("dot_general")
def _dot(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    (left_sum, right_sum), (left_batch, right_batch) = step.params["dimension_numbers"]
    form = step.outvars[0].aval
    if kind_of(form.dtype) != "f" or any(_kind(v) != "f" for v in inputs):
        raise Untranslatable("a matrix product of whole numbers")

    def arranged(value: Value, batch: Any, summed: Any) -> tuple[Value, tuple[int, ...]]:
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
        one, other = elements(left), elements(right)
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
    """Multiply two matrices in a loop, eight results at a time."""
    a, b = t.in_memory(left), t.in_memory(right)
    batches, rows, columns, summed = sizes
    uniform = a.uniform and b.uniform
    out = t.code.memory(shape, "f", uniform)
    if rows > columns:
        outer, inner, counts, swapped = a, b, (rows, columns), True
    else:
        outer, inner, counts, swapped = b, a, (columns, rows), False
    form = "float" if uniform else "F"
    n, i, o, s = (t.code.name("i") for _ in range(4))
    many, few = counts
    at = lambda row, column: (  # noqa: E731
        f"({n} * {rows} + {row}) * {columns} + {column}"
    )
    width = 8
    lines = [f"for (int {n} = 0; {n} < {batches}; {n}++)"]
    lines.append(f"for (int {i} = 0; {i} < {few}; {i}++) {{")
    for begin, end, size in ((0, many // width * width, width), (many // width * width, many, 1)):
        if begin == end:
            continue
        lines.append(f"for (int {o} = {begin}; {o} < {end}; {o} += {size}) {{ {form} ")
        lines[-1] += ", ".join(f"x{j} = {form}()" for j in range(size)) + ";"
        lines.append(f"for (int {s} = 0; {s} < {summed}; {s}++) {{")
        each = inner.at(f"({n} * {few} + {i}) * {summed} + {s}")
        lines.append(f"{'float' if inner.uniform else 'F'} y = {each};")
        for j in range(size):
            other = outer.at(f"({n} * {many} + {o} + {j}) * {summed} + {s}")
            lines.append(f"x{j} += {other} * y;")
        lines.append("}")
        for j in range(size):
            place = at(f"{o} + {j}", i) if swapped else at(i, f"{o} + {j}")
            lines.append(f"{out.at(f'({place})')} = x{j};")
        lines.append("}")
    lines.append("}")
    t.line(" ".join(lines), uniform)
    return out


# Elements by their number


def _bounded(t: Translator, index: Element, highest: int) -> Element:
    low, high = constant(0, index.kind), constant(highest, index.kind)
    return t.compute("clamp", {}, [low, index, high], index.kind)


def element_at(
    t: Translator, array: Value, strides: Sequence[int], index: Any, base: int
) -> Element:
    """Return the element of a flat array at `base` plus the product of numbers and strides."""
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
    if not all(i.uniform for i, _ in moving) and len(moving) == 1 and array.size <= CHAIN:
        if not is_table(array):
            return _chosen(t, elements(array).ravel()[fixed :: moving[0][1]], moving[0][0])
    memory = t.in_memory(array)
    place = " + ".join([str(fixed), *(f"{i.text} * {s}" for i, s in moving)])
    if all(i.uniform for i, _ in moving):
        return t.code.define(memory.at(f"({place})"), memory.kind, memory.uniform)
    vector = t.code.define(place, "i", False)
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
def _dynamic_slice(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
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
    if any(start.value is None for start in starts):
        array = t.in_memory(array)
    for place in np.ndindex(out.shape):
        base = sum(i * s for i, s in zip(place, strides, strict=True))
        out[place] = element_at(t, array, strides, starts, base)
    return out


@rule("dynamic_update_slice")
def _dynamic_update_slice(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    array, update = elements(inputs[0]), elements(inputs[1])
    kind = kind_of(step.outvars[0].aval.dtype)
    starts = [
        _bounded(t, elements(v).item(), n - size)
        for v, n, size in zip(inputs[2:], array.shape, update.shape, strict=True)
    ]
    out = np.array(array)
    for place in np.ndindex(array.shape):
        for inside in np.ndindex(update.shape):
            hits = constant(True, "b")
            for start, here, i in zip(starts, place, inside, strict=True):
                if not 0 <= here - i:
                    hits = constant(False, "b")
                    break
                equal = t.compute("eq", {}, [start, constant(here - i, start.kind)], "b")
                hits = t.compute("and", {}, [hits, equal], "b")
            if hits.value is None or hits.value:
                out[place] = t.compute("select_n", {}, [hits, out[place], update[inside]], kind)
    return [out]


@rule("gather")
def _gather(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
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
    if not all(each.value is not None for each in indices.ravel()):
        array = t.in_memory(array)
    for place in np.ndindex(shape):
        batch = tuple(i for axis, i in enumerate(place) if axis not in numbers.offset_dims)
        offset = [place[axis] for axis in numbers.offset_dims]
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
        out[place] = value
    return [out]


_SCATTERED = {"add": "add", "mul": "mul", "min": "min", "max": "max", "sub": "sub", "": ""}


@rule("scatter", "scatter-add", "scatter_add", "scatter-mul", "scatter_mul", "scatter-sub",
      "scatter_min", "scatter_max", "scatter-min", "scatter-max")  # fmt: skip
def _scatter(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    array, indices, updates = (elements(value) for value in inputs)
    numbers, mode = step.params["dimension_numbers"], str(step.params["mode"])
    kind = kind_of(step.outvars[0].aval.dtype)
    joins = step.primitive.name.replace("-", "_").removeprefix("scatter").removeprefix("_")
    if tuple(getattr(numbers, "operand_batching_dims", ())):
        raise Untranslatable("a scatter in batches")
    windows = numbers.update_window_dims
    kept = [axis for axis in range(array.ndim) if axis not in numbers.inserted_window_dims]
    out = np.array(array)
    for place in np.ndindex(updates.shape):
        batch = tuple(i for axis, i in enumerate(place) if axis not in windows)
        offset = np.zeros(array.ndim, int)
        offset[kept] = [place[axis] for axis in windows]
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
                old, new = out[target], updates[place]
                new = t.compute(_SCATTERED[joins], {}, [old, new], kind) if joins else new
                out[target] = t.compute("select_n", {}, [hits, old, new], kind)
    return [out]


# Random numbers


@rule("random_wrap")
def _wrap(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    words = elements(inputs[0])
    return [pairs(words[..., 0], words[..., 1])]


@rule("random_unwrap")
def _unwrap(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    keys = elements(inputs[0])
    return [np.stack([words_of(keys, 0), words_of(keys, 1)], -1)]


@rule("random_seed")
def _seed(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    seeds = elements(t.elementwise("convert_element_type", {}, inputs, "u", inputs[0].shape))
    return [pairs(filled(seeds.shape, constant(0, "u")), seeds)]


@rule("random_fold_in")
def _fold_in(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    keys, data = elements(inputs[0]), inputs[1]
    words = elements(t.elementwise("convert_element_type", {}, [data], "u", data.shape))
    out = np.empty(keys.shape, object)
    for place in np.ndindex(keys.shape):
        out[place] = _encrypted(t, keys[place], constant(0, "u"), words[place])
    return [out]


@rule("random_split")
def _split_keys(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    return [_counted(t, elements(inputs[0]), step.params["shape"])]


@rule("random_bits")
def _bits(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    if step.params["bit_width"] != 32:
        raise Untranslatable("random bits of another width than 32")
    keys = _counted(t, elements(inputs[0]), step.params["shape"])
    out = np.empty(keys.shape, object)
    for place in np.ndindex(keys.shape):
        out[place] = t.compute("xor", {}, list(keys[place]), "u")
    return [out]


@rule("threefry2x32")
def _threefry(t: Translator, step: Any, inputs: list[Value]) -> list[Value]:
    shape = step.outvars[0].aval.shape
    a, b, x, y = (np.broadcast_to(elements(v), shape) for v in inputs)
    out = np.empty(shape, object)
    for place in np.ndindex(shape):
        out[place] = _encrypted(t, (a[place], b[place]), x[place], y[place])
    return [words_of(out, 0), words_of(out, 1)]


def _counted(t: Translator, keys: Elements, shape: Sequence[int]) -> Elements:
    if not jax.config.read("jax_threefry_partitionable"):
        raise Untranslatable("random keys with jax_threefry_partitionable=False")
    count = int(np.prod(shape, dtype=np.int64))
    out = np.empty((*keys.shape, count), object)
    for place in np.ndindex(keys.shape):
        for i in range(count):
            out[(*place, i)] = _encrypted(t, keys[place], constant(0, "u"), constant(i, "u"))
    return out.reshape(*keys.shape, *shape)


def _encrypted(t: Translator, key: Any, x: Element, y: Element) -> tuple[Element, Element]:
    operands = [*key, x, y]
    uniform = all(each.uniform for each in operands)
    texts = [e.text if uniform or not e.uniform else f"wide({e.text})" for e in operands]
    high, low = (t.code.fresh("u", uniform) for _ in range(2))
    t.line(f"threefry({', '.join(texts)}, &{high.text}, &{low.text});", uniform)
    return high, low
