"""Graphs of ONNX as pure functions of JAX.

    policy = read_onnx("walk.onnx")

Weights are a pytree; integers for shapes and indices stay constants, so that JAX compiles with
fixed shapes. Source: the ONNX specification, `docs/IR.md` and `docs/Operators.md`.
"""

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from verifai_jax.addons.rl.policies import onnx_trees
from verifai_jax.addons.rl.policies.errors import (
    MAX_BYTES,
    MAX_NUMBERS,
    MAX_VALUES,
    PolicyError,
    refused,
)
from verifai_jax.addons.rl.policies.onnx_layers import extreme
from verifai_jax.addons.rl.policies.onnx_memory import Stated, memory_of
from verifai_jax.addons.rl.policies.onnx_node import TYPES, Node, cast, fitting, known
from verifai_jax.addons.rl.policies.onnx_operators import GROWING, OPERATORS, output_size
from verifai_jax.addons.rl.policies.onnx_trees import DOMAIN
from verifai_jax.core.messages.errors import check_names, require
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.foreign_files import open_file

Values = dict[str, Any]
OPSET = 18
"""The operator set of the graphs that `writing` makes; runtimes since 2023 read it."""
SPILLED = ""
"""What has the name of no value: whether whole numbers have left their range."""
OPSETS = 7, 26
"""The first and the last operator set that is read."""
_WEIGHTED = {"Gemm", "MatMul", "Conv", "LSTM", "GRU", "RNN"}
"""Operators whose constant inputs are weights."""
_ACTIONS = "action", "mu", "mean", "logit", "label", "output_label"
"""Names of outputs that are the action, where there are several; the last ones of classifiers."""
_DOMAINS = "", "ai.onnx"
"""Names of ONNX's own operators."""


@dataclass(frozen=True, eq=False)
class Graph:
    """The function of a graph: `(weights, observation, memory) -> (outputs, memory)`.

    It has nodes in the order of computation; constant arrays that are not weights; the shapes of
    observations by name; `memory`, pairs of an input and the output that is its next value; the
    name of the output; types of inputs that are not real. Graphs with equal content are equal, so
    policies that only differ in weights share a program.
    """

    nodes: tuple[Node, ...]
    constants: Mapping[str, np.ndarray]
    inputs: Mapping[str, tuple[int, ...]]
    memory: tuple[tuple[str, str], ...]
    output: str
    types: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def digest(self) -> str:
        """Hash of all parts."""
        parts = [getattr(self, f.name) for f in fields(self)]
        text = json.dumps(parts, sort_keys=True, default=_as_json)
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Graph) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:
        return f"Graph({self.digest})"

    def example(self, weights: PyTree) -> Any:
        """Return zeros in the form of an observation, without a batch axis."""
        zeros = {n: np.zeros(s[1:] if s[:1] == (1,) else s) for n, s in self.inputs.items()}
        return next(iter(zeros.values())) if len(zeros) == 1 else zeros

    def to_json(self) -> dict[str, Any]:
        """Return a graph of `traced`, whose attributes are numbers and texts, for `read_graph`."""
        nodes = [[n.operator, n.inputs, n.outputs, n.attributes] for n in self.nodes]
        inputs = {name: list(shape) for name, shape in self.inputs.items()}
        return {"nodes": nodes, "inputs": inputs, "memory": self.memory, "output": self.output}

    def __call__(self, weights: PyTree, observation: Any, memory: PyTree) -> tuple[Array, PyTree]:
        """Compute the outputs of one observation, or of a batch of the graph's own rank."""
        values: Values = {**self.constants, **weights}
        added = 0
        for name, shape in self.inputs.items():
            given = observation[name] if isinstance(observation, Mapping) else observation
            given = jnp.asarray(fitting(f"the observation {name!r}", given))
            given = cast(given, TYPES[self.types.get(name, 1)])
            added = len(shape) - given.ndim
            if added < 0:
                limit = f"the network takes observations of rank {len(shape)} at most"
                raise PolicyError(f"{limit}; got shape {list(given.shape)}")
            values[name] = given.reshape((1,) * added + given.shape)
        values.update(zip(dict(self.memory), memory or (), strict=True))
        run(self.nodes, values)
        absent = [n for n in (self.output, *dict(self.memory).values()) if n not in values]
        if absent:
            raise PolicyError(f"{absent[0]!r} is an output that is not supported")
        outputs = jnp.asarray(fitting(f"the output {self.output!r}", values[self.output]))
        if outputs.dtype in (jnp.float16, jnp.bfloat16):
            outputs = cast(outputs, float)
        if SPILLED in values:
            real = jnp.issubdtype(outputs.dtype, jnp.floating)
            none = jnp.nan if real else extreme(outputs, "min")
            outputs = jnp.where(values[SPILLED], none, outputs)
        # A label, as of a classifier or an argmax, is a single number.
        lowest = 0 if jnp.issubdtype(outputs.dtype, jnp.integer) else 1
        for _ in range(added):
            outputs = outputs[0] if outputs.ndim > lowest and outputs.shape[0] == 1 else outputs
        after = tuple(values[name] for _, name in self.memory) or None
        return outputs, after


