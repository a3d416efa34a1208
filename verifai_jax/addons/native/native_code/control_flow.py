"""Loops and branches of a translated program."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from jax.extend.core import Literal

from verifai_jax.addons.native.native_code.translation import (
    SINGLE,
    Translator,
    pairs,
    rule,
    words_of,
)
from verifai_jax.addons.native.native_code.values import (
    KEY,
    Element,
    Equation,
    Form,
    Memory,
    Params,
    Program,
    Value,
    constant,
    elements,
    kind_of,
    names_in,
)
from verifai_jax.core.compute.fingerprint import operands_of_scan
from verifai_jax.core.compute.jaxprs import programs_in

Forms: TypeAlias = list[Form]
"""Shapes and types of the values of a loop."""
CHOSEN = 6
"""Steps of the branches up to which all of them are taken, and one is chosen."""


class Carry:
    """The values that a loop or a branch changes: variables, or arrays in memory.

    A branch changes its initial values in place if nothing else uses them, so unchanged values need
    no copy.
    """

    def __init__(
        self, t: Translator, forms: Forms, uniform: list[bool], start: Sequence[Value] = ()
    ) -> None:
        self.t, self.forms, self.uniform = t, forms, uniform
        self.values: list[Value] = []
        self._next: list[Memory | None] = []
        own = _own(t, start)
        for i, (form, same) in enumerate(zip(forms, uniform, strict=True)):
            kind, next_one = kind_of(form.dtype), None
            if i in own and not same:
                self.values.append(start[i])
                if isinstance(start[i], Memory):
                    next_one = t.code.memory(form.shape, kind, same)
            elif kind == KEY:
                words = [self._variables(form.shape, "u", same) for _ in range(2)]
                self.values.append(pairs(*words))
            elif form.size <= SINGLE:
                self.values.append(self._variables(form.shape, kind, same))
            else:
                memory = t.code.memory(form.shape, kind, same)
                self.values.append(memory)
                t.code.carried(memory.name)
                next_one = t.code.memory(form.shape, kind, same)
            self._next.append(next_one)

    def _variables(self, shape: tuple[int, ...], kind: str, uniform: bool) -> np.ndarray:
        out = np.empty(shape, object)
        for cell in np.ndindex(shape):
            out[cell] = self.t.code.keep(kind, uniform)
        return out

    def assign(self, values: list[Value]) -> None:
        """Assign new values to all of them simultaneously."""
        code = self.t.code
        changed: list[Element] = []
        given: list[Element] = []
        moved: list[tuple[Memory, Memory]] = []
        for mine, other, memory in zip(self.values, values, self._next, strict=True):
            if memory is None:
                changed += single_numbers(mine)
                given += single_numbers(other)
                continue
            assert isinstance(mine, Memory)
            if isinstance(other, Memory) and other.name == mine.name and not other.offset:
                continue
            if isinstance(other, Memory) and not memory.uniform:
                self.t.write(memory, other)
                moved.append((mine, memory))
                continue
            for i, each in enumerate(elements(other).ravel()):
                if memory.uniform:
                    code.piece.after.append(f"{memory.at(i)} = {each.text};")
                else:
                    code.store(memory.at(i), each)
            moved.append((mine, memory))
        code.assign(changed, given)
        for mine, memory in moved:
            i = code.name("i")
            line = f"for (int {i} = 0; {i} < {mine.size}; {i}++) {mine.at(i)} = {memory.at(i)};"
            (code.piece.after if mine.uniform else code.piece.each).append(line)

    def varies(self, values: list[Value]) -> bool:
        """Record which of them are not uniform after all; return whether there are any."""
        found = False
        for i, value in enumerate(values):
            if self.uniform[i] and not is_uniform(value):
                self.uniform[i], found = False, True
        return found


def _own(t: Translator, start: Sequence[Value]) -> set[int]:
    """Return which values the loop around a branch changes, and nothing after the branch uses."""
    if not start:
        return set()
    uses, needed = Counter(name for value in start for name in names_in(value)), t.needed()
    found = set()
    for i, value in enumerate(start):
        names = list(names_in(value))
        whole = (
            value.formula is None and not value.offset
            if isinstance(value, Memory)
            else len(names) == value.size and all(isinstance(each, Element) for each in value.flat)
        )
        alone = (n not in needed and uses[n] == 1 and t.code.is_carried(n) for n in names)
        if whole and names and all(alone):
            found.add(i)
    return found


def single_numbers(value: Value) -> list[Element]:
    """Return the single numbers of a value; for random keys their words."""
    numbers: list[Element] = []
    for each in elements(value).ravel():
        numbers += [each] if isinstance(each, Element) else list(each)
    return numbers


def is_uniform(value: Value) -> bool:
    """Return whether a value is equal for all simulations."""
    if isinstance(value, Memory):
        return value.uniform
    return all(each.uniform for each in single_numbers(value))


def until_settled(
    t: Translator, forms: Forms, uniform: list[bool], emit: Callable[[Carry], list[Value] | None],
    changed: Sequence[Value] = (),
) -> list[Value]:  # fmt: skip
    """Translate a loop or branch, repeatedly as long as more of its values turn out to differ.

    - `changed`: the initial values of a branch; those that nothing else uses are changed in place.
    """
    mark = t.code.mark()
    while True:
        carry = Carry(t, forms, uniform, changed)
        results = emit(carry)
        if results is not None:
            return results
        t.code.back_to(mark)


@rule("scan")
def _scan(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    params = step.params
    (consts, count), length = operands_of_scan(params), params["length"]
    program = params["jaxpr"]
    shared, start = inputs[:consts], inputs[consts : consts + count]
    forms = [each.aval for each in step.outvars]
    if length == 0:
        return [*start, *(np.empty(form.shape, object) for form in forms[count:])]
    stacked = [_stacked(t, value) for value in inputs[consts + count :]]
    wanted = [type(each).__name__ != "DropVar" for each in step.outvars[count:]]

    def emit(carry: Carry) -> list[Value] | None:
        carry.assign(start)
        i = t.code.name("i")
        head = f"{i} = 0; {i} < {length}; {i}++"
        if params["reverse"]:
            head = f"{i} = {length - 1}; {i} >= 0; {i}--"
        outs = [
            t.code.memory(form.shape, kind_of(form.dtype)) if some else np.empty(0, object)
            for form, some in zip(forms[count:], wanted, strict=True)
        ]
        t.code.open_loop(f"for (int {head}) {{", i)
        now = [each(i) for each in stacked]
        results = t.closed(program, [*shared, *carry.values, *now])
        if carry.varies(results[:count]):
            return None
        for out, value, some in zip(outs, results[count:], wanted, strict=True):
            if some:
                assert isinstance(out, Memory)
                t.write(out._replace(offset=f"{i} * {out.size // length}"), value)
        carry.assign(results[:count])
        t.code.close_loop()
        return [*carry.values, *outs]

    return until_settled(t, forms[:count], [is_uniform(v) for v in start], emit)


def _stacked(t: Translator, value: Value) -> Callable[[str], Value]:
    """Return the function of a loop's counter that gives one row of an array."""
    if isinstance(value, np.ndarray) and value.size and not isinstance(value.flat[0], Element):
        high, low = (_stacked(t, words_of(value, word)) for word in (0, 1))
        return lambda i: pairs(elements(high(i)), elements(low(i)))
    if len(value.shape) == 1:
        first = elements(value)[0]
        numbers = [each.value for each in elements(value)]
        if first.kind == "i" and None not in numbers:
            by = int(numbers[1] - numbers[0]) if len(numbers) > 1 else 1
            if numbers == [numbers[0] + by * i for i in range(len(numbers))]:
                text = lambda i: f"{int(numbers[0])} + {by} * {i}"  # noqa: E731
                return lambda i: _single(t.code.define(text(i), "i", True))
    memory, shape = t.in_memory(value), value.shape[1:]
    size = int(np.prod(shape, dtype=np.int64))

    def row(i: str) -> Value:
        offset = " + ".join(filter(None, (memory.offset, f"{i} * {size}")))
        one = memory._replace(shape=shape, offset=offset, values=None)
        return one if size > SINGLE else elements(one)

    return row


