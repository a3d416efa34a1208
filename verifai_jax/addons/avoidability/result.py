"""The result of `last_chance`: the bracket, the escapes, and their picture."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from verifai_jax.core.display.figure import Drawn, Figure
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.replay import Replay

PANELS = 4
"""Signals drawn, at most."""


@dataclass(frozen=True, eq=False)
class Escape:
    """A way in which the failure is avoided, simulated again alone; `str()` says what it had to do.

    - `start`, `stop`: the seconds between which it differs; `stop` is None if to the end.
    - `robustness`: the least robustness over the formulas; `trace`: its trace.
    - `did`: what it had to do, in words.
    - `actions`: a row for each decision from `start` to `stop`; None for other means.
    - `features`: the new and the old value of each changed column; empty for other means.
    """

    start: float
    stop: float | None
    robustness: float
    trace: Trace = field(repr=False)
    did: str
    actions: Float[np.ndarray, "decisions entries"] | None = field(default=None, repr=False)
    features: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)

    def __str__(self) -> str:
        until = "to the end" if self.stop is None else f"to {format_seconds(self.stop, 4)}"
        then = "" if self.stop is None else "; then the policy goes on"
        return f"{self.did}, from {format_seconds(self.start, 4)} {until}{then}"


@dataclass(frozen=True, eq=False)
class LastChance(Drawn, InNotebook):
    """The last instant at which a failure could have been avoided, as a bracket in seconds.

    - `row`: the number of the failing simulation, None for given features; `by`: who could have
      avoided it; `failed`: the first instant from which on the formula is broken whatever follows.
    - `avoidable_until`: the last instant with an escape, None if none was found; `no_escape_from`:
      the next instant that was tried; from it on no escape was found; `bracket`: both.
    - `proved_from`: the instant from which the failure is proved unavoidable; None without a proof.
    - `escape`: the escape from `avoidable_until`; `escapes`: this and earlier ones.
    - `tried`: all instants from which escapes were searched for; `simulations`: forks that went on.
    - `replay`: the failing simulation; `notes`: sentences for the user.
    """

    _picture = "verifai_jax.addons.avoidability.result", "plot_last_chance"
    row: int | None
    by: str
    failed: float
    avoidable_until: float | None
    no_escape_from: float
    proved_from: float | None
    escapes: tuple[Escape, ...] = field(repr=False)
    tried: tuple[float, ...] = field(repr=False)
    simulations: int
    replay: Replay = field(repr=False)
    notes: tuple[str, ...] = ()

    @property
    def escape(self) -> Escape | None:
        return self.escapes[0] if self.escapes else None

    @property
    def bracket(self) -> tuple[float, float]:
        return self.avoidable_until or 0.0, self.no_escape_from

    @property
    def headline(self) -> str:
        which = "a failure" if self.row is None else f"the failure of row {self.row}"
        about = f"{which} of {self.replay.problem.name}: "
        if self.avoidable_until is None:
            return f"{about}no escape by {self.by} was found from any instant"
        before = format_seconds(max(self.failed - self.avoidable_until, 0.0), 4)
        until = format_seconds(self.avoidable_until, 4)
        return f"{about}{self.by} could avoid it until {until}, {before} before it"

    def __str__(self) -> str:
        lines = [f"  failure      at {format_seconds(self.failed, 4)}"]
        if self.escape is not None:
            robust = f"robustness {self.escape.robustness:z.3g}, simulated alone"
            lines += [f"  escape       {self.escape}", f"               {robust}"]
        lines.append(
            f"  no escape    found from {format_seconds(self.no_escape_from, 4)} on, in "
            f"{self.simulations:,} simulations from {len(self.tried)} instants"
        )
        if self.proved_from is not None:
            when = format_seconds(self.proved_from, 4)
            lines.append(f"  proved       unavoidable from {when} on, whatever the actions")
        notes = (f"  note         {note}" for note in self.notes)
        return "\n".join([*self.replay.warnings, self.headline, *lines, *notes])

    __repr__ = __str__


def plot_last_chance(result: LastChance, path: str | Path | None = None) -> Figure:
    """Draw signals of the failing trace and of the escapes (green), and the bracket (amber)."""
    from verifai_jax.pictures.replay import plot_replay
    from verifai_jax.pictures.style import FAILING, NOT_CLAIMED, SAFE, show_or_save

    replay = result.replay
    monitored = dict.fromkeys(s for f in replay.problem.formulas.values() for s in f.signals())
    shown = list({**monitored, **dict.fromkeys(replay.trace.signals)})[:PANELS]
    figure = plot_replay(replay, signals=shown)
    end = float(np.asarray(replay.trace.clock())[-1])
    for axes, signal in zip(figure.axes, shown, strict=False):
        style = axes.get_lines()[0].get_drawstyle()
        for escape in result.escapes[::-1]:
            trace = escape.trace.trim()
            on = np.asarray(trace.clock()) >= escape.start - 1e-9
            last = escape is result.escape
            line = {"color": SAFE, "linewidth": 2.0 if last else 0.9, "drawstyle": style}
            values = np.asarray(trace.signals[signal])[on]
            drawn = axes.plot(np.asarray(trace.clock())[on], values, **line)
            earlier = "earlier escapes" if escape is result.escapes[-1] else "_"
            drawn[0].set_label("last escape" if last else earlier)
        if result.escape is not None:
            span = {"color": NOT_CLAIMED, "alpha": 0.4, "linewidth": 0}
            axes.axvspan(*result.bracket, label="last chance", **span)
        if result.proved_from is not None:
            span = {"color": FAILING, "alpha": 0.08, "linewidth": 0}
            axes.axvspan(result.proved_from, end, label="proved unavoidable", **span)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=7, frameon=False)
    color = FAILING if result.escape is None else SAFE
    figure.supxlabel(result.headline, fontsize=8, color=color, wrap=True)
    return show_or_save(figure, path)