Read = tuple[Graph, dict[str, Array], PyTree]
"""A graph that was read, its weights, and its initial memory."""


def _as_json(part: Any) -> Any:
    is_node = isinstance(part, Node)
    return vars(part) if is_node else [part.dtype.str, part.shape, part.tobytes().hex()]


def run(nodes: Sequence[Node], values: Values, total: int = 0) -> int:
    """Compute nodes one after the other, and store their outputs among the values.

    **Returns:** the count of numbers computed, together with the `total` before.
    """
    for node in nodes:
        absent = [name for name in node.inputs if name and name not in values]
        if absent:
            raise PolicyError(f"{node} reads {absent[0]!r}, an output that is not supported")
        inputs = [values[name] if name else None for name in node.inputs]
        shapes = ", ".join("-" if i is None else str(list(np.shape(i))) for i in inputs)
        with refused(f"{node} cannot be computed from inputs of shapes {shapes}"):
            _check_size(node, total + output_size(node, *inputs))
            if node.operator == "If":
                outputs, total = _branch(node, inputs[0], values, total)
            else:
                outputs = OPERATORS[node.operator](node, *inputs)
                _note_spilled(node, inputs, outputs, values)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        total += sum(int(np.size(made)) for made in outputs)
        _check_size(node, total)
        values.update(zip(node.outputs, outputs, strict=False))
    return total


def _note_spilled(node: Node, inputs: Sequence[Any], outputs: Any, values: Values) -> None:
    """Note among the values whether whole numbers of 64 bits leave the 32 that JAX has for them."""
    if isinstance(outputs, tuple) or known(outputs):
        return
    for value in inputs if node.operator not in ("Slice", "Reshape", "Expand") else ():
        fitting(node, value)
    if not node.wide or node.operator not in GROWING or outputs.dtype.itemsize == 8:
        return
    reals = [i if i is None or known(i) else jnp.asarray(i, float) for i in inputs]
    about = OPERATORS[GROWING[node.operator]](node, *reals)
    ends = np.iinfo(outputs.dtype)
    beyond = ~jnp.all((about >= float(ends.min)) & (about < float(ends.max)))
    values[SPILLED] = values.get(SPILLED, False) | beyond


def _check_size(node: Node, count: int) -> None:
    if count > MAX_NUMBERS:
        raise PolicyError(
            f"with {node} the graph computes {count:z.3g} numbers; the graph of a policy may "
            f"compute at most {MAX_NUMBERS:,}"
        )


def _branch(node: Node, condition: Any, values: Values, total: int) -> tuple[tuple[Any, ...], int]:
    """Compute the branch of an `If` whose condition is a constant."""
    node.refuse(
        not known(condition),
        "branches on a value of the observation, which is not supported: export the model with "
        "torch.where instead",
    )
    inner, outputs = node.attributes["then_branch" if np.all(condition) else "else_branch"]
    within = dict(values)
    total = run(inner, within, total)
    values.update({SPILLED: within[SPILLED]} if SPILLED in within else {})
    return tuple(within[name] for name in outputs), total


