"""The course of a search: the robustness of each simulation, in order."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.core.display.figure import Axes, Figure
from verifai_jax.falsification.run import Run
from verifai_jax.pictures import style

DOTS = 4000
"""Simulations drawn as dots at most; the lines are exact."""


def plot_robustness_history(
    run: Run | Mapping[str, Run], path: str | Path | None = None, axes: Axes | None = None
) -> Figure:
    """Draw robustness over simulations with the running minimum; several runs share the axes.

    **Arguments:**
    - `run`: a run, or a dictionary of runs by their label in the legend.
    - `axes`: axes to draw into; a new figure when left out.
    """
    runs = {"": run} if isinstance(run, Run) else run
    given: Any = axes
    figure = style.new_figure(figsize=(7.5, 4)) if given is None else given.figure
    panel = figure.subplots() if given is None else given
    if len(runs) == 1:
        _one(panel, next(iter(runs.values())))
    else:
        for label, each in runs.items():
            rho = _robustness(each)
            number = np.arange(1, len(rho) + 1)
            failing = _failing(each)
            first = f"first failure: {failing[0] + 1:,}" if len(failing) else "no failure"
            best = np.fmin.accumulate(rho)
            (line,) = panel.plot(number, best, label=f"{label}  ({first})", linewidth=1.8)
            if len(failing):
                panel.plot(failing[0] + 1, rho[failing[0]], "o", color=line.get_color())
        panel.set_xscale("log")
        panel.legend(frameon=False)
    panel.axhline(0, color=style.BOUND, linewidth=1, linestyle="--")
    panel.set_xlabel("simulations")
    panel.set_ylabel("robustness (negative: violated)")
    style.tidy(panel)
    return style.show_or_save(figure, path)


def _one(axes: Axes, run: Run) -> None:
    rho = _robustness(run)
    number = np.arange(1, len(rho) + 1)
    shown = np.unique(np.linspace(0, len(rho) - 1, DOTS).astype(int))
    # The counterexamples are what one looks for: they are never thinned out.
    failing = _failing(run)
    shown = np.union1d(shown, failing[:DOTS])
    colors = np.where(np.isin(shown, failing), style.FAILING, style.SAFE)
    axes.scatter(number[shown], rho[shown], c=colors, s=5, alpha=0.5, linewidths=0)
    axes.plot(
        number, np.fmin.accumulate(rho), color=style.BOUND, linewidth=1.6, label="best so far"
    )
    if len(failing):
        first = failing[0]
        axes.annotate(
            f"first counterexample: simulation {first + 1:,}",
            (first + 1, rho[first]),
            textcoords="offset points",
            xytext=(24, 48),
            fontsize=8,
            color=style.FAILING,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5},
            arrowprops={"arrowstyle": "-", "color": style.FAILING, "linewidth": 0.8},
        )
    doubtful = run.table.unconfirmed.index.to_numpy()
    violating = len(run.table.violating)
    title = f"{run.name}: {violating:,} of {len(rho):,} simulations violate the property"
    if len(doubtful):
        axes.scatter(
            number[doubtful[:DOTS]], rho[doubtful[:DOTS]], c=style.NOT_CLAIMED, s=12, marker="^",
            linewidths=0, label=f"{len(doubtful):,} not claimed",
        )  # fmt: skip
    axes.set_title(title)
    axes.legend(frameon=False, loc="upper right")


def _robustness(run: Run) -> Float[np.ndarray, " n"]:
    return run.table.all["rho"].to_numpy(float)


def _failing(run: Run) -> Int[np.ndarray, " k"]:
    """Return the row numbers of the counterexamples."""
    return run.table.counterexamples.index.to_numpy()
