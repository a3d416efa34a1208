"""Pictures about requirements: fronts of mined parameters, examples, distinguishing traces."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from verifai_jax.addons.monitoring.distinguishing import Distinction
from verifai_jax.addons.monitoring.exemplary import Examples
from verifai_jax.addons.monitoring.mining import Mined
from verifai_jax.core.display.figure import Axes, Figure
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.bounds import signal_bounds
from verifai_jax.mtl.fitting import fitted, sizes_of
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.pictures import style


def plot_mined(mined: Mined, path: str | Path | None = None) -> Figure:
    """Draw the corners of a front, and the chosen values.

    **Raises:** `ValueError` for one parameter, which has no front.
    """
    if len(mined.tightest) < 2:
        raise ValueError("one parameter has a tightest value and no front to draw; see summary()")
    one, other = mined.tightest
    figure = style.new_figure(figsize=(6.0, 4.5), facecolor="white")
    axis = figure.add_subplot()
    corners = sorted((corner[one], corner[other]) for corner in mined.front)
    axis.plot(*zip(*corners, strict=True), "o", color="#1b2a41", ms=4, label="corners of the front")
    where = "post" if mined.tightest[one] == "least" else "pre"
    axis.step(*zip(*corners, strict=True), where=where, color="#7b8794")
    axis.plot(mined.values[one], mined.values[other], "o", color="#cf3f21", ms=8, label="chosen")
    axis.set_xlabel(f"{one} (tight: the {mined.tightest[one]})")
    axis.set_ylabel(f"{other} (tight: the {mined.tightest[other]})")
    axis.set_title(mined.text, fontsize=10)
    axis.legend()
    return style.show_or_save(figure, path)


def plot_examples(examples: Examples, path: str | Path | None = None) -> Figure:
    """Draw the traces side by side: a row for each signal, and one for the truth.

    **Raises:** `ValueError` if no trace was found.
    """
    titles = {"satisfying": "satisfies", "barely": "barely satisfies", "breaking": "breaks"}
    traces = {
        f"{titles[name]} ({examples.robustness[name]:+z.3g})": trace
        for name, trace in examples.traces.items()
    }
    return _plot_traces([examples.formula], traces, path)


def plot_distinction(distinction: Distinction, path: str | Path | None = None) -> Figure:
    """Draw the trace that distinguishes two formulas, and when each of them holds.

    **Raises:** `ValueError` if no trace was found.
    """
    traces = {} if distinction.trace is None else {distinction.source: distinction.trace}
    return _plot_traces([distinction.one, distinction.other], traces, path)


def _plot_traces(
    formulas: Sequence[Formula], traces: Mapping[str, Trace], path: str | Path | None
) -> Figure:
    if not traces:
        raise ValueError("no trace was found, so that there is nothing to draw")
    names = list(dict.fromkeys(name for formula in formulas for name in formula.signals()))
    rows, columns = len(names) + len(formulas), len(traces)
    height = 1.4 * len(names) + 0.7 * len(formulas) + 1
    figure = style.new_figure(figsize=(3.2 * columns + 2.0, height))
    heights = [1.0] * len(names) + [0.35] * len(formulas)
    grid = figure.subplots(
        rows, columns, sharex="col", sharey="row", squeeze=False, height_ratios=heights
    )
    for (title, trace), column in zip(traces.items(), grid.T, strict=True):
        values = HostValues.of(trace)
        clock = np.arange(values.length) * values.dt / values.stride
        column[0].set_title(title, fontsize=10)
        column[-1].set_xlabel("time (s)")
        for axes, name in zip(column, names, strict=False):
            axes.plot(clock, values.signals[name], color=style.INPUT, drawstyle="steps-post")
            sizes = sizes_of(trace.signals)
            _draw_bounds(axes, [fitted(f, trace.units, sizes) for f in formulas], name)
            style.tidy(axes)
        for axes, formula in zip(column[len(names) :], formulas, strict=True):
            fails = np.broadcast_to(values.truth(formula) <= 0, len(clock))
            axes.axvspan(clock[0], clock[-1], color=style.SAFE, lw=0)
            axes.fill_between(clock, 0, fails, step="post", color=style.FAILING, lw=0)
            axes.set_yticks([])
            axes.set_ylim(0, 1)
    for axes, name in zip(grid[:, 0], [*names, *map(str, formulas)], strict=True):
        label = style.wrap_name(name, 28, 4)
        axes.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=9)
    return style.show_or_save(figure, path)


def _draw_bounds(axes: Axes, formulas: Sequence[Formula], name: str) -> None:
    """Draw the numbers that a signal is compared with."""
    solved = (limits for f in formulas for _, limits in signal_bounds(f, name))
    for number in {limit.number for limits in solved for limit in limits}:
        if number is not None:
            axes.axhline(number, color=style.BOUND, lw=0.9, ls="--")
