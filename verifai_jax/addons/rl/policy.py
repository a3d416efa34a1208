"""A trained policy: a small network from observations to actions, and its file.

    policy = load_policy("policy.npz")
    policy(observation)                       # logits `[n]`, or the unit action `[size]`
    policy.act(observation)                   # the likeliest action
    save_policy(policy, "policy.npz", seed=0, steps=200_000)

The file holds numbers and text, never code.
"""

import dataclasses
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Key

from verifai_jax.core.display.extensions import verb
from verifai_jax.core.messages.checks import check_count, is_number
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_archives import read_arrays
from verifai_jax.core.user_code.source_collection import made_here, sources_of
from verifai_jax.systems.actions import Action, Continuous, Discrete

Layer = tuple[Float[Array | np.ndarray, "... _ _"], Float[Array | np.ndarray, "... _"]]
Layers = tuple[Layer, ...]
"""Weights `[inputs, outputs]` and biases `[outputs]` of each layer, first layer first."""
ACTIVATIONS: dict[str, Callable[[ArrayLike], Array]] = {"tanh": jnp.tanh, "relu": jax.nn.relu}
"""Functions between the layers, by name. All are 0 at 0."""
_KINDS: dict[str, type[Action]] = {"discrete": Discrete, "continuous": Continuous}


class PolicyFileError(ValueError):
    """An error for a file without a policy written by `save_policy`."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Policy:
    """A network with the normalisation of its observations and the kind of its actions.

    - `layers`: weights `[inputs, outputs]` and biases `[outputs]`, first layer first.
    - `mean`, `scale`: `[k]`; the network receives `(observation - mean) / scale`, or the
      observation itself if they are None.
    - `log_std`: `[size]`, logarithm of the standard deviation for exploration; None for discrete
      actions, and if the deviation depends on the observation.
    - `action`: the kind of action.
    - `activation`: name of the activation, one of `ACTIVATIONS`. All are 0 at 0, so that units with
      weights 0 have no effect.
    - `squash`: whether a continuous policy's outputs are squashed by tanh; otherwise they are
      clipped.

    **Raises:** `UnknownNameError` for an unknown activation; `ValueError` for squashed logits.
    """

    # JAX rebuilds the class with stacked arrays and placeholders, which have other shapes.
    __no_type_check__ = True
    layers: Layers
    mean: Float[Array | np.ndarray, " k"] | None
    scale: Float[Array | np.ndarray, " k"] | None
    log_std: Float[Array | np.ndarray, " size"] | None
    action: Action = dataclasses.field(metadata={"static": True})
    activation: str = dataclasses.field(default="tanh", metadata={"static": True})
    squash: bool = dataclasses.field(default=False, metadata={"static": True})

    def __post_init__(self) -> None:
        check_names("activation", [self.activation], ACTIVATIONS)
        if self.squash and isinstance(self.action, Discrete):
            raise ValueError(f"only continuous actions can be squashed; got {self.action}")

    def __call__(
        self, observation: Float[Array | np.ndarray, "*batch k"]
    ) -> Float[Array, "*batch outputs"]:
        """Return logits or values `[n]` of the actions, or the mean action `[size]`.

        A continuous action is scaled: 0 is the middle of its range, and -1 and 1 are the ends. A
        batch of observations gives a batch of outputs.
        """
        if self.mean is not None and self.scale is not None:
            observation = (observation - self.mean) / self.scale
        outputs = network(self.layers, observation, self.activation)
        return jnp.tanh(outputs) if self.squash else outputs

    def act(
        self, observation: Float[Array | np.ndarray, " k"]
    ) -> Int[Array, ""] | Float[Array, " size"]:
        """Return the most likely action: an index, or a vector `[size]` within its range."""
        return most_likely_action(self.action, self(observation))

    def save(self, path: str | Path) -> Path:
        """Write the policy as `.npz` (`save_policy`), or its action as `.onnx` or `.safetensors`.

        **Returns:** the path.
        **Raises:** `PolicyError` for another file ending.
        """
        if Path(path).suffix == ".npz":
            save_policy(self, path)
            return Path(path)
        graph, arrays, start = self.as_graph()
        return verb("policies").write(graph, arrays, start, Path(path))

    def as_graph(self, observation: object = None) -> tuple[Any, Any, Any]:
        """Return the policy as a graph of ONNX operators, like policies of other frameworks."""
        as_any = verb("policies").Policy(self, _act)
        return as_any.as_graph(np.zeros(self.layers[0][0].shape[0]))


def _act(policy: Policy, observation: Array, memory: None) -> tuple[Array, None]:
    return policy.act(observation), memory


def network(
    layers: Layers, x: Float[Array | np.ndarray, "*batch inputs"], activation: str = "tanh"
) -> Float[Array, "*batch outputs"]:
    """Evaluate a multilayer perceptron with the activation between its layers."""
    between = ACTIVATIONS[activation]
    for weight, bias in layers[:-1]:
        x = between(x @ weight + bias)
    weight, bias = layers[-1]
    return jnp.asarray(x @ weight + bias)


def scalar_network(
    layers: Layers, inputs: Sequence[Float[Array, ""]], activation: str = "tanh"
) -> list[Float[Array, ""]]:
    """Evaluate the same network with scalars, for a few hundred weights that are constants.

    Under `vmap` each scalar becomes a row of lanes, and all operations fuse into straight-line
    vector code. In a rollout of hundreds of lanes this is 1.5 times as fast as small matrix
    products, but takes longer to compile. Do not use it for traced weights.
    """
    values, between = list(inputs), ACTIVATIONS[activation]
    for i, (weight, bias) in enumerate(layers):
        columns = np.asarray(weight).T.tolist()
        sums = []
        for column, start in zip(columns, np.asarray(bias).tolist(), strict=True):
            total: Any = start
            for w, value in zip(column, values, strict=True):
                total = total + w * value
            sums.append(total)
        values = sums if i == len(layers) - 1 else [between(total) for total in sums]
    return values


def new_layers(key: Key[Array, ""], sizes: Sequence[int], gain: float) -> Layers:
    """Draw orthogonal weights and zero biases, scaled by `gain` in the last layer, else sqrt(2).

    Source: Saxe, McClelland and Ganguli (2014), section 3.
    """
    layers = []
    for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        scale = gain if i == len(sizes) - 2 else 2**0.5
        draw = jax.nn.initializers.orthogonal(scale)
        # One after the other under `vmap`: QR decompositions of several matrices at once, on
        # several devices of a CPU, wait for each other for ever (jaxlib 0.10.2).
        one = jax.custom_batching.sequential_vmap(
            partial(draw, shape=(inputs, outputs), dtype=jnp.float32)
        )
        weight = one(jax.random.fold_in(key, i))
        layers.append((weight, jnp.zeros(outputs)))
    return tuple(layers)


def most_likely_action(
    action: Action, outputs: Float[Array, " outputs"]
) -> Int[Array, ""] | Float[Array, " size"]:
    """Return the mode of the action distribution given by a network's outputs."""
    if isinstance(action, Discrete):
        return jnp.argmax(outputs).astype(jnp.int32)
    return scale_to_range(action, outputs)


