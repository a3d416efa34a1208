"""Few programs: a cache of what is compiled for one object, and few shapes of what it is given.

    ENGINES: Slot[EngineMode, Engine] = Slot("engines")
    engine = problem.programs.get(ENGINES, mode, lambda: Engine(problem, *mode))

Whoever compiles declares a slot, which fixes the types of its keys and of its values. What is
compiled is kept and freed with the object. Each shape compiles a program of its own, so numbers of
rows become powers of two.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

import numpy as np

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


@dataclass(frozen=True)
class Slot(Generic[K, V]):
    """A kind of cached value, by name; `K` is the type of its keys and `V` that of its values."""

    name: str


class ProgramCache:
    """Values by slot and key; see the module's docstring."""

    def __init__(self) -> None:
        self._slots: dict[str, dict[Hashable, object]] = {}

    def get(self, slot: Slot[K, V], key: K, make: Callable[[], V]) -> V:
        """Return the value of this key, which `make` makes the first time.

        What `make` raises is raised, and nothing is kept.
        """
        values = self._slots.setdefault(slot.name, {})
        if key not in values:
            values[key] = make()
        return cast(V, values[key])

    def peek(self, slot: Slot[K, V], key: K) -> V | None:
        """Return the value of this key, or None before it is made."""
        return cast("V | None", self._slots.get(slot.name, {}).get(key))

    def clear(self) -> None:
        """Forget everything, so that its memory can be freed."""
        self._slots.clear()


def power_of_two(count: int) -> int:
    """Return the least power of two that is at least `count`, and at least 1."""
    return 1 << max(count - 1, 0).bit_length()


def pad_rows(rows: Any, count: int | None = None) -> np.ndarray:
    """Return rows followed by copies of the last one.

    **Arguments:**
    - `rows`: an array `[n, ...]`; an empty one stays as it is.
    - `count`: rows of the result, at least `n`; the next power of two when left out.
    """
    rows = np.asarray(rows)
    missing = (power_of_two(len(rows)) if count is None else count) - len(rows)
    if not missing:
        return rows
    return np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)])
