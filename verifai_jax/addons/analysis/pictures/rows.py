"""Rows among others, over the two features that vary most."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from verifai_jax.addons.analysis.data.samples import Samples
from verifai_jax.core.display.figure import Axes

DOTS = 3000
"""Rows drawn at most."""
# Colour-blind readers can distinguish the first eight (Okabe and Ito, 2008).
PALETTE = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#8c6d31", "#000000")
_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19)


def two_columns(samples: Samples) -> tuple[str, str]:
    """Return the two columns to draw over: ordered ones with the largest relative variation."""
    spread = samples.matrix().std(axis=0)
    ordered = [samples.ordered[j].name for j in np.argsort(-spread, kind="stable")]
    names = [*ordered, *(column.name for column in samples.unordered)]
    return pair(samples, names)


def pair(samples: Samples, names: Sequence[str]) -> tuple[str, str]:
    """Return the first two columns; a single column with the robustness, if there is any."""
    if len(names) > 1:
        return names[0], names[1]
    return names[0], "rho" if np.isfinite(samples.rho).any() else names[0]


def positions(samples: Samples, name: str, frame: pd.DataFrame) -> Float[np.ndarray, " n"]:
    """Return the positions of rows along a column; NaN for an absent entry."""
    index = {column.name: j for j, column in enumerate(samples.columns)}.get(name)
    if index is None or samples.columns[index].ordered:
        return frame[name].to_numpy(np.float64)
    codes = samples.columns[index].codes(frame[name])
    # Rows with the same choice lie side by side: shifted by row number, not at random.
    step = np.sqrt(_PRIMES[index % len(_PRIMES)])
    shift = 0.5 * (frame.index.to_numpy() * step % 1 - 0.5)
    return np.where(codes < 0, np.nan, codes + shift)


def draw_rows(
    axes: Axes, samples: Samples, rows: Int[np.ndarray, " k"], color: str, label: str,
    names: Sequence[str] | None = None,
) -> Float[np.ndarray, "drawn 2"]:  # fmt: skip
    """Draw all samples faintly and `rows` (numbers) as rings; return the positions of these."""
    across, up = names or two_columns(samples)
    everything = samples.frame.iloc[:: max(1, len(samples) // DOTS)]
    chosen = samples.at(rows[:DOTS])
    points = np.stack([positions(samples, name, chosen) for name in (across, up)], axis=1)
    axes.scatter(
        positions(samples, across, everything),
        positions(samples, up, everything),
        c="#b8b8b8",
        s=9,
        linewidths=0,
        alpha=0.7,
        label="others",
    )
    axes.scatter(*points.T, facecolors="none", edgecolors=color, s=36, label=label)
    name_axes(axes, samples, across, up)
    axes.legend(frameon=False, fontsize=8)
    return points


def name_axes(axes: Axes, samples: Samples, across: str, up: str) -> None:
    """Label the two axes, with the names of choices."""
    columns = {column.name: column for column in samples.columns}
    for name, axis in ((across, axes.xaxis), (up, axes.yaxis)):
        axis.set_label_text(name)
        if name in columns and not columns[name].ordered:
            choices = columns[name].choices
            axis.set_ticks(np.arange(len(choices)), [str(choice)[:20] for choice in choices])
        else:
            locator: Any = axis.get_major_locator()
            locator.set_params(nbins=5)
