"""Progress bars: drawn where there is a terminal, and no run depends on them."""

import contextlib
import os
import sys

import pytest

from verifai_jax.core.progress import SimulationProgress, has_viewer


def some_progress(between=lambda: None):
    with SimulationProgress("cars", 100, show=True) as progress:
        progress.update(10, 1, -0.5)
        between()
        progress.note("nobody sees this")
        progress.update(100, 3, -0.7)


def test_a_terminal_that_goes_away_ends_no_run(monkeypatch):
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    terminal = os.fdopen(theirs, "w")
    monkeypatch.setattr(sys, "stderr", terminal)
    assert has_viewer()
    some_progress(between=lambda: os.close(ours))
    with contextlib.suppress(OSError):  # What it could not write is lost.
        terminal.close()


def test_a_stream_that_is_closed_or_missing_has_no_viewer(monkeypatch):
    with open(os.devnull, "w") as file:
        monkeypatch.setattr(sys, "stderr", file)
    assert not has_viewer()
    some_progress()
    monkeypatch.setattr(sys, "stderr", None)
    assert not has_viewer()
    some_progress()
