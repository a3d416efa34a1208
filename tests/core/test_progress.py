"""Progress bars: drawn where there is a terminal, and no run depends on them."""

import contextlib
import inspect
import io
import os
import sys
import time

import jax.numpy as jnp
import pytest

import verifai_jax as vj
from verifai_jax.core.display import progress
from verifai_jax.core.display.progress import (
    SimulationProgress,
    count_done,
    has_viewer,
    say_done,
    shows_progress,
)


def some_progress(between=lambda: None):
    with SimulationProgress("cars", 100, show=True) as shown:
        shown.update(10, 1, -0.5)
        between()
        shown.note("nobody sees this")
        shown.update(100, 3, -0.7)


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


def test_a_notebook_without_widgets_has_one_line_that_is_written_over(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setitem(sys.modules, "ipykernel", type(sys)("ipykernel"))
    monkeypatch.setattr(progress, "has_viewer", lambda: False)
    monkeypatch.setattr(progress, "EVERY", 60.0)
    with SimulationProgress("cars", 100) as shown:
        shown.update(40, 1, -0.5)
        time.sleep(1.3)
    time.sleep(0.1)
    text = stream.getvalue()
    assert text.startswith("\rcars: 40/100 simulations")
    assert text.endswith("\r")
    assert "\n" not in text


@shows_progress("comparing")
def compare_things(thing, budget=100, *, progress=None, inside=lambda: None):
    inside()
    return thing


class Cars:
    name = "cars"


def pipe(monkeypatch):
    """Make the error stream a pipe that gets a line every few milliseconds."""
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(progress, "EVERY", 0.01)
    return stream


def wait_for(stream, text):
    until = time.monotonic() + 10
    while text not in stream.getvalue() and time.monotonic() < until:
        time.sleep(0.005)
    assert text in stream.getvalue()


def test_a_pipe_gets_lines_that_say_what_is_going_on(monkeypatch):
    piped = pipe(monkeypatch)

    def inside():
        wait_for(piped, "comparing cars: 0/100 simulations, 0.0 min so far\n")
        count_done(40)
        wait_for(piped, "comparing cars: 40/100 simulations, ")
        # What is begun within takes the line over, and gives it back.
        with SimulationProgress("bikes", 7, None) as bar:
            bar.update(3, 1, -0.5)
            wait_for(piped, "bikes: 3/7 simulations, ")
            assert "best -0.5  1 counterexamples" in piped.getvalue()
            count_done(2)
        compare_things(Cars(), progress=None)
        wait_for(piped, "comparing cars: 42/100 simulations, ")
        say_done(50, 200, "two open")
        wait_for(piped, "comparing cars: 50/200 simulations, two open, ")

    assert compare_things(Cars(), inside=inside).name == "cars"
    # A line may be on its way when the verb ends; then there is none any more.
    time.sleep(0.02)
    said = piped.getvalue()
    time.sleep(0.05)
    assert piped.getvalue() == said


def test_nothing_is_said_where_that_is_wanted(monkeypatch):
    piped = pipe(monkeypatch)

    def inside():
        with SimulationProgress("bikes", 7, None):
            time.sleep(0.05)

    compare_things(Cars(), progress=False, inside=inside)
    compare_things(Cars(), progress=lambda done, total, text: None, inside=inside)
    assert piped.getvalue() == ""


def test_a_name_cannot_steer_a_terminal(monkeypatch):
    piped = pipe(monkeypatch)
    compare_things("a\x1b[2Jb", inside=lambda: wait_for(piped, r"comparing a\x1b[2Jb: "))


def test_one_bar_on_a_terminal_for_a_verb_and_what_it_calls(monkeypatch):
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)

        def inside():
            outer = progress._ongoing.get()
            with SimulationProgress("bikes", 7, None) as bar:
                bar.update(3, 1, -0.5)
                shown = [task for task in outer._display.tasks if task.visible]
                assert [task.description for task in shown] == ["bikes"]
                assert shown[0].fields["amount"] == "3/7 simulations"
            assert [t.description for t in outer._display.tasks if t.visible] == ["comparing cars"]

        compare_things(Cars(), inside=inside)
    os.close(ours)


@pytest.mark.addons
def test_every_verb_that_takes_long_says_what_it_is_doing():
    verbs = [
        vj.compare, vj.repair, vj.synthesize, vj.shrink, vj.explain, vj.confirm,
        vj.replay_counterexamples, vj.estimate, vj.modes, vj.certify, vj.falsify, vj.fuzz,
        vj.resume, vj.simulate, vj.sweep, vj.augment, vj.rl.train, vj.analysis.analyze,
        vj.analysis.sobol_indices, vj.analysis.morris, vj.analysis.gradient_sensitivity,
        vj.analysis.importance, vj.perception.abstract, vj.perception.train_detector,
    ]  # fmt: skip
    missing = [v.__name__ for v in verbs if "progress" not in inspect.signature(v).parameters]
    assert missing == []


@pytest.mark.thorough
def test_simulations_of_a_verb_are_counted(monkeypatch):
    counted = []
    count = progress.ProgressBar.count
    monkeypatch.setattr(
        progress.ProgressBar, "count", lambda bar, n: (counted.append(n), count(bar, n))
    )

    def system(features, key):
        return vj.Trace({"x": features["x"] * jnp.ones(3)}, dt=0.5)

    still = vj.Problem("still", {"x": vj.Box(-1, 1)}, system, "always x < 2")
    compared = vj.compare(still, still, budget=256, margin=0.001)
    assert sum(counted) == compared.simulations
