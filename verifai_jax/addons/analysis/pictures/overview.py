"""The overview of a run, and the influence of its features, as pictures."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from verifai_jax.addons.analysis._importance import NAMES, Importance
from verifai_jax.addons.analysis.overview import Analysis
from verifai_jax.addons.analysis.pictures.panels import (
    cells,
    draw_rule,
    draw_samples,
    name_points,
    two_features,
)
from verifai_jax.addons.analysis.sensitivity.sensitivity import Sensitivity
from verifai_jax.core.display.figure import Axes, Figure
from verifai_jax.core.messages.text import format_percent
from verifai_jax.pictures import style
from verifai_jax.pictures.style import BOUND, new_figure, show_or_save

MAX_BARS = 10
MAX_MARKED = 6
MAX_RULES = 2


def plot_overview(analysis: Analysis, path: str | Path | None = None) -> Figure:
    """Draw failures over the two most important features, and the importances as bars."""
    samples = analysis.samples
    title = analysis.parts[0].words.splitlines()[0]
    if samples is None:
        figure = new_figure(figsize=(6, 1.2))
        figure.text(
            0.5, 0.5, f"{analysis.name}: {title}"[:120], ha="center", va="center", fontsize=9
        )
        return show_or_save(figure, path)
    importance, rules = analysis["importance"], analysis["rules"]
    bars = 0 if importance is None else min(len(importance.table), MAX_BARS)
    figure = new_figure(figsize=(10.4 if bars else 6.2, 4.8))
    widths = [1.5, 1] if bars else [1]
    panels = figure.subplots(1, len(widths), squeeze=False, width_ratios=widths)[0]
    axes = panels[0]
    # The axes are those of the first rule, whose box would lie on no others.
    used = [c.feature for rule in rules.rules for c in rule.conditions] if rules else []
    ranked = importance.ranked if importance is not None else []
    across, up = two_features(samples, [*used, *ranked])
    draw_samples(axes, samples, across, up)
    for number, rule in enumerate(rules.rules[:MAX_RULES] if rules else (), 1):
        draw_rule(axes, samples, rule, across, up, number, "rule ")
    _mark_representatives(axes, analysis, across, up)
    if importance is not None:
        columns = {target: _NAMES[target] for target in importance.scores}
        draw_bars(panels[1], importance.table.head(MAX_BARS), columns)
        panels[1].set_xlabel("loss of a model's score without the feature")
    lines = [f"{analysis.name}: {title}"]
    if rules is not None and rules.rules:
        first = rules.rules[0]
        lines.append(f"rule 1: {first.words} ({format_percent(first.coverage)} of the failures)")
    figure.suptitle("\n".join(line[:260] for line in lines), fontsize=9.5)
    return show_or_save(figure, path)


_NAMES = {"failing": "failing", "rho": "robustness"}


def _mark_representatives(axes: Axes, analysis: Analysis, across: str, up: str) -> None:
    """Mark with numbers the rows that stand for the clusters of failures."""
    samples = analysis.samples
    assert samples is not None
    rows = analysis.representatives[:MAX_MARKED]
    x, y = cells(samples, across, up)
    for number, row in enumerate(rows):
        index = int(np.flatnonzero(samples.rows == row)[0])
        if not np.isfinite([x[index], y[index]]).all():
            continue
        axes.plot(x[index], y[index], "o", ms=13, mfc="white", mec=BOUND, mew=1.2)
        axes.annotate(str(number), (x[index], y[index]), ha="center", va="center", fontsize=8)
    if rows:
        axes.plot([], [], "o", mfc="white", mec=BOUND, label="typical row of a cluster of failures")
        axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(0, 1.1))


SECOND = "#8d99ae"
"""Colour of what is shown next to failures and to total influence."""
MAX_IMPORTANCES = 15
MAX_SENSITIVITIES = 20


def plot_importance(importance: Importance, path: str | Path | None = None) -> Figure:
    """Draw the losses of the models' scores as bars."""
    columns = {
        target: f"{NAMES[target]} ({importance.score_words(target)})"
        for target in importance.scores
    }
    title = f"importance of the features of {importance.name}"
    weak = [target for target in importance.scores if not importance.is_reliable(target)]
    if weak:
        what = " and of ".join(NAMES[target] for target in weak)
        title += f"\nmeaningless for {what}: the model does not predict"
    shown = importance.table.head(MAX_IMPORTANCES)
    return plot_bars(shown, columns, title, "loss of score when shuffled", path)


