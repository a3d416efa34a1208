"""How a search went: the robustness of each simulation in the order they were made."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.plotting.style import BOUND, FAILING, SAFE, new_figure, show_or_save, tidy

if TYPE_CHECKING:
    from verifai_jax.falsification.run import Run

DOTS = 4000  # More dots than this are thinned out; the lines are exact.


def plot_budget(
    run: "Run | dict[str, Run]", path: str | Path | None = None, axes: Any = None
) -> Any:
    """Draw robustness over simulations with the running minimum; several runs share the axes.

    - `run`: a run, or runs by the label that the legend gives them.

    Returns the figure.
    """
    runs = run if isinstance(run, dict) else {"": run}
    figure = axes.figure if axes is not None else new_figure(figsize=(7.5, 4))
    axes = figure.subplots() if axes is None else axes
    if len(runs) == 1:
        _one(axes, next(iter(runs.values())))
    else:
        for label, each in runs.items():
            rho = _robustness(each)
            number = np.arange(1, len(rho) + 1)
            failing = _failing(each)
            first = f"first failure: {failing[0] + 1:,}" if len(failing) else "no failure"
            best = np.fmin.accumulate(rho)
            (line,) = axes.plot(number, best, label=f"{label}  ({first})", linewidth=1.8)
            if len(failing):
                axes.plot(failing[0] + 1, rho[failing[0]], "o", color=line.get_color())
        axes.set_xscale("log")
        axes.legend(frameon=False)
    axes.axhline(0, color=BOUND, linewidth=1, linestyle="--")
    axes.set_xlabel("simulations")
    axes.set_ylabel("robustness (negative: violated)")
    tidy(axes)
    return show_or_save(figure, path)


def _one(axes: Any, run: "Run") -> None:
    rho = _robustness(run)
    number = np.arange(1, len(rho) + 1)
    shown = np.unique(np.linspace(0, len(rho) - 1, DOTS).astype(int))
    # The counterexamples are what one looks for: they are never thinned out.
    failing = _failing(run)
    shown = np.union1d(shown, failing[:DOTS])
    colors = np.where(np.isin(shown, failing), FAILING, SAFE)
    axes.scatter(number[shown], rho[shown], c=colors, s=5, alpha=0.5, linewidths=0)
    axes.plot(number, np.fmin.accumulate(rho), color=BOUND, linewidth=1.6, label="best so far")
    _mark_first(axes, rho, failing)
    axes.set_title(f"{run.name}: {len(failing):,} of {len(rho):,} simulations violate the property")
    axes.legend(frameon=False, loc="upper right")


def _mark_first(axes: Any, rho: np.ndarray, failing: np.ndarray) -> None:
    if len(failing):
        first = failing[0]
        axes.annotate(
            f"first counterexample: simulation {first + 1:,}",
            (first + 1, rho[first]),
            textcoords="offset points",
            xytext=(24, 48),
            fontsize=8,
            color=FAILING,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5},
            arrowprops={"arrowstyle": "-", "color": FAILING, "linewidth": 0.8},
        )


def _robustness(run: "Run") -> np.ndarray:
    return run.table.all["rho"].to_numpy(float)


def _failing(run: "Run") -> np.ndarray:
    """Row numbers of the counterexamples."""
    return run.table.counterexamples.index.to_numpy()
