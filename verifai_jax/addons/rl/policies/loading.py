"""The function that loads policies trained with any framework.

policy("ppo.zip")                                       # Stable-Baselines3 policy("walk.onnx")
# whatever exports ONNX policy("actor.safetensors", activation="elu")           # weights of an MLP
policy(torch_module, observation=np.zeros(48))
"""

import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from verifai_jax.addons.rl.policies.base import Actions, Normaliser, Policy, bounds, stack_frames
from verifai_jax.addons.rl.policies.errors import MAX_BYTES, PolicyError
from verifai_jax.addons.rl.policies.networks import Mlp, activation_name, linear_layers, natural
from verifai_jax.addons.rl.policies.objects import from_object, read_brax
from verifai_jax.addons.rl.policies.onnx_graph import read_graph, read_onnx
from verifai_jax.addons.rl.policies.sb3 import read_normaliser, read_sb3
from verifai_jax.addons.rl.policies.torch_archive import open_archive, read_member, read_state
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import require, suggests_options
from verifai_jax.core.messages.text import one_line
from verifai_jax.systems.policy import Policy as OwnPolicy
from verifai_jax.systems.policy import load_policy

Network = Callable[[dict[str, Array], PyTree], PyTree]
FORMATS = (".zip", ".onnx", ".safetensors", ".pt", ".pth", ".npz")


@suggests_options
def policy(
    source: Any,
    *,
    observation: ArrayLike | None = None,
    normalise: str | Path | tuple[ArrayLike, ArrayLike] | Normaliser | None = None,
    action: str | None = None,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    activation: str | None = None,
    network: Network | None = None,
    layers: Sequence[str] | None = None,
    output: str | None = None,
    memory: Mapping[str, str] | None = None,
    stack: int = 1,
    batched: bool = False,
) -> Policy | OwnPolicy:
    """Load a policy trained in any framework, as a pure JAX function with its weights.

    **Arguments:**
    - `source`: a file or a model:
      - `.zip`: a model of Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG, DQN), with its spaces,
        squashing and bounds;
      - `.onnx`: a graph; outputs that are fed back to inputs become the memory of a recurrent one;
      - `.safetensors`, or `.pt` and `.pth` of `torch.save(module.state_dict())`: weights of an MLP
        with `activation=`, or of your own `network=`;
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
    - `layers`: names of the layers of an MLP, in order; by default sorted by name.
    - `output`: the output that is the action, for an ONNX graph with several.
    - `memory`: recurrent values of an ONNX graph, `{input: output}`; by default found by shape.
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
        loaded = _of_file(Path(source), activation, network, layers, output=output, memory=memory)
    else:
        loaded = from_object(source, observation, batched)
    stated = action is not None or low is not None or high is not None
    if isinstance(loaded, OwnPolicy):
        if normalise is not None or stated or stack > 1:
            raise PolicyError(
                "the policy's own file defines its normalisation and actions: leave these "
                "options out"
            )
        return loaded
    changes: dict[str, Any] = {}
    if normalise is not None:
        changes["normaliser"] = _normaliser(normalise)
    if stated:
        low_, high_ = (() if v is None else bounds(v, n) for v, n in ((low, "low"), (high, "high")))
        changes["actions"] = Actions(action or "clip", low_, high_)
    loaded = replace(loaded, **changes)
    if stack > 1:
        if observation is None:
            raise PolicyError("stack= needs observation=, an example of a single observation")
        loaded = stack_frames(loaded, stack, int(np.size(observation)))
    return loaded


def _of_file(
    path: Path,
    activation: str | None,
    network: Network | None,
    layers: Sequence[str] | None,
    *,
    output: str | None,
    memory: Mapping[str, str] | None,
) -> Policy | OwnPolicy:
    if path.is_dir():
        return read_brax(path.resolve())
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise PolicyError(f"{path} has to be one of {', '.join(FORMATS)}, or a folder of Brax")
    if path.stat().st_size > MAX_BYTES:
        raise PolicyError(
            f"{path} has {path.stat().st_size / 1e6:z.0f} MB, and a policy may have at most "
            f"{MAX_BYTES / 1e6:z.0f} MB"
        )
    data = path.read_bytes()
    stored = _stored_graph(data, path)
    weights_alone = kind in (".safetensors", ".pt", ".pth") and stored is None
    if not weights_alone and (activation or network or layers):
        raise PolicyError(
            f"{path} defines its network: leave out activation=, network= and layers="
        )
    if stored is not None:
        graph, weights, first = read_graph(*stored, str(path))
        return Policy(weights, graph, first)
    if kind == ".npz":
        return load_policy(path)
    if kind == ".zip":
        return read_sb3(data, str(path))
    if kind == ".onnx":
        graph, weights, first = read_onnx(path, data, str(path), output=output, memory=memory)
        return Policy(weights, graph, first)
    arrays = _safetensors(data, path) if kind == ".safetensors" else read_state(data, str(path))
    return _of_weights(arrays, activation, network, layers, str(path))


def _stored_graph(data: bytes, path: Path) -> tuple[Any, dict[str, np.ndarray]] | None:
    """Return the graph and the arrays of a file of `Policy.save`; None for another file.

    **Raises:** `PolicyError` for a damaged file.
    """
    try:
        if path.suffix.lower() == ".npz":
            archive = open_archive(data, str(path))
            arrays = {
                n.removesuffix(".npy"): np.lib.format.read_array(
                    io.BytesIO(read_member(archive, n, str(path))), allow_pickle=False
                )
                for n in archive.namelist()
            }
            about = json.loads(str(arrays.pop("about")))
            return (about["graph"], arrays) if "graph" in about else None
        if path.suffix.lower() == ".safetensors":
            header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
            about = header.get("__metadata__", {}).get("graph")
            return None if about is None else (json.loads(about), _safetensors(data, path))
    except PolicyError:
        raise
    except Exception as error:
        raise PolicyError(f"{path} holds no policy: {one_line(str(error))}") from error
    return None


def _safetensors(data: bytes, path: Path) -> dict[str, np.ndarray]:
    package = require("safetensors.numpy", extra="policies")
    try:
        return package.load(data)
    except Exception as error:
        raise PolicyError(f"{path} holds no tensors: {one_line(str(error))}") from error


class _Given:
    """The function of a user's own network and its weights."""

    def __init__(self, network: Network) -> None:
        self.network = network

    def __call__(self, weights: PyTree, observation: PyTree, memory: None) -> tuple[Any, None]:
        return self.network(weights, observation), None


