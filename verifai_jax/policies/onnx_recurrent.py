"""The recurrent operators of ONNX: LSTM, GRU and RNN.

Source: the ONNX specification, `docs/Operators.md`, sections LSTM, GRU and RNN.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from verifai_jax.policies.errors import PolicyError

_GATES = {"LSTM": 4, "GRU": 3, "RNN": 1}
_USUAL = {"LSTM": ("Sigmoid", "Tanh", "Tanh"), "GRU": ("Sigmoid", "Tanh"), "RNN": ("Tanh",)}
_FUNCTIONS = {"Sigmoid": jax.nn.sigmoid, "Tanh": jnp.tanh, "Relu": jax.nn.relu}


def lstm(node: Any, x: Array, w: Array, r: Array, *others: Array | None) -> tuple[Array, ...]:
    """Return the outputs `[time, directions, batch, hidden]`, the last output and the last cell."""
    b, _, h, c, peepholes = (*others, *(None,) * 5)[:5]
    if peepholes is not None or node.get("input_forget", 0):
        raise PolicyError(f"{node} has peepholes or coupled gates, which are not supported")
    return _both_ways(node, _lstm_step, x, w, r, b, (h, c))


def gru(node: Any, x: Array, w: Array, r: Array, *others: Array | None) -> tuple[Array, ...]:
    """Return the outputs `[time, directions, batch, hidden]` and the last output."""
    b, _, h = (*others, *(None,) * 3)[:3]
    return _both_ways(node, _gru_step, x, w, r, b, (h,))


def rnn(node: Any, x: Array, w: Array, r: Array, *others: Array | None) -> tuple[Array, ...]:
    """Return the outputs `[time, directions, batch, hidden]` and the last output."""
    b, _, h = (*others, *(None,) * 3)[:3]
    return _both_ways(node, _rnn_step, x, w, r, b, (h,))


def _both_ways(
    node: Any, step: Any, x: Array, w: Array, r: Array, b: Any, start: tuple[Any, ...]
) -> tuple[Array, ...]:
    """Go through the time in the node's directions, and stack what comes."""
    if node.get("layout", 0) or node.get("clip", None):
        raise PolicyError(f"{node} has layout=1 or clip, which are not supported")
    direction = node.get("direction", "forward")
    hidden, count = r.shape[-1], r.shape[0]
    names = node.get("activations", _USUAL[node.operator] * count)
    unknown = sorted({*names} - {*_FUNCTIONS})
    if unknown:
        raise PolicyError(f"{node} has the activation {unknown[0]}, which is not supported")
    functions = [_FUNCTIONS[name] for name in names]
    each = len(functions) // count
    ends, series = [], []
    for i in range(count):
        backwards = direction == "reverse" or i == 1
        biases = jnp.zeros(2 * _GATES[node.operator] * hidden) if b is None else b[i]
        input_bias, bias = jnp.split(biases, 2)
        first = tuple(
            jnp.zeros((x.shape[1], hidden), x.dtype) if s is None else jnp.asarray(s[i], x.dtype)
            for s in start
        )
        chosen = functions[i * each : (i + 1) * each]

        def one(carry: Any, at: Array, i: int = i, chosen: Any = chosen, bias: Array = bias) -> Any:
            after = step(node, chosen, at, carry, r[i], bias, hidden)
            return after, after[0]

        inputs = x @ w[i].T + input_bias
        if inputs.shape[0] == 1:
            end, output = one(first, inputs[0])
            outputs = output[None]
        else:
            end, outputs = jax.lax.scan(one, first, inputs, reverse=backwards)
        ends.append(end)
        series.append(outputs)
    last = tuple(jnp.stack([end[k] for end in ends]) for k in range(len(start)))
    return (jnp.stack(series, axis=1), *last)


def _lstm_step(
    node: Any, f: Any, at: Array, carry: Any, r: Array, bias: Array, hidden: int
) -> tuple[Array, Array]:
    h, c = carry
    gates = at + h @ r.T + bias
    i, o, forget, new = jnp.split(gates, 4, axis=-1)
    c = f[0](forget) * c + f[0](i) * f[1](new)
    return f[0](o) * f[2](c), c


def _gru_step(
    node: Any, f: Any, at: Array, carry: Any, r: Array, bias: Array, hidden: int
) -> tuple[Array]:
    (h,) = carry
    both, rest = 2 * hidden, r[2 * hidden :]
    z, reset = jnp.split(f[0](at[..., :both] + h @ r[:both].T + bias[:both]), 2, axis=-1)
    if node.get("linear_before_reset", 0):
        new = f[1](at[..., both:] + reset * (h @ rest.T + bias[both:]))
    else:
        new = f[1](at[..., both:] + (reset * h) @ rest.T + bias[both:])
    return ((1 - z) * new + z * h,)


def _rnn_step(
    node: Any, f: Any, at: Array, carry: Any, r: Array, bias: Array, hidden: int
) -> tuple[Array]:
    (h,) = carry
    return (f[0](at + h @ r.T + bias),)
