"""Policies of Stable-Baselines3 from their files, without it and without unpickling.

A model's `.zip` has the settings as JSON (`data`), among them pickled spaces, and the weights
(`policy.pth`). `VecNormalize.save` writes one pickle. Source: Stable-Baselines3 2.7,
`common/policies.py`, `common/torch_layers.py`, `sac/policies.py`, `td3/policies.py`,
`dqn/policies.py`, `vec_normalize.py`.
"""

import base64
import json
import logging
import re
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.rl.policies.base import Actions, Normaliser, Policy
from verifai_jax.addons.rl.policies.errors import MAX_BYTES, PolicyError, refused
from verifai_jax.addons.rl.policies.networks import LstmMlp, Mlp, activation_name
from verifai_jax.addons.rl.policies.pickled import Name, Record, array_of, read_pickle
from verifai_jax.addons.rl.policies.tensors import Tensors, linear_layers, natural
from verifai_jax.addons.rl.policies.torch_archive import read_state
from verifai_jax.core.store.foreign_archives import open_archive, read_member

_KINDS = (
    # What is there, the hidden layers, the last layer (None: the last of the hidden ones), the
    # features.
    ("action_net.weight", "mlp_extractor.policy_net.", "action_net", ""),
    ("actor.latent_pi.0.weight", "actor.latent_pi.", "actor.mu", "actor."),
    ("actor.mu.weight", "actor.latent_pi.", "actor.mu", "actor."),
    ("actor.mu.0.weight", "actor.mu.", None, "actor."),
    ("q_net.q_net.0.weight", "q_net.q_net.", None, "q_net."),
)
"""PPO and A2C; SAC, with and without hidden layers; TD3 and DDPG; DQN."""
_POLICIES = re.compile(
    r"((?:Recurrent)?ActorCritic|MaskableActorCritic|SAC|TD3|TQC|DQN|)(Mlp|Cnn|)Policy"
)
_EXTRACTORS = re.compile("FlattenExtractor|NatureCNN")
Space = tuple[str, dict[str, Any]]
"""The kind of a space of Gymnasium, and its attributes."""
EXPORT = "export it as ONNX, and load that"


def read_sb3(data: bytes, what: str) -> Policy:
    """Return a model of Stable-Baselines3, which acts as its `predict(..., deterministic=True)`."""
    archive = open_archive(data, what, MAX_BYTES)
    if "data" not in archive.namelist() or "policy.pth" not in archive.namelist():
        raise PolicyError(
            f"{what} is not a model of Stable-Baselines3: it has no data and policy.pth. Name an "
            "archive of torch.save .pt"
        )
    with refused(f"the settings of {what} are damaged", repr):
        settings = json.loads(read_member(archive, "data", what))
        observed = _space(settings["observation_space"], "observation", what)
        acts = _space(settings["action_space"], "action", what)
        options = _unpickled(settings.get("policy_kwargs", {}), f"policy_kwargs of {what}")
        if not isinstance(options, Mapping):
            raise PolicyError(f"policy_kwargs of {what} is damaged")
        options = {str(name): value for name, value in options.items()}
        name = f"policy.pth of {what}"
        weights = Tensors(read_state(read_member(archive, "policy.pth", what), name), name)
        kind = _unpickled(settings.get("policy_class"), f"policy_class of {what}")
        _check_class(kind, _POLICIES, "a policy", what)
        extractor = options.get("features_extractor_class")
        _check_class(extractor, _EXTRACTORS, "a features extractor", what)
        loaded = _policy(weights, observed, acts, options, what)
        remembers = loaded.initial_memory is not None
        if isinstance(kind, Name) and remembers != kind.name.startswith("Recurrent"):
            raise PolicyError(f"{what} has a policy of the class {kind.name}, but other tensors")
        weights.settle(EXPORT, logging.INFO)
        return loaded


