"""Graphs of ONNX as pure functions of JAX.

policy = read_onnx("walk.onnx")

Weights are a pytree; integers that say shapes and indices stay numbers, so that JAX compiles with
fixed shapes. Source: the ONNX specification, `docs/IR.md` and `docs/Operators.md`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from verifai_jax.core.errors import check_names, require
from verifai_jax.core.text import one_line
from verifai_jax.policies.errors import MAX_BYTES, PolicyError
from verifai_jax.policies.onnx_operators import OPERATORS, Node

Values = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Graph:
    """The function of a graph: `(weights, observation, memory) -> (outputs, memory)`.

    - `nodes`: in the order in which they are computed.
    - `constants`: arrays that are no weights: shapes, indices, flags.
    - `inputs`: names of the observations, with their ranks.
    - `memory`: pairs of an input and the output that is its next value.
    - `output`: name of the output.
    """

    nodes: tuple[Node, ...]
    constants: Mapping[str, np.ndarray]
    inputs: Mapping[str, int]
    memory: tuple[tuple[str, str], ...]
    output: str

    def __call__(self, weights: PyTree, observation: Any, memory: PyTree) -> tuple[Array, PyTree]:
        """Compute the outputs of one observation, or of a batch of the graph's own rank."""
        values: Values = {**self.constants, **weights}
        added = 0
        for name, rank in self.inputs.items():
            given = observation[name] if isinstance(observation, Mapping) else observation
            given = jnp.asarray(given)
            if not jnp.issubdtype(given.dtype, jnp.floating):
                given = given.astype(float)
            added = rank - given.ndim
            if added < 0:
                raise PolicyError(
                    f"the network takes observations of rank {rank} at most; got shape "
                    f"{list(given.shape)}"
                )
            values[name] = given.reshape((1,) * added + given.shape)
        for (name, _), value in zip(self.memory, memory or (), strict=True):
            values[name] = value
        run(self.nodes, values)
        outputs = jnp.asarray(values[self.output])
        for _ in range(added):
            outputs = outputs[0] if outputs.ndim > 1 and outputs.shape[0] == 1 else outputs
        after = tuple(values[name] for _, name in self.memory) or None
        return outputs, after


def run(nodes: Sequence[Node], values: Values) -> None:
    """Compute nodes one after the other, and put their outputs among the values.

    **Raises:** `PolicyError` that names the node, its operator and the shapes that it got.
    """
    for node in nodes:
        absent = [name for name in node.inputs if name and name not in values]
        if absent:
            raise PolicyError(f"{node} reads {absent[0]!r}, an output that is not supported")
        inputs = [values[name] if name else None for name in node.inputs]
        try:
            if node.operator == "If":
                outputs = _branch(node, inputs[0], values)
            else:
                outputs = OPERATORS[node.operator](node, *inputs)
        except PolicyError:
            raise
        except Exception as error:
            shapes = ", ".join("-" if i is None else str(list(np.shape(i))) for i in inputs)
            raise PolicyError(
                f"{node} cannot be computed from inputs of shapes {shapes}: {one_line(str(error))}"
            ) from error
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        values.update(zip(node.outputs, outputs, strict=False))


def _branch(node: Node, condition: Any, values: Values) -> tuple[Any, ...]:
    """Compute the branch of an `If` whose condition is a constant."""
    if not isinstance(condition, np.ndarray | np.generic):
        raise PolicyError(
            f"{node} decides by a value of the observation, which is not supported: export the "
            "model with torch.where instead"
        )
    inner, outputs = node.attributes["then_branch" if np.all(condition) else "else_branch"]
    within = dict(values)
    run(inner, within)
    return tuple(within[name] for name in outputs)


