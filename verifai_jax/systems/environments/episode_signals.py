"""Signals of an environment's trace, by the option `signals`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import PyTree

from verifai_jax.core.errors import unknown_name
from verifai_jax.core.user_errors import check_called_with
from verifai_jax.systems.base import Features
from verifai_jax.systems.channels import NamedNumbers
from verifai_jax.systems.environments.episode import Moment
from verifai_jax.systems.pytree_checks import (
    outline,
)

SignalsOption: TypeAlias = (
    Mapping[str, int | str] | Sequence[str] | Callable[..., Mapping[str, Any]] | None
)
"""The option `signals` of an environment; see `read_signals`."""


def read_signals(
    signals: SignalsOption,
    moment: Moment,
    action: PyTree,
    features: Features,
    named: Mapping[str, Any],
    name: str,
) -> Any:
    """Return one sample of the signals that the option `signals` names.

    - `signals`: a function `(state, observation, action, reward, features) -> dict`; names of the
      observation's entries, in their order; or `{name: index or key of the observation}`. The last
      two also give `action` and `reward`. None: `named`, `observation`, `action` and `reward`.

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
    """Refuse a `signals=` option that `read_signals` could not use.

    - `state`: what a function gets first, as text.

    **Raises:** `ValueError`.
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
            f"signals must have names of their own beside action and reward; got {names}"
        )


def names_of_entries(signals: SignalsOption) -> dict[str, NamedNumbers]:
    """Return where an observation has the entries that the option `signals` names."""
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
