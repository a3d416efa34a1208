"""The result of a sequence of scenarios: its probability, its parts, its counterexamples."""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.text import format_percent

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class PartEstimate:
    """One part of a sequence, given that the parts before it have not failed.

    - `name`: the name of its problem.
    - `probability`: share that fails; NaN if no simulation has a verdict.
    - `low`, `high`: ends of its interval.
    - `samples`: number of simulations, or of rows of a run, on which it rests.
    - `without`: number of these without a verdict, or with a start outside the part's space.
    - `effective`: effective number of independent samples; smaller than `samples` only if rows of a
      run are weighted.
    """

    name: str
    probability: float
    low: float
    high: float
    samples: int
    without: int
    effective: float

    def __str__(self) -> str:
        weighed = self.effective < 0.999 * self.samples
        worth = f", worth {self.effective:z,.0f}" if weighed else ""
        lost = f", {self.without:,} of them without a verdict" if self.without else ""
        return (
            f"{self.name:<16} {format_percent(self.probability)} ({format_percent(self.low)} to "
            f"{format_percent(self.high)}) of {self.samples:,}{worth}{lost}"
        )


@dataclass(frozen=True, eq=False)
class SequenceEstimate(InNotebook):
    """The failure probability of a sequence of scenarios, as `sequence` returns it.

    - `parts`: an estimate of each part that was reached.
    - `low`, `high`: ends of the interval of the whole.
    - `confidence`: the probability that all intervals hold together.
    - `counterexamples`: a row for each failure: the `part` that fails, and the features of that
      part and of all earlier ones as columns `PART.FEATURE`.
    - `simulations`: number of simulations made.
    - `seed`: the seed of the samples; part i has the random keys of seed + i.
    - `notes`: the assumptions of the intervals.
    """

    parts: tuple[PartEstimate, ...]
    low: float
    high: float
    confidence: float
    counterexamples: "pd.DataFrame" = field(repr=False)
    simulations: int
    seed: int
    notes: tuple[str, ...] = ()

    @property
    def probability(self) -> float:
        """Probability that any part fails."""
        return 1 - math.prod(1 - part.probability for part in self.parts)

    def __str__(self) -> str:
        whole = " then ".join(part.name for part in self.parts)
        lines = [
            f"{whole} fails with probability {format_percent(self.probability)} "
            f"({format_percent(self.confidence)} interval {format_percent(self.low)} to "
            f"{format_percent(self.high)})"
        ]
        lines += [f"  {part}" for part in self.parts]
        lines.append(
            f"  {len(self.counterexamples):,} counterexamples; {self.simulations:,} simulations, "
            f"seed {self.seed}"
        )
        return "\n".join(lines + [f"  note: {note}" for note in self.notes])

    __repr__ = __str__
