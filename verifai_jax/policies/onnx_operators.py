"""Operators of ONNX, each a function `(node, *inputs) -> outputs`.

An operator of NumPy arrays alone gives NumPy arrays, so that shapes and indices stay numbers under
`jit`. Source: the ONNX specification, `docs/Operators.md`, up to operator set 23.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from verifai_jax.policies.errors import PolicyError
from verifai_jax.policies.onnx_recurrent import gru, lstm, rnn

Value: TypeAlias = Array
"""A value of a graph. Where it is known before the observation, an array of NumPy takes its place,
which has the same operations."""


@dataclass(frozen=True, eq=False)
class Node:
    """One operation of a graph.

    - `operator`, `name`: as the file has them.
    - `inputs`, `outputs`: names of values; an input that is left out is empty.
    - `attributes`: plain values, arrays, and subgraphs as `(nodes, outputs)`.
    - `opset`: version of the operators.
    """

    operator: str
    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]
    opset: int

    def __str__(self) -> str:
        return f"node {self.name!r} ({self.operator})"

    def get(self, name: str, default: Any) -> Any:
        """Return an attribute, or its default."""
        return self.attributes.get(name, default)


def _module(*values: Value) -> Any:
    """Return NumPy where all values are its arrays, otherwise JAX's."""
    return np if all(isinstance(v, np.ndarray | np.generic) for v in values) else jnp


def _same(name: str) -> Callable[..., Any]:
    """Return an operator that is a function of NumPy of this name."""

    def operator(node: Node, *inputs: Value) -> Value:
        return getattr(_module(*inputs), name)(*inputs)

    return operator


def _folded(name: str) -> Callable[..., Any]:
    """Return an operator of any number of inputs that is a function of two."""

    def operator(node: Node, first: Value, *others: Value) -> Value:
        for other in others:
            first = getattr(_module(first, other), name)(first, other)
        return first

    return operator


def _activation(function: Callable[[Value], Value]) -> Callable[..., Any]:
    """Return an operator that is a function of one array."""
    return lambda node, x: function(x)


def _axis(node: Node, x: Value, usual: int) -> int:
    axis = node.get("axis", usual)
    return axis + x.ndim if axis < 0 else axis


def _divide(node: Node, a: Value, b: Value) -> Value:
    xp = _module(a, b)
    if np.issubdtype(a.dtype, np.integer):
        return xp.trunc(a / b).astype(a.dtype)  # Towards zero, as in C.
    return a / b


def _mod(node: Node, a: Value, b: Value) -> Value:
    xp = _module(a, b)
    return xp.fmod(a, b) if node.get("fmod", 0) else xp.mod(a, b)


def _gemm(node: Node, a: Value, b: Value, c: Value | None = None) -> Value:
    a = a.T if node.get("transA", 0) else a
    b = b.T if node.get("transB", 0) else b
    alpha, beta = node.get("alpha", 1.0), node.get("beta", 1.0)
    product = jnp.matmul(a, b)
    product = product if alpha == 1 else alpha * product
    return product if c is None else product + (c if beta == 1 else beta * c)


def _selu(node: Node, x: Value) -> Value:
    alpha = node.get("alpha", 1.6732631921768188)
    gamma = node.get("gamma", 1.0507010221481323)
    return gamma * jnp.where(x > 0, x, alpha * jnp.expm1(jnp.minimum(x, 0)))


def _softmax(function: Callable[..., Any]) -> Callable[..., Any]:
    def operator(node: Node, x: Value) -> Value:
        if node.opset >= 13:
            return function(x, axis=node.get("axis", -1))
        # Before, all axes from this one on were one.
        axis = node.get("axis", 1) % x.ndim
        return function(x.reshape(*x.shape[:axis], -1), axis=-1).reshape(x.shape)

    return operator


def _clip(node: Node, x: Value, low: Value | None = None, high: Value | None = None) -> Value:
    low = node.get("min", None) if low is None else low
    high = node.get("max", None) if high is None else high
    xp = _module(x)
    x = x if low is None else xp.maximum(x, xp.asarray(low, x.dtype))
    return x if high is None else xp.minimum(x, xp.asarray(high, x.dtype))


