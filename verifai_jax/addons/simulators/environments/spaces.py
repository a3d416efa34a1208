"""Conversion and checks of actions and observations by the class of their Gymnasium space.

    fit(env.action_space, action, clip=True)            # as the environment takes it, or a Misfit
    named_numbers("action", action)                     # {"action": ...}, or {"action.grip": ...}

Classes are recognised by their names, because Gymnasium is an optional package and older packages
use the same names.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from verifai_jax.core.messages.text import one_line

Space = Any
"""A `gymnasium.Space`; its types cannot be imported here."""


class Misfit(ValueError):
    """An error for a value outside of a space; the message says which part, and why."""


class Fitted(NamedTuple):
    """An action in the environment's form, and whether it lay outside the bounds of a Box."""

    action: Any
    outside: bool


def kind_of(space: Space) -> str:
    """Return the name of Gymnasium's class of a space; empty for a space of another library."""
    known = ("Discrete", "MultiDiscrete", "MultiBinary", "Box", "Dict", "Tuple", "Text")
    return next((c.__name__ for c in type(space).__mro__ if c.__name__ in known), "")


def describe(space: Space) -> str:
    """Describe a space in one line."""
    return one_line(repr(space), 160)


def check_space(space: Space, name: str, delayed: bool) -> None:
    """Refuse an action space whose actions cannot be checked, before anything is simulated.

    **Arguments:**
    - `delayed`: whether actions arrive late, so that a default action is needed.
    """
    if space is None:
        raise ValueError(f"{name} has no action_space, by which the policy's actions are checked")
    for path, part in _parts(space, "action_space"):
        kind = kind_of(part)
        if not kind and not callable(getattr(part, "contains", None)):
            raise ValueError(
                f"{path} of {name} must be a space of Gymnasium, or have a method contains; "
                f"got {part!r}"
            )
        if kind == "Box" and np.any(np.isnan(part.low) | np.isnan(part.high)):
            raise ValueError(f"{path} of {name} has a NaN among its bounds: {describe(part)}")
        if kind == "Box" and np.any(part.low > part.high):
            raise ValueError(
                f"{path} of {name} has a lower bound above the upper one, so that no action is "
                f"valid: {describe(part)}"
            )
        if delayed and not kind:
            raise ValueError(
                f"{path} of {name} has no neutral action, which action_delay needs: "
                f"{describe(part)}"
            )


def _parts(space: Space, path: str) -> Iterator[tuple[str, Space]]:
    kind = kind_of(space)
    if kind == "Dict":
        for name, part in space.spaces.items():
            yield from _parts(part, f"{path}[{name!r}]")
    elif kind == "Tuple":
        for i, part in enumerate(space.spaces):
            yield from _parts(part, f"{path}[{i}]")
    else:
        yield path, space


def no_action(space: Space) -> Any:
    """Return the default action before the first action has arrived: zero, or close to zero.

    It is the first choice of a discrete space, and the shortest text.
    """
    kind = kind_of(space)
    if kind == "Dict":
        return {name: no_action(part) for name, part in space.spaces.items()}
    if kind == "Tuple":
        return tuple(no_action(part) for part in space.spaces)
    if kind == "Text":
        return min(space.character_set, default="") * space.min_length
    if kind == "Discrete":
        return int(getattr(space, "start", 0))
    if kind == "MultiDiscrete":
        return np.array(np.broadcast_to(getattr(space, "start", 0), space.shape), space.dtype)
    zeros = np.zeros(space.shape, space.dtype)
    return np.asarray(np.clip(zeros, space.low, space.high)) if kind == "Box" else zeros


def fit(space: Space, action: object, clip: bool = True) -> Fitted:
    """Return an action in the environment's form.

    **Arguments:**
    - `clip`: whether values outside the bounds of a Box are clipped, as training libraries do, or
      passed on. In both cases `outside` reports them.
    **Raises:** `Misfit` for a value that is not an action of the space.
    """
    kind = kind_of(space)
    if kind == "Dict":
        parts = {k: fit(space.spaces[k], v, clip) for k, v in _entries(space, action).items()}
        whole = {name: part.action for name, part in parts.items()}
        return Fitted(whole, any(part.outside for part in parts.values()))
    if kind == "Tuple":
        several = [
            fit(part, value, clip)
            for part, value in zip(space.spaces, _sequence(space, action), strict=True)
        ]
        return Fitted(tuple(part.action for part in several), any(part.outside for part in several))
    if kind == "Box":
        return _fit_box(space, _numbers(space, action), clip)
    return Fitted(_discrete(space, kind, action), False)


