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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from verifai_jax.core.errors import check_names
from verifai_jax.rl.task.task import Action, Continuous, Discrete

Layers = tuple[tuple[Float[Array, "inputs outputs"], Float[Array, " outputs"]], ...]

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"tanh": jnp.tanh, "relu": jax.nn.relu}

_KINDS: dict[str, type[Discrete] | type[Continuous]] = {
    "discrete": Discrete,
    "continuous": Continuous,
}


class PolicyFileError(ValueError):
    """A file that holds no policy of ours."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Policy:
    """A network, what it sees, and what its outputs mean.

    - `layers`: weights `[inputs, outputs]` and biases `[outputs]`, first layer first.
    - `mean`, `scale`: `[k]`; the network sees `(observation - mean) / scale`. None: as it is.
    - `log_std`: `[size]`, of the Gaussian that explores; None for discrete actions, and where the
      deviation depends on the observation.
    - `activation`: between the layers, of `ACTIVATIONS`. All are 0 at 0, so that units whose
      weights are 0 change nothing.
    - `squash`: the outputs of a continuous policy go through tanh; otherwise they are clipped.

    **Raises:** `UnknownNameError` for another activation; `ValueError` for squashed logits.
    """

    layers: Layers
    mean: Float[Array, " k"] | None
    scale: Float[Array, " k"] | None
    log_std: Float[Array, " size"] | None
    action: Action = dataclasses.field(metadata={"static": True})
    activation: str = dataclasses.field(default="tanh", metadata={"static": True})
    squash: bool = dataclasses.field(default=False, metadata={"static": True})

    def __post_init__(self) -> None:
        check_names("activation", [self.activation], ACTIVATIONS)
        if self.squash and isinstance(self.action, Discrete):
            raise ValueError(f"only continuous actions can be squashed; got {self.action}")

    def __call__(self, observation: Float[Array, " k"]) -> Float[Array, " outputs"]:
        """Logits or values of the `n` actions, or the mean action in units of half its range."""
        if self.mean is not None and self.scale is not None:
            observation = (observation - self.mean) / self.scale
        outputs = network(self.layers, observation, self.activation)
        return jnp.tanh(outputs) if self.squash else outputs

    def act(self, observation: Float[Array, " k"]) -> Int[Array, ""] | Float[Array, " size"]:
        """The likeliest action: an index, or a vector within its range."""
        return likeliest(self.action, self(observation))


def network(
    layers: Layers, x: Float[Array, "*batch inputs"], activation: str = "tanh"
) -> Float[Array, "*batch outputs"]:
    """A multilayer perceptron with the activation between its layers."""
    between = ACTIVATIONS[activation]
    for weight, bias in layers[:-1]:
        x = between(x @ weight + bias)
    weight, bias = layers[-1]
    return x @ weight + bias


def written_out(
    layers: Layers, inputs: Sequence[Float[Array, ""]], activation: str = "tanh"
) -> list[Float[Array, ""]]:
    """The same network number by number, for a few hundred weights that are known constants.

    Under `vmap` each number is a row of lanes and all of them fuse into straight-line vector code:
    in a rollout of hundreds of lanes 1.5 times as fast as small matrix products, at more compile
    time. Not for weights that are themselves being traced.
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
    """Orthogonal weights and zero biases; `gain` scales the last layer, sqrt(2) the others.

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


def likeliest(action: Action, outputs: Float[Array, " outputs"]) -> Array:
    """The mode of the distribution over actions that a network's outputs describe."""
    if isinstance(action, Discrete):
        return jnp.argmax(outputs).astype(jnp.int32)
    return in_range(action, outputs)


def in_range(action: Continuous, unit: Float[Array, " size"]) -> Float[Array, " size"]:
    """From units of half the range around its middle to the action itself, clipped."""
    middle, half = (action.high + action.low) / 2, (action.high - action.low) / 2
    return jnp.clip(middle + half * unit, action.low, action.high)


def save_policy(policy: Policy, path: str | Path, **notes: Any) -> None:
    """Write a policy as a compressed `.npz` of float32 arrays, with `notes` (JSON) beside them."""
    kind = next(name for name, cls in _KINDS.items() if isinstance(policy.action, cls))
    about = {
        "action": {"kind": kind, **dataclasses.asdict(policy.action)},
        "activation": policy.activation,
        "squash": policy.squash,
        "notes": notes,
    }
    arrays: dict[str, Any] = {"about": np.array(json.dumps(about))}
    for i, (weight, bias) in enumerate(policy.layers):
        arrays[f"weight{i}"], arrays[f"bias{i}"] = np.float32(weight), np.float32(bias)
    for name in ("mean", "scale", "log_std"):
        if (value := getattr(policy, name)) is not None:
            arrays[name] = np.float32(value)
    np.savez_compressed(path, **arrays)


def load_policy(path: str | Path) -> Policy:
    """Read a policy that `save_policy` wrote. The file can hold numbers and text only.

    **Raises:** `FileNotFoundError`; `PolicyFileError` for a file of another kind.
    """
    arrays, about = _read(path)
    try:
        action = dict(about["action"])
        kind = _KINDS[action.pop("kind")](**action)
        count = sum(name.startswith("weight") for name in arrays)
        layers = tuple(
            (jnp.asarray(arrays[f"weight{i}"]), jnp.asarray(arrays[f"bias{i}"]))
            for i in range(count)
        )
        shapes = [weight.shape for weight, _ in layers]
        chained = all(a[1] == b[0] for a, b in itertools.pairwise(shapes))
        if not layers or not chained:
            raise KeyError(f"layers of shapes {shapes}")
        optional = {
            name: jnp.asarray(arrays[name]) if name in arrays else None
            for name in ("mean", "scale", "log_std")
        }
        # Files of before these two were fields have tanh networks that are not squashed.
        how = {name: about[name] for name in ("activation", "squash") if name in about}
        return Policy(layers=layers, action=kind, **optional, **how)
    except (KeyError, TypeError, ValueError) as error:
        raise PolicyFileError(f"{path} holds no policy: {error}") from error


def policy_notes(path: str | Path) -> dict[str, Any]:
    """The notes that were saved with a policy: how it was trained, how well it did."""
    return _read(path)[1].get("notes", {})


def _read(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return arrays, json.loads(str(arrays.pop("about")))
    except FileNotFoundError:
        raise
    except Exception as error:
        raise PolicyFileError(f"{path} holds no policy: {error}") from error
