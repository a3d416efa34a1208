"""The translator: a program that JAX traced for one simulation, as code for blocks of them.

    source = translated(jaxpr, inputs)                  # C++, or `Untranslatable`

Moves of array elements are done during translation; only computations become code. Small arrays
become single variables; large ones are stored in memory and computed in loops.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

import jax
import numpy as np
from jaxtyping import Array, ArrayLike

from verifai_jax.addons.native.native_code import elementary
from verifai_jax.addons.native.native_code.code import Code, widened
from verifai_jax.addons.native.native_code.values import (
    DTYPES,
    KEY,
    Element,
    Elements,
    Equation,
    Form,
    Memory,
    Params,
    Program,
    Untranslatable,
    Value,
    constant,
    elements,
    filled,
    kind_of,
    names_in,
    same,
)
from verifai_jax.core.compute.jaxprs import called, run_through

LONG = 300
"""Characters of an expression up to which it is computed where it is used."""
SINGLE = 32
"""Elements of an array up to which each is a variable of its own."""
Rule = Callable[["Translator", Equation, list[Value]], list[Value]]
RULES: dict[str, Rule] = {}
"""How each primitive is translated that is not elementary."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Register a translation rule for primitives with these names."""

    def register(function: Rule) -> Rule:
        for name in names:
            RULES[name] = function
        return function

    return register


