"""The picture of modes of failure: their probabilities, and where their failures lie."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from verifai_jax.addons.estimation.failure_modes.result import Modes
from verifai_jax.addons.estimation.pictures.estimate import log_ticks
from verifai_jax.core.messages.text import format_percent
from verifai_jax.pictures import style

COLORS = (
    style.FAILING,
    style.INPUT,
    style.SAFE,
    style.NOT_CLAIMED,
    "#8e6c8a",
    "#7f4f24",
    "#4ea8de",
    "#90a955",
)
"""Colours of the modes, in turn."""
WIDEST = 30
"""Characters of a line of a name next to its bar."""


def plot_modes(modes: Modes, path: str | Path | None = None) -> Figure:
    """Draw the probability of each mode with its interval, and failures of each mode.

    **Returns:** the figure. Failures are drawn over the two numerical features in which the modes
    differ most, together with each mode's likeliest failure.
    """
    numeric = _apart(modes)
    figure = style.new_figure(figsize=(10.4 if numeric else 6.2, 0.6 * max(len(modes), 4) + 1.6))
    axes = list(np.atleast_1d(figure.subplots(1, 2 if numeric else 1)))
    _draw_bars(axes[0], modes)
    if numeric:
        _draw_failures(axes[1], modes, numeric)
    return style.show_or_save(figure, path)


def _draw_bars(axes: Axes, modes: Modes) -> None:
    for mode in modes:
        color = COLORS[mode.number % len(COLORS)]
        axes.plot([mode.low, mode.high], [mode.number] * 2, color=color, linewidth=4, alpha=0.6)
        axes.plot(mode.probability, mode.number, "o", color=color)
    names = [style.wrap_name(f"{mode.number}: {mode.name}", WIDEST, 3) for mode in modes]
    axes.set_yticks(range(len(modes)), names)
    axes.set_ylim(len(modes) - 0.4, -0.6)
    if len(modes):
        axes.set_xscale("log")
        log_ticks(axes.xaxis)
    axes.set_xlabel(f"failure probability ({format_percent(modes.confidence)})")
    axes.set_title(f"modes of failure of {modes.name}", fontsize=10)
    style.tidy(axes)


def _draw_failures(axes: Axes, modes: Modes, names: tuple[str, str]) -> None:
    first, second = names
    for mode in modes:
        color = COLORS[mode.number % len(COLORS)]
        axes.plot(
            mode.failures[first].to_numpy(), mode.failures[second].to_numpy(), ".",
            color=color, markersize=3, alpha=0.5,
        )  # fmt: skip
    for mode in modes:
        axes.plot(
            mode.features[first], mode.features[second], "*", markersize=11,
            markerfacecolor=COLORS[mode.number % len(COLORS)], markeredgecolor=style.BOUND,
        )  # fmt: skip
    axes.set_xlabel(first)
    axes.set_ylabel(second)
    axes.set_title("failures; stars: the likeliest", fontsize=10)
    style.tidy(axes)


def _apart(modes: Modes) -> tuple[str, str] | None:
    """Return the two numerical features in which the modes differ most; None with fewer."""
    if not len(modes):
        return None
    frames = [mode.failures for mode in modes]
    numeric = [str(n) for n in frames[0].columns if pd.api.types.is_numeric_dtype(frames[0][n])]
    if len(numeric) < 2:
        return None
    together = pd.concat(frames)

    def apart(name: str) -> float:
        within = np.mean([np.var(frame[name].to_numpy(np.float64)) for frame in frames])
        return -float(np.var(together[name].to_numpy(np.float64))) / max(float(within), 1e-300)

    first, second, *_ = sorted(numeric, key=apart)
    return first, second
