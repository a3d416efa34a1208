"""Pure functions of JAX as graphs of ONNX operators.

A function is traced, and each operation of JAX becomes operators of ONNX. This covers networks of
flax and equinox, policies of Brax, scales, squashing and memory. The existing jax2onnx is not used,
because it only translates models of certain libraries and pins their versions.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from verifai_jax.addons.rl.policies.errors import PolicyError
from verifai_jax.addons.rl.policies.onnx_graph import OPSET, Graph
from verifai_jax.addons.rl.policies.onnx_node import Node
from verifai_jax.core.compute.fingerprint import operands_of_scan
from verifai_jax.core.compute.jaxprs import called, run_through

Jaxpr = Any
"""A `jax.core.Jaxpr`, its equations, variables and their forms: JAX does not export the classes."""
Value: TypeAlias = str | np.ndarray
"""The name of a value that depends on the observation or the weights, or a known array."""
Traced = tuple[Graph, dict[str, np.ndarray], tuple[np.ndarray, ...]]
"""A graph, all its arrays by name, and its initial memory."""
Options = Mapping[str, Any]
Ints = Sequence[int]
_SAME = {
    "add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div", "max": "Max", "min": "Min",
    "pow": "Pow", "neg": "Neg", "exp": "Exp", "log": "Log", "tanh": "Tanh", "logistic": "Sigmoid",
    "sqrt": "Sqrt", "abs": "Abs", "sign": "Sign", "floor": "Floor", "ceil": "Ceil", "sin": "Sin",
    "cos": "Cos", "tan": "Tan", "atan": "Atan", "erf": "Erf", "eq": "Equal", "lt": "Less",
    "le": "LessOrEqual", "gt": "Greater", "ge": "GreaterOrEqual", "and": "And", "or": "Or",
    "xor": "Xor", "not": "Not", "copy": "Identity",
    "stop_gradient": "Identity", "add_any": "Add", "round": "Round",
}  # fmt: skip
"""Operations of JAX that are one operator of ONNX on the same inputs."""
_COMPOSED: dict[str, Callable[..., str]] = {
    "ne": lambda node, number, x, y: node("Not", [node("Equal", [x, y])]),
    "square": lambda node, number, x: node("Mul", [x, x]),
    "rsqrt": lambda node, number, x: node("Reciprocal", [node("Sqrt", [x])]),
    "exp2": lambda node, number, x: node("Pow", [number(2), x]),
    "log1p": lambda node, number, x: node("Log", [node("Add", [x, number(1)])]),
    "expm1": lambda node, number, x: node("Sub", [node("Exp", [x]), number(1)]),
    "erfc": lambda node, number, x: node("Sub", [number(1), node("Erf", [x])]),
    "rem": lambda node, number, x, y: node("Mod", [x, y], fmod=1),
    "clamp": lambda node, number, low, x, high: node("Min", [node("Max", [x, low]), high]),
}
"""Operations of JAX that are several operators, by `node` and `number`, which makes constants."""
_REDUCTIONS = {f"reduce_{kind.lower()}": f"Reduce{kind}" for kind in ("Sum", "Max", "Min", "Prod")}
_TYPES = {"f": 1, "b": 9, "i": 6, "u": 12}
"""Numbers of the types of ONNX: float, bool, int32, uint32."""


def traced(
    function: Callable[..., Any], weights: PyTree, observation: PyTree, memory: PyTree
) -> Traced:
    """Translate a pure function `(weights, observation, memory) -> (action, memory)` to ONNX.

    - `weights`: a pytree of arrays, whose paths become their names.
    - `observation`: an example; several arrays by name become several inputs.
    - `memory`: the memory at the start of an episode, a pytree; None for none.

    **Raises:** `PolicyError` for an operation that ONNX, or this translation, does not support.
    """
    named = observation if isinstance(observation, Mapping) else {"observation": observation}
    shapes = {name: tuple(np.shape(value)) for name, value in named.items()}
    states, structure = jax.tree.flatten(memory)
    leaves, tree = jax.tree.flatten_with_path(weights)
    held = [f"weights.{jax.tree_util.keystr(p, simple=True, separator='.')}" for p, _ in leaves]

    def flat(arrays: list[Array], seen: dict[str, Array], states: list[Array]) -> list[Any]:
        given = seen if isinstance(observation, Mapping) else seen["observation"]
        action, after = function(
            jax.tree.unflatten(tree, arrays), given, jax.tree.unflatten(structure, states)
        )
        return [jnp.asarray(action), *jax.tree.leaves(after)]

    seen = {name: jnp.asarray(value) for name, value in named.items()}
    values = [jnp.asarray(leaf) for _, leaf in leaves]
    closed = jax.make_jaxpr(flat)(values, seen, [jnp.asarray(s) for s in states])
    first = [f"memory.{i}" for i in range(len(states))]
    # JAX sorts the keys of a dictionary.
    inputs = [*held, *sorted(seen), *first]
    translation = _Translation(dict(zip(held, map(np.asarray, values), strict=True)))
    outputs = translation.translate(closed.jaxpr, [_known(c) for c in closed.consts], list(inputs))
    after = [f"memory.{i}.next" for i in range(len(states))]
    for name, value in zip(["action", *after], outputs, strict=True):
        translation.node("Identity", [value], name)
    nodes = tuple(translation.needed(["action", *after]))
    graph = Graph(nodes, {}, shapes, tuple(zip(first, after, strict=True)), output="action")
    read = {name for node in graph.nodes for name in node.inputs}
    arrays = {n: a for n, a in translation.arrays.items() if n in read}
    return graph, arrays, tuple(np.asarray(s) for s in states)


class _Translation:
    """The nodes of a graph under construction; a value is a node's name, or a known array."""

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        self.arrays, self.nodes = arrays, list[Node]()

    def name(self, value: Value) -> str:
        """Return the name of a value; for a known array, that of the constant with its content."""
        if isinstance(value, str):
            return value
        array = np.asarray(value)
        known = [n for n, a in self.arrays.items() if n.startswith("c") and _same(a, array)]
        name = [*known, f"c{len(self.arrays)}"][0]
        self.arrays[name] = array
        return name

    def node(
        self, operator: str, inputs: Sequence[Value], output: str = "", **attributes: Any
    ) -> str:
        """Add a node, and return the name of its output."""
        made = output or f"v{len(self.nodes)}"
        names = tuple(self.name(value) for value in inputs)
        self.nodes.append(Node(operator, made, names, (made,), attributes, OPSET))
        return made

    def needed(self, outputs: Sequence[str]) -> list[Node]:
        """Return the nodes on which outputs depend, in order."""
        wanted, kept = set(outputs), []
        for node in reversed(self.nodes):
            if node.outputs[0] in wanted:
                kept.append(node)
                wanted.update(node.inputs)
        return kept[::-1]

    def translate(
        self, jaxpr: Jaxpr, constants: Sequence[Value], inputs: Sequence[Value]
    ) -> list[Value]:
        """Add the nodes of a function, and return its outputs."""
        return run_through(jaxpr, constants, inputs, lambda each: _known(each.val), self.equation)

    def equation(self, equation: Jaxpr, given: list[Value]) -> list[Value]:
        """Return the outputs of one operation."""
        kind, options = equation.primitive.name, equation.params
        if (inner := called(equation)) is not None:
            plain = getattr(inner, "jaxpr", inner)
            return self.translate(plain, getattr(inner, "consts", ()), given)
        if not any(isinstance(value, str) for value in given) and kind != "pure_callback":
            made = equation.primitive.bind(*map(_on_device, given), **options)
            return [_known(m) for m in (made if equation.primitive.multiple_results else [made])]
        if kind == "scan":
            return self.scan(given, options)
        if kind == "unstack":
            form, axis = equation.outvars[0].aval.shape, options["axis"]
            count = range(len(equation.outvars))
            rows = [self.sliced(given[0], [i], [i + 1], [axis]) for i in count]
            return [self.reshaped(row, form) for row in rows]
        if kind == "split":
            ends = np.cumsum(options["sizes"])
            starts = ends - options["sizes"]
            parts = zip(starts, ends, strict=True)
            return [self.sliced(given[0], [s], [e], [options["axis"]]) for s, e in parts]
        form, shapes = equation.outvars[0].aval, [v.aval for v in equation.invars]
        try:
            return [self.operation(kind, given, options, form, shapes)]
        except NotImplementedError:
            remedy = "save its weights with its own framework"
            raise PolicyError(
                f"the policy computes {kind}, which cannot be saved as a graph: {remedy}"
            ) from None

    def scan(self, given: list[Value], options: Mapping[str, Any]) -> list[Value]:
        """Return the outputs of a loop of fixed length, written out."""
        fixed, carried = operands_of_scan(options)
        constants, carry = given[:fixed], given[fixed : fixed + carried]
        series, inner = given[fixed + carried :], options["jaxpr"]
        shapes = [v.aval.shape for v in inner.jaxpr.invars[fixed + carried :]]
        steps, rows = range(options["length"]), {}
        for i in reversed(steps) if options["reverse"] else steps:
            now = [
                self.reshaped(self.sliced(value, [i], [i + 1], [0]), shape)
                if isinstance(value, str)
                else value[i]
                for value, shape in zip(series, shapes, strict=True)
            ]
            outputs = self.translate(inner.jaxpr, inner.consts, [*constants, *carry, *now])
            carry, rows[i] = outputs[:carried], outputs[carried:]
        shapes = [v.aval.shape for v in inner.jaxpr.outvars[carried:]]
        stacked = [
            self.node("Concat", [self.reshaped(rows[i][k], (1, *shape)) for i in steps], axis=0)
            for k, shape in enumerate(shapes)
        ]
        return [*carry, *stacked]

    def reshaped(self, value: Value, shape: Iterable[int]) -> str:
        return self.node("Reshape", [value, _i(shape)])

    def sliced(
        self, value: Value, starts: Ints, ends: Ints, axes: Ints | None = None, steps: Ints = ()
    ) -> str:
        axes = range(len(starts)) if axes is None else axes
        last = [_i(steps)] if steps else []
        return self.node("Slice", [value, _i(starts), _i(ends), _i(axes), *last])

    def operation(
        self, kind: str, given: list[Value], options: Options, form: Jaxpr, shapes: list[Jaxpr]
    ) -> str:
        """Return the output of an operation; `NotImplementedError` for an unknown one."""
        node, x = self.node, given[0]
        real = shapes[0].dtype
        if kind in ("and", "or", "xor", "not") and real.kind != "b":
            raise NotImplementedError
        if kind in _SAME:
            return node(_SAME[kind], given)
        if kind in _REDUCTIONS:
            return node(_REDUCTIONS[kind], [x, _i(options["axes"])], keepdims=0)
        if kind in ("argmax", "argmin"):
            (axis,) = options["axes"]
            found = node("ArgMax" if kind == "argmax" else "ArgMin", [x], axis=axis, keepdims=0)
            return node("Cast", [found], to=number_type(form.dtype))
        if kind in _COMPOSED:
            return _COMPOSED[kind](node, lambda n: np.asarray(n, real), *given)
        match kind:
            case "integer_pow":
                return self.power(x, options["y"], real)
            case "select_n" if len(given) == 3 and real.kind == "b":
                return node("Where", [x, given[2], given[1]])
            case "convert_element_type":
                return node("Cast", [x], to=number_type(form.dtype))
            case "reshape" | "squeeze" | "expand_dims":
                return self.reshaped(x, form.shape)
            case "broadcast_in_dim":
                sizes = dict(zip(options["broadcast_dimensions"], shapes[0].shape, strict=True))
                ones = [sizes.get(i, 1) for i in range(len(form.shape))]
                return node("Expand", [self.reshaped(x, ones), _i(form.shape)])
            case "transpose":
                return node("Transpose", [x], perm=tuple(options["permutation"]))
            case "concatenate":
                return node("Concat", given, axis=options["dimension"])
            case "stack":
                parts = [np.insert(v.shape, options["axis"], 1) for v in shapes]
                rows = [self.reshaped(v, part) for v, part in zip(given, parts, strict=True)]
                return node("Concat", rows, axis=options["axis"])
            case "tile":
                return node("Tile", [x, _i(options["reps"])])
            case "gather":
                return self.gathered(given, options, shapes)
            case "slice":
                starts, ends = options["start_indices"], options["limit_indices"]
                steps = options["strides"] or ()
                return self.sliced(x, starts, ends, steps=steps)
            case "dynamic_slice" if not any(isinstance(v, str) for v in given[1:]):
                sizes = options["slice_sizes"]
                bounds = zip(given[1:], shapes[0].shape, sizes, strict=True)
                starts = [min(max(int(v), 0), whole - n) for v, whole, n in bounds]
                ends = [s + n for s, n in zip(starts, sizes, strict=True)]
                return self.sliced(x, starts, ends)
            case "pad" if all(i == 0 and min(a, b) >= 0 for a, b, i in options["padding_config"]):
                pads = [c[k] for k in (0, 1) for c in options["padding_config"]]
                return node("Pad", [x, _i(pads), given[1]])
            case "dot_general":
                return self.product(given, options["dimension_numbers"], form.shape, shapes)
            case "conv_general_dilated" if options["batch_group_count"] == 1:
                return self.convolution(given, options)
            case "reduce_window_max" | "reduce_window_sum":
                return self.pooling(kind, x, options, real)
        raise NotImplementedError

    def gathered(self, given: list[Value], options: Options, shapes: list[Jaxpr]) -> str:
        """Return entries of one axis by their indices, which are clipped as JAX does."""
        x, index = given
        numbers, shape, form = options["dimension_numbers"], shapes[0].shape, shapes[1].shape
        (axis, *others), rank = numbers.start_index_map, len(form) - 1
        whole = (*shape[:axis], 1, *shape[axis + 1 :])
        offsets = (*range(axis), *range(axis + rank, len(shape) - 1 + rank))
        plain = numbers.collapsed_slice_dims == (axis,) and not numbers.operand_batching_dims
        if others or not plain or options["slice_sizes"] != whole or numbers.offset_dims != offsets:
            raise NotImplementedError
        if isinstance(index, str):
            bound = np.asarray(shape[axis] - 1, shapes[1].dtype)
            index = self.node("Min", [self.node("Max", [index, np.zeros_like(bound)]), bound])
            return self.node("Gather", [x, self.reshaped(index, form[:-1])], axis=axis)
        chosen = np.clip(index.reshape(form[:-1]), 0, shape[axis] - 1).astype(np.int64)
        return self.node("Gather", [x, chosen], axis=axis)

    def power(self, x: Value, exponent: int, real: np.dtype[Any]) -> str:
        if not 1 <= abs(exponent) <= 8:
            return self.node("Pow", [x, np.asarray(exponent, real)])
        made = x
        for _ in range(abs(exponent) - 1):
            made = self.node("Mul", [made, x])
        return self.node("Reciprocal", [made]) if exponent < 0 else self.node("Identity", [made])

    def product(
        self, given: list[Value], numbers: Jaxpr, shape: Sequence[int], shapes: list[Jaxpr]
    ) -> str:
        """Return a product over any axes, as a product of matrices `[b, m, k]` and `[b, k, n]`."""
        contracted, batch = numbers
        sides, free = [], []
        for i, last in ((0, True), (1, False)):
            form, k, b = shapes[i].shape, tuple(contracted[i]), tuple(batch[i])
            rest = tuple(a for a in range(len(form)) if a not in (*k, *b))
            order = (*b, *rest, *k) if last else (*b, *k, *rest)
            sizes = [math.prod(form[a] for a in axes) for axes in (b, rest, k)]
            whole = (sizes[0], sizes[1], sizes[2]) if last else (sizes[0], sizes[2], sizes[1])
            whole = whole if b else whole[1:]
            value = given[i]
            if order != tuple(range(len(form))):
                value = self.node("Transpose", [value], perm=order)
            # The weights of a layer stay as they are.
            sides.append(value if tuple(whole) == tuple(form) else self.reshaped(value, whole))
            free.append(rest)
        return self.reshaped(self.node("MatMul", sides), shape)

    def convolution(self, given: list[Value], options: Options) -> str:
        image, kernel, out = options["dimension_numbers"]
        if any(n != 1 for n in options["lhs_dilation"]):
            raise NotImplementedError
        pads = tuple(p[k] for k in (0, 1) for p in options["padding"])
        sides = zip(given, (image, kernel), strict=True)
        made = self.node(
            "Conv", [self.node("Transpose", [v], perm=tuple(spec)) for v, spec in sides],
            strides=tuple(options["window_strides"]), pads=pads,
            dilations=tuple(options["rhs_dilation"]), group=options["feature_group_count"],
        )  # fmt: skip
        return self.node("Transpose", [made], perm=tuple(int(i) for i in np.argsort(out)))

    def pooling(self, kind: str, x: Value, options: Options, real: np.dtype[Any]) -> str:
        """Return the maximum or the sum of each window, over all axes except two."""
        window = options["window_dimensions"]
        still = [i for i, n in enumerate(window) if n == 1][:2]
        moved = [i for i in range(len(window)) if i not in still]
        if len(still) < 2 or any(n != 1 for n in options["base_dilation"]):
            raise NotImplementedError
        order = (*still, *moved)
        kernel = tuple(window[i] for i in moved)
        if any(any(options["padding"][i]) or options["window_strides"][i] != 1 for i in still):
            raise NotImplementedError
        attributes: dict[str, Any] = {
            "kernel_shape": kernel, "strides": tuple(options["window_strides"][i] for i in moved),
            "pads": tuple(options["padding"][i][k] for k in (0, 1) for i in moved),
        }  # fmt: skip
        if any(options["window_dilation"][i] != 1 for i in moved):
            attributes["dilations"] = tuple(options["window_dilation"][i] for i in moved)
        image = self.node("Transpose", [x], perm=order)
        if kind == "reduce_window_max":
            made = self.node("MaxPool", [image], **attributes)
        else:
            mean = self.node("AveragePool", [image], **attributes, count_include_pad=1)
            made = self.node("Mul", [mean, np.asarray(math.prod(kernel), real)])
        return self.node("Transpose", [made], perm=tuple(int(i) for i in np.argsort(order)))


def _known(value: Any) -> Any:
    """Return a value that depends on no input as a NumPy array; random keys stay as they are."""
    is_key = jnp.issubdtype(getattr(value, "dtype", np.bool_), jax.dtypes.prng_key)
    return value if is_key else np.asarray(value)


def _on_device(value: Any) -> Any:
    return jnp.asarray(value) if isinstance(value, np.ndarray | np.generic) else value


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return one.dtype == other.dtype and one.shape == other.shape and np.array_equal(one, other)


def _i(values: Iterable[int]) -> np.ndarray:
    """Return a shape, axes or indices as ONNX takes them."""
    return np.asarray([int(v) for v in values], np.int64)


def number_type(dtype: np.dtype[Any]) -> int:
    """Return ONNX's number for a type."""
    return _TYPES[np.dtype(dtype).kind]
