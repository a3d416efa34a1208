"""The function that loads policies trained with any framework.

policy("ppo.zip")                                       # Stable-Baselines3
policy("walk.onnx")                                     # whatever exports ONNX
policy("actor.safetensors", activation="elu")           # weights of an MLP
policy(torch_module, observation=np.zeros(48))
"""

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import ml_dtypes
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from verifai_jax.addons.rl.policies.base import Actions, Normaliser, Policy, bounds, stack_frames
from verifai_jax.addons.rl.policies.errors import MAX_BYTES, PolicyError, refused
from verifai_jax.addons.rl.policies.networks import Mlp, activation_name
from verifai_jax.addons.rl.policies.objects import from_object, pure_program, read_brax
from verifai_jax.addons.rl.policies.onnx_graph import read_graph, read_onnx
from verifai_jax.addons.rl.policies.onnx_memory import Stated
from verifai_jax.addons.rl.policies.sb3 import read_normaliser, read_sb3
from verifai_jax.addons.rl.policies.tensors import (
    Tensors,
    layer_names,
    linear_layers,
    listed,
    normaliser_of,
    normalisers,
)
from verifai_jax.addons.rl.policies.torch_archive import read_state, widened
from verifai_jax.addons.rl.policy import Policy as OwnPolicy
from verifai_jax.addons.rl.policy import load_policy
from verifai_jax.core.compute.fingerprint import used_inputs
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import require, suggests_options
from verifai_jax.core.store.foreign_archives import read_arrays
from verifai_jax.core.store.foreign_files import ForeignFileError, read_bytes

log = logging.getLogger("verifai_jax.policies")
Network = Callable[[dict[str, Array], PyTree], PyTree]
_MlpOptions = tuple[str | None, Network | None, Sequence[str] | None, Sequence[str]]
"""The arguments `activation`, `network`, `layers` and `ignore` of `policy`."""
_TYPES: dict[str, Any] = {
    **{f"{kind}{8 * size}": f"{kind.lower()}{size}" for kind in "FIU" for size in (1, 2, 4, 8)},
    **{"BOOL": bool, "BF16": ml_dtypes.bfloat16},
    **{"F8_E4M3": ml_dtypes.float8_e4m3fn, "F8_E5M2": ml_dtypes.float8_e5m2},
}
"""Types of numbers by their names in files of safetensors."""
FORMATS = (".zip", ".onnx", ".safetensors", ".pt", ".pth", ".npz")


@suggests_options
def policy(
    source: Any, *, observation: ArrayLike | None = None,
    normalise: str | Path | tuple[ArrayLike, ArrayLike] | Normaliser | None = None,
    action: str | None = None, low: ArrayLike | None = None, high: ArrayLike | None = None,
    activation: str | None = None, network: Network | None = None,
    layers: Sequence[str] | None = None, output: str | None = None,
    memory: Mapping[str, str] | None = None, ignore: Sequence[str] = (), stack: int = 1,
    batched: bool = False,
) -> Policy | OwnPolicy:  # fmt: skip
    """Load a policy trained in any framework, as a pure JAX function with its weights.

    **Arguments:**
    - `source`: a file or a model:
      - `.zip`: a model of Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG, DQN,
        RecurrentPPO), with its spaces, squashing and bounds;
      - `.onnx`: a graph; outputs that are fed back to inputs become the memory of a recurrent one;
      - `.safetensors`, or `.pt` and `.pth` of `torch.save(module.state_dict())`: weights of an MLP
        with `activation=`, or of your own `network=`; the normaliser that rsl_rl, rl_games and skrl
        store beside them is applied;
      - `.npz` of `rl.save_policy`;
      - a folder: a PPO checkpoint of Brax or MuJoCo Playground;
      - a model of Stable-Baselines3; a PyTorch module with `observation=`; a module of equinox or
        flax (nnx); `(module, variables)` of flax (linen); an inference function of Brax; any
        function of the observation. A function that JAX cannot trace runs in Python, and the log
        says how long a call takes.
    - `observation`: an example observation, needed to translate a PyTorch module, and to know its
      size with `stack=`.
    - `normalise`: how observations are normalised first: the file of `VecNormalize.save`, or
      `(mean, scale)`.
    - `action`: how outputs become an action, if the file does not state it: `"argmax"`; `"clip"`,
      `"scale"` or `"tanh"` with `low=` and `high=`; `"positive"`; `"outputs"` (default).
    - `low`, `high`: bounds of the action.
    - `activation`: the activation of an MLP, after every layer except the last.
    - `network(weights, observation) -> outputs`: the network for other weights, given by name.
    - `layers`: names of the layers of an MLP, in order; by default all that are no critic's.
    - `output`: the output that is the action, for an ONNX graph with several.
    - `memory`: recurrent values of an ONNX graph, `{input: output}`; by default found by their
      names, and by the ports of LSTM, GRU and RNN.
    - `ignore`: names of tensors of a checkpoint, or their beginnings, that an action does not need.
    - `stack`: number of observations that the policy receives at once, the newest last.
    - `batched`: whether a Python function takes a batch of observations.
    **Returns:** a `Policy`, which any system accepts as its policy or controller (`policy.act`), or
    the `rl.Policy` of an `.npz`.
    **Raises:** `FileNotFoundError`; `PolicyError` for a file that is damaged or not supported, and
    for unused options. Nothing in a file is executed.
    """
    check_count("stack", stack)
    if isinstance(source, Policy | OwnPolicy):
        loaded = source
    elif isinstance(source, str | Path):
        mlp, graph = (activation, network, layers, ignore), (output, memory)
        try:
            loaded = _of_file(Path(source), mlp, graph, normalise is not None)
        except ForeignFileError as error:
            raise PolicyError(str(error)) from error
    else:
        loaded = from_object(source, observation, batched)
    stated = action is not None or low is not None or high is not None
    if isinstance(loaded, OwnPolicy):
        if normalise is not None or stated or stack > 1:
            defines = "the policy's own file defines its normalisation and actions"
            raise PolicyError(f"{defines}: leave these options out")
        return loaded
    if normalise is not None:
        loaded = replace(loaded, normaliser=_normaliser(normalise))
    if stated:
        lowest = () if low is None else bounds(low, "low")
        highest = () if high is None else bounds(high, "high")
        loaded = replace(loaded, actions=Actions(action or "clip", lowest, highest))
    if stack > 1:
        if observation is None:
            raise PolicyError("stack= needs observation=, an example of a single observation")
        loaded = stack_frames(loaded, stack, int(np.size(observation)))
    return loaded