def _cast(node: Node, x: Value) -> Any:
    kinds = {1: float, 10: float, 11: float, 16: float, 6: np.int32, 7: np.int64, 9: np.bool_}
    kinds |= {2: np.uint8, 3: np.int8, 5: np.int16, 12: np.uint32, 13: np.uint64}
    kind = kinds.get(node.attributes["to"])
    if kind is None:
        raise PolicyError(f"{node} makes numbers of a type that is not supported")
    if isinstance(x, np.ndarray | np.generic):
        return np.asarray(x).astype(np.float32 if kind is float else kind)
    if kind is float and jnp.issubdtype(x.dtype, jnp.floating):
        return x  # The working precision is the caller's.
    return x.astype(
        jnp.result_type(float) if kind is float else jax.dtypes.canonicalize_dtype(kind)
    )


def _constant(node: Node) -> Any:
    (value,) = node.attributes.values()
    array = np.asarray(value)
    return array.astype(np.float32) if array.dtype == np.float64 else array


def _constant_of_shape(node: Node, shape: Value) -> Any:
    value = np.asarray(node.get("value", np.zeros(1, np.float32))).ravel()[0]
    return np.full(_static(node, shape), value)


def _static(node: Node, value: Value) -> tuple[int, ...]:
    """Return numbers that say a shape, axes or indices.

    **Raises:** `PolicyError` where they depend on the observation.
    """
    if not isinstance(value, np.ndarray | np.generic):
        raise PolicyError(f"{node} has a shape that depends on the observation")
    return tuple(int(n) for n in np.ravel(value))


def _axes(node: Node, given: Value | None) -> tuple[int, ...] | None:
    """Return axes, an attribute in old operator sets and an input in new ones."""
    if given is not None:
        return _static(node, given) or None
    axes = node.get("axes", None)
    return None if axes is None else tuple(axes)


def _reshape(node: Node, x: Value, shape: Value | None = None) -> Value:
    sizes = list(node.attributes["shape"] if shape is None else _static(node, shape))
    if not node.get("allowzero", 0):
        sizes = [x.shape[i] if n == 0 else n for i, n in enumerate(sizes)]
    return x.reshape(sizes)


def _squeeze(node: Node, x: Value, axes: Value | None = None) -> Value:
    found = _axes(node, axes)
    found = tuple(i for i, n in enumerate(x.shape) if n == 1) if found is None else found
    return _module(x).squeeze(x, found)


