"""Numbers that a compiled program reads from an argument instead of containing as constants.

    numbers = LiftedNumbers()
    numbers.read_from(vector, lambda: simulate(u))      # while a program of (u, vector) is traced
    numbers.vector("float32")                           # the argument to call the program with

A program with the bounds of a space as constants is compiled again after every edit of a bound.
Inside `lifting()`, which surrounds the map from the unit cube to features, a domain gets its
numbers from `lifted(self, ...)`; elsewhere they stay constants.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

CAPACITY = 256
"""Numbers of a program that are lifted; further ones stay constants."""
T = TypeVar("T")


class LiftedNumbers:
    """The lifted numbers of a program, and their indices in its argument vector."""

    def __init__(self) -> None:
        self._indices: dict[tuple[int, str], int] = {}
        self._owners: list[object] = []  # Kept, so that their identities stay theirs.
        self._values: list[float] = []

    def read_from(self, vector: Float[Array, " numbers"], function: Callable[[], T]) -> T:
        """Call a function in which lifted numbers are read from the vector."""
        token = _current.set((self, vector))
        try:
            return function()
        finally:
            _current.reset(token)

    def vector(self, precision: str) -> Float[np.ndarray, " numbers"]:
        """Return the argument vector: the numbers in this precision, padded with zeros."""
        vector = np.zeros(CAPACITY, precision)
        vector[: len(self._values)] = self._values
        return vector

    def index_of(self, name: str, owner: object, values: np.ndarray) -> int | None:
        """Return the index of these numbers in the vector; None if there is no room for them."""
        key = (id(owner), name)
        if key not in self._indices:
            if len(self._values) + values.size > CAPACITY:
                return None
            self._indices[key] = len(self._values)
            self._owners.append(owner)
            self._values.extend(np.ravel(values).tolist())
        return self._indices[key]


_current: ContextVar[tuple[LiftedNumbers, Any] | None] = ContextVar("lifted numbers", default=None)
_wanted: ContextVar[bool] = ContextVar("numbers are to be lifted", default=False)


@contextmanager
def lifting() -> Iterator[None]:
    """Return a context in which numbers are lifted, if the program being traced supports it.

    No function that JAX traces once and caches may be called inside: it would store the argument.
    """
    token = _wanted.set(True)
    try:
        yield
    finally:
        _wanted.reset(token)


def is_lifting() -> bool:
    """Return whether numbers are being lifted."""
    return _wanted.get() and _current.get() is not None


def lifted(owner: object, **values: np.ndarray) -> tuple[Any, ...]:
    """Return these numbers as arguments of the traced program, or unchanged outside of `lifting`.

    **Arguments:**
    - `owner`: the object that owns the numbers; with their names it identifies them.
    - `values`: arrays in the precision of the program.
    """
    current = _current.get()
    if current is None or not _wanted.get():
        return tuple(values.values())
    numbers, vector = current
    found = []
    for name, value in values.items():
        same = value.dtype == vector.dtype
        index = numbers.index_of(name, owner, value) if same else None
        if index is None:
            found.append(value)
        else:
            found.append(jnp.reshape(vector[index : index + value.size], value.shape))
    return tuple(found)