def read_onnx(
    path: Path | None, data: bytes, what: str, output: str | None = None, memory: Stated = None
) -> Read:
    """Read an ONNX model.

    **Arguments:**
    - `path`: path of the file, next to which tensors may be stored; None for bytes.
    - `what`: its name in errors.
    - `output`: name of the output to use, if there are several.
    - `memory`: the recurrent values `{input: output}`; found by ports and names if None.
    **Returns:** the graph, its weights, and its initial memory: zeros, or None.
    **Raises:** `PolicyError` for a damaged model, or one with unsupported operators.
    """
    package = require("onnx", extra="policies")
    with refused(f"{what} is not an ONNX model, or is damaged"):
        model = package.load_from_string(data)
        graph = model.graph
        opset = max([0, *(o.version for o in model.opset_import if o.domain in _DOMAINS)])
        trees = max([0, *(o.version for o in model.opset_import if o.domain == DOMAIN)])
    opset = opset or (OPSET if trees else 0)
    if not graph.output or not opset:
        raise PolicyError(f"{what} is not an ONNX model: it has no outputs, or names no operators")
    reader = _Reader(package, path, what, opset, trees)
    arrays = reader.tensors(graph)
    fed = [i for i in graph.input if i.name not in arrays]
    first, last = OPSETS
    if not first <= opset <= last:
        raise PolicyError(
            f"{what} has operator set {opset}; {first} to {last} are supported: export it with "
            f"opset_version={OPSET}"
        )
    infer, wrong = package.shape_inference.infer_shapes, ""
    try:
        graph = infer(model, check_type=True).graph
    except Exception as error:
        # Sizes may be declared wrongly, which does no harm.
        if re.search("(unsupported|inconsistent) type|input size", str(error)):
            wrong = one_line(str(error))
    nodes = reader.nodes(graph, {*arrays, *(i.name for i in fed)}, {})
    _check_finite(nodes, arrays, what)
    types = {i.name: i.type.tensor_type.elem_type for i in fed}
    wrong = wrong or next((f"type {t} of {n!r}" for n, t in types.items() if t not in TYPES), "")
    if wrong:
        raise PolicyError(f"{what} has types that ONNX or this reader does not allow: {wrong}")
    weights, constants = _sorted_out(arrays)
    shapes, made = ({v.name: _shape(v) for v in values} for values in (fed, graph.output))
    for name, shape in shapes.items():
        if math.prod(shape) > MAX_NUMBERS:
            raise PolicyError(f"{what} takes an input {name!r} of shape {list(shape)}")
    feeds = memory_of(nodes, (shapes, made), memory, output, what)
    inputs = {name: shape for name, shape in shapes.items() if name not in feeds}
    if not inputs:
        raise PolicyError(f"{what} has no input for an observation")
    chosen = _output([n for n in made if n not in feeds.values()], output, list(made), what)
    start = tuple(cast(jnp.zeros(shapes[name]), TYPES[types[name]]) for name in feeds) or None
    types = {name: types[name] for name in inputs if TYPES[types[name]] is not float}
    return Graph(nodes, constants, inputs, tuple(feeds.items()), chosen, types), weights, start


def _sorted_out(arrays: Mapping[str, np.ndarray]) -> tuple[dict[str, Array], dict[str, np.ndarray]]:
    """Return the weights among arrays, which are real numbers, and the others."""
    real = [n for n, a in arrays.items() if a.dtype.kind not in "iub" and a.size]
    weights = {n: jnp.asarray(arrays[n]) for n in real}
    return weights, {n: a for n, a in arrays.items() if n not in weights}


