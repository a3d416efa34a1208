"""Operators of ONNX, each a function `(node, *inputs) -> outputs`.

An operator of NumPy arrays alone gives NumPy arrays, so that shapes and indices stay numbers under
`jit`. Source: the ONNX specification, `docs/Operators.md`, up to operator set 23.
"""

import math
from collections.abc import Callable
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.rl.policies import onnx_layers as layers
from verifai_jax.addons.rl.policies import onnx_quantized, onnx_trees
from verifai_jax.addons.rl.policies.onnx_node import (
    TYPES,
    Node,
    Value,
    cast,
    known,
    like,
    module,
    static,
    static_axes,
    whole,
)

Given = Value | None


def _same(name: str) -> Callable[..., Any]:
    """Return an operator that is a function of NumPy of this name."""
    return lambda node, *inputs: getattr(module(*inputs), name)(*inputs)


def _folded(name: str) -> Callable[..., Any]:
    """Return an operator of any number of inputs that is a function of two."""
    return lambda node, *inputs: reduce(getattr(module(*inputs), name), inputs)


def _by_index(name: str) -> Callable[..., Any]:
    """Return an operator that takes entries of an axis by their indices."""

    def operator(node: Node, x: Value, index: Value) -> Value:
        axis = node.get("axis", 0) % x.ndim
        size = x.shape[axis]
        beyond = known(index) and np.any((index < -size) | (index >= size))
        node.refuse(beyond, f"has an index beyond the {size} entries of axis {axis}")
        index = module(index).where(index < 0, index + size, index)
        if name == "take_along_axis":
            x = x[tuple(slice(None if i == axis else n) for i, n in enumerate(index.shape))]
        return getattr(module(x, index), name)(x, index, axis=axis)

    return operator


def _divide(node: Node, a: Value, b: Value) -> Value:
    if not whole(a):
        return a / b
    down = a // b
    return down + ((down * b != a) & ((a < 0) != (b < 0)))  # Towards zero, as in C.


def _mod(node: Node, a: Value, b: Value) -> Value:
    as_in_c = node.get("fmod", 0)
    node.refuse(not (as_in_c or whole(a)), "has fmod=0, which is for whole numbers")
    return getattr(module(a, b), "fmod" if as_in_c else "mod")(a, b)


def _pow(node: Node, a: Value, b: Value) -> Value:
    if not whole(a):
        return like(module(a, b).power(a, b), a)
    if not whole(b):
        odd = not known(b) or np.any(b != np.round(b))
        node.refuse(odd, "has a whole number to the power of a real one, which is not supported")
        b = cast(b, np.int32)
    xp = module(a, b)
    inverse = xp.where(abs(a) == 1, a ** xp.asarray(b % 2, a.dtype), 0)
    return like(xp.where(b < 0, inverse, xp.power(a, xp.maximum(b, 0))), a)


def _gemm(node: Node, a: Value, b: Value, c: Given = None) -> Value:
    a = a.T if node.get("transA", 0) else a
    b = b.T if node.get("transB", 0) else b
    alpha, beta = node.get("alpha", 1.0), node.get("beta", 1.0)
    if whole(a):
        odd = alpha != int(alpha) or beta != int(beta)
        node.refuse(odd, f"has alpha={alpha:zg} and beta={beta:zg} for whole numbers")
        alpha, beta = int(alpha), int(beta)
    product = jnp.matmul(a, b)
    product = product if alpha == 1 else alpha * product
    return product if c is None else product + (c if beta == 1 else beta * c)


def _softmax(function: Callable[..., Any]) -> Callable[..., Any]:
    def operator(node: Node, x: Value) -> Value:
        if node.opset >= 13:
            return function(x, axis=node.get("axis", -1))
        # Before, all axes from this one on were one.
        axis = node.get("axis", 1) % x.ndim
        return function(x.reshape(*x.shape[:axis], -1), axis=-1).reshape(x.shape)

    return operator