def check_observation(space: Space, observation: object) -> None:
    """Refuse an observation outside its space; it may exceed the bounds of a Box.

    **Raises:** `Misfit`.
    """
    kind = kind_of(space)
    if kind == "Dict":
        for name, value in _entries(space, observation).items():
            check_observation(space.spaces[name], value)
    elif kind == "Tuple":
        for part, value in zip(space.spaces, _sequence(space, observation), strict=True):
            check_observation(part, value)
    elif kind == "Box":
        array = np.asarray(observation)
        if array.shape != space.shape or array.dtype.kind not in "biuf":
            raise _misfit(space, observation)
    elif kind:
        _discrete(space, kind, observation)


def _discrete(space: Space, kind: str, value: object) -> Any:
    """Return an element of a space without Boxes."""
    if kind == "Text" or not kind:
        if not space.contains(value):
            raise _misfit(space, value)
        return value
    # The argmax of a batch of one stands for the choice.
    value = np.reshape(value, ()) if kind == "Discrete" and np.shape(value) == (1,) else value  # pyright: ignore
    numbers = _numbers(space, value)
    low = np.asarray(getattr(space, "start", 0))
    choices = {"Discrete": "n", "MultiDiscrete": "nvec"}
    above = low + (np.asarray(getattr(space, choices[kind])) if kind in choices else 2)
    with np.errstate(invalid="ignore"):
        whole = (numbers >= low) & (numbers < above) & (numbers == np.floor(numbers))
    if not np.all(whole):
        raise _misfit(space, value)
    return int(numbers) if kind == "Discrete" else numbers.astype(space.dtype)


def _fit_box(space: Space, numbers: np.ndarray, clip: bool) -> Fitted:
    if np.any(np.isnan(numbers)):
        raise _misfit(space, numbers)
    dtype = np.dtype(space.dtype)
    if dtype.kind == "f":
        # In the precision of the space: 0.1 as a double lies above 0.1 in single precision.
        with np.errstate(over="ignore"):
            numbers = numbers.astype(dtype)
    elif np.any(numbers != np.floor(numbers)):
        raise _misfit(space, numbers)
    outside = bool(np.any((numbers < space.low) | (numbers > space.high)))
    if outside and clip:
        numbers = np.asarray(np.clip(numbers, space.low, space.high))
    elif outside and dtype.kind != "f":
        limits = np.iinfo(dtype) if dtype.kind in "iu" else None
        if limits is None or np.any((numbers < limits.min) | (numbers > limits.max)):
            raise _misfit(space, numbers)
    return Fitted(numbers.astype(dtype), outside)


def _numbers(space: Space, value: object) -> np.ndarray:
    """Return a value as real numbers in the shape of the space."""
    masked = isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any()
    try:
        array = np.asarray(value)
    except ValueError:  # Rows of different lengths.
        raise _misfit(space, value) from None
    if masked or array.dtype.kind not in "biuf":
        raise _misfit(space, value)
    # One number stands for a vector of one.
    if array.shape != space.shape and not (space.shape == (1,) and array.shape == ()):
        raise _misfit(space, value, shape=array.shape)
    return array.reshape(space.shape)


def _entries(space: Space, value: object) -> dict[str, Any]:
    if not isinstance(value, Mapping) or set(value) != set(space.spaces):
        raise _misfit(space, value)
    return {name: value[name] for name in space.spaces}


def _sequence(space: Space, value: object) -> list[Any]:
    plain = isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.ndim > 0)
    if not plain or len(value) != len(space.spaces):  # pyright: ignore[reportArgumentType]
        raise _misfit(space, value)
    return list(value)  # pyright: ignore[reportArgumentType]


def _misfit(space: Space, value: object, shape: tuple[int, ...] | None = None) -> Misfit:
    got, known = f"got {one_line(repr(value), 80)}", describe(space)
    if shape is None:
        return Misfit(f"{got}, which {known} does not have")
    return Misfit(f"{got} of shape {list(shape)}, where {known} needs {list(space.shape)}")


def named_numbers(name: str, value: object) -> dict[str, np.ndarray]:
    """Return the numbers in a value as signals by name, arrays as vectors; texts are left out.

    Parts of a Dict and of a Tuple get names such as `action.grip` and `action.0`.
    """
    if isinstance(value, Mapping):
        parts = value.items()
    elif isinstance(value, tuple):
        parts = enumerate(value)
    else:
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            return {}
        array = array.reshape(-1) if array.ndim > 1 else array
        return {name: array.reshape(()) if array.shape == (1,) else array}
    named: dict[str, np.ndarray] = {}
    for key, part in parts:
        named |= named_numbers(f"{name}.{key}" if name else str(key), part)
    return named


# What environments compute once from their attributes, and would not follow a feature.
DERIVED: dict[str, dict[str, Callable[[Any], Any]]] = {
    "CartPoleEnv": {
        "total_mass": lambda env: env.masspole + env.masscart,
        "polemass_length": lambda env: env.masspole * env.length,
    }
}