def read_graph(data: Mapping[str, Any], arrays: Mapping[str, np.ndarray], what: str) -> Read:
    """Return the result of `read_onnx`, from `Graph.to_json`, which is checked, and all arrays."""
    with refused(f"{what} is damaged: its graph is not valid", repr):
        nodes = tuple(
            Node(operator, outputs[0], tuple(inputs), tuple(outputs), {
                name: tuple(v) if isinstance(v, list) else v for name, v in attributes.items()
            }, OPSET)
            for operator, inputs, outputs, attributes in data["nodes"]
        )  # fmt: skip
        inputs = {str(n): tuple(int(k) for k in shape) for n, shape in data["inputs"].items()}
        memory = tuple((str(one), str(after)) for one, after in data["memory"])
        start = tuple(jnp.asarray(arrays[one]) for one, _ in memory) or None
        output = str(data["output"])
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub" or np.any(np.isnan(array)):
            raise PolicyError(f"the array {name!r} of {what} holds NaN, or no numbers")
    check_nodes(nodes, {*arrays, *inputs}, [output, *(after for _, after in memory)], what)
    _check_finite(nodes, arrays, what)
    rest = {n: a for n, a in arrays.items() if n not in dict(memory)}
    weights, constants = _sorted_out(rest)
    return Graph(nodes, constants, inputs, memory, output), weights, start


def _check_finite(nodes: Sequence[Node], arrays: Mapping[str, np.ndarray], what: str) -> None:
    """Refuse weights that are infinite; other constants, such as bounds, may be."""
    used = {n for node in nodes if node.operator in _WEIGHTED for n in node.inputs if n in arrays}
    for name in sorted(used):
        if not np.all(np.isfinite(np.asarray(arrays[name], np.float32))):
            raise PolicyError(f"the tensor {name!r} of {what} holds infinite weights")


def check_nodes(nodes: Sequence[Node], known: set[str], outputs: Sequence[str], what: str) -> None:
    """Check that operators exist, and that inputs of nodes and outputs are computed earlier."""
    known = set(known)
    if len(nodes) > MAX_VALUES:
        raise PolicyError(f"{what} has {len(nodes):,} nodes; at most {MAX_VALUES:,} are read")
    missing = sorted({n.operator for n in nodes} - {*OPERATORS, "If"})
    if missing:
        first = next(n for n in nodes if n.operator == missing[0])
        raise PolicyError(
            f"{what} uses {', '.join(missing)}, which is not supported (node {first.name!r}): "
            "leave it out of the exported model, or give the policy as a Python function"
        )
    for node in nodes:
        absent = [name for name in node.inputs if name and name not in known]
        if absent:
            raise PolicyError(
                f"{what} is damaged: {node} reads {absent[0]!r}, which no node before it computes"
            )
        known.update(node.outputs)
    for name in outputs:
        if name not in known:
            raise PolicyError(f"{what} is damaged: no node computes its output {name!r}")


