"""A policy that somebody else has trained: a pytree of weights and a pure function.

    policy = vj.policy("ppo.zip")
    policy.act(observation)                             # an action of its environment
    action, memory = policy.act(observation, memory)    # one that remembers

A graph is saved as an ONNX file, which `vj.policy` and any ONNX runtime read.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from verifai_jax.addons.rl.policies.errors import PolicyError
from verifai_jax.addons.rl.policies.onnx_graph import OPSET, Graph
from verifai_jax.addons.rl.policies.tracing import Traced, number_type, traced
from verifai_jax.core.messages.errors import check_names, require
from verifai_jax.core.store.atomic_files import replacing

Compute = Callable[[PyTree, PyTree, PyTree], tuple[Any, PyTree]]
"""A pure function `(weights, observation, memory) -> (outputs, memory)`."""
Arrays = Mapping[str, np.ndarray]
ACTIONS = {
    "outputs": "the outputs themselves", "argmax": "the index of the greatest output",
    "positive": "1 where an output is positive, else 0",
    "clip": "the outputs, clipped to low..high",
    "scale": "the outputs, in units of half the range low..high around its middle, clipped",
    "tanh": "tanh of the outputs, in the same units",
}  # fmt: skip
"""Ways of turning outputs into an action, by name."""


@dataclass(frozen=True)
class Actions:
    """The conversion of a network's outputs to an action.

    - `kind`: one of `ACTIONS`.
    - `low`, `high`: bounds of each entry of the action; for `clip`, `scale` and `tanh`.
    - `counts`: the number of options of each choice, in the order of the outputs; for `argmax`.
    - `shape`: the shape of an action with bounds; a vector when left out.

    **Raises:** `UnknownNameError` for an unknown kind; `PolicyError` for missing or unsuitable
    bounds.
    """

    kind: str = "outputs"
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    counts: tuple[int, ...] = ()
    shape: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        check_names("action", [self.kind], ACTIONS)
        bounded = self.kind in ("clip", "scale", "tanh")
        pairs = list(zip(self.low, self.high, strict=False))
        got = f"got {self.low} and {self.high}"
        if len(self.low) != len(self.high) or bool(self.low) != bounded:
            what = "needs low= and high= of one size" if bounded else "takes no low= and high="
            raise PolicyError(f"action={self.kind!r} {what}; {got}")
        if not all(low < high for low, high in pairs):
            raise PolicyError(f"low must be less than high; {got}")
        if self.kind in ("scale", "tanh") and not np.all(np.isfinite(pairs)):
            raise PolicyError(f"action={self.kind!r} needs finite bounds; {got}")

    def __call__(self, outputs: Array) -> Array:
        """Return the action that outputs `[n]` mean."""
        if self.kind == "argmax":
            if not self.counts:
                return jnp.argmax(outputs, axis=-1).astype(jnp.int32)
            ends = np.cumsum(self.counts)[:-1]
            chosen = [jnp.argmax(part, axis=-1) for part in jnp.split(outputs, ends, axis=-1)]
            return jnp.stack(chosen, axis=-1).astype(jnp.int32)
        if self.kind == "positive":
            return (outputs > 0).astype(jnp.int32)
        if self.kind == "outputs":
            return outputs
        low, high = (np.asarray(bounds, outputs.dtype) for bounds in (self.low, self.high))
        if self.kind == "clip":
            action = jnp.clip(outputs, low, high)
        else:
            unit = jnp.tanh(outputs) if self.kind == "tanh" else outputs
            action = jnp.clip((high + low) / 2 + (high - low) / 2 * unit, low, high)
        return action.reshape(*action.shape[:-1], *self.shape) if self.shape else action


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Normaliser:
    """The normalisation of observations: `(observation - mean) / scale`, clipped to `-clip..clip`.

    **Raises:** `PolicyError` for values that are not numbers, and for a scale that is not positive.
    """

    # JAX rebuilds the class with placeholders.
    __no_type_check__ = True
    mean: Float[Array | np.ndarray, "*k"]
    scale: Float[Array | np.ndarray, "*k"]
    clip: float | None = dataclasses.field(default=None, metadata={"static": True})

    def __call__(self, observation: Array) -> Array:
        """Return an observation in units of its scale."""
        scaled = (observation - self.mean) / self.scale
        return scaled if self.clip is None else jnp.clip(scaled, -self.clip, self.clip)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Policy:
    """A network of any framework in JAX, with the conversions of its inputs and outputs.

    It is a pytree: its weights are batched, differentiated and computed in double precision like
    those of `rl.Policy`.

    - `weights`: a pytree of arrays.
    - `compute(weights, observation, memory) -> (outputs, memory)`: a pure function; the memory is
      None for a network without memory.
    - `initial_memory`: the memory at the start of an episode; None for a policy without memory.
    - `normaliser`: the normalisation of observations; None for none.
    - `actions`: the conversion of outputs to an action.
    """

    __no_type_check__ = True
    weights: PyTree
    compute: Compute = dataclasses.field(metadata={"static": True})
    initial_memory: PyTree = None
    normaliser: Normaliser | None = None
    actions: Actions = dataclasses.field(default_factory=Actions, metadata={"static": True})

    def __call__(self, observation: PyTree, *memory: PyTree) -> Any:
        """Return the outputs of the network; with its memory, for one that remembers."""
        (remembered,) = memory or (None,)
        if (self.initial_memory is None) != (remembered is None):
            if self.initial_memory is None:
                raise TypeError("this policy has no memory: call act(observation)")
            raise TypeError(
                "this policy has a memory: act(observation, memory) returns (action, memory), and "
                "policy.initial_memory is the first"
            )
        if self.normaliser is not None:
            observation = self.normaliser(observation)
        outputs, after = self.compute(self.weights, observation, remembered)
        return outputs if self.initial_memory is None else (outputs, after)

    def act(self, observation: PyTree, *memory: PyTree) -> Any:
        """Return the action; for a policy with memory, `(action, memory)`.

        **Arguments:**
        - `observation`: one observation, or a batch for a network of vectors.
        - `memory`: the memory of a policy with memory; `initial_memory` at the start of an episode.
        **Raises:** `TypeError` for a missing memory, or one given to a policy without memory.
        """
        if self.initial_memory is None:
            return self.actions(self(observation, *memory))
        outputs, after = self(observation, *memory)
        return self.actions(outputs), after

    def save(self, path: str | Path, observation: PyTree = None) -> Path:
        """Write the policy to a file that `vj.policy` reads, and any runtime if it is ONNX.

        The file computes the action, including scales, squashing and bounds. The memory of a policy
        becomes inputs and outputs `memory.0`, `memory.0.next` and so on.

        **Arguments:**
        - `path`: a path that ends in `.onnx`, `.safetensors`, or `.npz`, which needs no other
          package.
        - `observation`: an example observation, if the network does not determine its size.
        **Returns:** the path.
        **Raises:** `PolicyError` for another ending, and for a policy that ONNX cannot express:
        one that draws random numbers, or that runs in Python.
        """
        graph, arrays, start = self.as_graph(observation)
        return write(graph, arrays, start, Path(path))

    def as_graph(self, observation: PyTree = None) -> Traced:
        """Return the policy as a graph of ONNX operators with its arrays and its initial memory.

        **Raises:** the `PolicyError` of `save`.
        """
        if observation is None:
            observation = getattr(self.compute, "example", lambda _: None)(self.weights)
        if observation is None:
            raise PolicyError("the policy does not define its input: give an example, observation=")
        seen = jax.tree.map(lambda o: np.asarray(o, np.float32), observation)

        def decide(parts: PyTree, observation: PyTree, memory: PyTree) -> tuple[Any, PyTree]:
            weights, normaliser = parts
            policy = dataclasses.replace(self, weights=weights, normaliser=normaliser)
            if self.initial_memory is None:
                return policy.act(observation), None
            return policy.act(observation, memory)

        return traced(decide, (self.weights, self.normaliser), seen, self.initial_memory)


@dataclass(frozen=True)
class Stacked:
    """The function of a policy that receives its last `count` observations, the oldest first."""

    inner: Compute
    count: int

    def example(self, weights: PyTree) -> np.ndarray | None:
        """Return zeros in the form of one observation; None if the network leaves it open."""
        network, _ = weights
        inner = getattr(self.inner, "example", lambda _: None)(network)
        return None if inner is None else np.zeros(np.size(inner) // self.count)

    def __call__(self, weights: PyTree, observation: Array, memory: PyTree) -> tuple[Any, PyTree]:
        """Compute with the frames that the memory holds and this observation."""
        frames, within = memory
        network, normaliser = weights
        size = observation.shape[-1]
        # It is of one observation, or of all frames.
        if normaliser is not None and jnp.size(normaliser.mean) == size:
            observation, normaliser = normaliser(observation), None
        frames = jnp.concatenate([frames[size:], observation], axis=-1)
        seen = frames if normaliser is None else normaliser(frames)
        outputs, within = self.inner(network, seen, within)
        return outputs, (frames, within)


def stack_frames(policy: Policy, count: int, size: int) -> Policy:
    """Return a policy that receives one observation and remembers the previous `count - 1`.

    Before the first observation there are zeros, as in the frame stack of Stable-Baselines3.

    - `size`: number of entries in one observation.

    **Raises:** `PolicyError` for a normalisation of another number of entries.
    """
    scaled = None if policy.normaliser is None else policy.normaliser.mean
    if scaled is not None and np.size(scaled) not in (1, size, count * size):
        raise PolicyError(
            f"the normalisation is of {np.size(scaled)} numbers, and the policy sees {count} "
            f"observations of {size}: it must be of {size} or {count * size}"
        )
    return Policy(
        weights=(policy.weights, policy.normaliser), compute=Stacked(policy.compute, count),
        initial_memory=(jnp.zeros(count * size), policy.initial_memory), actions=policy.actions,
    )  # fmt: skip


def bounds(values: object, name: str) -> tuple[float, ...]:
    """Return bounds of an action as a tuple; refuse what are no numbers."""
    try:
        array = np.atleast_1d(np.asarray(values, float)).ravel()
    except (TypeError, ValueError):
        what = f"{name} must be a number or one for each entry"
        raise PolicyError(f"{what}; got {values!r}") from None
    if np.any(np.isnan(array)):
        raise PolicyError(f"{name} must not be NaN; got {values!r}")
    return tuple(array.tolist())


def write(graph: Graph, arrays: Arrays, start: Sequence[np.ndarray], path: Path) -> Path:
    """Write a graph that was `traced` with its arrays and its first memory.

    **Raises:** `PolicyError` for an ending other than `.onnx`, `.safetensors` and `.npz`, and for
    an initial memory that ONNX cannot store.
    """
    endings = (".onnx", ".safetensors", ".npz")
    if path.suffix not in endings:
        raise PolicyError(f"a policy is saved as {', '.join(endings)}; got {path.name!r}")
    named = {name: first for (name, _), first in zip(graph.memory, start, strict=True)}
    if path.suffix != ".onnx":
        arrays = {**arrays, **named}
    elif any(np.any(first) for first in start):
        raise PolicyError("ONNX cannot store a memory that does not start at zero: save it as .npz")
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


def _as_onnx(graph: Graph, arrays: Arrays, memory: Arrays) -> bytes:
    onnx = require("onnx", extra="policies")
    helper = onnx.helper
    node, info = helper.make_node, helper.make_tensor_value_info
    nodes = [node(n.operator, n.inputs, n.outputs, n.name, **n.attributes) for n in graph.nodes]
    inputs = [info(name, onnx.TensorProto.FLOAT, shape) for name, shape in graph.inputs.items()]
    inputs += [info(name, number_type(a.dtype), a.shape) for name, a in memory.items()]
    names = (graph.output, *(after for _, after in graph.memory))
    outputs = [onnx.ValueInfoProto(name=name) for name in names]
    tensors = [onnx.numpy_helper.from_array(array, name) for name, array in arrays.items()]
    model = helper.make_model(
        helper.make_graph(nodes, "policy", inputs, outputs, tensors),
        opset_imports=[helper.make_opsetid("", OPSET)], ir_version=9, producer_name="verifai_jax",
    )  # fmt: skip
    model = onnx.shape_inference.infer_shapes(model, strict_mode=True, data_prop=True)
    onnx.checker.check_model(model)
    return model.SerializeToString()