def scale_to_range(
    action: Continuous, unit: Float[Array, "*batch size"]
) -> Float[Array, "*batch size"]:
    """Map [-1, 1] to the range of the action, clipped."""
    middle, half = (action.high + action.low) / 2, (action.high - action.low) / 2
    return jnp.clip(middle + half * unit, action.low, action.high)


def save_policy(
    policy: Policy, path: str | Path, *, sources: Mapping[str, Any] | None = None, **notes: object
) -> None:
    """Write a policy as a compressed `.npz` of float32 arrays.

    **Arguments:**
    - `policy`: the policy to write.
    - `path`: the file.
    - `sources`: the files with which it was trained, as a run records them; by default those of the
      modules that call this function. `policy_sources` reads them.
    - `notes`: plain data for JSON, stored next to the arrays; `policy_notes` reads them.
    """
    kind = next(name for name, cls in _KINDS.items() if isinstance(policy.action, cls))
    sources = sources_of(made=made_here()).to_json() if sources is None else dict(sources)
    about = {
        "action": {"kind": kind, **dataclasses.asdict(policy.action)}, "notes": notes,
        "activation": policy.activation, "squash": policy.squash, "sources": sources,
    }  # fmt: skip
    arrays: dict[str, Any] = {"about": np.array(json.dumps(about))}
    for i, (weight, bias) in enumerate(policy.layers):
        arrays[f"weight{i}"], arrays[f"bias{i}"] = np.float32(weight), np.float32(bias)
    for name in ("mean", "scale", "log_std"):
        if (value := getattr(policy, name)) is not None:
            arrays[name] = np.float32(value)
    path = Path(path)
    with replacing(path if path.suffix == ".npz" else Path(f"{path}.npz")) as partial:
        np.savez_compressed(partial, **arrays)