def _of_file(
    path: Path, mlp: _MlpOptions, graph: tuple[str | None, Stated], normalised: bool
) -> Policy | OwnPolicy:
    if path.is_dir():
        return read_brax(path.resolve())
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise PolicyError(f"{path} has to be one of {', '.join(FORMATS)}, or a folder of Brax")
    data = read_bytes(path, MAX_BYTES)
    stored = _stored_graph(data, path)
    weights_alone = kind in (".safetensors", ".pt", ".pth") and stored is None
    if not weights_alone and any(mlp):
        raise PolicyError(
            f"{path} defines its network: leave out activation=, network=, layers= and ignore="
        )
    if stored is not None:
        function, weights, first = read_graph(*stored, str(path))
        return Policy(weights, function, first)
    if kind == ".npz":
        return load_policy(path)
    if kind == ".zip":
        return read_sb3(data, str(path))
    if kind == ".onnx":
        function, weights, first = read_onnx(path, data, str(path), *graph)
        return Policy(weights, function, first)
    arrays = _safetensors(data, path) if kind == ".safetensors" else read_state(data, str(path))
    return _of_weights(Tensors(arrays, str(path)), mlp, normalised)


def _stored_graph(data: bytes, path: Path) -> tuple[Any, dict[str, np.ndarray]] | None:
    """Return the graph and the arrays of a file of `Policy.save`; None for another file."""
    with refused(f"{path} holds no policy"):
        if path.suffix.lower() == ".npz":
            arrays = read_arrays(data, str(path), MAX_BYTES)
            about = json.loads(str(arrays.pop("about")))
            return (about["graph"], arrays) if "graph" in about else None
        if path.suffix.lower() == ".safetensors":
            header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
            about = header.get("__metadata__", {}).get("graph")
            return None if about is None else (json.loads(about), _safetensors(data, path))
    return None


def _safetensors(data: bytes, path: Path) -> dict[str, np.ndarray]:
    package = require("safetensors", extra="policies")
    with refused(f"{path} holds no tensors"):
        return {
            name: widened(np.frombuffer(part["data"], _TYPES[part["dtype"]]).reshape(part["shape"]))
            for name, part in package.deserialize(data)
        }


class _Given:
    """The function of a user's own network, for the weights of the file `what`."""

    def __init__(self, network: Network, what: str) -> None:
        self.network, self.what, self.checked = network, what, False

    def __call__(self, weights: PyTree, observation: PyTree, memory: None) -> tuple[Any, None]:
        if not self.checked:
            used = used_inputs(pure_program(self.network, weights, observation))
            names = [n for n, is_used in zip(sorted(weights), used, strict=False) if not is_used]
            if names:
                log.warning("network= uses no %s of %s", listed(names), self.what)
            self.checked = True
        return self.network(weights, observation), None


def _of_weights(tensors: Tensors, mlp: _MlpOptions, normalised: bool) -> Policy:
    """Return the policy of weights with a given network; every tensor is used, or named."""
    what, (activation, network, layers, ignore) = tensors.what, mlp
    tensors.ignore([ignore] if isinstance(ignore, str) else ignore)
    if (activation is None) == (network is None):
        raise PolicyError(
            f"{what} contains weights but no network: give activation= for an MLP, or "
            f"network=function(weights, observation); it has {listed(tensors)}"
        )
    if network is not None:
        arrays = {n: jnp.asarray(tensors.peek(n)) for n in tensors if n not in tensors.used}
        return Policy(arrays, _Given(network, what))
    assert activation is not None
    try:
        names = layer_names(tensors) if layers is None else layers
        weights = linear_layers(tensors, names, what)
    except PolicyError as error:
        raise PolicyError(f"{error}: give the layers of the policy in order with layers=") from None
    normaliser = None
    if normalised:
        tensors.used.update(n for kinds in normalisers(tensors).values() for n in kinds.values())
    else:
        normaliser = normaliser_of(tensors, weights[0][0].shape[0])
    tensors.settle(
        "name them in layers= if they are layers of the policy, give network=function(weights, "
        "observation) for a network of another form, or ignore= with their names"
    )
    return Policy(weights, Mlp(activation_name(activation)), normaliser=normaliser)


def _normaliser(given: str | Path | tuple[ArrayLike, ArrayLike] | Normaliser) -> Normaliser:
    if isinstance(given, Normaliser):
        return given
    if isinstance(given, str | Path):
        with refused("normalise"):
            return read_normaliser(read_bytes(given, MAX_BYTES), str(given))
    if not isinstance(given, tuple) or len(given) != 2:
        raise PolicyError(f"normalise must be a file or (mean, scale); got {given!r}")
    mean, scale = (np.asarray(v, np.float32) for v in given)
    if not np.all(np.isfinite(mean)) or not np.all(scale > 0):
        raise PolicyError("normalise needs a finite mean and a positive scale")
    return Normaliser(jnp.asarray(mean), jnp.asarray(scale))