def _single(element: Element) -> np.ndarray:
    out = np.empty((), object)
    out[()] = element
    return out


@rule("while")
def _while(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    params = step.params
    before, inside = params["cond_nconsts"], params["body_nconsts"]
    asked, shared = inputs[:before], inputs[before : before + inside]
    start = inputs[before + inside :]
    forms = [each.aval for each in step.outvars]
    switch = _only_once(params)

    def emit_branch(carry: Carry) -> list[Value] | None:
        # Nothing of it is computed in front of it, as it would be for a loop.
        on = elements(start[switch or 0]).item()
        mask = on if on.uniform else t.code.keep("b", False)
        if not on.uniform:
            t.code.assign([mask], [on])
            t.code.control(f"{{ I on = I(); REPEAT on |= {mask.text}_[k]; if (any(on)) {{")
        else:
            t.code.control(f"{{ if ({on.text}) {{")
        results = t.branch(params["body_jaxpr"], [*shared, *start], start)
        if not on.uniform:
            results = _chosen(t, mask, start, results, forms)
        if carry.varies(results):
            return None
        carry.assign(results)
        t.code.control("} else {")
        carry.assign(start)
        t.code.control("} }")
        return carry.values

    def emit(carry: Carry) -> list[Value] | None:
        carry.assign(start)
        t.code.open_loop("for (;;) {")
        (goes_on,) = t.closed(params["cond_jaxpr"], [*asked, *carry.values])
        on = elements(goes_on).item()
        if on.uniform:
            t.code.control(f"if (!{on.text}) break;")
            results = t.closed(params["body_jaxpr"], [*shared, *carry.values])
        else:
            mask = t.code.keep("b", False)
            t.code.assign([mask], [on])
            t.code.control(f"{{ I on = I(); REPEAT on |= {mask.text}_[k]; if (!any(on)) break; }}")
            inputs = [*shared, *carry.values]
            results = t.branch(params["body_jaxpr"], inputs, carry.values)
            results = _chosen(t, mask, carry.values, results, forms)
        if carry.varies(results):
            return None
        carry.assign(results)
        t.code.close_loop()
        return carry.values

    uniform = [is_uniform(value) for value in start]
    if switch is None:
        return until_settled(t, forms, uniform, emit)
    return until_settled(t, forms, uniform, emit_branch, start)


def _chosen(
    t: Translator, mask: Element, old: list[Value], new: list[Value], forms: Forms
) -> list[Value]:
    """Return the new values where the mask is set, and the old ones elsewhere."""
    return [
        t.elementwise("select_n", {}, [_single(mask), *each], kind_of(form.dtype), form.shape)
        for *each, form in zip(old, new, forms, strict=True)
    ]


def _only_once(params: Params) -> int | None:
    """Return which value decides on the only pass of a loop; None for one of more passes."""
    (asked,), condition = params["cond_jaxpr"].jaxpr.outvars, params["cond_jaxpr"].jaxpr
    if asked not in condition.invars[params["cond_nconsts"] :]:
        return None
    index = condition.invars.index(asked) - params["cond_nconsts"]
    after = params["body_jaxpr"].jaxpr.outvars[index]
    return index if isinstance(after, Literal) and not after.val else None


@rule("cond")
def _cond(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    branches, (which, *operands) = step.params["branches"], inputs
    forms = [each.aval for each in step.outvars]
    index = elements(which).item()
    if index.value is not None:
        chosen = min(max(int(index.value), 0), len(branches) - 1)
        return t.closed(branches[chosen], operands)
    if index.kind == "b":
        index = t.compute("convert_element_type", {}, [index], "i")
    limits = [constant(0, "i"), index, constant(len(branches) - 1, "i")]
    index = t.compute("clamp", {}, limits, "i")
    if not index.uniform or sum(map(_steps, branches)) <= CHOSEN:
        results = [t.branch(branch, operands, operands) for branch in branches]
        which = _single(index)
        if len(branches) == 2:
            which = _single(t.compute("ne", {}, [index, constant(0, "i")], "b"))
        return [
            t.elementwise("select_n", {}, [which, *each], kind_of(form.dtype), form.shape)
            for form, each in zip(forms, zip(*results, strict=True), strict=True)
        ]

    def emit(carry: Carry) -> list[Value] | None:
        for number, branch in enumerate(branches):
            t.code.control(f"{'else ' if number else ''}if ({index.text} == {number}) {{")
            results = t.closed(branch, operands)
            if carry.varies(results):
                return None
            carry.assign(results)
            t.code.control("}")
        return carry.values

    return until_settled(t, forms, [True] * len(forms), emit)


def _steps(branch: Program) -> int:
    """Count the steps of a program, those in it included."""
    program = getattr(branch, "jaxpr", branch)
    return sum(1 + sum(4 * _steps(inner) for inner in programs_in(step)) for step in program.eqns)