def read_normaliser(data: bytes, what: str) -> Normaliser:
    """Return the normalisation of observations, not by name, of `VecNormalize.save`."""
    record = read_pickle(data, what)
    state = record.state if isinstance(record, Record) else None
    if isinstance(state, Mapping) and state.get("norm_obs") is False:
        return Normaliser(jnp.zeros(()), jnp.ones(()))
    if not isinstance(state, Mapping) or "obs_rms" not in state:
        raise PolicyError(f"{what} is not a file of VecNormalize.save: it has no obs_rms")
    statistics = state["obs_rms"]
    values = statistics.state if isinstance(statistics, Record) else None
    if not isinstance(values, Mapping):
        raise PolicyError(f"{what} scales observations by name, which is not supported")
    mean, variance = (array_of(values.get(name)) for name in ("mean", "var"))
    if mean is None or variance is None or mean.shape != variance.shape:
        raise PolicyError(f"{what} is damaged: its obs_rms needs mean and var of one shape")
    epsilon, clip = (_number(state.get(name), name, what) for name in ("epsilon", "clip_obs"))
    scale = np.sqrt(np.asarray(variance, float) + epsilon)
    if not np.all(np.isfinite(mean)) or not np.all(scale > 0):
        raise PolicyError(f"{what} has a mean or variance that cannot be a scale")
    return Normaliser(jnp.asarray(mean, np.float32), jnp.asarray(scale, np.float32), clip)


def _check_class(given: object, known: re.Pattern[str], role: str, what: str) -> None:
    """Refuse a class whose computation is not that of the library's own."""
    name = given.name if isinstance(given, Name) else ""
    if name and not known.fullmatch(name):
        raise PolicyError(f"{what} has {role} of the class {name}: {EXPORT}")


def _number(value: object, name: str, what: str) -> float:
    value = value if (array := array_of(value)) is None else array
    with refused(f"{what} is damaged: its {name} is not a number"):
        return float(value)  # pyright: ignore[reportArgumentType]


def _unpickled(entry: Any, what: str) -> Any:
    """Return the pickled part of an entry of the settings, as plain values."""
    if isinstance(entry, Mapping) and ":serialized:" in entry:
        return read_pickle(base64.b64decode(entry[":serialized:"]), what)
    return entry


def _space(entry: Any, role: str, what: str) -> Space:
    """Return the kind of a space of Gymnasium, and its attributes, arrays read."""
    record = _unpickled(entry, f"the {role} space of {what}")
    kind = record.function if isinstance(record, Record) else None
    if isinstance(kind, Name) and kind.name in ("__newobj__", "_reconstructor"):
        kind = record.arguments[0]
    if not isinstance(kind, Name) or not isinstance(record.state, Mapping):
        raise PolicyError(f"the {role} space of {what} is damaged")
    read = {str(name): (value, array_of(value)) for name, value in record.state.items()}
    return kind.name, {n: value if array is None else array for n, (value, array) in read.items()}


def _policy(
    weights: Tensors, observed: Space, acts: Space, options: Mapping[str, Any], what: str
) -> Policy:
    known = [kind for kind in _KINDS if kind[0] in weights]
    if not known:
        some = ", ".join(sorted(weights)[:3])
        form = "a network of another form than PPO, A2C, SAC, TD3, DDPG and DQN have"
        raise PolicyError(f"{what} holds {form} ({some} ...): {EXPORT}")
    found, hidden, last, features = known[0]
    if "actor.mu.0.weight" in weights and found == "actor.latent_pi.0.weight":
        raise PolicyError(f"{what} is a SAC with use_sde=True: {EXPORT}")
    names = _numbered(weights, hidden) + ([last] if last else [])
    if any(name.startswith("mlp_extractor.shared_net.") for name in weights):
        names = _numbered(weights, "mlp_extractor.shared_net.") + names
    on_policy, function = found == "action_net.weight", options.get("activation_fn")
    usual = "tanh" if on_policy else "relu"
    activation = activation_name(function.name if isinstance(function, Name) else usual)
    network, arrays = _network(weights, names, features, observed, activation, options, what)
    cells, memory = _lstm(weights, what), None
    if cells:
        if network.pixels or cells[-1][1].shape[0] != arrays[0][0].shape[0]:
            raise PolicyError(f"{what} remembers in an LSTM of a form that is unknown: {EXPORT}")
        network, arrays = LstmMlp(activation, network.categories), (cells, arrays)
        memory = tuple((jnp.zeros(r.shape[0]), jnp.zeros(r.shape[0])) for _, r, _ in cells)
    squashed = not on_policy or bool(options.get("squash_output", False))
    return Policy(arrays, network, memory, actions=_actions(acts, squashed, what))


