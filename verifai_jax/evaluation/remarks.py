"""Notes of simulations on themselves (`Trace.notes`), added up for the notes of a run."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from verifai_jax.core.messages.text import MAX_MESSAGE_LENGTH, storable


@dataclass
class Remarks:
    """A count of simulations; for each note, how many of them had it, and how often in all."""

    simulations: int = 0
    counts: dict[str, tuple[int, int]] = field(default_factory=dict)

    def add(self, notes: Mapping[str, int], simulations: int = 1) -> None:
        """Take in the notes of a simulation, or those that several have together."""
        self.simulations += simulations
        for note, times in notes.items():
            self._count(storable(note, MAX_MESSAGE_LENGTH), simulations, times)

    def join(self, other: Mapping[str, Any]) -> None:
        """Take in the remarks of a worker, as `to_data` gives them."""
        self.simulations += other["simulations"]
        for note, (simulations, times) in other["counts"].items():
            self._count(note, simulations, times)

    def to_data(self) -> dict[str, Any]:
        """Return plain values, which travel between processes."""
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
