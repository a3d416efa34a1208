"""Configurations of a sweep by their hyper-parameters: parallel coordinates, and slices."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from verifai_jax.addons.estimation.simultaneous_interval import verdict_kind
from verifai_jax.addons.training.pictures.sweep import LOOKS
from verifai_jax.addons.training.sweeps.result import Sweep
from verifai_jax.pictures import style


def plot_parallel(sweep: Sweep, path: str | Path | None = None) -> Figure:
    """Draw a line for each configuration: its hyper-parameters, and its failure rate at the end."""
    table, names = sweep.configurations, _varying(sweep)
    figure = style.new_figure(figsize=(1.6 + 1.5 * len(names), 4.4))
    axes, heights = figure.subplots(), [_heights(sweep, name) for name in names]
    for i, (rate, verdict) in enumerate(zip(table["failure_rate"], table["verdict"], strict=True)):
        colour, marker = LOOKS[verdict_kind(str(verdict)) or "undecided"]
        axes.plot([*(one[i] for one in heights), rate], c=colour, marker=marker, ms=4, alpha=0.7)
    ends = [f"{_end(table[name].min())}\nto {_end(table[name].max())}" for name in names]
    ticks = [f"{style.wrap_name(name, 14)}\n{end}" for name, end in zip(names, ends, strict=True)]
    axes.set_xticks(range(len(names) + 1), [*ticks, "failure rate\n0\nto 1"], fontsize=8)
    axes.set_yticks([])
    axes.grid(visible=True, axis="x")
    axes.set_title(f"{sweep.name}: configurations by verdict", fontsize=10)
    return style.show_or_save(figure, path)


def plot_slices(sweep: Sweep, path: str | Path | None = None) -> Figure:
    """Draw the failure rate of the configurations over each hyper-parameter."""
    table, names = sweep.configurations, _varying(sweep)
    figure = style.new_figure(figsize=(2.6 * len(names) + 0.6, 3.4))
    for name, axes in zip(
        names, np.ravel(figure.subplots(1, len(names), sharey=True)), strict=True
    ):
        for verdict, rows in table.groupby("verdict"):
            colour, marker = LOOKS[verdict_kind(str(verdict)) or "undecided"]
            axes.scatter(rows[name], rows["failure_rate"], c=colour, marker=marker, label=verdict)
        if _is_log(sweep, name):
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(name)
        style.tidy(axes)
    figure.axes[0].set_ylabel("failure rate")
    figure.axes[-1].legend(frameon=False, fontsize=8)
    return style.show_or_save(figure, path)


def _varying(sweep: Sweep) -> list[str]:
    table: Any = sweep.configurations
    names = [n for n in sweep.hyperparameters if table[n].nunique() > 1]
    return names or list(sweep.hyperparameters)


def _is_log(sweep: Sweep, name: str) -> bool:
    domain = None if sweep.space is None else sweep.space.domains.get(name)
    return domain is not None and domain.tuning is not None and domain.tuning.scale == "log"


def _heights(sweep: Sweep, name: str) -> np.ndarray:
    """Return the values of a hyper-parameter between 0 and 1; texts by the alphabet."""
    column: Any = sweep.configurations[name]
    if column.dtype.kind not in "biuf":
        column = column.astype(str).rank(method="dense")
    values = np.asarray(np.log(column) if _is_log(sweep, name) else column, np.float64)
    low, high = np.nanmin(values), np.nanmax(values)
    return (values - low) / (high - low) if high > low else np.full(len(values), 0.5)


def _end(value: object) -> str:
    return f"{value:z.3g}" if isinstance(value, float) else str(value)
