"""A typed cache of what is compiled for one object, kept and freed with that object.

    ENGINES: Slot[EngineMode, Engine] = Slot("engines")
    engine = problem.programs.get(ENGINES, mode, lambda: Engine(problem, *mode))

Whoever compiles declares a slot, which fixes the types of its keys and of its values.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar, cast

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
        """Return the value of this key, or None if there is none yet."""
        return cast("V | None", self._slots.get(slot.name, {}).get(key))

    def clear(self) -> None:
        """Forget everything, so that its memory can be freed."""
        self._slots.clear()
