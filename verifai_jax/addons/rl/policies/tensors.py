"""Tensors of a checkpoint by name: each of them is used, or named.

tensors = Tensors(read_state(data, path), path)
layers = linear_layers(tensors, layer_names(tensors), path)
tensors.settle("give ...")                          # refuses what nothing has read
"""

import logging
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import pairwise

import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.rl.policies.base import Normaliser
from verifai_jax.addons.rl.policies.errors import PolicyError
from verifai_jax.addons.rl.policies.networks import Layers
from verifai_jax.core.messages.errors import unknown_name

log = logging.getLogger("verifai_jax.policies")
ASIDE = re.compile(
    r"(?<![A-Za-z0-9])(critics?|values?|vf|qf|qf?\d+|baseline|target|optim|optimizer|exp_avg|std|"
    r"logstd|sigma|logsigma|alpha|entropy|ent_coef|count|num_batches_tracked|discriminator|"
    r"scheduler|privileged_obs_norm)(?![A-Za-z0-9])"
)
"""Words in the names of tensors that a deterministic action does not depend on: those of critics,
targets and optimisers, and the spread of actions."""
OTHERWISE = "say how observations are normalised by normalise=(mean, scale), (0, 1) for not at all"


class Tensors(dict[str, np.ndarray]):
    """The tensors of the file `what`, in the order of names; `used` is what `[name]` has read."""

    def __init__(self, arrays: Mapping[str, np.ndarray], what: str) -> None:
        # A file need not keep their order.
        super().__init__({name: arrays[name] for name in sorted(arrays, key=natural)})
        self.what, self.used = what, set[str]()

    def __getitem__(self, name: str) -> np.ndarray:
        self.used.add(name)
        return self.peek(name)

    def peek(self, name: str) -> np.ndarray:
        """Return a tensor that does not count as read by that."""
        array = super().__getitem__(name)
        if not np.all(np.isfinite(array)):
            raise PolicyError(f"the tensor {name!r} of {self.what} holds NaN or infinite numbers")
        return array

    def ignore(self, names: Iterable[str]) -> None:
        """Count tensors as read, by names or their beginnings, of which each must exist."""
        for name in names:
            found = [n for n in self if f"{n}.".startswith(f"{name.rstrip('.')}.")]
            if not found:
                raise unknown_name(f"tensor of {self.what}", name, self)
            self.used.update(found)

    def settle(self, remedy: str, level: int = logging.WARNING) -> None:
        """Refuse unread tensors that an action may depend on, and log the others at this level.

        **Raises:** `PolicyError` with their names and the remedy.
        """
        used = [self.peek(name) for name in self.used]
        # A second name of a tensor that was read is none that is missing.
        again = {
            n for n, a in self.items() if a.size > 1 and any(np.array_equal(a, u) for u in used)
        }
        left = [name for name in self if name not in self.used | again]
        held = {name for names in normalisers(self).values() for name in names.values()}
        needed = [name for name in left if name in held or not ASIDE.search(name)]
        if needed:
            some = listed(needed)
            raise PolicyError(f"{self.what} also holds {some}, which nothing uses: {remedy}")
        if left:
            log.log(level, "%s also holds %s, which no action depends on", self.what, listed(left))


def listed(names: Collection[str], count: int = 8) -> str:
    """Write names, the first of many."""
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return ", ".join(list(names)[:count]) + more


def normalisers(tensors: Tensors) -> dict[str, dict[str, str]]:
    """Return unread means with variances or deviations, by common name and kind; no critic's."""
    found: dict[str, dict[str, str]] = {}
    for name in (name for name in tensors if name not in tensors.used):
        parent, _, leaf = name.rpartition(".")
        parts = re.fullmatch(r"(.*?)(mean|variance|var|std)(.*)", leaf)
        # In the name of its tensors running_mean_std is a normaliser, and no deviation.
        plain = parent.replace("mean_std", "")
        if parts is not None and f"{parent}.weight" not in tensors and not ASIDE.search(plain):
            common = f"{parent}.{parts[1]}*{parts[3]}"
            found.setdefault(common, {})[parts[2]] = name
    return {name: kinds for name, kinds in found.items() if "mean" in kinds and len(kinds) > 1}