def plot_sensitivity(sensitivity: Sensitivity, path: str | Path | None = None) -> Figure:
    """Draw sensitivity indices with their intervals."""
    shown = sensitivity.table.head(MAX_SENSITIVITIES)
    title = (
        f"{sensitivity.method} of {sensitivity.problem}, {sensitivity.simulations:,} simulations"
    )
    if "mu_star" in shown:
        return plot_effects(shown, title, path)
    if "total" in shown:
        columns = {"total": "in all", "first": "alone"}
        return plot_bars(shown, columns, title, "share of the variance", path)
    # Above 1 a bound says nothing; at its own length it would hide those that do.
    shown = shown.clip(upper=1)
    return plot_bars(shown, {"bound": ""}, title, "upper bound on the total index", path)


def plot_bars(
    table: pd.DataFrame, columns: Mapping[str, str], title: str, label: str,
    path: str | Path | None = None,
) -> Figure:  # fmt: skip
    """Draw one horizontal bar for each row and column of a table.

    **Arguments:**
    - `table`: a row for each feature; intervals are in the columns `NAME_low` and `NAME_high`, or
      in `low` and `high`.
    - `columns`: the legend text of each column to draw, empty for none.
    """
    figure = style.new_figure(figsize=(6.4, 1.3 + 0.38 * len(table) + 0.2 * (len(columns) > 1)))
    axes = figure.subplots()
    draw_bars(axes, table, columns)
    axes.set_xlabel(label)
    figure.suptitle(title, fontsize=10)
    return style.show_or_save(figure, path)


def draw_bars(axes: Axes, table: pd.DataFrame, columns: Mapping[str, str]) -> None:
    """Draw the bars of `plot_bars` into `axes`, the first row on top."""
    height = 0.76 / len(columns)
    position = np.arange(len(table))
    for j, (column, name) in enumerate(columns.items()):
        values = table[column].to_numpy(float)
        low, high = (
            table[end if end in table else f"{column}_{end}"].to_numpy(float)
            for end in ("low", "high")
        )
        # An interval of resampled values need not contain the value itself.
        reach = np.nan_to_num([np.maximum(values - low, 0), np.maximum(high - values, 0)])
        axes.barh(
            position + (j - (len(columns) - 1) / 2) * height,
            np.nan_to_num(values),
            height * 0.92,
            color=SECOND if column in ("first", "rho") else style.FAILING,
            label=name,
            xerr=reach,
            error_kw={"ecolor": style.BOUND, "elinewidth": 1, "capsize": 2},
        )
    axes.set_yticks(position, [style.wrap_name(str(name)) for name in table.index])
    axes.invert_yaxis()
    axes.axvline(0, color=style.BOUND, linewidth=0.8)
    style.tidy(axes)
    axes.grid(visible=False, axis="y")
    if any(columns.values()):
        axes.legend(frameon=False, fontsize=8, loc="lower right")


def plot_effects(table: pd.DataFrame, title: str, path: str | Path | None = None) -> Figure:
    """Draw the mean size of elementary effects against their standard deviation.

    **Arguments:**
    - `table`: the table from `analysis.morris`.
    """
    figure = style.new_figure(figsize=(5.6, 4.4))
    axes = figure.subplots()
    across, up = table["mu_star"].to_numpy(float), table["sigma"].to_numpy(float)
    maximum = 1.12 * max(np.max(across, initial=0), np.max(up, initial=0)) or 1.0
    axes.plot([0, maximum], [0, maximum], color=style.BOUND, linewidth=0.8, linestyle=":")
    axes.errorbar(
        across,
        up,
        xerr=[np.maximum(across - table["low"], 0), np.maximum(table["high"] - across, 0)],
        fmt="o",
        color=style.FAILING,
        ecolor=style.BOUND,
        elinewidth=0.8,
    )
    axes.set_xlim(0, maximum)
    axes.set_ylim(-0.03 * maximum, maximum)
    axes.set_xlabel("mean size of the effect on the robustness")
    axes.set_ylabel("standard deviation of the effect\n(interaction or curvature)")
    style.tidy(axes)
    figure.suptitle(title, fontsize=10)
    ends = (table[end].to_numpy(float) for end in ("low", "high"))
    name_points(axes, [str(name) for name in table.index], across, up, *ends)
    return style.show_or_save(figure, path)
