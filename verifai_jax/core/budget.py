"""How many simulations and seconds are left: one count for all parts of a synthesis."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Limits:
    """What may still be spent.

    **Arguments:**

    - `spent()`: simulations so far.
    - `most`: of them in all.
    - `until`: a time of `time.perf_counter`, or None.
    """

    spent: Callable[[], int]
    most: int
    until: float | None = None

    @property
    def left(self) -> int:
        """Simulations left, none after the time."""
        return 0 if self.late else max(0, self.most - self.spent())

    @property
    def over(self) -> bool:
        """Whether nothing is left."""
        return self.left == 0

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return self.until is not None and time.perf_counter() >= self.until

    @property
    def ended(self) -> str:
        """What ends a work that nothing else has ended."""
        return "max_seconds" if self.late else "budget"

    def slice(self, simulations: int) -> "Limits":
        """The same for a part that may spend so many simulations from now on."""
        return replace(self, most=min(self.most, self.spent() + simulations))


SEARCHING = 0.8
"""Share of `max_seconds` after which the search ends, so that time is left for the check."""


def timed(
    spent: Callable[[], int], budget: int, started: float, max_seconds: float | None
) -> tuple[Limits, Limits]:
    """The limits of a search, and of the check after it, whose simulations are not limited."""
    if max_seconds is None:
        return Limits(spent, budget), Limits(lambda: 0, 1)
    return (
        Limits(spent, budget, started + SEARCHING * max_seconds),
        Limits(lambda: 0, 1, started + max_seconds),
    )
