"""The clock of a sweep: what its time goes to, how much is left, and a bar for each stage."""

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterator

from verifai_jax.core.progress import ProgressBar

TRAINING, COMPILING, CERTIFYING = "training", "compiling", "certifying"


class OutOfTime(Exception):
    """The seconds of a sweep are over."""


class Watch:
    """A context manager around a sweep.

    - `max_seconds`: after which `check` raises `OutOfTime`; None for no limit.
    - `show`: whether to draw; None decides by where the error stream goes.

    `seconds` is what was spent in each stage; compiling is taken out of training.
    """

    def __init__(self, name: str, max_seconds: float | None, show: bool | None) -> None:
        self.name, self._bar = name, ProgressBar(show)
        self.seconds: dict[str, float] = defaultdict(float)
        self._began = time.perf_counter()
        self._until = None if max_seconds is None else self._began + max_seconds
        self._limit = self._until

    def __enter__(self) -> "Watch":
        self._bar.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.__exit__()

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.perf_counter() - self._began

    @contextlib.contextmanager
    def stage(self, name: str, total: float, unit: str, share: float = 1.0) -> Iterator[None]:
        """Time inside goes to `name`; `total` of the `unit` are to be done.

        - `share`: of the seconds, after which this stage is out of time.
        """
        began, inner = time.perf_counter(), self.seconds[COMPILING]
        if self._until is not None:
            self._limit = self._began + share * (self._until - self._began)
        self._bar.begin(f"{self.name}: {name}", total, unit)
        try:
            yield
        finally:
            compiled = self.seconds[COMPILING] - inner
            self.seconds[name] += time.perf_counter() - began - compiled
            self._bar.end()

    def advance(self, amount: float, figures: str = "") -> None:
        """Tell that so much more is done."""
        self._bar.advance(amount, figures)

    def told(self, done: float, total: float, figures: str) -> None:
        """Tell that `done` of `total` are done; the total may have changed."""
        self._bar.update(done, total, figures)

    def compiled(self, seconds: float) -> None:
        """Tell that so much of the present stage went into compiling."""
        self.seconds[COMPILING] += max(0.0, seconds)

    def check(self) -> None:
        """Raise `OutOfTime` where the seconds of this stage are over."""
        if self._limit is not None and time.perf_counter() >= self._limit:
            raise OutOfTime
