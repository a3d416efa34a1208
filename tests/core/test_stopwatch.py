"""Each moment counts for one thing, so that times add up and none is negative."""

import pytest

from verifai_jax.core.compute import stopwatch
from verifai_jax.core.compute.stopwatch import Stopwatch


@pytest.fixture
def clock(monkeypatch):
    """Let time pass by `clock.pass_(seconds)` alone."""

    class Clock:
        now = 100.0

        def pass_(self, seconds):
            self.now += seconds

        def perf_counter(self):
            return self.now

    fake = Clock()
    monkeypatch.setattr(stopwatch, "time", fake)
    return fake


def test_what_is_inside_counts_for_nothing_around_it(clock):
    watch = Stopwatch("compile", began=98.0)
    clock.pass_(1)
    with watch.on("search"):
        clock.pass_(2)
        with watch.on("compile"):
            clock.pass_(4)
        clock.pass_(8)
    clock.pass_(16)
    assert dict(watch.seconds) == {"compile": 2 + 1 + 4 + 16, "search": 10}
    assert sum(watch.seconds.values()) == clock.now - 98.0


def test_an_error_inside_ends_its_part(clock):
    watch = Stopwatch("rest")

    def raises():
        with watch.on("search"):
            clock.pass_(3)
            raise KeyError

    with pytest.raises(KeyError):
        raises()
    clock.pass_(1)
    assert dict(watch.seconds) == {"rest": 1, "search": 3}


def test_what_is_moved_is_at_most_what_was_taken(clock):
    watch = Stopwatch("rest", earlier={"compile": 5.0})
    with watch.on("search"):
        clock.pass_(3)
        watch.move(2, "compile")
        assert dict(watch.seconds) == {"rest": 0, "search": 1, "compile": 7}
        # Another thread may have waited meanwhile.
        watch.move(50, "compile")
        watch.move(-50, "compile")
    assert dict(watch.seconds) == {"rest": 0, "search": 0, "compile": 8}
