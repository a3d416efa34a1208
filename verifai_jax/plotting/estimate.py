"""Pictures of an estimate: how the levels led to the failures, and how even the weights are."""

from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.plotting.style import BOUND, FAILING, SAFE, new_figure, tidy

if TYPE_CHECKING:
    from verifai_jax.estimation.result import Estimate


def draw(found: "Estimate") -> Any:
    """The figure: the interval, the levels and the weights, as far as there are any."""
    levels = found.diagnostics.get("levels") or []
    weights = found.drawn.get("weights")
    panels = 1 + bool(levels) + (weights is not None and len(weights) > 0)
    figure = new_figure(figsize=(4.2 * panels, 3.4))
    axes = list(np.atleast_1d(figure.subplots(1, panels)))
    _interval(axes.pop(0), found)
    if levels:
        _levels(axes.pop(0), levels, found.diagnostics["fractions"])
    if axes:
        assert weights is not None
        _weights(axes.pop(0), weights)
    return figure


def _interval(axes: Any, found: "Estimate") -> None:
    sure = f"{100 * found.confidence:g} %"
    rows: list[Any] = [("bound by the prior alone", None, 0.0, found.upper_bound, BOUND)]
    if found.probability is not None:
        rows.append(("estimate", found.probability, found.low, found.high, FAILING))
    least = min([found.upper_bound, *(low for *_, low, _, _ in rows if low > 0)]) / 5
    for place, (_, value, low, high, color) in enumerate(rows):
        axes.plot([max(low, least), high], [place, place], color=color, linewidth=4, alpha=0.6)
        if value is not None:
            axes.plot(value, place, "o", color=color)
        else:
            axes.plot(high, place, "|", color=color, markersize=14)
    axes.set_xscale("log")
    axes.set_xlim(least, min(1.5, found.upper_bound * 4))
    axes.set_yticks(range(len(rows)), [row[0] for row in rows])
    axes.set_ylim(-0.8, len(rows) - 0.2)
    axes.set_xlabel(f"failure probability ({sure})")
    tidy(axes)


def _levels(axes: Any, levels: list[float], fractions: list[float]) -> None:
    reached = np.cumprod(fractions)
    shown = [max(level, 0.0) for level in levels]
    axes.plot([*shown], reached, "o-", color=SAFE)
    if levels[-1] == -np.inf:
        axes.plot(0.0, reached[-1], "o", color=FAILING, markersize=9)
        axes.annotate(
            "failures", (0.0, reached[-1]), textcoords="offset points", xytext=(10, -3), fontsize=9
        )
    if max(shown) > 50 * (np.median([s for s in shown if s > 0] or [1.0])):
        axes.set_xscale("symlog", linthresh=max(min([s for s in shown if s > 0]), 1e-3))
    axes.set_yscale("log")
    axes.set_xlabel("robustness at most")
    axes.set_ylabel("probability, by splitting")
    tidy(axes)


def _weights(axes: Any, weights: np.ndarray) -> None:
    axes.plot(np.arange(1, len(weights) + 1), 100 * np.cumsum(weights), color=FAILING)
    even = np.array([1, len(weights)])
    axes.plot(even, 100 * even / len(weights), color=BOUND, linestyle="--", linewidth=1)
    axes.set_xlabel("failures, the heaviest first")
    axes.set_ylabel("% of the estimate (dashed: all alike)")
    tidy(axes)
