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
        values, label = [*(one[i] for one in heights), rate], str(verdict) or "not certified"
        axes.plot(values, c=colour, marker=marker, ms=4, alpha=0.7, label=label)
    ends = [f"{_end(table[name].min())}\nto {_end(table[name].max())}" for name in names]
    ticks = [f"{style.wrap_name(name, 14)}\n{end}" for name, end in zip(names, ends, strict=True)]
    axes.set_xticks(range(len(names) + 1), [*ticks, "failure rate\n0\nto 1"], fontsize=8)
    axes.set_yticks([])
    axes.grid(visible=True, axis="x")
    axes.set_title(f"{sweep.name}: configurations by verdict", fontsize=10)
    lines, verdicts = axes.get_legend_handles_labels()
    shown = dict(zip(verdicts, lines, strict=True))
    axes.legend(shown.values(), shown, frameon=False, fontsize=8, loc="upper left",
                bbox_to_anchor=(1, 1))  # fmt: skip
    return style.show_or_save(figure, path)


def plot_slices(sweep: Sweep, path: str | Path | None = None) -> Figure:
    """Draw the failure rate of the configurations over each hyper-parameter."""
    table, names = sweep.configurations, _varying(sweep)
    table = table.loc[table["failure_rate"].notna()]
    figure = style.new_figure(figsize=(2.6 * len(names) + 0.6, 3.4))
    for name, axes in zip(
        names, np.ravel(figure.subplots(1, len(names), sharey=True)), strict=True
    ):
        values, texts = _as_numbers(table[name])
        for verdict, rows in table.groupby("verdict"):
            colour, marker = LOOKS[verdict_kind(str(verdict)) or "undecided"]
            at, rates = values[table.index.isin(rows.index)], rows["failure_rate"]
            axes.scatter(at, rates, c=colour, marker=marker, label=verdict)
        if texts:
            axes.set_xticks(range(len(texts)), texts)
        if _is_log(sweep, name):
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(name)
        style.tidy(axes)
    figure.axes[0].set_ylabel("failure rate")
    if len(table):
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
    """Return the values of a hyper-parameter between 0 and 1."""
    column, _ = _as_numbers(sweep.configurations[name])
    values = np.log(column) if _is_log(sweep, name) else column
    low, high = np.nanmin(values), np.nanmax(values)
    return (values - low) / (high - low) if high > low else np.full(len(values), 0.5)


def _as_numbers(column: Any) -> tuple[np.ndarray, list[str]]:
    """Return a column as numbers, for texts their places in the alphabet, and these texts."""
    if column.dtype.kind in "biuf":
        return np.asarray(column, np.float64), []
    texts = sorted({*column.astype(str)})
    return np.array([texts.index(str(each)) for each in column], np.float64), texts


def _end(value: object) -> str:
    return f"{value:z.3g}" if isinstance(value, float) else str(value)