@dataclass(frozen=True)
class _Reader:
    """What reads the nodes and tensors of the file `what` at `path`, if it is one."""

    package: Any
    path: Path | None
    what: str
    opset: int
    trees: int

    def nodes(self, graph: Any, known: set[str], types: Mapping[str, int]) -> tuple[Node, ...]:
        """Return the nodes of a graph, checked."""
        found, inner, types = [], set(known), dict(types)
        for each in (*graph.input, *graph.value_info, *graph.output):
            types[each.name] = each.type.tensor_type.elem_type
        types |= {each.name: each.data_type for each in graph.initializer}
        for node in graph.node:
            of_trees = node.op_type in onnx_trees.OPERATORS
            if node.domain not in ((DOMAIN,) if of_trees else _DOMAINS):
                raise PolicyError(
                    f"{self.what} uses {node.op_type} of {node.domain or 'ai.onnx'}, which is not "
                    "supported: give the policy as a Python function, such as one of its runtime"
                )
            attributes = {a.name: self._attribute(a, inner, types) for a in node.attribute}
            name = node.name or (node.output[0] if node.output else "")
            wide = any(types.get(output) in (7, 13) for output in node.output[:1])
            ports = tuple(node.input), tuple(node.output)
            found.append(Node(_decoded(node.op_type), name, *ports, attributes, self.opset, wide))
            inner.update(node.output)
        check_nodes(found, known, [o.name for o in graph.output], self.what)
        for node in found:
            of_trees = node.operator in onnx_trees.OPERATORS
            opset, domain = (self.trees, DOMAIN) if of_trees else (self.opset, "")
            version = f"in operator set {opset}"
            try:
                page = self.package.defs.get_schema(node.operator, opset, domain).attributes
            except self.package.defs.SchemaError:
                raise PolicyError(f"{node} of {self.what} is not {version}") from None
            more = [name for name in node.attributes if name not in page]
            node.refuse(more, f"of {self.what} has {more}, no attributes {version}")
        return tuple(found)

    def _attribute(self, attribute: Any, known: set[str], types: Mapping[str, int]) -> Any:
        kinds = self.package.AttributeProto
        if attribute.type == kinds.TENSOR:
            return self._tensor(attribute.t)
        if attribute.type == kinds.GRAPH:
            inner, arrays = attribute.g, self.tensors(attribute.g)
            nodes = self.nodes(inner, known | {*arrays}, types)
            constants = (
                Node("Constant", name, (), (name,), {"value": array}, self.opset)
                for name, array in arrays.items()
            )
            return (*constants, *nodes), tuple(o.name for o in inner.output)
        value = self.package.helper.get_attribute_value(attribute)
        if isinstance(value, list | tuple):
            return tuple(map(_decoded, value))
        if not isinstance(value, bytes | float | int):
            raise PolicyError(f"the attribute {attribute.name!r} in {self.what} is not supported")
        return _decoded(value)

    def tensors(self, graph: Any) -> dict[str, np.ndarray]:
        """Return the tensors of a graph by name."""
        names = [t.name for t in graph.initializer]
        if twice := next((name for name in set(names) if names.count(name) > 1), ""):
            raise PolicyError(f"{self.what} has two tensors that are called {twice!r}")
        return {t.name: self._tensor(t) for t in graph.initializer}

    def _tensor(self, tensor: Any) -> np.ndarray:
        with refused(f"the tensor {tensor.name!r} of {self.what}"):
            if tensor.data_location == self.package.TensorProto.EXTERNAL:
                array = self._external(tensor)
            else:
                array = self.package.numpy_helper.to_array(tensor)
            if array.dtype.kind not in "fiub" and "float" not in array.dtype.name:
                raise ValueError(f"it holds {array.dtype}")
        if array.dtype.kind not in "iub":
            if array.dtype not in (np.float16, jnp.bfloat16):
                array = np.asarray(array, np.float32)
            if np.any(np.isnan(array)):
                raise PolicyError(f"the tensor {tensor.name!r} of {self.what} holds NaN")
        return array

    def _external(self, tensor: Any) -> np.ndarray:
        """Read a tensor that is stored in a file of the model's own folder."""
        said = {entry.key: entry.value for entry in tensor.external_data}
        name = said.get("location", "")
        if self.path is None or not name or Path(name).name != name:
            raise ValueError(f"it is kept in {name!r}, which is not a file next to the model")
        dtype = self.package.helper.tensor_dtype_to_np_dtype(tensor.data_type)
        count = int(np.prod(tensor.dims, dtype=object)) * dtype.itemsize
        offset, length = int(said.get("offset", 0)), int(said.get("length", count))
        file = self.path.parent / name
        if length != count or min(offset, count) < 0 or count > MAX_BYTES:
            raise ValueError(f"it says {length} bytes for shape {list(tensor.dims)}")
        with open_file(file, within=self.path.parent) as opened:
            if offset + count > opened.seek(0, os.SEEK_END):
                raise ValueError(f"{name} is smaller than the model says")
            opened.seek(offset)
            return np.frombuffer(opened.read(count), dtype).reshape(tuple(tensor.dims))


def _decoded(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def _shape(value: Any) -> tuple[int, ...]:
    """Return the shape of an input or output, with 1 for an unspecified size."""
    return tuple(int(d.dim_value) or 1 for d in value.type.tensor_type.shape.dim)


def _output(left: list[str], chosen: str | None, made: list[str], what: str) -> str:
    if chosen is not None:
        check_names("output", [chosen], made)
        return chosen
    if len(left) == 1:
        return left[0]
    named = [n for n in left if n.lower().rstrip("s") in _ACTIONS]
    if len(named) != 1:
        raise PolicyError(
            f"{what} has outputs {', '.join(left)}: say which is the action by output="
        )
    return named[0]
