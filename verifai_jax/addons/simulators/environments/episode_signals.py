"""Observations and actions of an environment as arrays, and the trace's signals made of them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import PyTree, UInt8

from verifai_jax.addons.simulators.environments.episode import Moment
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.user_code.user_errors import check_called_with
from verifai_jax.core.values.gaps import with_gaps
from verifai_jax.systems.base import Features
from verifai_jax.systems.channels import NamedNumbers
from verifai_jax.systems.pytree_checks import outline

SignalsOption: TypeAlias = (
    Mapping[str, int | str] | Sequence[str] | Callable[..., Mapping[str, Any]] | None
)
"""The option `signals` of an environment; see `read_signals`."""


def read_signals(
    signals: SignalsOption, moment: Moment, action: PyTree, features: Features,
    named: Mapping[str, Any], name: str,
) -> Any:  # fmt: skip
    """Return one sample of the signals given by the option `signals`.

    - `signals`: a function `(state, observation, action, reward, features) -> dict`; names of the
      observation's entries, in their order; or `{name: index or key of the observation}`. The last
      two forms also give `action` and `reward`. None gives `named`, `observation`, `action` and
      `reward`.

    **Raises:** `ValueError` for an entry that the observation does not have.
    """
    if callable(signals):
        return signals(moment.state, moment.observation, action, moment.reward, features)
    loop = {"action": _plain(action), "reward": moment.reward}
    if signals is None:
        everything = {**named, "observation": moment.observation, **loop}
        if isinstance(moment.observation, Mapping):
            everything |= {str(k): v for k, v in moment.observation.items()}
        return {k: _plain(v) for k, v in everything.items() if hasattr(v, "ndim") and v.ndim <= 1}
    if isinstance(signals, Mapping):
        return loop | {k: _entry(moment.observation, at, k, name) for k, at in signals.items()}
    shape = getattr(moment.observation, "shape", None)
    if shape != (len(signals),):
        raise ValueError(
            f"signals has {len(signals)} names, {', '.join(signals)}, for the entries of an "
            f"observation of {name}, which is {outline(moment.observation)}; "
            "name all of them, or give {name: index}"
        )
    return {entry: moment.observation[i] for i, entry in enumerate(signals)} | loop


def check_signals_option(signals: object, state: str = "state") -> None:
    """Refuse an option `signals` that `read_signals` cannot use.

    - `state`: the first argument of a function, as text.
    """
    if signals is None:
        return
    if callable(signals):
        arguments = (state, "observation", "action", "reward", "features")
        check_called_with("signals", signals, arguments)
        return
    names = list(signals) if isinstance(signals, Mapping | Sequence) else []
    if not names or isinstance(signals, str) or not all(isinstance(n, str) for n in names):
        raise ValueError(
            "signals must be names of the observation's entries, {name: index or key}, or a "
            f"function ({state}, observation, action, reward, features) -> dict; got {signals!r}"
        )
    if len(set(names)) < len(names) or {"action", "reward"} & set(names):
        raise ValueError(
            f"signals must have different names, other than action and reward; got {names}"
        )


def names_of_entries(signals: SignalsOption) -> dict[str, NamedNumbers]:
    """Return the locations in an observation of the entries named by the option `signals`."""
    if callable(signals) or signals is None:
        return {}
    entries = (
        signals if isinstance(signals, Mapping) else {name: i for i, name in enumerate(signals)}
    )
    return {
        name: NamedNumbers("observation", at)
        if isinstance(at, str)
        else NamedNumbers("observation", "", (at,))
        for name, at in entries.items()
    }


def _entry(observation: PyTree, at: int | str, signal: str, name: str) -> Any:
    if isinstance(observation, Mapping):
        if at not in observation:
            raise unknown_name(f"entry of {name}'s observation", at, observation)
        return _plain(observation[at])
    length = observation.shape[0] if getattr(observation, "ndim", 0) == 1 else 0
    if not isinstance(at, int | np.integer) or not -length <= at < length:
        raise ValueError(
            f"signal {signal!r} is entry {at!r} of an observation of {name}, which is "
            f"{outline(observation)}"
        )
    return observation[at]


def _plain(value: PyTree) -> Any:
    """Return a vector of one entry as that entry, so that formulas need no index."""
    return value[0] if getattr(value, "shape", None) == (1,) else value


def entry_form(leaf: object) -> Any:
    """Return the form of an entry of a space; the space itself if it holds no numbers."""
    array = np.asarray(leaf)
    return jax.ShapeDtypeStruct(array.shape, array.dtype) if array.dtype.kind in "biuf" else leaf


def single_picture(image: Any, name: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return the single picture that an environment drew.

    **Raises:** `ValueError` for anything else.
    """
    image = image[-1] if isinstance(image, list) and image else image
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[2] not in (3, 4) or array.dtype != np.uint8:
        raise ValueError(
            f"render of {name} must return a picture [height, width, 3] of bytes; got "
            f"{outline(image)}"
        )
    return array[..., :3]


def as_arrays(value: object) -> Any:
    """Return an observation or action with its numbers as arrays, in the same structure."""
    if isinstance(value, Mapping):
        return {name: as_arrays(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return tuple(as_arrays(part) for part in value)
    return value if isinstance(value, str) else np.asarray(with_gaps("observation", value))


def named_entries(observation: Mapping[str, Any] | tuple[Any, ...]) -> dict[str, Any]:
    """Return the parts of a nested observation by name: `height`, `arm.angle`, `observation.0`."""
    entries: dict[str, Any] = {}
    several = isinstance(observation, Mapping)
    parts = observation.items() if several else enumerate(observation)
    for key, part in parts:
        name = str(key) if several else f"observation.{key}"
        if isinstance(part, Mapping | tuple):
            inner = named_entries(part)
            stem = "observation." if isinstance(part, tuple) else ""
            entries |= {f"{name}.{k.removeprefix(stem)}": v for k, v in inner.items()}
        else:
            entries[name] = part
    return entries


def host_policy_function(policy: object, compiled: bool = True) -> Callable[..., Any]:
    act = getattr(policy, "act", None)
    function = act if callable(act) else policy
    if not callable(function):
        raise ValueError(
            f"policy must be a function of the observation, or have a method act; got {policy!r}"
        )
    # A network in JAX costs a hundred times less a step when it is compiled as a whole.
    network = function is not policy and jax.tree.leaves(policy) != [policy]
    return jax.jit(function) if network and compiled else function