def read_onnx(
    path: Path | None,
    data: bytes,
    what: str,
    *,
    output: str | None,
    memory: Mapping[str, str] | None,
) -> tuple[Graph, dict[str, Array], PyTree]:
    """Read a model of ONNX.

    **Arguments:**

    - `path`: of the file, next to which tensors may be kept; None for bytes alone.
    - `data`: the model.
    - `what`: its name, for errors.
    - `output`: name of the output that is meant, of several.
    - `memory`: `{input: output}` of what the network remembers; found by the shapes where None.

    **Returns:** the graph, its weights, and its memory at the start: zeros, or None.

    **Raises:** `PolicyError` for a model that is damaged or uses what is not supported.
    """
    package = require("onnx", extra="policies")
    try:
        model = package.load_from_string(data)
        graph = model.graph
        opset = max(
            (o.version for o in model.opset_import if o.domain in ("", "ai.onnx")), default=0
        )
    except Exception as error:
        raise PolicyError(
            f"{what} is no model of ONNX, or a damaged one: {one_line(str(error))}"
        ) from error
    if not graph.output or not opset:
        raise PolicyError(f"{what} is no model of ONNX: it has no outputs, or names no operators")
    arrays = {t.name: _tensor(t, path, what) for t in graph.initializer}
    fed = [i for i in graph.input if i.name not in arrays]
    nodes = _nodes(graph, opset, {*arrays, *(i.name for i in fed)}, path, what)
    weights = {n: jnp.asarray(a) for n, a in arrays.items() if a.dtype.kind == "f" and a.size}
    constants = {n: a for n, a in arrays.items() if n not in weights}
    made = [o.name for o in graph.output]
    feeds = dict(_memory(fed, graph.output, memory))
    left = [i for i in fed if i.name not in feeds]
    remembered = [i for i in fed if i.name in feeds]
    if not left:
        raise PolicyError(f"{what} has no input for an observation")
    inputs = {i.name: len(i.type.tensor_type.shape.dim) for i in left}
    chosen = _output([n for n in made if n not in feeds.values()], output, made, what)
    start = tuple(jnp.zeros(_shape(i)) for i in remembered) or None
    ordered = tuple((i.name, feeds[i.name]) for i in remembered)
    return Graph(nodes, constants, inputs, ordered, chosen), weights, start


def _nodes(
    graph: Any, opset: int, known: set[str], path: Path | None, what: str
) -> tuple[Node, ...]:
    """Return the nodes of a graph, whose operators exist and whose inputs are computed before."""
    missing = sorted({n.op_type for n in graph.node} - {*OPERATORS, "If"})
    if missing:
        first = next(n for n in graph.node if n.op_type == missing[0])
        raise PolicyError(
            f"{what} uses {', '.join(missing)}, which is not supported (node "
            f"{first.name or first.output[0]!r}): leave it out of the exported model, or give the "
            "policy as a Python function"
        )
    found, known = [], set(known)
    for node in graph.node:
        if node.domain not in ("", "ai.onnx"):
            raise PolicyError(
                f"{what} uses {node.op_type} of {node.domain}, which is not ONNX's own"
            )
        absent = [name for name in node.input if name and name not in known]
        if absent:
            raise PolicyError(
                f"{what} is damaged: node {node.name or node.op_type!r} reads {absent[0]!r}, "
                "which no node before it computes"
            )
        attributes = {a.name: _attribute(a, opset, known, path, what) for a in node.attribute}
        name = node.name or (node.output[0] if node.output else "")
        found.append(
            Node(node.op_type, name, tuple(node.input), tuple(node.output), attributes, opset)
        )
        known.update(node.output)
    for made in graph.output:
        if made.name not in known:
            raise PolicyError(f"{what} is damaged: no node computes its output {made.name!r}")
    return tuple(found)


