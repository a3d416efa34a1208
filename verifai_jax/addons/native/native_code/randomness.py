"""Random keys and bits, as the generator Threefry-2x32 of JAX makes them."""

from collections.abc import Sequence

import jax
import numpy as np

from verifai_jax.addons.native.native_code.translation import Translator, pairs, rule, words_of
from verifai_jax.addons.native.native_code.values import (
    Element,
    Elements,
    Equation,
    Untranslatable,
    Value,
    constant,
    elements,
    filled,
)


@rule("random_wrap")
def _wrap(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    words = elements(inputs[0])
    return [pairs(words[..., 0], words[..., 1])]


@rule("random_unwrap")
def _unwrap(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    keys = elements(inputs[0])
    return [np.stack([words_of(keys, 0), words_of(keys, 1)], -1)]


@rule("random_seed")
def _seed(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    seeds = elements(t.elementwise("convert_element_type", {}, inputs, "u", inputs[0].shape))
    return [pairs(filled(seeds.shape, constant(0, "u")), seeds)]


@rule("random_fold_in")
def _fold_in(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    keys, data = elements(inputs[0]), inputs[1]
    words = elements(t.elementwise("convert_element_type", {}, [data], "u", data.shape))
    out = np.empty(keys.shape, object)
    for cell in np.ndindex(keys.shape):
        out[cell] = _encrypted(t, keys[cell], constant(0, "u"), words[cell])
    return [out]


@rule("random_split")
def _split_keys(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    return [_counted(t, elements(inputs[0]), step.params["shape"])]


@rule("random_bits")
def _bits(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    if step.params["bit_width"] != 32:
        raise Untranslatable("random bits of another width than 32")
    keys = _counted(t, elements(inputs[0]), step.params["shape"])
    out = np.empty(keys.shape, object)
    for cell in np.ndindex(keys.shape):
        out[cell] = t.compute("xor", {}, list(keys[cell]), "u")
    return [out]


@rule("threefry2x32")
def _threefry(t: Translator, step: Equation, inputs: list[Value]) -> list[Value]:
    shape = step.outvars[0].aval.shape
    four: Elements = [np.broadcast_to(elements(v), shape) for v in inputs]
    a, b, x, y = four
    out = np.empty(shape, object)
    for cell in np.ndindex(shape):
        out[cell] = _encrypted(t, (a[cell], b[cell]), x[cell], y[cell])
    return [words_of(out, 0), words_of(out, 1)]


def _counted(t: Translator, keys: Elements, shape: Sequence[int]) -> Elements:
    if not getattr(jax.config, "jax_threefry_partitionable", False):
        raise Untranslatable("random keys with jax_threefry_partitionable=False")
    count = int(np.prod(shape, dtype=np.int64))
    out = np.empty((*keys.shape, count), object)
    for cell in np.ndindex(keys.shape):
        for i in range(count):
            out[(*cell, i)] = _encrypted(t, keys[cell], constant(0, "u"), constant(i, "u"))
    return out.reshape((*keys.shape, *shape))


def _encrypted(
    t: Translator, key: tuple[Element, Element], x: Element, y: Element
) -> tuple[Element, Element]:
    operands = [*key, x, y]
    uniform = all(each.uniform for each in operands)
    texts = [e.text if uniform or not e.uniform else f"wide({e.text})" for e in operands]
    high, low = (t.code.fresh("u", uniform) for _ in range(2))
    t.line(f"threefry({', '.join(texts)}, &{high.text}, &{low.text});", uniform)
    return high, low
