"""The picture of a last chance: the failing trace, the bracket, and the escapes."""

from pathlib import Path

import numpy as np

from verifai_jax.addons.avoidability.result import LastChance
from verifai_jax.core.display.figure import Figure
from verifai_jax.pictures.replay import plot_replay
from verifai_jax.pictures.style import FAILING, NOT_CLAIMED, SAFE, show_or_save

PANELS = 4
"""Signals drawn, at most."""


def plot_last_chance(result: LastChance, path: str | Path | None = None) -> Figure:
    """Draw signals of the failing trace and of the escapes (green), and the bracket (amber)."""
    replay = result.replay
    monitored = dict.fromkeys(s for f in replay.problem.formulas.values() for s in f.signals())
    shown = list({**monitored, **dict.fromkeys(replay.trace.signals)})[:PANELS]
    figure = plot_replay(replay, signals=shown)
    end = float(np.asarray(replay.trace.clock())[-1])
    for axes, signal in zip(figure.axes, shown, strict=False):
        for escape in result.escapes[::-1]:
            trace = escape.trace.trim()
            on = np.asarray(trace.clock()) >= escape.start - 1e-9
            line = {"color": SAFE, "linewidth": 2.0 if escape is result.escape else 0.9}
            axes.plot(np.asarray(trace.clock())[on], np.asarray(trace.signals[signal])[on], **line)
        axes.axvspan(*result.bracket, color=NOT_CLAIMED, alpha=0.4, linewidth=0)
        if result.proved_from is not None:
            axes.axvspan(result.proved_from, end, color=FAILING, alpha=0.08, linewidth=0)
    said = str(result).splitlines()[len(replay.warnings)]
    figure.supxlabel(said, fontsize=8, color=SAFE, wrap=True)
    return show_or_save(figure, path)
