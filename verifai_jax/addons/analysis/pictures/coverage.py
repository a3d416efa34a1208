"""Coverage as a picture: the share of cells with samples, and the pair of features with holes."""

from pathlib import Path

import numpy as np

from verifai_jax.addons.analysis._coverage import Coverage
from verifai_jax.addons.analysis.pictures.panels import draw_samples, two_features
from verifai_jax.core.display.figure import Figure
from verifai_jax.pictures import style

MAX_SHOWN = 12
"""Features drawn, the least covered first."""


def plot_coverage(coverage: Coverage, path: str | Path | None = None) -> Figure:
    """Draw the share of cells occupied, and samples with the largest hole."""
    samples = coverage.samples
    worst = coverage.table.sort_values("occupied", kind="stable")
    figure = style.new_figure(figsize=(9.6, 4.2))
    left, right = figure.subplots(1, 2)
    shown = worst.head(MAX_SHOWN)
    position = np.arange(len(shown))
    several = len(coverage.table) > 1
    for k, (column, label, color) in enumerate(
        [("occupied", "its cells", style.SAFE), ("pairs", "pairs of cells with others", "#8d99ae")]
    ):
        if column == "pairs" and not several:
            continue
        at = position + (0.38 * k - 0.19) * several
        left.barh(at, np.nan_to_num(shown[column]), 0.34, color=color, label=label)
        expected = shown["expected_pairs" if k else "expected"]
        left.plot(expected, at, "|", color=style.BOUND, markersize=10, markeredgewidth=1.5)
    left.plot([], [], "|", color=style.BOUND, label="of as many uniform samples")
    left.set_yticks(position, [style.wrap_name(str(name)) for name in shown.index])
    left.invert_yaxis()
    left.set_xlim(0, 1.02)
    left.set_xlabel("share occupied")
    style.tidy(left)
    left.grid(visible=False, axis="y")
    left.legend(frameon=False, fontsize=7, loc="upper center", bbox_to_anchor=(0.5, 1.14), ncols=3)
    ordered = [column.name for column in samples.ordered]
    across, up = two_features(samples, [name for name in worst.index if name in ordered])
    draw_samples(right, samples, across, up, size=6)
    if (
        coverage.hole is not None
        and across in coverage.hole
        and (up in coverage.hole or across == up)
    ):
        y = coverage.hole[up] if across != up else float(np.nanmean(right.get_ylim()))
        right.plot(
            coverage.hole[across], y, "X", color=style.FAILING, markeredgecolor="white", ms=12
        )
        right.set_title("cross: middle of the largest hole", fontsize=8)
    figure.suptitle(str(coverage).splitlines()[0][:160], fontsize=9, wrap=True)
    return style.show_or_save(figure, path)
