"""The picture of a policy in two engines: the pair with the largest gap, and all gaps."""

from pathlib import Path

import numpy as np

from verifai_jax.addons.estimation.comparison.result import Transfer
from verifai_jax.core.display.figure import Figure
from verifai_jax.pictures.style import BOUND, FAILING, INPUT, SAFE, new_figure, show_or_save, tidy


def plot_transfer(result: Transfer, path: str | Path | None = None) -> Figure:
    """Draw the signal with the largest gap in both engines, and the gaps over a feature.

    **Arguments:**
    - `path`: the file to write; none when left out.
    """
    figure = new_figure(figsize=(8.4, 3.4))
    left, right = figure.subplots(1, 2)
    table = result.table[result.table["proper"]]
    if result.worst is None:
        left.text(0.5, 0.5, "no difference beyond rounding", ha="center", transform=left.transAxes)
        left.set_axis_off()
    else:
        row, *traces = result.worst
        name, _, entry = str(result.table.loc[row, "signal"]).partition("[")
        styles = zip(traces, result.names, (INPUT, FAILING), ("-", "--"), strict=True)
        for trace, label, color, style in styles:
            values = np.asarray(trace.signals[name], float)[: trace.valid]
            values = values if values.ndim == 1 else values[:, int(entry.rstrip("]"))]
            times = np.asarray(trace.clock())[: len(values)]
            left.plot(times, values, style, color=color, label=label)
        left.axvline(result.table.loc[row, "parted"], color=BOUND, lw=0.8, ls=":")
        left.set_xlabel("time [s]")
        left.set_ylabel(result.table.loc[row, "signal"])
        left.set_title(f"row {row}: they part at the dotted line", fontsize="medium")
        left.legend()
    feature = next((n for n in result.influence if n in table), next(iter(result.space.columns)))
    turned = table.index.isin(result.flips.index)
    groups = ((~turned, SAFE, "same verdict"), (turned, FAILING, "only one fails"))
    for chosen, color, label in groups:
        rows = table[chosen]
        if len(rows):
            gaps = np.maximum(rows["gap"], 1e-12)
            right.scatter(rows[feature], gaps, s=8, c=color, label=f"{len(rows):,} {label}")
    right.set_yscale("log")
    right.set_xlabel(feature)
    right.set_ylabel("gap [ranges of a signal]")
    right.legend()
    for axes in (left, right):
        tidy(axes)
    return show_or_save(figure, path)
