"""Influence of features as a picture: bars with intervals, and strength against irregularity."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.plotting.style import BOUND, FAILING, new_figure, show_or_save, tidy

if TYPE_CHECKING:
    import pandas as pd

SECOND = "#8d99ae"
"""Colour of what is shown next to failures and to total influence."""


def plot_bars(
    table: "pd.DataFrame",
    columns: Mapping[str, str],
    title: str,
    label: str,
    path: str | Path | None = None,
) -> Any:
    """Draw one horizontal bar a row and column; returns the figure.

    - `columns`: column -> its name in the legend, empty for none; intervals are in `column_low` and
      `column_high`, or in `low` and `high`.
    """
    figure = new_figure(figsize=(6.4, 1.3 + 0.38 * len(table) + 0.2 * (len(columns) > 1)))
    axes = figure.subplots()
    draw_bars(axes, table, columns)
    axes.set_xlabel(label)
    figure.suptitle(title, fontsize=10)
    return show_or_save(figure, path)


def draw_bars(axes: Any, table: "pd.DataFrame", columns: Mapping[str, str]) -> None:
    """Draw the bars of `plot_bars` into `axes`, the first row on top."""
    height = 0.76 / len(columns)
    place = np.arange(len(table))
    for j, (column, name) in enumerate(columns.items()):
        values = table[column].to_numpy(float)
        low, high = (
            table[end if end in table else f"{column}_{end}"].to_numpy(float)
            for end in ("low", "high")
        )
        # An interval of resampled values need not contain the value itself.
        reach = np.nan_to_num([np.maximum(values - low, 0), np.maximum(high - values, 0)])
        axes.barh(
            place + (j - (len(columns) - 1) / 2) * height,
            np.nan_to_num(values),
            height * 0.92,
            color=SECOND if column in ("first", "rho") else FAILING,
            label=name,
            xerr=reach,
            error_kw={"ecolor": BOUND, "elinewidth": 1, "capsize": 2},
        )
    axes.set_yticks(place, [str(name) for name in table.index])
    axes.invert_yaxis()
    axes.axvline(0, color=BOUND, linewidth=0.8)
    tidy(axes)
    axes.grid(visible=False, axis="y")
    if any(columns.values()):
        axes.legend(frameon=False, fontsize=8, loc="lower right")


def plot_effects(table: "pd.DataFrame", title: str, path: str | Path | None = None) -> Any:
    """Draw mean size of the effects against their standard deviation; returns the figure."""
    figure = new_figure(figsize=(5.6, 4.4))
    axes = figure.subplots()
    across, up = table["mu_star"].to_numpy(float), table["sigma"].to_numpy(float)
    most = 1.12 * max(np.max(across, initial=0), np.max(up, initial=0)) or 1.0
    axes.plot([0, most], [0, most], color=BOUND, linewidth=0.8, linestyle=":")
    axes.errorbar(
        across,
        up,
        xerr=[np.maximum(across - table["low"], 0), np.maximum(table["high"] - across, 0)],
        fmt="o",
        color=FAILING,
        ecolor=BOUND,
        elinewidth=0.8,
    )
    for name, x, y in zip(table.index, across, up, strict=True):
        axes.annotate(str(name), (x, y), textcoords="offset points", xytext=(5, 5), fontsize=8)
    axes.set_xlim(0, most)
    axes.set_ylim(-0.03 * most, most)
    axes.set_xlabel("mean size of the effect on the robustness")
    axes.set_ylabel("standard deviation of the effect\n(interaction or curvature)")
    tidy(axes)
    figure.suptitle(title, fontsize=10)
    return show_or_save(figure, path)
