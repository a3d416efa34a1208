"""Rows that are near each other, among all rows."""

from pathlib import Path

from verifai_jax.analysis.neighbours import Neighbours
from verifai_jax.core.figure import Figure
from verifai_jax.plotting.rows import draw_rows
from verifai_jax.plotting.style import BOUND, new_figure, show_or_save, tidy


def plot_neighbours(neighbours: Neighbours, path: str | Path | None = None) -> Figure:
    """Draw the rows among the others, over the two features that vary most.

    **Arguments:**

    - `neighbours`: what `analysis.k_closest`, `nearest` or `random_rows` returned.
    - `path`: file that the picture is written to, if given.

    **Returns:** the figure.
    """
    figure = new_figure(figsize=(5.2, 4.2))
    axes = figure.subplots()
    draw_rows(
        axes, neighbours.samples, neighbours.rows, color=BOUND, label=f"{len(neighbours.rows)} rows"
    )
    tidy(axes)
    figure.suptitle(f"{neighbours.how}, {neighbours.samples.kind}", fontsize=10)
    return show_or_save(figure, path)
