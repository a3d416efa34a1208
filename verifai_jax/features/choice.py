"""Values without an order: one of several choices (`Categorical`), or a `Constant`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeGuard

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree, Shaped

from verifai_jax.core.messages.checks import check_name
from verifai_jax.core.messages.text import format_percent
from verifai_jax.features.domain import (
    MAX_LEVELS,
    MAX_REAL,
    Domain,
    Numbers,
    Row,
    Tuning,
    as_number,
    as_numbers,
    as_real,
    as_scalar,
    as_tuple,
    cell,
    centre,
    format_choices,
    on_device,
    short,
    without_objects,
)
from verifai_jax.features.english import number
from verifai_jax.features.facts import Facts

MAX_CHOICES = 12
"""Maximum number of choices that an English sentence lists one by one."""


@dataclass(frozen=True, init=False, repr=False)
class Categorical(Domain):
    """One of several choices without an order: `Categorical("ppo", "sac", weights=[0.9, 0.1])`.

    If all choices are numbers the value is the number; otherwise JAX cannot hold it and the value
    is its index in `choices`, an `int32`. The table always shows the choice itself. A user writes
    the choice. An integer that is not a choice is taken as an index, unless some choice could be
    read as a number.

    **Arguments:**
    - `choices`: numbers, texts or other objects, one by one.
    - `weights`: their probabilities; equally likely when left out.
    **Raises:** `ValueError` for no choices, the same choice twice, or weights that are not one
    positive number for each choice with sum one.
    """

    choices: tuple[object, ...]
    probabilities: tuple[float, ...] | None = None

    def __init__(self, *choices: object, weights: Sequence[float] | None = None) -> None:
        object.__setattr__(self, "choices", tuple(as_scalar(choice) for choice in choices))
        if not self.choices:
            raise ValueError("a Categorical needs at least one choice; got none")
        if len(choices) == 1 and isinstance(self.choices[0], list | tuple | set | dict):
            raise ValueError(
                f"choices are given one by one, Categorical('a', 'b'); got {choices[0]!r}"
            )
        if len(self.choices) > MAX_LEVELS:
            raise ValueError(f"a Categorical has at most {MAX_LEVELS} choices")
        known: set[object] = set()
        for choice in self.choices:
            if str(choice):
                check_name("a choice", str(choice), lines=True)  # As the table shows it.
            keys: set[object] = {str(choice)}  # All that the table shows of most objects.
            if isinstance(choice, int | float):
                limit = 2**31 - 1 if isinstance(choice, int) else MAX_REAL
                if not abs(choice) <= limit:
                    raise ValueError(
                        "choices that are numbers must be finite, integers must fit into 32 bits; "
                        f"got {choice!r}"
                    )
                keys.add(float(np.float32(choice)))  # All that a system sees of a number.
            if keys & known:
                raise ValueError(
                    f"the choice {choice!r} is given twice in {format_choices(self.choices)}"
                )
            known |= keys
        if weights is not None:
            object.__setattr__(self, "probabilities", self._probabilities(weights))

    def _probabilities(self, weights: Sequence[float]) -> tuple[float, ...]:
        """Check the weights and return them as probabilities."""
        numbers = tuple(as_number(weight, "a weight of a Categorical") for weight in weights)
        if len(numbers) != len(self.choices):
            raise ValueError(
                f"a Categorical with {len(self.choices)} choices needs as many weights; got "
                f"{len(numbers)}"
            )
        if not all(weight > 0 for weight in numbers):
            raise ValueError(
                "weights must be positive (leave out a choice that never comes); "
                f"got {short(numbers)}"
            )
        if min(numbers) < 1 / MAX_LEVELS:
            raise ValueError(
                f"a weight must be at least {1 / MAX_LEVELS:z.1g}, the smallest that a float32 "
                f"coordinate can represent; got {short(numbers)}"
            )
        if abs(math.fsum(numbers) - 1) > 1e-6:
            raise ValueError(
                f"weights must sum to one; {short(numbers)} sum to {math.fsum(numbers):z.7g}"
            )
        return numbers

    @cached_property
    def numeric(self) -> bool:
        return self._dtype.kind != "O"

    @cached_property
    def _dtype(self) -> np.dtype:
        kinds = {type(choice) for choice in self.choices}
        if kinds == {bool}:
            return np.dtype(bool)
        if kinds <= {int, float}:
            return np.dtype(np.int32 if kinds == {int} else np.float64)
        return np.dtype(object)

    @cached_property
    def _shown(self) -> np.ndarray:
        """The choices as the table shows them."""
        if self.numeric:
            return np.array(self.choices, self._dtype)
        return np.array([str(choice) for choice in self.choices], dtype=object)

    @property
    def levels(self) -> tuple[int, ...]:
        return (len(self.choices),)

    @property
    def weights(self) -> tuple[tuple[float, ...] | None, ...]:
        return (self.probabilities,)

    @property
    def ordered(self) -> tuple[bool, ...]:
        return (False,)

    @cached_property
    def _edges(self) -> np.ndarray:
        """Ends of the cells, where these are unequal."""
        assert self.probabilities is not None
        return np.concatenate([[0], np.cumsum(self.probabilities)]).astype(np.float32)

    def from_unit(self, u: Float[Array, "1"]) -> Shaped[Array, ""]:
        if self.probabilities is None:
            index = cell(u[0], len(self.choices))
        else:
            index = jnp.searchsorted(self._edges[1:-1], u[0], side="right").astype(jnp.int32)
        if not self.numeric:
            return index
        dtype = u.dtype if self._dtype == np.float64 else self._dtype
        return jnp.asarray(self._shown, dtype)[index]

    @property
    def monotone(self) -> bool:
        return True

    def to_unit(self, value: Numbers) -> Float[Array, "1"]:
        index = jnp.asarray(value)
        if self.numeric:
            index = jnp.argmin(jnp.abs(as_real(index) - self._shown.astype(np.float32)))
        if self.probabilities is None:
            return centre(index, len(self.choices))
        middles = (self._edges[1:] + self._edges[:-1]) / 2
        return jnp.reshape(jnp.asarray(middles)[index], (1,)).astype(jnp.result_type(float))

    def coerce(self, value: PyTree) -> Shaped[Array, "*shape"]:
        if self.numeric:
            if self._dtype == np.float64:
                return as_real(value)
            return jnp.asarray(without_objects(value), self._dtype)
        if _is_index(value):
            return on_device(value if isinstance(value, jax.Array) else np.asarray(value))
        values = np.asarray(value, dtype=object)
        indices = []
        for choice in values.ravel():
            if (index := self._index_of(choice)) is None:
                raise ValueError(f"{choice!r} is none of {format_choices(self.choices)}")
            indices.append(index)
        return on_device(np.array(indices, np.int32).reshape(values.shape))

    def check(self, value: object, name: str) -> None:
        known = f"one of {format_choices(self.choices)}"
        if np.ndim(np.asarray(value, dtype=object)) != 0:
            raise ValueError(f"{name} must be {known}; got {value!r}")
        index, value = _is_index(value), as_scalar(value)
        closest = ""
        if self.numeric:
            if isinstance(value, bool | int | float):
                if self._nearest(float(value)) is not None:
                    return
                gaps = np.abs(self._shown.astype(np.float64) - value)
                if np.isfinite(value):
                    closest = f"; the nearest value is {self.choices[int(np.argmin(gaps))]!r}"
        elif index:
            if isinstance(value, int) and 0 <= value < len(self.choices):
                return
        elif self._index_of(value) is not None:
            return
        raise ValueError(f"{name} must be {known}; got {value!r}{closest}")

    def columns(self, name: str) -> tuple[str, ...]:
        return (name,)

    def to_columns(
        self, values: Shaped[Array, " n"] | Shaped[np.ndarray, " n"], name: str
    ) -> dict[str, np.ndarray]:
        index = np.asarray(values)
        if self.numeric:
            # The nearest one: a system sees 0.1 as float32, the table shows 0.1.
            numbers = self._shown.astype(np.float64)
            order = np.argsort(numbers)
            middles = (numbers[order][1:] + numbers[order][:-1]) / 2
            index = order[np.searchsorted(middles, index.astype(np.float64))]
        return {name: self._shown[index]}

    def from_columns(self, row: Row, name: str) -> Shaped[Array, ""]:
        shown = as_scalar(row[name])
        if not self.numeric:
            if (index := self._choice(shown)) is not None:
                return on_device(np.asarray(index, np.int32))
        else:
            index = self._nearest(shown) if isinstance(shown, bool | int | float) else None
            if index is not None:
                return self.coerce(self.choices[index])
        raise ValueError(f"{name} must be one of {format_choices(self.choices)}; got {shown!r}")

    def _index_of(self, value: object) -> int | None:
        """Return the index of a value as users write it: a choice, or the text in the table.

        An integer is an index, as systems see it, only where no choice can be read as a number.
        """
        value = as_scalar(value)
        index = self._choice(value)
        if index is None and type(value) is int and not self._has_numbers:
            return value if 0 <= value < len(self.choices) else None
        return index

    def _choice(self, value: object) -> int | None:
        """Return the index of a choice, or of the text that the table shows of it."""
        if type(value) is float and value.is_integer() and str(value) not in self._shown:
            value = int(value)  # So pandas reads integers of a column with empty entries.
        found = np.flatnonzero(self._shown == str(value))
        if len(found):
            return int(found[0])
        same = (i for i, each in enumerate(self.choices) if type(each) is type(value))
        return next((i for i in same if bool(self.choices[i] == value)), None)

    @cached_property
    def _has_numbers(self) -> bool:
        """True where a choice is a number, or a text that reads as one."""
        return any(_reads_as_number(choice) for choice in self.choices)

    def _nearest(self, value: float) -> int | None:
        """Return the index of the choice that is this number in float32."""
        numbers = self._shown.astype(np.float64)
        index = int(np.argmin(np.abs(numbers - value)))
        return index if np.float32(numbers[index]) == np.float32(value) else None

    def words(self) -> str:
        chances = self.probabilities
        choices = [number(choice) for choice in self.choices]
        if chances is not None:
            choices = [
                f"{choice} ({format_percent(float(chance))})"
                for choice, chance in zip(choices, chances, strict=True)
            ]
        listed = ", ".join(choices[:MAX_CHOICES])
        more = f", and {len(choices) - MAX_CHOICES} more" if len(choices) > MAX_CHOICES else ""
        return f"one of {listed}{more}" + ("" if chances is not None else ", all equally probable")

    @property
    def uniform(self) -> bool:
        return self.probabilities is None

    @property
    def tuning(self) -> Tuning:
        return Tuning("choice", choices=self.choices)

    def facts(self, name: str) -> Facts:
        count, weights = len(self.choices), self.probabilities
        prior = tuple(float(weight) for weight in weights) if weights else (1 / count,) * count
        # As the table shows them, in the order of the space.
        choices = self.choices if self.numeric else tuple(map(str, self.choices))
        return {name: {"ordered": False, "choices": choices, "prior": prior}}

    def __repr__(self) -> str:
        weights = ""
        if self.probabilities is not None:
            weights = f", weights={short(self.probabilities)}"
        return f"Categorical({format_choices(self.choices)}{weights})"


def _is_index(value: object) -> TypeGuard[Any]:
    """Return whether a value is an index as `from_unit` gives it, and no number of a person."""
    return isinstance(value, jax.Array) or getattr(value, "dtype", None) == np.int32


def _reads_as_number(choice: object) -> bool:
    try:
        float(choice)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        return False
    return True


@dataclass(frozen=True, repr=False)
class Constant(Domain):
    """One value that never varies: a number, a bool, an array of numbers, or a text.

    It takes no unit coordinate and no column of the table. A system sees a text as the index 0, as
    in a `Categorical` with one choice.

    **Arguments:**
    - `value`: the value, such as `9.8`, `[0, 1]`, `"dry"`.
    **Raises:** `ValueError` for a number that is not finite, or a value of another type.
    """

    arguments = ("value",)
    value: float | bool | str | PyTree

    def __post_init__(self) -> None:
        value = self.value
        if isinstance(value, str):
            return
        try:
            numbers = np.asarray(value)
            plain = numbers.dtype.kind in "biuf" and bool(np.all(np.isfinite(numbers)))
        except (TypeError, ValueError):
            plain = False
        if not plain:
            raise ValueError(
                f"a Constant is a finite number, an array of them, or a text; got {value!r}"
            )
        object.__setattr__(self, "value", as_tuple(numbers.tolist()))

    @property
    def levels(self) -> tuple[int, ...]:
        return ()

    def from_unit(self, u: Float[Array, "0"]) -> Shaped[Array, "*shape"]:
        return self._value(u.dtype)

    @property
    def monotone(self) -> bool:
        return True

    def to_unit(self, value: PyTree) -> Float[Array, "0"]:
        return jnp.zeros(0, jnp.result_type(float))

    def coerce(self, value: PyTree) -> Shaped[Array, "*shape"]:
        if isinstance(self.value, str):
            return jnp.zeros(np.shape(value), jnp.int32)
        return jnp.broadcast_to(self._value(jnp.result_type(float)), np.shape(value))

    def check(self, value: object, name: str) -> None:
        shown = self.value
        if isinstance(shown, str):
            same = (
                value == shown if isinstance(value, str) else np.array_equal(np.asarray(value), 0)
            )
        else:
            given = as_numbers(value, name)
            same = given.shape == np.shape(shown) and np.array_equal(
                given.astype(np.float32), np.asarray(shown, np.float32)
            )
        if not same:
            raise ValueError(f"{name} is a constant, {shown!r}; got {value!r}")

    def columns(self, name: str) -> tuple[str, ...]:
        return ()

    def to_columns(self, values: PyTree, name: str) -> dict[str, np.ndarray]:
        return {}

    def from_columns(self, row: Row, name: str) -> Shaped[Array, "*shape"]:
        return self._value(jnp.result_type(float))

    def _value(self, real: np.dtype) -> Shaped[Array, "*shape"]:
        if isinstance(self.value, str):
            return jnp.asarray(0, jnp.int32)
        kind = np.asarray(self.value).dtype.kind
        return jnp.asarray(self.value, {"b": bool, "i": jnp.int32}.get(kind, real))

    def words(self) -> str:
        return f"always {number(self.value)}"

    @property
    def uniform(self) -> bool:
        return True

    @property
    def held_at(self) -> PyTree:
        return self.value
