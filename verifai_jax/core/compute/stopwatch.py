"""A stopwatch whose parts add up: each moment counts for exactly one activity.

    watch = Stopwatch("rest")
    with watch.on("search"):
        with watch.on("compile"):              # no longer counts for the search
            ...
    watch.seconds                              # {"rest": 0.1, "search": 0.2, "compile": 1.4}

No time is computed as a difference of two others, so none is negative.
"""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from verifai_jax.core.compute.compilation import seconds_waited


class Stopwatch:
    """Seconds spent, by activity.

    **Arguments:**
    - `name`: the activity until the first `on`.
    - `began`: the start on the clock `time.perf_counter`; now by default.
    - `earlier`: seconds already spent by activity, for example in an earlier part of a run.
    """

    def __init__(
        self, name: str, began: float | None = None, earlier: Mapping[str, float] | None = None
    ) -> None:
        self._seconds: dict[str, float] = defaultdict(float, earlier or {})
        self._names = [name]
        self._since = time.perf_counter() if began is None else began

    @property
    def seconds(self) -> Mapping[str, float]:
        """Seconds by activity so far; 0 for an activity without any."""
        self._count()
        return self._seconds

    @contextmanager
    def on(self, name: str) -> Iterator[None]:
        """Count the time inside for activity `name` only."""
        self._count()
        self._names.append(name)
        try:
            yield
        finally:
            self._count()
            self._names.pop()

    @contextmanager
    def waiting_for_programs_is(self, name: str) -> Iterator[None]:
        """Count for `name` the time inside that is spent waiting for programs to compile."""
        before = seconds_waited()
        try:
            yield
        finally:
            self.move(seconds_waited() - before, name)

    def move(self, seconds: float, to: str) -> None:
        """Count seconds measured inside the present part for activity `to` instead.

        At most the seconds of the present part are moved.
        """
        self._count()
        own = self._names[-1]
        moved = min(max(seconds, 0.0), self._seconds[own])
        self._seconds[own] -= moved
        self._seconds[to] += moved

    def _count(self) -> None:
        now = time.perf_counter()
        self._seconds[self._names[-1]] += now - self._since
        self._since = now
