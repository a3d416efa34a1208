"""A diverse subset among all rows, in the order in which it was chosen."""

from pathlib import Path

import numpy as np

from verifai_jax.analysis._diverse import Diverse
from verifai_jax.core.figure import Figure
from verifai_jax.plotting.rows import draw_rows, two_columns
from verifai_jax.plotting.style import FAILING, new_figure, show_or_save, tidy


def plot_diverse(diverse: Diverse, path: str | Path | None = None) -> Figure:
    """Draw the rows among all, in their order, and the distance of each from those before.

    **Arguments:**

    - `diverse`: what `analysis.diverse` returned.
    - `path`: file that the picture is written to, if given.

    **Returns:** the figure.
    """
    figure = new_figure(figsize=(8.6, 4.0))
    cloud, curve = figure.subplots(1, 2, width_ratios=(1.4, 1))
    across, up = two_columns(diverse.samples)
    drawn = draw_rows(
        cloud, diverse.samples, diverse.rows, FAILING, f"{len(diverse.rows)} chosen", (across, up)
    )
    for i, (x, y) in enumerate(drawn[:12]):
        if np.isfinite(x) and np.isfinite(y):
            style = {"xytext": (5, 4), "textcoords": "offset points", "fontsize": 8}
            cloud.annotate(str(i + 1), (x, y), **style)
    curve.plot(
        np.arange(2, len(diverse.rows) + 1),
        diverse.distances[1:],
        "o-",
        color=FAILING,
        markersize=3,
    )
    curve.set_ylim(bottom=0)
    curve.set_xlabel("rows chosen")
    curve.set_ylabel("distance of the last from those before")
    curve.xaxis.get_major_locator().set_params(integer=True)
    for axes in (cloud, curve):
        tidy(axes)
    figure.suptitle(f"{len(diverse.rows)} diverse rows, {diverse.samples.kind}", fontsize=10)
    return show_or_save(figure, path)
