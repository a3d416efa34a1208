"""A budget of simulations and seconds: one count for all parts of a synthesis."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Budget:
    """A budget of simulations, and perhaps of time.

    **Arguments:**
    - `spent()`: simulations so far.
    - `maximum`: simulations at most.
    - `until`: a time of `time.perf_counter` in seconds, or None.
    """

    spent: Callable[[], int]
    maximum: int
    until: float | None = None

    @property
    def left(self) -> int:
        """Simulations left, none after the time."""
        return 0 if self.timed_out else max(0, self.maximum - self.spent())

    @property
    def exhausted(self) -> bool:
        """True where nothing is left."""
        return self.left == 0

    @property
    def timed_out(self) -> bool:
        """True where the time is up."""
        return self.until is not None and time.perf_counter() >= self.until

    @property
    def stopped_by(self) -> str:
        """Reason for which the work stopped: `"max_seconds"` or `"budget"`."""
        return "max_seconds" if self.timed_out else "budget"

    def slice(self, simulations: int) -> "Budget":
        """Return the budget of a part of the work that may make `simulations` from now on."""
        return replace(self, maximum=min(self.maximum, self.spent() + simulations))


SEARCH_SHARE = 0.8
"""Share of `max_seconds` after which the search ends, so that time is left for the check."""


def split_budget(
    spent: Callable[[], int], budget: int, started: float, max_seconds: float | None
) -> tuple[Budget, Budget]:
    """Return the budget of a search and that of the check after it, which has no simulation limit.

    **Arguments:**
    - `spent()`: simulations so far.
    - `budget`: simulations of the search at most.
    - `started`: a time of `time.perf_counter` in seconds.
    - `max_seconds`: the maximum number of seconds of search and check together, or None.
    """
    if max_seconds is None:
        return Budget(spent, budget), Budget(lambda: 0, 1)
    return (
        Budget(spent, budget, started + SEARCH_SHARE * max_seconds),
        Budget(lambda: 0, 1, started + max_seconds),
    )
