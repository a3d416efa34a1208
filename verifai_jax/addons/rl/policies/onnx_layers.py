"""Layers of ONNX: normalisations, convolutions, pooling, LSTM, GRU and RNN.

Source: the ONNX specification, `docs/Operators.md`, up to operator set 23.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from verifai_jax.addons.rl.policies.onnx_node import Node, Value, cast, like

IN_TRAINING = "is in training mode: export the model after model.eval()"


def layer_normalization(node: Node, x: Value, scale: Value, bias: Value | None = None) -> Value:
    """Return entries divided by their deviation over the last axes, or their RMS about zero."""
    axes = tuple(range(node.get("axis", -1) % x.ndim, x.ndim))
    given, x = x, cast(x, float)
    if node.operator == "LayerNormalization":
        x = x - jnp.mean(x, axis=axes, keepdims=True)
    variance = jnp.mean(x**2, axis=axes, keepdims=True)
    scaled = x / jnp.sqrt(variance + node.get("epsilon", 1e-5)) * scale
    return like(scaled if bias is None else scaled + bias, given)


def _across(x: Value, vector: Value) -> Value:
    """Reshape one number per channel so that it broadcasts over a batch."""
    return jnp.reshape(vector, ((1, -1) + (1,) * (x.ndim - 2))[: x.ndim])


def channel_normalization(node: Node, x: Value, scale: Value, b: Value, *moments: Value) -> Value:
    """Return channels normalised by their stored deviation, or by the deviation of each image."""
    node.refuse(node.get("training_mode", 0), IN_TRAINING)
    node.refuse(not node.get("spatial", 1), "has spatial=0, which is not supported")
    if moments:
        mean, variance = (_across(x, v) for v in moments)
    else:
        axes = tuple(range(2, x.ndim))
        mean, variance = (f(x, axis=axes, keepdims=True) for f in (jnp.mean, jnp.var))
    scaled = (x - mean) / jnp.sqrt(variance + node.get("epsilon", 1e-5))
    return like(scaled * _across(x, scale) + _across(x, b), x)


def _window(node: Node, x: Value, kernel: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Return strides, dilations and padding of a convolution or pooling."""
    rank = len(kernel)
    strides = tuple(node.get("strides", (1,) * rank))
    dilations = tuple(node.get("dilations", (1,) * rank))
    automatic = node.get("auto_pad", "NOTSET")
    if not automatic.startswith("SAME"):
        pads = node.get("pads", (0,) * 2 * rank)
        return strides, dilations, list(zip(pads[:rank], pads[rank:], strict=True))
    odd = node.operator != "Conv" and set(dilations) != {1}
    node.refuse(odd, f"has auto_pad={automatic} with dilations, on which runtimes disagree")
    around = []
    for size, k, s, d in zip(x.shape[2:], kernel, strides, dilations, strict=True):
        total = max(0, (-(-size // s) - 1) * s + (k - 1) * d + 1 - size)
        upper = (total // 2, total - total // 2)
        around.append(upper if automatic == "SAME_UPPER" else upper[::-1])
    return strides, dilations, around


def extreme(x: Value, of: str) -> Any:
    """Return the value of a type with which a maximum (`max`) or minimum (`min`) begins."""
    if x.dtype == bool:
        return of == "min"
    if jnp.issubdtype(x.dtype, jnp.integer):
        ends = np.iinfo(x.dtype)
        return np.asarray(ends.min if of == "max" else ends.max, x.dtype)
    return -jnp.inf if of == "max" else jnp.inf


def conv(node: Node, x: Value, kernel: Value, bias: Value | None = None) -> Value:
    """Return a convolution."""
    strides, dilations, around = _window(node, x, kernel.shape[2:])
    real = jnp.promote_types(x.dtype, kernel.dtype)
    image, kernel = jnp.asarray(x, real), jnp.asarray(kernel, real)
    more = {"rhs_dilation": dilations, "feature_group_count": node.get("group", 1)}
    made = jax.lax.conv_general_dilated(image, kernel, strides, around, **more)
    return made if bias is None else made + _across(made, bias)


def pool(node: Node, x: Value) -> Value:
    """Return the maximum or the mean of each window."""
    kernel = tuple(node.attributes["kernel_shape"])
    strides, dilations, around = _window(node, x, kernel)
    beyond = [0] * len(kernel)
    if node.get("ceil_mode", 0):
        spans = [(k - 1) * d + 1 for k, d in zip(kernel, dilations, strict=True)]
        sizes = zip(x.shape[2:], spans, strides, around, strict=True)
        for i, (size, span, s, (low, high)) in enumerate(sizes):
            more = -(size + low + high - span) % s
            # A window that would begin in the padding after the end is left out.
            begins = size + low + high + more - span
            beyond[i] = more - s if more and begins >= size + low else more

    def windows(values: Value, start: float, function: Callable[..., Any], pads: Any) -> Value:
        pads = [(low, high + more) for (low, high), more in zip(pads, beyond, strict=True)]
        sizes = (1, 1, *kernel), (1, 1, *strides), [(0, 0), (0, 0), *pads]
        dilated = (1, 1, *dilations)
        return jax.lax.reduce_window(values, start, function, *sizes, window_dilation=dilated)

    if node.operator == "MaxPool":
        return windows(x, extreme(x, "max"), jax.lax.max, around)
    # Padding counts where the node says so; what lies beyond it never does.
    counted = float(node.get("count_include_pad", 0))
    ones = jnp.pad(jnp.ones_like(x), [(0, 0), (0, 0), *around], constant_values=counted)
    whole = windows(ones, 0.0, jax.lax.add, [(0, 0)] * len(kernel))
    return windows(x, 0.0, jax.lax.add, around) / whole


_FUNCTIONS = {"Sigmoid": jax.nn.sigmoid, "Tanh": jnp.tanh, "Relu": jax.nn.relu}


def recurrent(node: Node, x: Array, w: Array, r: Array, *more: Array | None) -> tuple[Array, ...]:
    """Return the outputs `[time, directions, batch, hidden]`, and the last state."""
    b, lengths, h, c, peepholes = (*more, *[None] * 5)[:5]
    gates, usual, step = _STEPS[node.operator]
    odd = peepholes is not None or node.get("input_forget", 0)
    node.refuse(odd, "has peepholes or coupled gates, which are not supported")
    odd = node.get("layout", 0) or node.get("clip", None)
    node.refuse(odd, "has layout=1 or clip, which are not supported")
    hidden, count = r.shape[-1], r.shape[0]
    node.refuse(count > 2, f"has {count} directions; there are two")
    names = node.get("activations", usual * count)
    unknown = sorted({*names} - {*_FUNCTIONS})
    node.refuse(unknown != [], f"has the activation {unknown[:1]}, which is not supported")
    start = (h, c) if node.operator == "LSTM" else (h,)
    times = jnp.arange(len(x))
    ends, series = [], []
    for i in range(count):
        biases = jnp.zeros(2 * gates * hidden) if b is None else b[i]
        input_bias, bias = jnp.split(biases, 2)
        none = jnp.zeros((x.shape[1], hidden), x.dtype)
        first = tuple(none if s is None else jnp.asarray(s[i], x.dtype) for s in start)
        f = [_FUNCTIONS[name] for name in names[i * len(usual) : (i + 1) * len(usual)]]

        def one(carry: Any, at: Any, i: int = i, f: Any = f, bias: Array = bias) -> Any:
            after = step(node, f, at[0], carry, r[i], bias)
            if lengths is None:
                return after, after[0]
            # After its end a sequence keeps its state and its output is zero.
            within = (at[1] < jnp.asarray(lengths))[:, None]
            after = tuple(jnp.where(within, a, c) for a, c in zip(after, carry, strict=True))
            return after, jnp.where(within, after[0], 0)

        inputs = x @ w[i].T + input_bias, times
        if len(x) == 1:
            end, output = one(first, (inputs[0][0], 0))
            outputs = output[None]
        else:
            backwards = node.get("direction", "forward") == "reverse" or i == 1
            end, outputs = jax.lax.scan(one, first, inputs, reverse=backwards)
        ends.append(end)
        series.append(outputs)
    last = tuple(jnp.stack([end[k] for end in ends]) for k in range(len(start)))
    return (jnp.stack(series, axis=1), *last)


def _lstm_step(node: Node, f: Any, at: Array, carry: Any, r: Array, bias: Array) -> Any:
    h, c = carry
    i, o, forget, new = jnp.split(at + h @ r.T + bias, 4, axis=-1)
    c = f[0](forget) * c + f[0](i) * f[1](new)
    return f[0](o) * f[2](c), c


def _gru_step(node: Node, f: Any, at: Array, carry: Any, r: Array, bias: Array) -> Any:
    (h,) = carry
    both = 2 * h.shape[-1]
    rest = r[both:]
    z, reset = jnp.split(f[0](at[..., :both] + h @ r[:both].T + bias[:both]), 2, axis=-1)
    if node.get("linear_before_reset", 0):
        new = f[1](at[..., both:] + reset * (h @ rest.T + bias[both:]))
    else:
        new = f[1](at[..., both:] + (reset * h) @ rest.T + bias[both:])
    return ((1 - z) * new + z * h,)


def _rnn_step(node: Node, f: Any, at: Array, carry: Any, r: Array, bias: Array) -> Any:
    return (f[0](at + carry[0] @ r.T + bias),)


_STEPS: dict[str, tuple[int, tuple[str, ...], Callable[..., Any]]] = {
    "LSTM": (4, ("Sigmoid", "Tanh", "Tanh"), _lstm_step),
    "GRU": (3, ("Sigmoid", "Tanh"), _gru_step), "RNN": (1, ("Tanh",), _rnn_step),
}  # fmt: skip
"""The number of gates, the usual activations, and one step of each recurrent layer."""
