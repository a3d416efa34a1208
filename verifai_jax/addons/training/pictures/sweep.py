"""The picture of a sweep: return against safety, learning curves, importance."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from verifai_jax.addons.estimation.simultaneous_interval import verdict_kind
from verifai_jax.addons.training.sweeps.importance import HyperparameterImportance
from verifai_jax.addons.training.sweeps.ranking import (
    full_return_threshold,
    is_safe,
    last_checkpoints,
    preference_order,
)
from verifai_jax.addons.training.sweeps.result import Sweep
from verifai_jax.addons.training.sweeps.summary import format_failures
from verifai_jax.core.messages.text import format_percent, shorten
from verifai_jax.pictures import style

if TYPE_CHECKING:
    import pandas as pd
LOOKS = {
    "safe": (style.SAFE, "o"), "undecided": (style.WITHOUT_VERDICT, "D"),
    "unsafe": (style.FAILING, "X"),
}  # fmt: skip
"""Colour and marker of each verdict."""
RETURN = "#31688e"
"""Colour of the return."""
BARS = {"failure_rate": (style.FAILING, "failing", ""), "nominal_return": (RETURN, "return", "//")}
"""Colour, name and hatching of the targets of an importance."""
MAX_BARS = 8
"""Hyper-parameters in a panel, at most."""


def plot_sweep(sweep: Sweep, path: str | Path | None = None) -> Figure:
    """Draw safety, learning curves and importance, as far as available."""
    curves = _curve_rows(sweep)
    importance = sweep.importance()
    bars = bool(importance.scores)
    widths = [1.5] + [1.0] * bool(curves) + [0.95] * bars
    figure = style.new_figure(figsize=(4.2 * sum(widths) - 0.8 * (len(widths) == 3), 4.9))
    panels = list(np.ravel(figure.subplots(1, len(widths), width_ratios=widths)))
    _draw_safety(panels.pop(0), sweep)
    if curves:
        _draw_curves(panels.pop(0), sweep, curves)
    if bars:
        _draw_importance(panels.pop(0), importance)
    title = f"{shorten(sweep.name, 40)}: {sweep.headline}"
    if len(title) > 10 * figure.get_figwidth():
        title = title.replace("; ", "\n", 1)
    figure.suptitle(title, fontsize=11)
    return style.show_or_save(figure, path)


def plot_importance(importance: HyperparameterImportance, path: str | Path | None = None) -> Figure:
    """Draw the shares of the variance, or the trends if no model is reliable."""
    figure = style.new_figure(figsize=(6.4, 1.6 + 0.42 * len(importance.table)))
    _draw_importance(figure.subplots(), importance)
    return style.show_or_save(figure, path)


def _draw_importance(axes: Axes, importance: HyperparameterImportance) -> None:
    reliable = any(importance.is_reliable(target) for target in importance.scores)
    (_draw_shares if reliable else _draw_trends)(axes, importance)


def _draw_safety(axes: Axes, sweep: Sweep) -> None:
    """Draw each policy by its nominal return and its failure probability, with the interval."""
    table = sweep.table.iloc[preference_order(sweep.table)]
    table = table.loc[np.isfinite(table["nominal_return"].to_numpy(np.float64))]
    if not len(table):
        said = "no policy has a certificate and a return"
        axes.text(0.5, 0.5, said, ha="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    crowded = len(table) > 60
    lowest = _lowest_shown(table, sweep.p)
    shown = _spread(table, lowest)
    final = shown.index.isin(last_checkpoints(sweep.table).index)
    for verdict, (colour, marker) in LOOKS.items():
        of_kind = is_safe(table) if verdict == "safe" else (table["verdict"] == verdict).to_numpy()
        for rows, weight in ((shown.loc[of_kind & ~final], 0.3), (shown.loc[of_kind & final], 1.0)):
            if not len(rows):
                continue
            when = "" if weight == 1.0 else ", earlier checkpoint"
            if weight == 1.0:
                _draw_intervals(axes, rows, colour, 0.35 if crowded else 0.6)
            axes.scatter(
                rows["nominal_return"], rows["failure_rate"], c=colour, marker=marker,
                s=26 if crowded else 42, alpha=weight, edgecolors="white", linewidths=0.6,
                label=f"{verdict}{when} ({len(rows)})", zorder=2 + weight,
            )  # fmt: skip
    front = shown.loc[shown.index.isin(sweep.pareto().index)].sort_values("nominal_return")
    axes.scatter(
        front["nominal_return"], front["failure_rate"], facecolors="none", edgecolors=style.BOUND,
        s=110 if crowded else 130, linewidths=1.1, label=f"Pareto front ({len(front)})", zorder=4,
    )  # fmt: skip
    # Linear up to the least rate, so that none at all has a place; logarithmic from there on.
    axes.set_yscale("symlog", linthresh=lowest, linscale=0.6)
    axes.set_ylim(-0.25 * lowest, 1.6)
    ticks = [0.0, *(10.0**k for k in range(-6, 1) if 10.0**k >= lowest * 0.999)]
    axes.set_yticks(ticks, [format_percent(tick) for tick in ticks])
    axes.set_yticks([], minor=True)
    if sweep.p is not None:
        label = f"wanted: below {format_percent(sweep.p)}"
        axes.axhline(
            sweep.p, color=style.BOUND, linewidth=0.9, linestyle="--", zorder=0, label=label
        )
    axes.set_xlabel("nominal return of the policy")
    axes.set_ylabel("failure probability")
    axes.set_title("Return is not safety", fontsize=10)
    style.tidy(axes)
    _legend_below(axes, 3)


def _draw_intervals(axes: Axes, rows: "pd.DataFrame", colour: str, alpha: float) -> None:
    rate = rows["failure_rate"]
    axes.errorbar(
        rows["nominal_return"], rate,
        yerr=[rate - rows["failure_low"], rows["failure_high"] - rate], fmt="none", ecolor=colour,
        elinewidth=0.9, alpha=alpha, zorder=1,
    )  # fmt: skip


def _legend_below(axes: Axes, columns: int) -> None:
    """Put the legend below the panel, where it hides nothing."""
    axes.legend(
        frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=columns,
        columnspacing=1.0, handletextpad=0.4,
    )  # fmt: skip


def _lowest_shown(table: "pd.DataFrame", wanted: float | None) -> float:
    """Return the power of ten below which the axis is linear, less than every positive rate."""
    rates = table["failure_rate"].to_numpy(np.float64)
    lowest = min([*rates[rates > 0], 0.01 if wanted is None else wanted])
    return float(10.0 ** np.floor(np.log10(lowest)))


def _spread(table: "pd.DataFrame", lowest: float) -> "pd.DataFrame":
    """Shift points that would hide each other a little to the side."""
    shown = table.copy()
    shown["nominal_return"] = shown["nominal_return"].astype(float)
    span = float(np.ptp(shown["nominal_return"])) or 1.0
    cell = list(zip(
        np.round(shown["nominal_return"] / span * 60),
        np.round(np.log10(np.maximum(shown["failure_rate"].to_numpy(float), lowest / 3)) * 8),
        strict=True,
    ))  # fmt: skip
    counts: dict[tuple[float, float], int] = {}
    for i, index in zip(shown.index, cell, strict=True):
        turn = counts.get(index, 0)
        counts[index] = turn + 1
        side = (turn + 1) // 2 * (-1 if turn % 2 else 1)
        shown.loc[i, "nominal_return"] += np.clip(side, -4, 4) * span / 200
    return shown


def _curve_rows(sweep: Sweep) -> list[int]:
    """Choose the best row, and a policy with a high return that is unsafe, if there is one."""
    table = sweep.table
    if not len(order := preference_order(table)):
        return []
    rows = [int(table.index[order[0]])]
    others = last_checkpoints(table)
    others = others.loc[~_same_training(others, table.loc[rows[0]].to_dict())]
    unsafe = others.loc[others["verdict"] == "unsafe"]
    unsafe = unsafe.loc[unsafe["nominal_return"] >= full_return_threshold(table)]
    if len(unsafe):
        rows.append(int(unsafe["failure_rate"].idxmax()))  # pyright: ignore[reportArgumentType]
    return [row for row in rows if np.isfinite(sweep.curve_points(row)[1]).any()]


def _same_training(table: "pd.DataFrame", row: Mapping[str, Any]) -> Bool[np.ndarray, " rows"]:
    """Return True for the checkpoints of the training of a row."""
    same = (table["configuration"] == row["configuration"]) & (table["seed"] == row["seed"])
    return np.asarray(same)


def _draw_curves(axes: Axes, sweep: Sweep, rows: list[int]) -> None:
    """Draw the learning curves of the whole trainings of some rows, over environment steps."""
    last = last_checkpoints(sweep.table)
    used: set[str] = set()
    for row in rows:
        entry: Any = sweep.table.loc[row].to_dict()
        verdict = str(entry["verdict"])
        colour, marker = LOOKS[verdict_kind(verdict) or "undecided"]
        # Of two with one verdict the second has a colour and a line of its own.
        again = colour in used
        colour, marker = (RETURN, "s") if again else (colour, marker)
        used.add(colour)
        end = int(last.index[_same_training(last, entry)][0])
        trace, steps = sweep.curve(end), int(entry["steps"])
        clock, values = np.asarray(trace.clock()), np.asarray(trace["return"])
        axes.plot(
            clock / 1000, values, color=colour, marker=marker, markevery=max(1, len(clock) // 8),
            markersize=4, linewidth=1.5, linestyle="--" if again else "-",
            label=f"row {row}, {verdict}: {_failures(entry)}",
        )  # fmt: skip
        if end != row:
            at = min(int(np.searchsorted(clock, steps)), len(clock) - 1)
            axes.plot(
                clock[at] / 1000, values[at], color=colour, marker="*", markersize=12,
                markeredgecolor=style.BOUND, linestyle="none",
                label=f"row {row}: checkpoint at {steps:,} steps",
            )  # fmt: skip
    axes.set_xlabel("environment steps in thousands")
    axes.set_ylabel("mean return of training episodes")
    axes.set_title("Learning curves", fontsize=10)
    style.tidy(axes)
    _legend_below(axes, 1)


def _failures(row: Mapping[str, Any]) -> str:
    if row["simulations"] > 0:
        return format_failures(row)
    return f"fails in {format_percent(row['failure_rate'])}"


def _draw_shares(axes: Axes, importance: HyperparameterImportance) -> None:
    """Draw the share of the variance that each hyper-parameter explains."""
    targets = [target for target in importance.scores if importance.is_reliable(target)]
    targets, shown = targets or list(importance.scores), importance.table.head(MAX_BARS)
    for target, at, height in _draw_bars(axes, shown, targets, "total", importance.scores):
        alone = shown[f"{target}_first"].to_numpy(float)
        axes.vlines(
            alone, at - 0.45 * height, at + 0.45 * height, color=style.BOUND, linewidth=1.6,
            label="without interactions" if target == targets[-1] else "",
        )  # fmt: skip
    axes.set_xlim(0, 1.02)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1], ["0", "25 %", "50 %", "75 %", "100 %"])
    axes.set_xlabel("share of the variance, with interactions")
    axes.set_title("Importance", fontsize=10)
    _legend_below(axes, 1)


def _draw_trends(axes: Axes, importance: HyperparameterImportance) -> None:
    """Draw rank correlations of single hyper-parameters, and their range by chance."""
    names = [f"{target}_trend" for target in importance.scores]
    shown = importance.table.loc[importance.table[names].notna().any(axis=1)]
    order = shown[names].abs().max(axis=1).sort_values(ascending=False, kind="stable").index
    chance = max(importance.chance.values())
    axes.axvspan(
        -chance, chance, color=style.WITHOUT_VERDICT, alpha=0.18, linewidth=0, label="by chance"
    )
    _draw_bars(axes, shown.loc[order[:MAX_BARS]], list(importance.scores), "trend", {})
    axes.axvline(0, color=style.BOUND, linewidth=0.8)
    axes.set_xlim(-1, 1)
    axes.set_xlabel("rank correlation with each alone")
    axes.set_title("Correlations (no model predicts)", fontsize=10)
    _legend_below(axes, 3)


def _draw_bars(
    axes: Axes, shown: "pd.DataFrame", targets: list[str], column: str, scores: Mapping[str, float]
) -> list[tuple[str, Float[np.ndarray, " rows"], float]]:
    """Draw a bar for each hyper-parameter and target; return each target's places and height."""
    height, position, drawn = 0.76 / len(targets), np.arange(len(shown)), []
    for k, target in enumerate(targets):
        colour, what, hatch = BARS[target]
        label = f"{what} (model: R² {scores[target]:z.2f})" if scores else what
        at, widths = position + (k - (len(targets) - 1) / 2) * height, shown[f"{target}_{column}"]
        axes.barh(
            at, widths.to_numpy(float), height * 0.9, color=colour, hatch=hatch, edgecolor="white",
            linewidth=0, label=label,
        )  # fmt: skip
        drawn.append((target, at, height))
    axes.set_yticks(position, [style.wrap_name(str(name), 18) for name in shown.index])
    axes.invert_yaxis()
    style.tidy(axes)
    axes.grid(visible=False, axis="y")
    return drawn
