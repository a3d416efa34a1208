"""The clock of a sweep: seconds of each stage, the time limit, and a progress bar.

with Clock("mine", max_seconds=600, show=None) as clock, clock.stage(TRAINING, 10, "steps"):
    clock.check()                                   # raises OutOfTime
"""

import contextlib
import math
import time
from collections import defaultdict
from collections.abc import Iterator

from verifai_jax.core.display.progress import ProgressBar

TRAINING, COMPILING, CERTIFYING = "training", "compiling", "certifying"
"""Stages of a sweep, as its result names them."""


class OutOfTime(Exception):
    """An error for a stage that has exceeded its time."""


class Clock:
    """Times the stages of a sweep, as a context manager, and draws a bar (None: on a terminal).

    `seconds` are the seconds spent in each stage; compilation is not counted in training. `limit`
    is the instant of `time.monotonic` at which the present stage is out of time: `max_seconds`
    after the beginning, or a share of them.
    """

    def __init__(self, name: str, max_seconds: float | None, show: bool | None) -> None:
        self.name, self._bar = name, ProgressBar(show)
        self.seconds: dict[str, float] = defaultdict(float)
        self._began = time.monotonic()
        self._until = math.inf if max_seconds is None else self._began + max_seconds
        self.limit = self._until

    def __enter__(self) -> "Clock":
        self._bar.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.__exit__()

    @contextlib.contextmanager
    def stage(self, name: str, total: float, unit: str, share: float = 1.0) -> Iterator[None]:
        """Time the statements inside as a stage of so many units of work.

        - `share`: the share of `max_seconds` after which the stage is out of time.
        """
        began, compiling = time.monotonic(), self.seconds[COMPILING]
        self.limit = self._began + share * (self._until - self._began)
        self._bar.begin(f"{self.name}: {name}", total, unit)
        try:
            yield
        finally:
            compiled = self.seconds[COMPILING] - compiling
            self.seconds[name] += time.monotonic() - began - compiled
            self._bar.end()

    def advance(self, amount: float, figures: str = "") -> None:
        """Count further units of the present stage as done, and show `figures` next to the bar."""
        self._bar.advance(amount, figures)

    def show(self, done: float, total: float, figures: str) -> None:
        """Set the number of finished units and their total, which may have changed."""
        self._bar.set_done(done, total, figures)

    def count_compilation(self, seconds: float) -> None:
        """Count seconds of the present stage as compilation."""
        self.seconds[COMPILING] += max(0.0, seconds)

    def check(self) -> None:
        """Raise `OutOfTime` if the time of this stage is over."""
        if time.monotonic() >= self.limit:
            raise OutOfTime
