"""A budget of simulations and seconds, shared by all parts of a synthesis."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Budget:
    """A budget of simulations, optionally with a time limit.

    **Arguments:**
    - `spent()`: returns the number of simulations so far.
    - `maximum`: maximum number of simulations.
    - `until`: the time limit on the clock `time.perf_counter` in seconds, or None.
    """

    spent: Callable[[], int]
    maximum: int
    until: float | None = None

    @property
    def left(self) -> int:
        """Number of simulations left; 0 after the time limit."""
        return 0 if self.timed_out else max(0, self.maximum - self.spent())

    @property
    def exhausted(self) -> bool:
        """True if nothing is left."""
        return self.left == 0

    @property
    def timed_out(self) -> bool:
        """True if the time is over."""
        return self.until is not None and time.perf_counter() >= self.until

    @property
    def stopped_by(self) -> str:
        """Reason why the work stopped: `"max_seconds"` or `"budget"`."""
        return "max_seconds" if self.timed_out else "budget"

    def slice(self, simulations: int) -> "Budget":
        """Return the budget of a part of the work that may make `simulations` more simulations."""
        return replace(self, maximum=min(self.maximum, self.spent() + simulations))


SEARCH_SHARE = 0.8
"""Share of `max_seconds` after which the search ends, so that time is left for the check."""


def split_budget(
    spent: Callable[[], int], budget: int, started: float, max_seconds: float | None
) -> tuple[Budget, Budget]:
    """Return the budgets of a search and of the check after it, which only has a time limit.

    **Arguments:**
    - `spent()`: returns the number of simulations so far.
    - `budget`: maximum number of simulations of the search.
    - `started`: the start on the clock `time.perf_counter` in seconds.
    - `max_seconds`: maximum number of seconds of search and check together, or None.
    """
    if max_seconds is None:
        return Budget(spent, budget), Budget(lambda: 0, 1)
    return (
        Budget(spent, budget, started + SEARCH_SHARE * max_seconds),
        Budget(lambda: 0, 1, started + max_seconds),
    )
