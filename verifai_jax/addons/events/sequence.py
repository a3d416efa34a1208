"""A sequence of timed events: the value of an `Automaton` feature in a system.

    events = features["traffic"]
    events.times, events.kinds, events["gap"]           # [slots] each, with `events.mask`
    events.within("cut_in", time, 2.0)                  # during two seconds after such an event
    events.latest("gap", time, otherwise=100.0)         # the parameter of the latest event

All functions work on arrays of JAX, traced or not, and on those of NumPy that a system on the host
gets; a time may be one number or an array of them.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, Real

from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.messages.text import format_seconds

ABSENT = -1
"""The kind of a slot after the last event."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Events:
    """Events in order of time; slots after the last event are empty.

    - `kinds`: `[slots]`, the index of each event's name in `names`; -1 in an empty slot.
    - `waits`: `[slots]`, seconds since the previous event, or the start; 0 in an empty slot.
    - `parameters`: `[slots, ...]` by name; the middle of a domain for events without the parameter.
    - `names`: the names of the kinds of events.
    """

    # JAX rebuilds the class with placeholders and with batches, which have other shapes.
    __no_type_check__ = True
    kinds: Int[Array | np.ndarray, " slots"]
    waits: Float[Array | np.ndarray, " slots"]
    parameters: dict[str, Any]
    names: tuple[str, ...] = field(metadata={"static": True})

    @property
    def mask(self) -> Bool[Array | np.ndarray, " slots"]:
        """True at the slots that hold an event."""
        return self.kinds >= 0

    @property
    def length(self) -> Int[Array | np.ndarray, ""]:
        """Number of events."""
        return self.mask.sum(axis=-1)

    @property
    def times(self) -> Float[Array | np.ndarray, " slots"]:
        """Seconds from the start to each event; infinite in an empty slot."""
        xp = _library(self.waits)
        return xp.where(self.mask, xp.cumsum(self.waits, axis=-1), np.inf)

    def __getitem__(self, name: str) -> Any:
        """Return a parameter `[slots, ...]`, `"times"`, `"kinds"` or `"waits"`."""
        if name in ("times", "kinds", "waits"):
            return getattr(self, name)
        if name not in self.parameters:
            raise unknown_name("parameter of events", name, self.parameters)
        return self.parameters[name]

    def are(self, *names: str) -> Bool[Array | np.ndarray, " slots"]:
        """Return flags of the slots with an event of these names; without names, of any event."""
        if not names:
            return self.mask
        chosen = [self._kind_of(name) for name in names]
        found = self.kinds == chosen[0]
        for index in chosen[1:]:
            found = found | (self.kinds == index)
        return found

    def count(self, time: Real[Array | np.ndarray, "*times"] | float, *names: str) -> Any:
        """Return the number of events with these names up to and including `time`."""
        return self._past(time, names).sum(axis=-1)

    def active(self, time: Real[Array | np.ndarray, "*times"] | float, *names: str) -> Any:
        """Return the index of the latest event with these names at `time`; -1 before the first."""
        past = self._past(time, names)
        indices = past.shape[-1]
        xp = _library(past)
        return xp.max(xp.where(past, np.arange(indices), -1), axis=-1)

    def since(self, time: Real[Array | np.ndarray, "*times"] | float, *names: str) -> Any:
        """Return the seconds since the latest event with these names; infinite before the first."""
        index = self.active(time, *names)
        xp = _library(self.waits)
        elapsed = time - self.times[xp.maximum(index, 0)]
        return xp.where(index >= 0, elapsed, np.inf)

    def within(
        self, name: str, time: Real[Array | np.ndarray, "*times"] | float, seconds: Any
    ) -> Any:
        """Return whether an event with this name has happened in the last `seconds`.

        **Arguments:**
        - `seconds`: the duration of an event: a number, or the name of a parameter that gives it.
        """
        ends = self[seconds] if isinstance(seconds, str) else seconds
        xp = _library(self.waits)
        now = xp.asarray(time)[..., None]
        return xp.any(self._past(time, (name,)) & (now < self.times + ends), axis=-1)

    def latest(
        self, parameter: str, time: Real[Array | np.ndarray, "*times"] | float, *names: str,
        otherwise: Any = 0.0,
    ) -> Any:  # fmt: skip
        """Return a parameter of the latest event with these names; `otherwise` before the first."""
        values, index = self[parameter], self.active(time, *names)
        xp = _library(self.waits)
        chosen = xp.asarray(values)[xp.maximum(index, 0)]
        there = xp.reshape(index >= 0, np.shape(index) + (1,) * (np.ndim(chosen) - np.ndim(index)))
        return xp.where(there, chosen, otherwise)

    def listed(self) -> list[dict[str, Any]]:
        """Return the events as dictionaries: `{"time": 1.5, "kind": "cut_in", "gap": 7.0}`.

        All parameters are listed, including those that an event of this kind does not use.
        """
        count, times = int(self.length), np.asarray(self.times)
        return [
            {"time": float(times[i]), "kind": self.names[int(np.asarray(self.kinds)[i])]}
            | {name: np.asarray(values)[i].tolist() for name, values in self.parameters.items()}
            for i in range(count)
        ]

    def _kind_of(self, name: str) -> int:
        if name not in self.names:
            raise unknown_name("event", name, self.names)
        return self.names.index(name)

    def _past(self, time: Any, names: tuple[str, ...]) -> Any:
        xp = _library(self.waits)
        return self.are(*names) & (self.times <= xp.asarray(time)[..., None])

    def __repr__(self) -> str:
        known = isinstance(self.kinds, np.ndarray | jax.Array) and not isinstance(
            self.kinds, Tracer
        )
        if not known or np.ndim(self.kinds) != 1:
            return f"Events of {', '.join(self.names)}"
        shown = ", ".join(
            f"{event['kind']} at {format_seconds(event['time'], 4)}" for event in self.listed()
        )
        return f"Events({shown or 'none'})"


def _library(array: Any) -> Any:
    return np if isinstance(array, np.ndarray) else jnp
