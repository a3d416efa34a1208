"""Frequent patterns as bars next to the shares expected."""

from pathlib import Path
from typing import Any

import numpy as np

from verifai_jax.addons.analysis._frequent_patterns import FrequentPatterns
from verifai_jax.core.display.figure import Figure
from verifai_jax.core.messages.text import shorten
from verifai_jax.pictures.style import BOUND, FAILING, SAFE, new_figure, show_or_save, tidy

BARS = 16
"""Patterns drawn at most."""


def plot_frequent_patterns(patterns: FrequentPatterns, path: str | Path | None = None) -> Figure:
    """Draw the shares of the patterns with the greatest lift, and their expected shares."""
    compared = patterns.against != "nothing"
    shown = patterns.distinctive.head(BARS).sort_values("share", ascending=False, kind="stable")
    longest = max((len(text) for text in shown["combination"]), default=0)
    figure = new_figure(figsize=(5.2 + 0.055 * min(longest, 60), 1.5 + 0.34 * max(2, len(shown))))
    axes = figure.subplots()
    position = np.arange(len(shown))
    color = SAFE if patterns.samples.which == "safe" else FAILING
    axes.barh(position, shown["share"], 0.66, color=color, label="share of the rows looked at")
    if compared:
        axes.plot(
            shown["expected"],
            position,
            linestyle="",
            marker="|",
            markersize=13,
            markeredgewidth=2.2,
            color=BOUND,
            label="of all rows" if patterns.against == "table" else "in the prior",
        )
        rows: Any = shown.itertuples()
        for y, row in zip(position, rows, strict=True):
            if np.isfinite(row.lift):
                right = max(row.share, row.expected)
                axes.text(right + 0.015, float(y), f"{row.lift:z.2f}x", va="center", fontsize=8)
    axes.set_yticks(position, [shorten(text) for text in shown["combination"]])
    axes.invert_yaxis()
    axes.set_xlim(0, min(1.1, 1.15 * max(shown[["share", "expected"]].max().max(), 0.05)))
    axes.set_xlabel("share")
    tidy(axes)
    axes.grid(visible=False, axis="y")
    figure.legend(frameon=False, fontsize=8, loc="outside lower center", ncols=2)
    figure.suptitle(f"Frequent patterns, {patterns.samples.kind}", fontsize=10)
    return show_or_save(figure, path)