def _lstm(weights: Tensors, what: str) -> tuple[tuple[Any, Any, Any], ...]:
    """Return the layers of the actor's LSTM of RecurrentPPO: kernels, and the sum of biases."""
    cells, before = [], None
    while (at := f"l{len(cells)}") and f"lstm_actor.weight_ih_{at}" in weights:
        names = [f"lstm_actor.{part}_{at}" for part in ("weight_ih", "weight_hh", "bias_ih")]
        kernel, recurrent = (np.asarray(weights[name], np.float32).T for name in names[:2])
        bias = np.zeros(kernel.shape[-1], np.float32)
        for name in (names[2], names[2].replace("_ih", "_hh")):
            bias = bias + (np.asarray(weights[name], np.float32) if name in weights else 0)
        size = recurrent.shape[0]
        odd = recurrent.shape != (size, 4 * size) or kernel.shape[1:] != (4 * size,)
        if odd or before not in (None, kernel.shape[0]) or bias.shape != (4 * size,):
            raise PolicyError(f"layer {at} of the LSTM of {what} has tensors that do not fit")
        cells.append(tuple(map(jnp.asarray, (kernel, recurrent, bias))))
        before = size
    return tuple(cells)


def _numbered(weights: Tensors, prefix: str) -> list[str]:
    """Return the names of the layers of a sequence, in order."""
    names = {n.rpartition(".")[0] for n in weights if n.startswith(prefix)}
    return sorted(names, key=natural)


def _network(
    weights: Tensors, names: list[str], features: str, observed: Space, activation: str,
    options: Mapping[str, Any], what: str,
) -> tuple[Mlp, Any]:  # fmt: skip
    """Return the network's form and its weights."""
    kind, space = observed
    prefixes = [f"{features}{n}features_extractor." for n in ("pi_", "")]
    extractor = next((p for p in prefixes if any(n.startswith(p) for n in weights)), None)
    categories = {"Box": None, "MultiBinary": None, "Discrete": "n", "MultiDiscrete": "nvec"}
    if kind in categories and extractor is None:
        counts = [] if (name := categories[kind]) is None else np.ravel(space[name])
        network = Mlp(activation, tuple(int(n) for n in counts))
        return network, linear_layers(weights, names, what)
    convolutions = [f"{extractor}cnn.{i}" for i in (0, 2, 4)]
    image = len(space.get("_shape") or ()) == 3 and options.get("normalize_images", True) is True
    if kind != "Box" or not image or not all(f"{n}.weight" in weights for n in convolutions):
        sees = f"{what} reads observations of {kind}"
        raise PolicyError(f"{sees} with an unsupported features extractor: {EXPORT}")
    array = lambda name: jnp.asarray(weights[name], np.float32)  # noqa: E731
    kernels = tuple((array(f"{name}.weight"), array(f"{name}.bias")) for name in convolutions)
    layers = linear_layers(weights, [f"{extractor}linear.0", *names], what)
    return Mlp(activation, pixels=True), (kernels, layers)


def _actions(acts: Space, squashed: bool, what: str) -> Actions:
    """Return the conversion of outputs to an action of the space."""
    kind, space = acts
    if kind == "Discrete":
        if int(_number(space.get("start", 0), "start", what)) != 0:
            raise PolicyError(f"{what} has actions that do not begin at 0")
        return Actions("argmax")
    if kind == "MultiDiscrete":
        return Actions("argmax", counts=tuple(int(n) for n in np.ravel(space["nvec"])))
    if kind == "MultiBinary":
        return Actions("positive")
    if kind != "Box" or not np.ndim(space.get("low", 0)):
        raise PolicyError(f"{what} has actions of {kind} of a form that is not supported")
    low, high = (tuple(np.ravel(space[name]).astype(float).tolist()) for name in ("low", "high"))
    shape = np.shape(space["low"])
    return Actions("tanh" if squashed else "clip", low, high, shape=shape if len(shape) > 1 else ())