def _attribute(attribute: Any, opset: int, known: set[str], path: Path | None, what: str) -> Any:
    package = require("onnx", extra="policies")
    kinds = package.AttributeProto
    if attribute.type == kinds.TENSOR:
        return _tensor(attribute.t, path, what)
    if attribute.type == kinds.GRAPH:
        inner = attribute.g
        arrays = {t.name: _tensor(t, path, what) for t in inner.initializer}
        nodes = _nodes(inner, opset, known | {*arrays}, path, what)
        constants = tuple(
            Node("Constant", name, (), (name,), {"value": array}, opset)
            for name, array in arrays.items()
        )
        return (*constants, *nodes), tuple(o.name for o in inner.output)
    value = package.helper.get_attribute_value(attribute)
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, float | int):
        return value
    return tuple(v.decode("utf-8", "replace") if isinstance(v, bytes) else v for v in value)


def _tensor(tensor: Any, path: Path | None, what: str) -> np.ndarray:
    """Return a tensor of the model, from the file next to it where it is kept there."""
    package = require("onnx", extra="policies")
    try:
        if tensor.data_location == package.TensorProto.EXTERNAL:
            array = _external(tensor, path)
        else:
            array = package.numpy_helper.to_array(tensor)
        if array.dtype.kind not in "fiub" and "float" not in array.dtype.name:
            raise ValueError(f"it holds {array.dtype}")
    except Exception as error:
        raise PolicyError(
            f"the tensor {tensor.name!r} of {what}: {one_line(str(error))}"
        ) from error
    if array.dtype.kind not in "iub":
        array = np.asarray(array, np.float32)
        if np.any(np.isnan(array)):
            raise PolicyError(f"the tensor {tensor.name!r} of {what} holds NaN")
    return array


def _external(tensor: Any, path: Path | None) -> np.ndarray:
    """Read a tensor that is kept in a file of the model's own folder.

    **Raises:** `ValueError` for a file elsewhere, or one that is too small.
    """
    package = require("onnx", extra="policies")
    said = {entry.key: entry.value for entry in tensor.external_data}
    name = said.get("location", "")
    if path is None or not name or Path(name).name != name:
        raise ValueError(f"it is kept in {name!r}, which is no file beside the model")
    dtype = package.helper.tensor_dtype_to_np_dtype(tensor.data_type)
    count = int(np.prod(tensor.dims, dtype=object)) * dtype.itemsize
    offset, length = int(said.get("offset", 0)), int(said.get("length", count))
    file = path.parent / name
    if length != count or min(offset, count) < 0 or count > MAX_BYTES:
        raise ValueError(f"it says {length} bytes for shape {list(tensor.dims)}")
    if offset + count > file.stat().st_size:
        raise ValueError(f"{name} is smaller than the model says")
    with file.open("rb") as opened:
        opened.seek(offset)
        return np.frombuffer(opened.read(count), dtype).reshape(tuple(tensor.dims))


def _shape(value: Any) -> tuple[int, ...]:
    """Return the shape of an input or output; a size that is left open is 1."""
    return tuple(int(d.dim_value) or 1 for d in value.type.tensor_type.shape.dim)


def _memory(
    fed: Sequence[Any], made: Sequence[Any], stated: Mapping[str, str] | None
) -> list[tuple[str, str]]:
    """Return the inputs that are memory with the outputs that are their next values."""
    if stated is not None:
        check_names("input of the network", stated, [i.name for i in fed])
        check_names("output of the network", stated.values(), [o.name for o in made])
        return list(stated.items())
    # The first input is the observation. Another one is memory if an output after the first has its
    # shape: exporters write states in their order, after the outputs.
    pairs, left = [], list(made[1:])
    for one in fed[1:]:
        match = next((o for o in left if _shape(o) == _shape(one)), None)
        if match is not None:
            left.remove(match)
            pairs.append((one.name, match.name))
    return pairs


def _output(left: list[str], chosen: str | None, made: list[str], what: str) -> str:
    if chosen is not None:
        check_names("output", [chosen], made)
        return chosen
    if len(left) == 1:
        return left[0]
    named = [n for n in left if n.lower().rstrip("s") in ("action", "mu", "mean", "logit")]
    if len(named) != 1:
        raise PolicyError(
            f"{what} has outputs {', '.join(left)}: say which is the action by output="
        )
    return named[0]
