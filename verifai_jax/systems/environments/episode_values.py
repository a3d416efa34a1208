"""Observations and actions of Gymnasium as arrays and names, and functions of a policy for it."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import UInt8

from verifai_jax.core.gaps import with_gaps
from verifai_jax.systems.pytree_checks import outline


def entry_form(leaf: object) -> Any:
    """Return the form of an entry of a space, itself where it holds no numbers."""
    array = np.asarray(leaf)
    return jax.ShapeDtypeStruct(array.shape, array.dtype) if array.dtype.kind in "biuf" else leaf


def single_picture(image: Any, name: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return what an environment drew, a single picture.

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
    """Return an observation or action with its numbers as arrays, in its own form."""
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
