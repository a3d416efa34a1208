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
        if self.until is not None and time.perf_counter() >= self.until:
            return 0
        return max(0, self.most - self.spent())

    @property
    def over(self) -> bool:
        """Whether nothing is left."""
        return self.left == 0

    def slice(self, simulations: int) -> "Limits":
        """The same for a part that may spend so many simulations from now on."""
        return replace(self, most=min(self.most, self.spent() + simulations))
