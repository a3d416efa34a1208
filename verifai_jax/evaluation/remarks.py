"""Notes of simulations (`Trace.notes`), added up for the notes of a run."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from verifai_jax.core.messages.text import MAX_MESSAGE_LENGTH, storable


@dataclass
class Remarks:
    """Counts of simulations: how many had each note, and how often it occurred in all."""

    simulations: int = 0
    counts: dict[str, tuple[int, int]] = field(default_factory=dict)

    def add(self, notes: Mapping[str, int], simulations: int = 1) -> None:
        """Record the notes of a simulation, or the common notes of several."""
        self.simulations += simulations
        for note, times in notes.items():
            self._count(storable(note, MAX_MESSAGE_LENGTH), simulations, times)

    def join(self, other: Mapping[str, Any]) -> None:
        """Add the remarks of a worker, in the form of `to_data`."""
        self.simulations += other["simulations"]
        for note, (simulations, times) in other["counts"].items():
            self._count(note, simulations, times)

    def to_data(self) -> dict[str, Any]:
        """Return plain values, which can be sent between processes."""
        return {"simulations": self.simulations, "counts": dict(self.counts)}

    def _count(self, note: str, simulations: int, times: int) -> None:
        before = self.counts.get(note, (0, 0))
        self.counts[note] = (before[0] + simulations, before[1] + int(times))

    @property
    def texts(self) -> tuple[str, ...]:
        """The notes as sentences, with their counts."""
        return tuple(
            f"in {some} of {self.simulations} simulations ({times} times in all): {note}"
            for note, (some, times) in self.counts.items()
        )
