"""The picture of a failure table: the probability of a failure by each fault."""

from pathlib import Path

from matplotlib.figure import Figure

from verifai_jax.addons.faults.failure_table.result import FailureTable
from verifai_jax.core.messages.text import format_percent
from verifai_jax.pictures import style

SMALLEST = 1e-9
"""Probability at which the axis ends, where an interval begins at zero."""


def plot_failure_table(found: FailureTable, path: str | Path | None = None) -> Figure:
    """Draw the probability of a failure for each fault and pair, with its interval."""
    figure = style.new_figure(figsize=(7.2, 0.45 * max(len(found), 3) + 1.4))
    axes = figure.subplots()
    for index, effect in enumerate(found):
        color = style.FAILING if effect.fails else style.SAFE
        ends = [max(effect.low, SMALLEST), max(effect.high, SMALLEST)]
        axes.plot(ends, [index] * 2, color=color, linewidth=4, alpha=0.6)
        if effect.probability > 0:
            axes.plot(effect.probability, index, "o", color=color)
    axes.set_yticks(range(len(found)), [style.wrap_name(each.name, 30, 3) for each in found])
    axes.set_ylim(len(found) - 0.4, -0.6)
    axes.set_xscale("log")
    given = "" if found.rate is not None else ", given the fault"
    axes.set_xlabel(f"failure probability{given} ({format_percent(found.confidence)})")
    return style.show_or_save(figure, path)
