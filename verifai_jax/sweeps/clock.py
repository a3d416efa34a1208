"""The clock of a sweep: what its time goes to, how much is left, and a bar for each stage.

Drawn by rich on the error stream, on a terminal or in a notebook that has ipywidgets; nothing
elsewhere.
"""

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from verifai_jax.core.progress import _watched

TRAINING, COMPILING, CERTIFYING = "training", "compiling", "certifying"


class OutOfTime(Exception):
    """The seconds of a sweep are over."""


class Watch:
    """A context manager around a sweep.

    - `max_seconds`: after which `check` raises `OutOfTime`; None for no limit.
    - `show`: whether to draw; None and True decide by where the output goes.

    `seconds` is what was spent in each stage; compiling is taken out of training.
    """

    def __init__(self, name: str, max_seconds: float | None, show: bool | None) -> None:
        self.name, self.show = name, show is not False and _watched()
        self.seconds: dict[str, float] = defaultdict(float)
        self._began = time.perf_counter()
        self._until = None if max_seconds is None else self._began + max_seconds
        self._limit = self._until
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> "Watch":
        if self.show:
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed:,.0f}/{task.total:,.0f} {task.fields[unit]}"),
                TextColumn("{task.fields[figures]}"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

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
        if self._bar is not None:
            words = f"{self.name}: {name}"
            self._task = self._bar.add_task(words, total=total, unit=unit, figures="compiling")
        try:
            yield
        finally:
            compiled = self.seconds[COMPILING] - inner
            self.seconds[name] += time.perf_counter() - began - compiled
            if self._bar is not None:
                self._bar.remove_task(self._task)
                self._task = None

    def advance(self, amount: float, figures: str = "") -> None:
        """Tell that so much more is done."""
        if self._task is not None:
            self._bar.update(self._task, advance=amount, figures=figures)

    def told(self, done: float, total: float, figures: str) -> None:
        """Tell that `done` of `total` are done; the total may have changed."""
        if self._task is not None:
            self._bar.update(self._task, completed=done, total=total, figures=figures)

    def compiled(self, seconds: float) -> None:
        """Tell that so much of the present stage went into compiling."""
        self.seconds[COMPILING] += max(0.0, seconds)

    def check(self) -> None:
        """Raise `OutOfTime` where the seconds of this stage are over."""
        if self._limit is not None and time.perf_counter() >= self._limit:
            raise OutOfTime