def _of_weights(
    arrays: Mapping[str, np.ndarray],
    activation: str | None,
    network: Network | None,
    layers: Sequence[str] | None,
    what: str,
) -> Policy:
    """Return the policy of weights with a given network."""
    if (activation is None) == (network is None):
        raise PolicyError(
            f"{what} contains weights but no network: give activation= for an MLP, or "
            f"network=function(weights, observation); it has {', '.join(sorted(arrays)[:8])}"
        )
    if network is not None:
        return Policy({name: jnp.asarray(array) for name, array in arrays.items()}, _Given(network))
    assert activation is not None
    found = [n.removesuffix(".weight") for n, a in arrays.items() if n.endswith(".weight")]
    names = sorted(found, key=natural) if layers is None else list(layers)
    if not names:
        raise PolicyError(f"{what} has no tensor that ends in .weight")
    try:
        return Policy(linear_layers(arrays, names, what), Mlp(activation_name(activation)))
    except PolicyError as error:
        raise PolicyError(f"{error}; give the layers of the policy in order with layers=") from None


def _normaliser(given: str | Path | tuple[ArrayLike, ArrayLike] | Normaliser) -> Normaliser:
    if isinstance(given, Normaliser):
        return given
    if isinstance(given, str | Path):
        return read_normaliser(Path(given).read_bytes(), str(given))
    if not isinstance(given, tuple) or len(given) != 2:
        raise PolicyError(f"normalise must be a file or (mean, scale); got {given!r}")
    mean, scale = (np.asarray(v, np.float32) for v in given)
    if not np.all(np.isfinite(mean)) or not np.all(scale > 0):
        raise PolicyError("normalise needs a finite mean and a positive scale")
    return Normaliser(jnp.asarray(mean), jnp.asarray(scale))
