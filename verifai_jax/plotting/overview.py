"""The overview of a run as one picture."""

from pathlib import Path

import numpy as np

from verifai_jax.analysis.overview import Analysis
from verifai_jax.core.figure import Axes, Figure
from verifai_jax.core.text import format_percent
from verifai_jax.plotting.bars import draw_bars
from verifai_jax.plotting.panels import cells, draw_rule, draw_samples, two_features
from verifai_jax.plotting.style import BOUND, new_figure, show_or_save

MAX_BARS = 10
MAX_MARKED = 6
MAX_RULES = 2


def plot_overview(analysis: Analysis, path: str | Path | None = None) -> Figure:
    """Draw failures over the two most important features, and the importances as bars.

    **Arguments:**

    - `analysis`: what `analysis.analyze` returned.
    - `path`: file that the picture is written to, if given.

    **Returns:** the figure.
    """
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
