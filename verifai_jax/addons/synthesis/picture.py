"""The worst robustness that each attack of a repair found."""

from pathlib import Path
from typing import Any

from verifai_jax.addons.synthesis.results import Repair
from verifai_jax.core.display.figure import Figure
from verifai_jax.pictures.style import BOUND, FAILING, SAFE, new_figure, show_or_save, tidy


def plot_repair(repair: Repair, path: str | Path | None = None) -> Figure:
    """Draw the worst robustness found by the attack of each round."""
    figure = new_figure(figsize=(5.0, 3.0))
    axes = figure.subplots()
    worst = [turn.worst for turn in repair.rounds]
    colours = [FAILING if turn.counterexamples else SAFE for turn in repair.rounds]
    axes.plot(range(1, len(worst) + 1), worst, color=BOUND, linewidth=0.8)
    axes.scatter(range(1, len(worst) + 1), worst, color=colours, zorder=3)
    axes.axhline(repair.margin, color=BOUND, linewidth=0.8, linestyle="--")
    axes.set(xlabel="round", ylabel="worst robustness found", title=repair.name)
    locator: Any = axes.xaxis.get_major_locator()
    locator.set_params(integer=True)
    tidy(axes)
    return show_or_save(figure, path)