def _split(node: Node, x: Value, sizes: Value | None = None) -> tuple[Value, ...]:
    axis = node.get("axis", 0)
    lengths = node.get("split", None) if sizes is None else _static(node, sizes)
    if lengths is None:
        count = node.get("num_outputs", len(node.outputs))
        step = -(-x.shape[axis] // count)
        lengths = [min(step, x.shape[axis] - i * step) for i in range(count)]
    return tuple(_module(x).split(x, np.cumsum(lengths)[:-1].tolist(), axis=axis))


def _slice(node: Node, x: Value, *given: Value) -> Value:
    if given:
        starts, ends, axes, steps = (
            None if v is None else _static(node, v) for v in (*given, None, None)[:4]
        )
    else:
        starts, ends, axes, steps = (node.get(n, None) for n in ("starts", "ends", "axes", "steps"))
    assert starts is not None
    assert ends is not None
    axes = range(len(starts)) if axes is None else axes
    steps = [1] * len(starts) if steps is None else steps
    where = [slice(None)] * x.ndim
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        # An end before the first entry means "to the first one" when it goes backwards.
        stop = None if step < 0 and end < -x.shape[axis] else end
        where[axis] = slice(start, stop, step)
    return x[tuple(where)]


def _gather(node: Node, x: Value, index: Value) -> Value:
    axis = node.get("axis", 0)
    index = _module(index).where(index < 0, index + x.shape[axis], index)
    return _module(x, index).take(x, index, axis=axis)


def _gather_elements(node: Node, x: Value, index: Value) -> Value:
    axis = node.get("axis", 0)
    index = _module(index).where(index < 0, index + x.shape[axis], index)
    return _module(x, index).take_along_axis(x, index, axis=axis)


def _expand(node: Node, x: Value, shape: Value) -> Value:
    whole = np.broadcast_shapes(x.shape, _static(node, shape))
    return _module(x).broadcast_to(x, whole)


def _tile(node: Node, x: Value, repeats: Value) -> Value:
    return _module(x).tile(x, _static(node, repeats))


def _pad(
    node: Node,
    x: Value,
    pads: Value | None = None,
    value: Value | None = None,
    axes: Value | None = None,
) -> Value:
    widths = node.attributes["pads"] if pads is None else _static(node, pads)
    chosen = range(x.ndim) if axes is None else _static(node, axes)
    around = [(0, 0)] * x.ndim
    for i, axis in enumerate(chosen):
        around[axis] = (widths[i], widths[len(chosen) + i])
    mode = node.get("mode", "constant")
    if mode == "constant":
        filled = node.get("value", 0.0) if value is None else value
        return jnp.pad(x, around, constant_values=filled)
    return jnp.pad(x, around, mode={"reflect": "reflect", "edge": "edge", "wrap": "wrap"}[mode])


def _range(node: Node, start: Value, end: Value, step: Value) -> Any:
    values = [np.asarray(v) for v in (start, end, step)]
    return np.arange(*(v.item() for v in values), dtype=values[0].dtype)


def _reduce(name: str) -> Callable[..., Any]:
    def operator(node: Node, x: Value, axes: Value | None = None) -> Value:
        found = _axes(node, axes)
        if found is None and node.get("noop_with_empty_axes", 0):
            return x
        xp, keep = _module(x), bool(node.get("keepdims", 1))
        if name == "l2":
            return xp.sqrt(xp.sum(x * x, axis=found, keepdims=keep))
        return getattr(xp, name)(x, axis=found, keepdims=keep)

    return operator


def _arg(name: str) -> Callable[..., Any]:
    def operator(node: Node, x: Value) -> Value:
        axis, keep = node.get("axis", 0), bool(node.get("keepdims", 1))
        if node.get("select_last_index", 0):
            return x.shape[axis] - 1 - getattr(jnp, name)(jnp.flip(x, axis), axis, keepdims=keep)
        return getattr(jnp, name)(x, axis=axis, keepdims=keep)

    return operator


def _layer_normalization(node: Node, x: Value, scale: Value, bias: Value | None = None) -> Value:
    axes = tuple(range(node.get("axis", -1) % x.ndim, x.ndim))
    centred = x - jnp.mean(x, axis=axes, keepdims=True)
    variance = jnp.mean(centred**2, axis=axes, keepdims=True)
    scaled = centred / jnp.sqrt(variance + node.get("epsilon", 1e-5)) * scale
    return scaled if bias is None else scaled + bias


def _across(x: Value, vector: Value) -> Value:
    """Return one number a channel in the form of a batch of them."""
    return jnp.reshape(vector, (1, -1) + (1,) * (x.ndim - 2))


def _batch_normalization(
    node: Node, x: Value, scale: Value, b: Value, mean: Value, var: Value
) -> Value:
    if node.get("training_mode", 0):
        raise PolicyError(f"{node} is in training mode: export the model after model.eval()")
    scale, b, mean, var = (_across(x, v) for v in (scale, b, mean, var))
    return (x - mean) / jnp.sqrt(var + node.get("epsilon", 1e-5)) * scale + b


def _instance_normalization(node: Node, x: Value, scale: Value, b: Value) -> Value:
    axes = tuple(range(2, x.ndim))
    centred = x - jnp.mean(x, axis=axes, keepdims=True)
    variance = jnp.mean(centred**2, axis=axes, keepdims=True)
    epsilon = node.get("epsilon", 1e-5)
    return centred / jnp.sqrt(variance + epsilon) * _across(x, scale) + _across(x, b)


def _window(
    node: Node, x: Value, kernel: tuple[int, ...]
) -> tuple[tuple[int, ...], tuple[int, ...], list[tuple[int, int]]]:
    """Return strides, dilations and padding of a convolution or pooling."""
    rank = len(kernel)
    strides = tuple(node.get("strides", (1,) * rank))
    dilations = tuple(node.get("dilations", (1,) * rank))
    automatic = node.get("auto_pad", "NOTSET")
    if automatic in ("SAME_UPPER", "SAME_LOWER"):
        around = []
        for size, k, s, d in zip(x.shape[2:], kernel, strides, dilations, strict=True):
            total = max(0, (-(-size // s) - 1) * s + (k - 1) * d + 1 - size)
            half = total // 2
            upper = (half, total - half)
            around.append(upper if automatic == "SAME_UPPER" else upper[::-1])
        return strides, dilations, around
    pads = node.get("pads", (0,) * 2 * rank)
    return strides, dilations, list(zip(pads[:rank], pads[rank:], strict=True))


def _conv(node: Node, x: Value, kernel: Value, bias: Value | None = None) -> Value:
    strides, dilations, around = _window(node, x, kernel.shape[2:])
    x, kernel = jnp.asarray(x), jnp.asarray(kernel)
    real = jnp.promote_types(x.dtype, kernel.dtype)
    made = jax.lax.conv_general_dilated(
        x.astype(real),
        kernel.astype(real),
        strides,
        around,
        rhs_dilation=dilations,
        feature_group_count=node.get("group", 1),
    )
    return made if bias is None else made + _across(made, bias)


def _pool(largest: bool) -> Callable[..., Any]:
    def operator(node: Node, x: Value) -> Value:
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

        def windows(
            values: Value, start: float, function: Callable[..., Any], pads: list[tuple[int, int]]
        ) -> Value:
            pads = [(low, high + more) for (low, high), more in zip(pads, beyond, strict=True)]
            return jax.lax.reduce_window(
                values,
                start,
                function,
                (1, 1, *kernel),
                (1, 1, *strides),
                [(0, 0), (0, 0), *pads],
                window_dilation=(1, 1, *dilations),
            )

        if largest:
            return windows(x, -jnp.inf, jax.lax.max, around)
        # Padding counts where the node says so; what lies beyond it never does.
        counted = float(node.get("count_include_pad", 0))
        ones = jnp.pad(jnp.ones_like(x), [(0, 0), (0, 0), *around], constant_values=counted)
        none = [(0, 0)] * len(kernel)
        return windows(x, 0.0, jax.lax.add, around) / windows(ones, 0.0, jax.lax.add, none)

    return operator


def _global_pool(name: str) -> Callable[..., Any]:
    return lambda node, x: getattr(jnp, name)(x, axis=tuple(range(2, x.ndim)), keepdims=True)


def _dropout(
    node: Node, x: Value, ratio: Value | None = None, training: Value | None = None
) -> Value:
    if training is not None and np.any(training):
        raise PolicyError(f"{node} is in training mode: export the model after model.eval()")
    return x


_OF_NUMPY = {
    "Add": "add", "Sub": "subtract", "Mul": "multiply", "Pow": "power", "Sqrt": "sqrt",
    "Exp": "exp", "Log": "log", "Abs": "abs", "Neg": "negative", "Floor": "floor", "Ceil": "ceil",
    "Round": "round", "Sign": "sign", "Sin": "sin", "Cos": "cos", "Tan": "tan", "Atan": "arctan",
    "Tanh": "tanh", "Equal": "equal", "Greater": "greater", "Less": "less",
    "GreaterOrEqual": "greater_equal", "LessOrEqual": "less_equal", "And": "logical_and",
    "Or": "logical_or", "Xor": "logical_xor", "Not": "logical_not",
}  # fmt: skip
"""Operators that are functions of NumPy, entry by entry."""
_REDUCTIONS = {
    "ReduceMean": "mean", "ReduceSum": "sum", "ReduceMax": "max", "ReduceMin": "min",
    "ReduceProd": "prod", "ReduceL2": "l2",
}  # fmt: skip
"""Operators over axes, by the function of NumPy."""
_ACTIVATIONS: dict[str, Callable[[Value], Value]] = {
    "Sigmoid": jax.nn.sigmoid,
    "Softplus": jax.nn.softplus,
    "Softsign": jax.nn.soft_sign,
    "HardSwish": lambda x: x * jnp.clip(x / 6 + 0.5, 0, 1),
    "Mish": lambda x: x * jnp.tanh(jax.nn.softplus(x)),
    "Erf": jax.scipy.special.erf,
}
"""Operators without attributes, as functions of one array."""
_ELEMENTWISE = {*_OF_NUMPY, "Min", "Max", "Sum", "Mean", "Div", "Mod", "PRelu", "Where"}


def output_size(node: Node, *inputs: Any) -> int:
    """Return how many numbers an operator gives at most, before it is computed.

    Only for those that can give many more than they take; 0 for all others.
    """
    shapes: list[tuple[int, ...]] = [() if v is None else np.shape(v) for v in inputs]
    match node.operator, len(inputs):
        case "ConstantOfShape", 1:
            return math.prod(_static(node, inputs[0]))
        case "Expand", 2:
            return math.prod(np.broadcast_shapes(shapes[0], _static(node, inputs[1])))
        case "Tile", 2:
            return math.prod(shapes[0]) * math.prod(_static(node, inputs[1]))
        case "Range", 3:
            start, end, step = (float(np.asarray(value)) for value in inputs)
            return int(max(0.0, (end - start) / step)) if step else 0
        case "Pad", _:
            pads = node.get("pads", ()) if len(inputs) == 1 else _static(node, inputs[1])
            return math.prod(n + 2 * max(0, 0, *pads) for n in shapes[0])
        case "Conv" | "MaxPool" | "AveragePool", _:
            channels = shapes[1][0] if node.operator == "Conv" else shapes[0][1]
            wide = 2 * max(0, 0, *node.get("pads", ()))
            return shapes[0][0] * channels * math.prod(n + wide for n in shapes[0][2:])
        case "Gather", 2:
            rows = max(1, shapes[0][node.get("axis", 0)])
            return math.prod(shapes[0]) // rows * math.prod(shapes[1])
        case "MatMul", 2:
            a, b = shapes
            batch = math.prod(np.broadcast_shapes(a[:-2], b[:-2]))
            return batch * math.prod(a[-2:-1]) * math.prod(b[-1:] if len(b) > 1 else ())
        case "Gemm", _:
            return max(shapes[0]) * max(shapes[1])
        case operator, _ if operator in _ELEMENTWISE:
            return math.prod(np.broadcast_shapes(*shapes))
    return 0


OPERATORS: dict[str, Callable[..., Any]] = {
    **{operator: _same(name) for operator, name in _OF_NUMPY.items()},
    **{operator: _reduce(name) for operator, name in _REDUCTIONS.items()},
    **{operator: _activation(function) for operator, function in _ACTIVATIONS.items()},
    "MatMul": _same("matmul"),
    "Min": _folded("minimum"), "Max": _folded("maximum"), "Sum": _folded("add"),
    "Mean": lambda node, *inputs: sum(inputs) / len(inputs),
    "Div": _divide, "Mod": _mod, "Gemm": _gemm,
    "Reciprocal": lambda node, x: 1 / x,
    "Relu": lambda node, x: _module(x).maximum(x, _module(x).asarray(0, x.dtype)),
    "Elu": lambda node, x: jax.nn.elu(x, node.get("alpha", 1.0)),
    "Celu": lambda node, x: jax.nn.celu(x, node.get("alpha", 1.0)),
    "LeakyRelu": lambda node, x: jax.nn.leaky_relu(x, node.get("alpha", 0.01)),
    "PRelu": lambda node, x, slope: jnp.where(x > 0, x, slope * x),
    "Selu": _selu,
    "HardSigmoid": lambda node, x: jnp.clip(
        node.get("alpha", 0.2) * x + node.get("beta", 0.5), 0, 1
    ),
    "Gelu": lambda node, x: jax.nn.gelu(x, node.get("approximate", "none") == "tanh"),
    "Softmax": _softmax(jax.nn.softmax), "LogSoftmax": _softmax(jax.nn.log_softmax),
    "Clip": _clip, "Cast": _cast, "CastLike": lambda node, x, like: x.astype(like.dtype),
    "Constant": _constant, "ConstantOfShape": _constant_of_shape,
    "Identity": lambda node, x: x, "Dropout": _dropout,
    "Reshape": _reshape,
    "Flatten": lambda node, x: x.reshape(math.prod(x.shape[: _axis(node, x, 1)]), -1),
    "Transpose": lambda node, x: x.transpose(node.get("perm", tuple(range(x.ndim))[::-1])),
    "Squeeze": _squeeze,
    "Unsqueeze": lambda node, x, axes=None: _module(x).expand_dims(x, _axes(node, axes) or ()),
    "Concat": lambda node, *inputs: _module(*inputs).concatenate(
        inputs, axis=node.attributes["axis"]
    ),
    "Split": _split, "Slice": _slice, "Gather": _gather, "GatherElements": _gather_elements,
    "Expand": _expand, "Tile": _tile, "Pad": _pad, "Range": _range,
    "Shape": lambda node, x: np.array(
        x.shape[node.get("start", 0) : node.get("end", None)], np.int64
    ),
    "Size": lambda node, x: np.array(math.prod(x.shape), np.int64),
    "Where": lambda node, condition, a, b: _module(condition, a, b).where(condition, a, b),
    "ArgMax": _arg("argmax"), "ArgMin": _arg("argmin"),
    "LayerNormalization": _layer_normalization, "BatchNormalization": _batch_normalization,
    "InstanceNormalization": _instance_normalization,
    "Conv": _conv, "MaxPool": _pool(largest=True), "AveragePool": _pool(largest=False),
    "GlobalAveragePool": _global_pool("mean"), "GlobalMaxPool": _global_pool("max"),
    "LSTM": lstm, "GRU": gru, "RNN": rnn,
}  # fmt: skip
"""The operators that policies use, by name."""