class Translator:
    """Translates programs into the lines of `code`."""

    def __init__(self) -> None:
        self.code = Code()
        self._once = False
        self._needed: list[Callable[[], Iterable[Value]]] = []

    def program(
        self, program: Program, constants: Sequence[Array], inputs: Sequence[Value]
    ) -> list[Value]:
        """Translate the steps of a `Jaxpr`, and return its results.

        **Raises:** `Untranslatable` for an unknown part.
        """
        used = Counter(each for step in program.eqns for each in map(id, step.invars))
        used.update(map(id, program.outvars))
        known = [self.constant(value) for value in constants]
        values = dict(zip([*program.constvars, *program.invars], [*known, *inputs], strict=True))

        def step(step: Equation, operands: list[Value]) -> list[Value]:
            # What several steps use is stored; the others are computed where they are used.
            self._once = all(used[id(each)] <= 1 for each in step.outvars)
            used.subtract(map(id, step.invars))
            results = self.step(step, operands)
            values.update(zip(step.outvars, results, strict=True))
            return results

        with self._needing(lambda: (each for var, each in values.items() if used[id(var)] > 0)):
            return run_through(
                program, known, inputs, lambda each: self.constant(each.val, each.aval), step
            )

    @contextmanager
    def _needing(self, values: Callable[[], Iterable[Value]]) -> Iterator[None]:
        self._needed.append(values)
        yield
        self._needed.pop()

    def branch(
        self, program: Program, inputs: Sequence[Value], needed: Sequence[Value]
    ) -> list[Value]:
        """Translate a program such that some values can still be used unchanged afterwards."""
        with self._needing(lambda: needed):
            return self.closed(program, inputs)

    def needed(self) -> set[str]:
        """Return the names of all values used after the present step."""
        return {name for values in self._needed for each in values() for name in names_in(each)}

    def closed(self, program: Program, inputs: Sequence[Value]) -> list[Value]:
        """Translate a program with its constants, or one without constants."""
        inner = getattr(program, "jaxpr", program)
        return self.program(inner, getattr(program, "consts", ()), inputs)

    def step(self, step: Equation, inputs: list[Value]) -> list[Value]:
        """Translate one equation."""
        name = step.primitive.name
        try:
            if (inner := called(step)) is not None:
                return self.closed(inner, inputs)
            if name in RULES:
                return RULES[name](self, step, inputs)
            if name not in elementary.NAMES:
                raise Untranslatable(f"the operation {name}")
            out = step.outvars[0].aval
            return [self.elementwise(name, step.params, inputs, kind_of(out.dtype), out.shape)]
        except Untranslatable:
            raise
        except Exception as error:
            # Such as a form of the operation that its rule was not written for.
            text = f"the operation {name} ({type(error).__name__}: {error})"
            raise Untranslatable(text) from error

    def constant(self, value: ArrayLike, form: Form | None = None) -> Value:
        """Return a constant of a program."""
        kind = kind_of(jax.numpy.result_type(value) if form is None else form.dtype)
        if kind == KEY:
            raise Untranslatable("a random key that is a constant")
        array: Elements = np.asarray(value, DTYPES[kind])
        if array.size <= SINGLE:
            out = np.empty(array.shape, object)
            for cell in np.ndindex(array.shape):
                out[cell] = constant(array[cell], kind)
            return out
        if np.all(array == array.ravel()[0]):
            return filled(array.shape, constant(array.ravel()[0], kind))
        return Memory(self.code.table(array, kind), kind, True, array.shape, values=array)

    def elementwise(
        self, name: str, params: Params, inputs: list[Value], kind: str, shape: tuple[int, ...]
    ) -> Value:
        """Apply a scalar operation elementwise to arrays of one shape, or to single numbers."""
        if kind == KEY or any(self._is_key(value) for value in inputs):
            return self._of_keys(name, params, inputs, shape)
        size = int(np.prod(shape, dtype=np.int64))
        flat: list[Elements] = [self._operand(value, shape) for value in inputs]
        if all(isinstance(value, Element) for value in flat):
            return filled(shape, self.compute(name, params, flat, kind))
        if size <= SINGLE:
            arrays = [v if isinstance(v, Element) else elements(v).ravel() for v in flat]
            out = np.empty(size, object)
            for i in range(size):
                some = [v if isinstance(v, Element) else v[i] for v in arrays]
                out[i] = self.compute(name, params, some, kind)
            return out.reshape(shape)
        flat = [v if isinstance(v, Element) else self.flat(v) for v in flat]
        uniform = all(v.uniform for v in flat)

        def formula(index: str) -> str:
            some = [
                v if isinstance(v, Element) else Element(v.at(index), v.kind, v.uniform)
                for v in flat
            ]
            return self.text(name, params, some, kind)

        lazy = Memory("", kind, uniform, shape, formula=formula)
        return lazy if self._once and len(formula("")) <= LONG else self.in_memory(lazy)

    def flat(self, value: Value) -> Memory:
        """Return a value as an array whose elements have a C expression of their index."""
        return value if isinstance(value, Memory) else self.in_memory(value)

    def line(self, text: str, uniform: bool = False) -> None:
        """Add a line of code."""
        piece = self.code.piece
        (piece.together if uniform else piece.each).append(text)

    def compute(self, name: str, params: Params, operands: list[Element], kind: str) -> Element:
        """Return the result of a scalar operation."""
        if all(each.value is not None for each in operands):
            folded = elementary.fold(name, kind, [each.value for each in operands])
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
        if name in ("max", "min") and operands[1].value is not None:
            # A constant that comes first is no NaN, which the compiler then need not look for.
            operands = operands[::-1]
        uniform = all(each.uniform for each in operands)
        older = name == "div" and kind == "f" and self.code.is_older(operands[1], operands[0])
        if older and not uniform:
            # The reciprocal is taken before the loop.
            by = self.code.define(f"1.f / {operands[1].text}", "f", operands[1].uniform)
            text = f"divided({', '.join(map(widened, (*operands, by)))})"
        else:
            text = self.text(name, params, operands, kind)
        return self.code.define(text, kind, uniform)

    def text(self, name: str, params: Params, operands: list[Element], kind: str) -> str:
        """Return the C expression of a scalar operation."""
        bounds = {"max": operands[:1], "min": operands[:1], "clamp": operands[::2]}.get(name, ())
        if (
            bounds
            and kind == "f"
            and all(e.value is not None and e.value == e.value for e in bounds)
        ):
            name = f"{name} of bounds"
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
        """Return a value as an array in memory with contiguous elements."""
        if isinstance(value, Memory):
            return value if value.formula is None else self._stored(value)
        flat = value.ravel()
        kind = flat[0].kind
        if all(each.value is not None for each in flat):
            array = np.array([each.value for each in flat], DTYPES[kind]).reshape(value.shape)
            return Memory(self.code.table(array, kind), kind, True, value.shape, values=array)
        return self.code.stored(flat.tolist(), value.shape)

    def _stored(self, value: Memory) -> Memory:
        """Compute an array into memory."""
        result = self.code.memory(value.shape, value.kind, value.uniform)
        self.write(result, value)
        return result

    def write(self, out: Memory, value: Value) -> None:
        """Write the elements of a value into an array, starting at its offset."""
        if not value.size:
            return
        if not isinstance(value, Memory) and not isinstance(value.flat[0], Element):
            raise Untranslatable("random keys that a loop collects")
        one = None if isinstance(value, Memory) or value.size <= SINGLE else same(value)
        if isinstance(value, np.ndarray) and one is None:
            for i, each in enumerate(value.ravel()):
                self.code.store(out.at(i), each)
            return
        i = self.code.name("i")
        if one is None:
            assert isinstance(value, Memory)
            one = Element(value.at(i), value.kind, value.uniform)
        each = one
        text = each.text if out.uniform or not each.uniform else f"wide({each.text})"
        head = f"for (int {i} = 0; {i} < {value.size}; {i}++)"
        self.line(f"{head} {out.at(i)} = {text};", out.uniform)

    def joined_in_memory(self, parts: Sequence[Value], form: Form) -> Memory:
        """Concatenate large arrays without writing a line for each element."""
        out, begin = self.code.memory(form.shape, kind_of(form.dtype)), 0
        for part in parts:
            self.write(out._replace(offset=str(begin)), part)
            begin += part.size
        return out

    def _operand(self, value: Value, shape: tuple[int, ...]) -> "Element | Value":
        """Return a value in this shape, or its element if all are the same."""
        if isinstance(value, Memory) and value.shape == shape and shape:
            return value
        array = elements(value)
        one = same(array)
        return np.broadcast_to(array, shape) if one is None else one

    @staticmethod
    def _is_key(value: Value) -> bool:
        return (
            isinstance(value, np.ndarray)
            and value.size > 0
            and not isinstance(value.flat[0], Element)
        )

    def _of_keys(
        self, name: str, params: Params, inputs: list[Value], shape: tuple[int, ...]
    ) -> Value:
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
    for cell in np.ndindex(keys.shape):
        out[cell] = keys[cell][word]
    return out


def pairs(high: Elements, low: Elements) -> Elements:
    """Return the random keys with these words."""
    out = np.empty(high.shape, object)
    for cell in np.ndindex(high.shape):
        out[cell] = (high[cell], low[cell])
    return out


@rule("optimization_barrier")
def _barrier(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    return inputs
