"""Graphs of ONNX operators as files that `vj.policy` reads, and for ONNX any runtime.

write(graph, arrays, memory, "walk.onnx")
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from verifai_jax.core.atomic_files import replacing
from verifai_jax.core.errors import require
from verifai_jax.policies.errors import PolicyError
from verifai_jax.policies.onnx_graph import OPSET, Graph
from verifai_jax.policies.tracing import number_type


def write(
    graph: Graph, arrays: Mapping[str, np.ndarray], start: Sequence[np.ndarray], path: Path
) -> Path:
    """Write a graph that was `traced` with its arrays and its first memory.

    **Raises:** `PolicyError` for another ending than `.onnx`, `.safetensors` and `.npz`, and for a
    first memory that ONNX cannot hold.
    """
    endings = (".onnx", ".safetensors", ".npz")
    if path.suffix not in endings:
        raise PolicyError(f"a policy is saved as {', '.join(endings)}; got {path.name!r}")
    named = {name: first for (name, _), first in zip(graph.memory, start, strict=True)}
    if path.suffix != ".onnx":
        arrays = {**arrays, **named}
    elif any(np.any(first) for first in start):
        raise PolicyError(
            "ONNX has no place for a memory that does not start at zero: save it as .npz"
        )
    # In the order of their names, so that equal policies are equal bytes.
    arrays = {name: np.ascontiguousarray(arrays[name]) for name in sorted(arrays)}
    with replacing(path) as partial:
        if path.suffix == ".onnx":
            partial.write_bytes(_as_onnx(graph, arrays, named))
        elif path.suffix == ".npz":
            about = np.array(json.dumps({"graph": graph.to_json()}))
            np.savez_compressed(partial, allow_pickle=False, about=about, **arrays)
        else:
            package = require("safetensors.numpy", extra="policies")
            package.save_file(arrays, partial, metadata={"graph": json.dumps(graph.to_json())})
    return path


def _as_onnx(
    graph: Graph, arrays: Mapping[str, np.ndarray], memory: Mapping[str, np.ndarray]
) -> bytes:
    onnx = require("onnx", extra="policies")
    helper, kinds = onnx.helper, onnx.TensorProto
    nodes = [
        helper.make_node(n.operator, n.inputs, n.outputs, name=n.name, **n.attributes)
        for n in graph.nodes
    ]
    inputs = [helper.make_tensor_value_info(n, kinds.FLOAT, s) for n, s in graph.inputs.items()]
    inputs += [
        helper.make_tensor_value_info(name, number_type(first.dtype), first.shape)
        for name, first in memory.items()
    ]
    names = (graph.output, *(after for _, after in graph.memory))
    outputs = [onnx.ValueInfoProto(name=name) for name in names]
    tensors = [onnx.numpy_helper.from_array(array, name) for name, array in arrays.items()]
    model = helper.make_model(
        helper.make_graph(nodes, "policy", inputs, outputs, tensors),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=9,
        producer_name="verifai_jax",
    )
    model = onnx.shape_inference.infer_shapes(model, strict_mode=True, data_prop=True)
    onnx.checker.check_model(model)
    return model.SerializeToString()