def _clip(node: Node, x: Value, low: Given = None, high: Given = None) -> Value:
    # Without an end infinity becomes the greatest number.
    ends: Any = jnp.finfo(x.dtype) if jnp.issubdtype(x.dtype, jnp.floating) else None
    low = node.get("min", ends and ends.min) if low is None else low
    high = node.get("max", ends and ends.max) if high is None else high
    xp = module(x)
    x = x if low is None else xp.maximum(x, xp.asarray(low, x.dtype))
    return x if high is None else xp.minimum(x, xp.asarray(high, x.dtype))


def _cast(node: Node, x: Value) -> Any:
    to = node.attributes["to"]
    node.refuse(to not in TYPES, f"makes numbers of type {to}, which is not supported")
    return cast(x, TYPES[to])


def _constant(node: Node) -> Any:
    (value,) = node.attributes.values()
    array = np.asarray(value)
    return array.astype(np.float32) if array.dtype == np.float64 else array


def _constant_of_shape(node: Node, shape: Value) -> Any:
    value = np.asarray(node.get("value", np.zeros(1, np.float32))).ravel()[0]
    return np.full(static(node, shape), value)


def _dropout(node: Node, x: Value, ratio: Given = None, training: object = False) -> Value:
    node.refuse(training, layers.IN_TRAINING)
    return x


def _flatten(node: Node, x: Value) -> Value:
    axis = node.get("axis", 1)
    axis += x.ndim * (axis < 0)
    return x.reshape(math.prod(x.shape[:axis]), math.prod(x.shape[axis:]))


def _reshape(node: Node, x: Value, shape: Given = None) -> Value:
    sizes = list(node.attributes["shape"] if shape is None else static(node, shape))
    if not node.get("allowzero", 0):
        sizes = [x.shape[i] if n == 0 else n for i, n in enumerate(sizes)]
    return x.reshape(sizes)


def _squeeze(node: Node, x: Value, axes: Given = None) -> Value:
    return module(x).squeeze(x, static_axes(node, axes))


