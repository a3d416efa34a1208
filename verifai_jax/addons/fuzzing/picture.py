"""Coverage of an automaton as a picture: pairs of transitions that occurred, or never did."""

from pathlib import Path

import numpy as np

from verifai_jax.addons.fuzzing.coverage import FuzzCoverage
from verifai_jax.core.display.figure import Figure
from verifai_jax.pictures.style import FAILING, new_figure, show_or_save


def plot_pairs(coverage: FuzzCoverage, path: str | Path | None = None) -> Figure:
    """Draw the possible pairs of consecutive transitions, by how often they occurred.

    **Arguments:**
    - `coverage`: the coverage of a run whose features have an automaton; the first one is drawn.
    **Raises:** `ValueError` for a run without an automaton.
    """
    if not coverage.automata:
        raise ValueError("there are no transitions to draw: the features have no Automaton")
    name, automaton = coverage.automata[0]
    possible, hits = coverage.pairs(name)
    labels = [each.label for each in automaton.transitions]
    size = 2.6 + 0.42 * len(labels)
    figure = new_figure(figsize=(size + 1.2, size))
    axes = figure.subplots()
    shown = np.where(possible & (hits > 0), np.log10(np.maximum(hits, 1)), np.nan)
    image = axes.imshow(shown, cmap="viridis", vmin=0)
    for one, other in np.argwhere(possible & (hits == 0)):
        axes.text(other, one, "x", color=FAILING, ha="center", va="center")
    axes.set_xticks(range(len(labels)), labels, rotation=60, ha="right", fontsize=7)
    axes.set_yticks(range(len(labels)), labels, fontsize=7)
    axes.set_xlabel("then")
    axes.set_ylabel("first")
    figure.colorbar(image, ax=axes, label="simulations, powers of ten", shrink=0.8)
    covered = int((possible & (hits > 0)).sum())
    title = f"{name}: {covered} of {int(possible.sum())} pairs followed each other"
    missing = " (x: never)" if covered < possible.sum() else ""
    axes.set_title(title + missing, fontsize=9)
    return show_or_save(figure, path)
