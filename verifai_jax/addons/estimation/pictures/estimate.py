"""The picture of an estimate: its interval, the splitting levels, and the importance weights."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from verifai_jax.addons.estimation.result import Estimate
from verifai_jax.core.messages.text import format_percent
from verifai_jax.pictures import style


def plot_estimate(estimate: Estimate, path: str | Path | None = None) -> Figure:
    """Draw the interval, the splitting levels and the weights of an estimate.

    **Arguments:**
    - `estimate`: the estimate; levels and weights are drawn if it has them.
    """
    levels = estimate.diagnostics.get("levels") or []
    weights = estimate.drawn.get("weights")
    panels = 1 + bool(levels) + (weights is not None and len(weights) > 0)
    figure = style.new_figure(figsize=(4.2 * panels, 3.4))
    axes = list(np.atleast_1d(figure.subplots(1, panels)))
    _draw_interval(axes.pop(0), estimate)
    if levels:
        _draw_levels(axes.pop(0), levels, estimate.diagnostics["fractions"])
    if axes:
        assert weights is not None
        _draw_weights(axes.pop(0), weights)
    return style.show_or_save(figure, path)


def _draw_interval(axes: Axes, estimate: Estimate) -> None:
    sure = format_percent(estimate.confidence)
    rows: list[Any] = [("bound by the prior alone", None, 0.0, estimate.upper_bound, style.BOUND)]
    if estimate.probability is not None:
        rows.append(("estimate", estimate.probability, estimate.low, estimate.high, style.FAILING))
    lowest = min([estimate.upper_bound, *(low for *_, low, _, _ in rows if low > 0)]) / 5
    for height, (_, value, low, high, color) in enumerate(rows):
        axes.plot([max(low, lowest), high], [height, height], color=color, linewidth=4, alpha=0.6)
        if value is not None:
            axes.plot(value, height, "o", color=color)
        else:
            axes.plot(high, height, "|", color=color, markersize=14)
    axes.set_xscale("log")
    axes.set_xlim(lowest, min(1.5, estimate.upper_bound * 4))
    log_ticks(axes.xaxis)
    axes.set_yticks(range(len(rows)), [style.wrap_name(row[0], 14) for row in rows])
    axes.set_ylim(-0.8, len(rows) - 0.2)
    axes.set_xlabel(f"failure probability ({sure})")
    style.tidy(axes)


def _draw_levels(axes: Axes, levels: list[float], fractions: list[float]) -> None:
    reached = np.cumprod(fractions)
    shown = [max(level, 0.0) for level in levels]
    axes.plot([*shown], reached, "o-", color=style.SAFE)
    if levels[-1] == -np.inf:
        axes.plot(0.0, reached[-1], "o", color=style.FAILING, markersize=9)
        axes.annotate(
            "failures", (0.0, reached[-1]), textcoords="offset points", xytext=(10, -3), fontsize=9
        )
    if max(shown) > 50 * (np.median([s for s in shown if s > 0] or [1.0])):
        axes.set_xscale("symlog", linthresh=max(min([s for s in shown if s > 0]), 1e-3))
    axes.set_yscale("log")
    log_ticks(axes.yaxis)
    axes.set_xlabel("robustness at most")
    axes.set_ylabel("probability, by splitting")
    style.tidy(axes)


def _draw_weights(axes: Axes, weights: Float[np.ndarray, " n"]) -> None:
    axes.plot(np.arange(1, len(weights) + 1), 100 * np.cumsum(weights), color=style.FAILING)
    even = np.array([1, len(weights)])
    axes.plot(even, 100 * even / len(weights), color=style.BOUND, linestyle="--", linewidth=1)
    axes.set_xlabel("failures, the heaviest first")
    axes.set_ylabel("% of the estimate (dashed: all alike)")
    style.tidy(axes)


def log_ticks(axis: Axis) -> None:
    """Label a few numbers on a logarithmic axis: powers of ten, or round numbers."""
    low, high = axis.get_view_interval()
    locator: Any = LogLocator(subs=(1.0, 2.0, 5.0) if high / low < 100 else (1.0,), numticks=6)
    if high / low < 5:  # Powers of ten, twice and five times these, are one at most.
        locator = MaxNLocator(4)
        axis.set_minor_locator(NullLocator())
    axis.set_major_locator(locator)
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:zg}"))
    axis.set_minor_formatter(NullFormatter())