def _split(node: Node, x: Value, sizes: Given = None) -> tuple[Value, ...]:
    axis = node.get("axis", 0)
    lengths = node.get("split", None) if sizes is None else static(node, sizes)
    if lengths is None:
        count = len(node.outputs)
        differ = node.get("num_outputs", count) != count
        node.refuse(differ, f"has {count} outputs, which are not its num_outputs")
        step = -(-x.shape[axis] // count)
        lengths = [min(step, x.shape[axis] - i * step) for i in range(count)]
    return tuple(module(x).split(x, np.cumsum(lengths)[:-1].tolist(), axis=axis))


def _slice(node: Node, x: Value, *given: Value) -> Value:
    named = zip(("starts", "ends", "axes", "steps"), given, strict=False)
    said = {**node.attributes, **{n: static(node, v) for n, v in named if v is not None}}
    starts, ends = said["starts"], said["ends"]
    axes, steps = said.get("axes", range(len(starts))), said.get("steps", [1] * len(starts))
    where = [slice(None)] * x.ndim
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        size, back = x.shape[axis], step < 0
        start, end = (at + size if at < 0 else at for at in (start, end))
        start = min(max(start, 0), size - back)
        end = min(max(end, -back), size - back)
        # An end before the first entry means "to the first one" when it goes backwards.
        where[axis] = slice(start, None if end < 0 else end, step)
    return x[tuple(where)]


def _pad(node: Node, x: Value, pads: Given = None, value: Given = None, axes: Given = None) -> Any:
    widths = node.attributes["pads"] if pads is None else static(node, pads)
    chosen = range(x.ndim) if axes is None else static(node, axes)
    around, left = [(0, 0)] * x.ndim, [slice(None)] * x.ndim
    for i, axis in enumerate(chosen):
        low, high = widths[i], widths[len(chosen) + i]
        around[axis] = max(low, 0), max(high, 0)
        left[axis] = slice(max(-low, 0), min(high, 0) or None)
    mode = node.get("mode", "constant")
    node.refuse(mode not in ("constant", "reflect", "edge", "wrap"), f"has mode={mode!r}")
    x = x[tuple(left)]
    if mode == "constant":
        filled = node.get("value", 0.0) if value is None else jnp.asarray(value).reshape(())
        return jnp.pad(x, around, constant_values=jnp.asarray(filled, x.dtype))
    return jnp.pad(x, around, mode=mode)


def _reduce(name: str) -> Callable[..., Any]:
    def operator(node: Node, x: Value, axes: Given = None) -> Value:
        found = static_axes(node, axes)
        if found is None and node.get("noop_with_empty_axes", 0):
            found = ()
        xp, form = module(x), {"axis": found, "keepdims": bool(node.get("keepdims", 1))}
        if name in ("max", "min"):
            # Of no values the maximum is the lowest value of the type.
            none = {"initial": layers.extreme(x, name)} if x.size == 0 else {}
            return getattr(xp, name)(x, **form, **none)
        if name == "mean" and whole(x):
            total = xp.sum(x, **form, dtype=x.dtype)
            return _divide(node, total, xp.asarray(x.size // max(total.size, 1), x.dtype))
        node.refuse(name == "l2" and whole(x), "has whole numbers, which are not supported")
        if name == "l1":
            return xp.sum(xp.abs(x), **form, dtype=x.dtype)
        if name == "l2":
            return xp.sqrt(xp.sum(x * x, **form, dtype=x.dtype))
        return getattr(xp, name)(x, **form, dtype=x.dtype)

    return operator


def _arg(name: str) -> Callable[..., Any]:
    def operator(node: Node, x: Value) -> Value:
        axis, last = node.get("axis", 0), node.get("select_last_index", 0)
        x = jnp.flip(x, axis) if last else x
        found = getattr(jnp, name)(x, axis, keepdims=bool(node.get("keepdims", 1)))
        return x.shape[axis] - 1 - found if last else found

    return operator


_OF_NUMPY = {
    "Add": "add", "Sub": "subtract", "Mul": "multiply", "Sqrt": "sqrt",
    "Exp": "exp", "Log": "log", "Abs": "abs", "Neg": "negative", "Floor": "floor", "Ceil": "ceil",
    "Round": "round", "Sign": "sign", "Sin": "sin", "Cos": "cos", "Tan": "tan", "Atan": "arctan",
    "Tanh": "tanh", "Equal": "equal", "Greater": "greater", "Less": "less",
    "GreaterOrEqual": "greater_equal", "LessOrEqual": "less_equal", "And": "logical_and",
    "Or": "logical_or", "Xor": "logical_xor", "Not": "logical_not", "IsNaN": "isnan",
    "Asin": "arcsin", "Acos": "arccos", "Sinh": "sinh", "Cosh": "cosh", "MatMul": "matmul",
}  # fmt: skip
"""Operators that are functions of NumPy on the same inputs."""
_REDUCTIONS = {
    "ReduceMean": "mean", "ReduceSum": "sum", "ReduceMax": "max", "ReduceMin": "min",
    "ReduceProd": "prod", "ReduceL1": "l1", "ReduceL2": "l2",
}  # fmt: skip
"""Operators over axes, by the function of NumPy."""
_ACTIVATIONS: dict[str, Callable[[Value], Value]] = {
    "Sigmoid": jax.nn.sigmoid, "Softplus": jax.nn.softplus, "Softsign": jax.nn.soft_sign,
    "HardSwish": lambda x: x * jnp.clip(x / 6 + 0.5, 0, 1), "Mish": jax.nn.mish,
    "Erf": jax.scipy.special.erf, "Reciprocal": lambda x: 1 / x,
}  # fmt: skip
"""Operators without attributes, as functions of one array."""
GROWING = {
    **{name: name for name in ("Add", "Sub", "Mul", "Div", "Pow", "Neg", "Abs", "Sum", "MatMul")},
    **{name: name for name in ("Gemm", "ReduceSum", "ReduceProd", "ReduceL1")},
    "ReduceMean": "ReduceSum", "Cast": "Identity", "CastLike": "Identity",
}  # fmt: skip
"""Operators whose results may be larger than their inputs, with those that say how large."""
_ELEMENTWISE = {*_OF_NUMPY, "Min", "Max", "Sum", "Mean", "Div", "Mod", "PRelu", "Where", "Clip"}
_ELEMENTWISE |= {"LayerNormalization", "RMSNormalization"}


def output_size(node: Node, *inputs: Any) -> int:
    """Return the maximum number of results of an operator, before it is computed.

    Only operators whose result can be much larger than their input are covered; others give 0.
    """
    shapes: list[tuple[int, ...]] = [() if v is None else np.shape(v) for v in inputs]
    match node.operator, len(inputs):
        case "ConstantOfShape", 1:
            return math.prod(static(node, inputs[0]))
        case "Expand", 2:
            return math.prod(np.broadcast_shapes(shapes[0], static(node, inputs[1])))
        case "Tile", 2:
            return math.prod(shapes[0]) * math.prod(static(node, inputs[1]))
        case "Range", 3:
            start, end, step = (float(np.asarray(value)) for value in inputs)
            return int(max(0.0, (end - start) / step)) if step else 0
        case "Pad", _:
            pads = node.get("pads", ()) if len(inputs) == 1 else static(node, inputs[1])
            return math.prod(n + 2 * max(0, 0, *pads) for n in shapes[0])
        case "Conv" | "MaxPool" | "AveragePool", _:
            channels = shapes[1][0] if node.operator == "Conv" else shapes[0][1]
            wide = 2 * max(0, 0, *node.get("pads", ()))
            if node.get("auto_pad", "NOTSET").startswith("SAME"):
                spans = node.get("kernel_shape", shapes[-1][2:])
                wide += max(spans) * max(node.get("dilations", (1,)))
            return shapes[0][0] * channels * math.prod(n + wide for n in shapes[0][2:])
        case "Gather", 2:
            rows = max(1, shapes[0][node.get("axis", 0)])
            return math.prod(shapes[0]) // rows * math.prod(shapes[1])
        case "MatMul" | "MatMulInteger" | "QLinearMatMul", _:
            a, b = shapes[0], shapes[3 if node.operator == "QLinearMatMul" else 1]
            batch = math.prod(np.broadcast_shapes(a[:-2], b[:-2]))
            return batch * math.prod(a[-2:-1]) * math.prod(b[-1:] if len(b) > 1 else ())
        case "TreeEnsembleRegressor" | "TreeEnsembleClassifier", _:
            # Of each node a threshold, and of each tree as many steps as the deepest one has.
            nodes, trees = len(node.get("nodes_nodeids", ())), len({*node.get("nodes_treeids", ())})
            targets = max(1, node.get("n_targets", 1), *node.get("class_ids", (0,)))
            return nodes * targets + math.prod(shapes[0][:1]) * trees * targets
        case "Concat", _:
            return sum(map(math.prod, shapes))
        case "BatchNormalization" | "InstanceNormalization", _:
            return math.prod(shapes[0]) * (
                1 if shapes[0][1] > 1 else max(map(math.prod, shapes[1:]))
            )
        case "LSTM" | "GRU" | "RNN", _:
            return math.prod(shapes[0][:2]) * math.prod(shapes[1][:2])
        case "Gemm", _:
            return max(shapes[0]) * max(shapes[1])
        case operator, _ if operator in _ELEMENTWISE:
            return math.prod(np.broadcast_shapes(*shapes))
    return 0


OPERATORS: dict[str, Callable[..., Any]] = {
    **{operator: _same(name) for operator, name in _OF_NUMPY.items()},
    **{operator: _reduce(name) for operator, name in _REDUCTIONS.items()},
    **{operator: lambda node, x, f=f: f(x) for operator, f in _ACTIVATIONS.items()},
    "Min": _folded("minimum"), "Max": _folded("maximum"), "Sum": _folded("add"),
    "Mean": lambda node, *inputs: sum(inputs) / len(inputs),
    "Div": _divide, "Gemm": _gemm, "Mod": _mod, "Pow": _pow,
    "Relu": lambda node, x: module(x).maximum(x, module(x).asarray(0, x.dtype)),
    "Elu": lambda node, x: jax.nn.elu(x, node.get("alpha", 1.0)),
    "Celu": lambda node, x: jax.nn.celu(x, node.get("alpha", 1.0)),
    "Selu": lambda node, x: (
        node.get("gamma", 1.0507010221481323) * jax.nn.elu(x, node.get("alpha", 1.6732631921768188))
    ),
    "LeakyRelu": lambda node, x: jax.nn.leaky_relu(x, node.get("alpha", 0.01)),
    "PRelu": lambda node, x, slope: jnp.where(x > 0, x, slope * x),
    "HardSigmoid": lambda node, x: jnp.clip(
        node.get("alpha", 0.2) * x + node.get("beta", 0.5), 0, 1
    ),
    "Gelu": lambda node, x: jax.nn.gelu(x, node.get("approximate", "none") == "tanh"),
    "Softmax": _softmax(jax.nn.softmax), "LogSoftmax": _softmax(jax.nn.log_softmax),
    "Clip": _clip, "Cast": _cast, "CastLike": lambda node, x, other: cast(x, other.dtype),
    "Constant": _constant, "ConstantOfShape": _constant_of_shape,
    "Identity": lambda node, x, *_: x, "Dropout": _dropout,
    "Reshape": _reshape, "Flatten": _flatten, "Squeeze": _squeeze,
    "Transpose": lambda node, x: x.transpose(node.get("perm", tuple(range(x.ndim))[::-1])),
    "Unsqueeze": lambda node, x, axes=None: module(x).expand_dims(
        x, static_axes(node, axes) or ()
    ),
    "Concat": lambda node, *inputs: module(*inputs).concatenate(
        inputs, axis=node.attributes["axis"]
    ),
    "Split": _split, "Slice": _slice, "Pad": _pad,
    "Gather": _by_index("take"), "GatherElements": _by_index("take_along_axis"),
    "Expand": lambda node, x, shape: module(x).broadcast_to(
        x, np.broadcast_shapes(x.shape, static(node, shape))
    ),
    "Tile": lambda node, x, repeats: module(x).tile(x, static(node, repeats)),
    "Range": lambda node, *ends: np.arange(
        *(np.asarray(v).item() for v in ends), dtype=np.asarray(ends[0]).dtype
    ),
    "Shape": lambda node, x: np.array(
        x.shape[node.get("start", 0) : node.get("end", None)], np.int64
    ),
    "Size": lambda node, x: np.array(math.prod(x.shape), np.int64),
    "Where": lambda node, *inputs: module(*inputs).where(*inputs),
    "ArgMax": _arg("argmax"), "ArgMin": _arg("argmin"),
    **dict.fromkeys(("LayerNormalization", "RMSNormalization"), layers.layer_normalization),
    **dict.fromkeys(("BatchNormalization", "InstanceNormalization"), layers.channel_normalization),
    "Conv": layers.conv, "MaxPool": layers.pool, "AveragePool": layers.pool,
    "GlobalAveragePool": lambda node, x: x.mean(tuple(range(2, x.ndim)), keepdims=True),
    "GlobalMaxPool": lambda node, x: x.max(tuple(range(2, x.ndim)), keepdims=True),
    **dict.fromkeys(("LSTM", "GRU", "RNN"), layers.recurrent),
    **onnx_quantized.OPERATORS, **onnx_trees.OPERATORS,
}  # fmt: skip
"""The operators that policies use, by name."""