def normaliser_of(tensors: Tensors, size: int) -> Normaliser | None:
    """Return the normaliser of an actor that takes `size` numbers, as its trainer applies it.

    **Returns:** None if the file has no normaliser.
    **Raises:** `PolicyError` for one of an unknown trainer, of another size, and for several.
    """
    found = normalisers(tensors)
    if not found:
        return None
    names = listed(sorted(name for kinds in found.values() for name in kinds.values()))
    common, kinds = next(iter(found.items()))
    parent, _, leaf = common.rpartition(".")
    number = {k: np.ravel(np.asarray(tensors.peek(n), float)) for k, n in kinds.items()}
    mean, variance = number["mean"], number.get("var", number.get("variance", np.zeros(())))
    deviation = number.get("std", np.sqrt(np.maximum(variance, 0)))
    if leaf == "_*":
        scale, clip, trainer = deviation + 0.01, None, "rsl_rl"
    elif leaf == "running_*" and f"{parent}.current_count" in tensors:
        scale, clip, trainer = deviation + 1e-8, 5.0, "skrl"
    elif leaf == "running_*" and f"{parent}.count" in tensors:
        scale, clip, trainer = np.sqrt(variance + 1e-5), 5.0, "rl_games"
    else:
        scale, clip, trainer = mean, None, ""
    if not trainer or len(found) > 1:
        form = "several normalisers" if len(found) > 1 else "a normaliser of an unknown form"
        raise PolicyError(f"{tensors.what} holds {form}, {names}: {OTHERWISE}")
    if mean.shape != (size,) or scale.shape != (size,):
        holds = f"{tensors.what} holds {names} for {mean.size} numbers"
        raise PolicyError(f"{holds}, and the network takes {size}: {OTHERWISE}")
    if not (np.all(np.isfinite([mean, scale])) and np.all(scale > 0)):
        raise PolicyError(f"{names} of {tensors.what} are no mean and scale: {OTHERWISE}")
    tensors.used.update(kinds.values())
    names += "" if clip is None else f", clipped to {clip:zg}"
    log.warning("%s: observations are normalised by %s, as by %s", tensors.what, names, trainer)
    return Normaliser(jnp.asarray(mean, np.float32), jnp.asarray(scale, np.float32), clip)


def layer_names(tensors: Tensors) -> list[str]:
    """Return the layers of an MLP in order, or refuse names and shapes that leave it open."""
    every = [name.removesuffix(".weight") for name in tensors if name.endswith(".weight")]
    actor = [name for name in every if not ASIDE.search(name)] or every
    if not actor:
        there = listed(tensors)
        raise PolicyError(f"{tensors.what} has no tensor that ends in .weight, but {there}")
    # One sequence, in whose names one number counts, and at most one layer without a number.
    counted = [name for name in actor if re.search(r"\d", name)]
    others = [name for name in actor if name not in counted]
    numbers = [tuple(re.findall(r"\d+", name)) for name in counted]
    varying = sum(len(set(column)) > 1 for column in zip(*numbers, strict=False))
    if len({re.sub(r"\d+", "#", name) for name in counted}) <= 1 and varying <= 1:
        if len(actor) == 1 or not others:
            return actor
        orders = [each for each in (counted + others, others + counted) if _fit(tensors, each)]
        if len(others) == 1 and len(orders) == 1:
            return orders[0]
    raise PolicyError(
        f"the names of {tensors.what} do not determine the order of its layers ({listed(actor)})"
    )


def _fit(tensors: Tensors, names: Sequence[str]) -> bool:
    shapes = [tensors.peek(f"{name}.weight").shape for name in names]
    return {*map(len, shapes)} == {2} and all(a[0] == b[1] for a, b in pairwise(shapes))


def linear_layers(weights: Tensors, names: Sequence[str], what: str) -> Layers:
    """Return PyTorch's layers as `([in, out], [out])`, each of which must fit the one before."""
    layers, before = [], None
    for name in names:
        if f"{name}.weight" not in weights:
            known = listed([n.removesuffix(".weight") for n in weights if ".weight" in n], 20)
            raise PolicyError(f"{what} has no tensor {name}.weight; its layers are {known}")
        weight = np.asarray(weights[f"{name}.weight"], np.float32)
        if weight.ndim != 2 or before not in (None, weight.shape[1]):
            raise PolicyError(f"{name}.weight of {what} has shape {list(weight.shape)}")
        bias = f"{name}.bias"
        bias = np.asarray(weights[bias] if bias in weights else [0] * len(weight), np.float32)
        if bias.shape != (len(weight),):
            raise PolicyError(f"{name}.bias of {what} has shape {list(bias.shape)}")
        if not (np.all(np.isfinite(weight)) and np.all(np.isfinite(bias))):
            raise PolicyError(f"the layer {name} of {what} holds numbers that are not finite")
        layers.append((jnp.asarray(weight.T), jnp.asarray(bias)))
        before = weight.shape[0]
    return tuple(layers)


def natural(name: str) -> list[int | str]:
    """Return a key that sorts `layer.10` after `layer.9`."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