def load_policy(path: str | Path) -> Policy:
    """Read a policy written by `save_policy`. The file can only contain numbers and text.

    **Returns:** the policy, with JAX arrays of float32.
    **Raises:** `FileNotFoundError`; `PolicyFileError` for a file of another kind, and for arrays
    that are missing, not finite, or of shapes that do not fit each other and the actions.
    """
    arrays, about = _read(path)
    try:
        kind = _action_of(about["action"])
        layers, rest = _layers_of(arrays)
        optional = {
            name: jax.device_put(rest.pop(name)) if name in rest else None
            for name in ("mean", "scale", "log_std")
        }
        if rest:
            raise ValueError(f"it has an array {min(rest)!r}, which belongs to no layer")
        # Files of before these two were fields have tanh networks that are not squashed.
        how = {name: about[name] for name in ("activation", "squash") if name in about}
        if not isinstance(how.get("squash", False), bool) or not isinstance(
            how.get("activation", ""), str
        ):
            raise ValueError(f"its activation must be a text and squash true or false; got {how}")
        policy = Policy(layers=layers, action=kind, **optional, **how)
        _check_fits(policy)
        return policy
    except KeyError as error:
        why = f"{error.args[0]!r} is missing or unknown"
        raise PolicyFileError(f"{path} holds no policy: {one_line(why)}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise PolicyFileError(f"{path} holds no policy: {one_line(str(error))}") from error


def _action_of(data: object) -> Action:
    """Return the kind of action that a file describes."""
    if not isinstance(data, dict) or data.get("kind") not in list(_KINDS):
        raise ValueError(f"its action must be an object of kind {' or '.join(_KINDS)}")
    kind = _KINDS[data["kind"]]
    numbers = {name: value for name, value in data.items() if name != "kind"}
    wanted = [field.name for field in dataclasses.fields(kind)]
    if sorted(numbers) != sorted(wanted):
        raise ValueError(f"its action must have {', '.join(wanted)}; got {', '.join(numbers)}")
    for name, value in numbers.items():
        if name in ("low", "high"):
            if not is_number(value) or not math.isfinite(value):
                raise ValueError(f"{name} of its action must be a finite number; got {value!r}")
        else:
            check_count(f"the number {name} of its actions", value)
    return kind(**numbers)


def _layers_of(arrays: Mapping[str, np.ndarray]) -> tuple[Layers, dict[str, np.ndarray]]:
    """Return the layers of a file whose shapes fit together, and the other arrays."""
    for name, array in arrays.items():
        if array.dtype.kind != "f" or not np.all(np.isfinite(array)):
            raise ValueError(f"its array {name!r} must hold finite floating-point numbers")
    rest = dict(arrays)
    count = max(1, sum(name.startswith("bias") for name in arrays))
    layers = tuple((rest.pop(f"weight{i}"), rest.pop(f"bias{i}")) for i in range(count))
    inputs = None
    for i, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or inputs not in (None, weight.shape[0]) or 0 in weight.shape:
            raise ValueError(f"its array 'weight{i}' has shape {list(weight.shape)}")
        inputs = weight.shape[1]
        if bias.shape != (inputs,):
            raise ValueError(
                f"its array 'bias{i}' must have shape [{inputs}]; got {list(bias.shape)}"
            )
    return tuple((jax.device_put(weight), jax.device_put(bias)) for weight, bias in layers), rest


def _check_fits(policy: Policy) -> None:
    """Check that the network's outputs fit the policy's kind of action."""
    action, outputs = policy.action, policy.layers[-1][0].shape[1]
    wanted = action.n if isinstance(action, Discrete) else action.size
    if outputs != wanted:
        raise ValueError(f"its network has {outputs} outputs, and its actions need {wanted}")
    sizes = {"mean": policy.layers[0][0].shape[0], "scale": policy.layers[0][0].shape[0]}
    for name, size in {**sizes, "log_std": wanted}.items():
        array = getattr(policy, name)
        if array is not None and array.shape != (size,):
            raise ValueError(
                f"its array {name!r} must have shape [{size}]; got {list(array.shape)}"
            )
    if (policy.mean is None) != (policy.scale is None):
        raise ValueError("it has only one of the arrays 'mean' and 'scale'")
    if policy.scale is not None and not np.all(np.asarray(policy.scale) > 0):
        raise ValueError("its array 'scale' must hold positive numbers")


def policy_notes(path: str | Path) -> dict[str, Any]:
    """Read the notes saved with a policy, for example on its training and its return.

    **Raises:** `FileNotFoundError`; `PolicyFileError` for a file of another kind.
    """
    return _plain_data(path, "notes")


def policy_sources(path: str | Path) -> dict[str, Any]:
    """Read the files and versions with which a policy was made, as a run records them.

    **Returns:** plain data with hashes of `files` and the `versions`; empty if the file has none.
    **Raises:** `FileNotFoundError`; `PolicyFileError` for a file of another kind.
    """
    return _plain_data(path, "sources")


def _plain_data(path: str | Path, name: str) -> dict[str, Any]:
    data = _read(path)[1].get(name, {})
    if not isinstance(data, dict):
        raise PolicyFileError(f"{path} is damaged: its {name} must be an object")
    return data


def _read(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    try:
        arrays = read_arrays(Path(path), str(path))
        about = json.loads(str(arrays.pop("about")))
        if not isinstance(about, dict):
            raise ValueError("its description of itself is not an object")
        return arrays, about
    except FileNotFoundError:
        raise
    except Exception as error:
        raise PolicyFileError(f"{path} holds no policy: {one_line(str(error))}") from error
