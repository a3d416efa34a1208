"""Rows among others, over the two features that vary most."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from verifai_jax.analysis.samples import Samples

DOTS = 3000
# The first eight are told apart by colour-blind readers (Okabe and Ito, 2008).
PALETTE = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#cc79a7",
    "#56b4e9",
    "#8c6d31",
    "#000000",
)


def two_columns(samples: Samples) -> tuple[str, str]:
    """The two columns over which to draw: ordered ones that vary most relative to their range."""
    spread = samples.matrix().std(axis=0)
    ordered = [samples.ordered[j].name for j in np.argsort(-spread, kind="stable")]
    names = [*ordered, *(column.name for column in samples.unordered)]
    return names[0], names[min(1, len(names) - 1)]


def positions(samples: Samples, name: str, frame: Any) -> np.ndarray:
    """Where rows are drawn along a column; a choice by its place, an absent entry nowhere."""
    column = next(column for column in samples.columns if column.name == name)
    if column.ordered:
        return frame[name].to_numpy(np.float64)
    codes = column.codes(frame[name])
    # Rows with the same choice side by side: a fixed shift, not a random one.
    shift = 0.5 * ((np.arange(len(codes)) * 0.618034) % 1 - 0.5)
    return np.where(codes < 0, np.nan, codes + shift)


def draw_rows(
    axes: Any,
    samples: Samples,
    rows: np.ndarray,
    color: str,
    label: str,
    names: Sequence[str] | None = None,
) -> None:
    """Draw all samples faintly and `rows` (numbers) as rings."""
    across, up = names or two_columns(samples)
    everything = samples.frame.iloc[:: max(1, len(samples) // DOTS)]
    for frame, options in (
        (everything, {"c": "#b8b8b8", "s": 9, "linewidths": 0, "alpha": 0.7, "label": "others"}),
        (
            samples.at(rows[:DOTS]),
            {"facecolors": "none", "edgecolors": color, "s": 36, "label": label},
        ),
    ):
        axes.scatter(positions(samples, across, frame), positions(samples, up, frame), **options)
    name_axes(axes, samples, across, up)
    axes.legend(frameon=False, fontsize=8)


def name_axes(axes: Any, samples: Samples, across: str, up: str) -> None:
    """Label the two axes; choices by their names."""
    columns = {column.name: column for column in samples.columns}
    for name, axis in ((across, axes.xaxis), (up, axes.yaxis)):
        axis.set_label_text(name)
        if not columns[name].ordered:
            choices = columns[name].choices
            axis.set_ticks(np.arange(len(choices)), [str(choice)[:20] for choice in choices])
