"""Operators of quantised graphs of ONNX: numbers of 8 bits with a scale and a zero point.

Source: the ONNX specification, `docs/Operators.md`, up to operator set 23.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from verifai_jax.addons.rl.policies.onnx_node import TYPES, Node, Value, cast, whole

Given = Value | None


def _along(x: Value, vector: Value, axis: int) -> Any:
    """Return a scale or a zero point in the form that it has beside `x`."""
    vector = jnp.asarray(vector)
    if vector.ndim == 0 or vector.size == 1:
        return vector.reshape(())
    return vector.reshape([-1 if i == axis % x.ndim else 1 for i in range(x.ndim)])


def _saturated(value: Array, zero: Any, kind: Any) -> Array:
    """Return real numbers, rounded to even, as whole ones of a type about its zero point."""
    ends = jnp.iinfo(kind)
    return jnp.clip(jnp.round(value) + zero, ends.min, ends.max).astype(kind)


def _check(node: Node, kind: Any) -> None:
    node.refuse(node.get("block_size", 0), "quantises in blocks, which is not supported")
    narrow = np.issubdtype(kind, np.integer) and np.dtype(kind).itemsize <= 2
    node.refuse(not narrow, f"quantises to {np.dtype(kind)}, which is not supported")


def quantize(node: Node, x: Value, scale: Value, zero: Given = None) -> Array:
    """Return real numbers as whole ones."""
    kind = TYPES.get(node.get("output_dtype", 0) or 2, float) if zero is None else zero.dtype
    _check(node, kind)
    axis = node.get("axis", 1)
    shift = 0 if zero is None else _along(x, zero, axis).astype(float)
    return _saturated(x / _along(x, scale, axis), shift, kind)


def dequantize(node: Node, x: Value, scale: Value, zero: Given = None) -> Array:
    """Return whole numbers as the real ones that they stand for."""
    node.refuse(node.get("block_size", 0), "quantises in blocks, which is not supported")
    node.refuse(not whole(x), f"has numbers of {x.dtype}, which are not supported")
    axis, x = node.get("axis", 1), jnp.asarray(x).astype(np.int32)
    x = x if zero is None else x - _along(x, zero, axis).astype(np.int32)
    return cast(x, float) * _along(x, scale, axis)


def quantize_dynamically(node: Node, x: Value) -> tuple[Array, Array, Array]:
    """Return real numbers as bytes, with the scale and the zero point that fit them."""
    x = jnp.asarray(x)
    low, high = jnp.minimum(x.min(), 0), jnp.maximum(x.max(), 0)
    scale = jnp.where(high == low, 1.0, (high - low) / 255).astype(x.dtype)
    zero = jnp.clip(jnp.round(-low / scale), 0, 255)
    return _saturated(x / scale, zero, np.uint8), scale, zero.astype(np.uint8)


def _less_zero(x: Value, zero: Given, axis: int) -> Array:
    x = jnp.asarray(x).astype(np.int32)
    return x if zero is None else x - _along(x, zero, axis).astype(np.int32)


def matmul_integer(node: Node, a: Value, b: Value, za: Given = None, zb: Given = None) -> Array:
    """Return a product of matrices of bytes, in 32 bits."""
    return jnp.matmul(_less_zero(a, za, -2), _less_zero(b, zb, -1))


def quantized_matmul(node: Node, *inputs: Value) -> Array:
    """Return a product of quantised matrices, quantised again."""
    a, sa, za, b, sb, zb, sy, zy = inputs
    _check(node, zy.dtype)
    total = cast(matmul_integer(node, a, b, za, zb), float)
    factor = _along(total, sa, -2) * _along(total, sb, -1) / _along(total, sy, -2)
    return _saturated(total * factor, _along(total, zy, -2).astype(float), zy.dtype)


OPERATORS: dict[str, Callable[..., Any]] = {
    "QuantizeLinear": quantize, "DequantizeLinear": dequantize,
    "DynamicQuantizeLinear": quantize_dynamically, "MatMulInteger": matmul_integer,
    "QLinearMatMul": quantized_matmul,
}  # fmt: skip
"""The operators, by name."""
