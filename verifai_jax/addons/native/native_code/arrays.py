"""Steps that only move the elements of arrays, for which no code is generated."""

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from verifai_jax.addons.native.native_code.translation import SINGLE, Translator, rule
from verifai_jax.addons.native.native_code.values import (
    DTYPES,
    Elements,
    Equation,
    Memory,
    Params,
    Untranslatable,
    Value,
    constant,
    elements,
    filled,
    kind_of,
)

Move: TypeAlias = Callable[[Params, Elements], Elements]
"""A function of the parameters of a step and of an array."""


def moved(*names: str) -> Callable[[Move], Move]:
    """Register a NumPy function that moves the elements of one array."""

    def register(function: Move) -> Move:
        def apply(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
            value = inputs[0]
            if _is_large(inputs):
                at = function(step.params, np.arange(value.size).reshape(value.shape))
                if at.size > SINGLE and np.all(np.diff(at.ravel()) == 1):
                    return [value.part(int(at.flat[0]), at.shape)]
            return [function(step.params, elements(value))]

        rule(*names)(apply)
        return function

    return register


@rule("reshape", "squeeze", "expand_dims")
def _reshape(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    shape = step.outvars[0].aval.shape
    if step.params.get("dimensions") is not None and step.primitive.name == "reshape":
        raise Untranslatable("a reshape that permutes")
    value = inputs[0]
    if isinstance(value, Memory):
        values = None if value.values is None else value.values.reshape(shape)
        return [value._replace(shape=shape, values=values)]
    return [value.reshape(shape)]


@moved("broadcast_in_dim")
def _broadcast(params: Params, array: Elements) -> Elements:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], array.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(array.reshape(shape), params["shape"])


@moved("transpose")
def _transpose(params: Params, array: Elements) -> Elements:
    return np.transpose(array, params["permutation"])


@moved("rev")
def _reverse(params: Params, array: Elements) -> Elements:
    return np.flip(array, params["dimensions"])


@moved("slice")
def _slice(params: Params, array: Elements) -> Elements:
    strides = params["strides"] or (1,) * array.ndim
    limits = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return array[tuple(slice(*each) for each in limits)]


@rule("concatenate")
def _concatenate(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    axis, form = step.params["dimension"], step.outvars[0].aval
    if _is_large(inputs) and math.prod(form.shape[:axis]) == 1:
        return [t.joined_in_memory(inputs, form)]
    return [np.concatenate([elements(v) for v in inputs], axis)]


def _is_large(values: list[Value]) -> bool:
    """Return whether arrays that differ between simulations lie in memory."""
    return any(isinstance(v, Memory) and v.values is None and v.size > SINGLE for v in values)


@rule("stack")
def _stack(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    return [np.stack([elements(v) for v in inputs], step.params["axis"])]


@rule("unstack", "split")
def _split(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    array, axis = elements(inputs[0]), step.params["axis"]
    if step.primitive.name == "unstack":
        rows = np.split(array, array.shape[axis], axis)
        return [row.squeeze(axis) for row in rows]
    return np.split(array, np.cumsum(step.params["sizes"])[:-1], axis)


@rule("pad")
def _pad(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    filler, form = elements(inputs[1]).item(), step.outvars[0].aval
    (low, high, inside), *others = step.params["padding_config"] or [(0, 0, 0)]
    if _is_large(inputs) and min(low, high) >= inside == 0 and not any(map(any, others)):
        each = math.prod(form.shape[1:])
        ends = (filled((count * each,), filler) for count in (low, high))
        return [t.joined_in_memory([next(ends), inputs[0], next(ends)], form)]
    array = elements(inputs[0])
    out = filled(form.shape, filler)
    cells = []
    for size, total, (low, _, inside) in zip(
        array.shape, out.shape, step.params["padding_config"], strict=True
    ):
        at = low + np.arange(size) * (inside + 1)
        cells.append((at, (at >= 0) & (at < total)))
    kept = array[np.ix_(*[np.flatnonzero(good) for _, good in cells])] if cells else array
    out[np.ix_(*[at[good] for at, good in cells])] = kept
    return [out]


@rule("iota")
def _iota(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    shape, axis = step.params["shape"], step.params["dimension"]
    kind = kind_of(step.params["dtype"])
    along = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return [t.constant(np.broadcast_to(along, shape).astype(DTYPES[kind]))]


@rule("empty", "empty2")
def _empty(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    form = step.outvars[0].aval
    return [filled(form.shape, constant(0, kind_of(form.dtype)))]


@moved("tile")
def _tile(params: Params, array: Elements) -> Elements:
    return np.tile(array, params["reps"])
