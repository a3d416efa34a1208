"""Matplotlib figures that belong to no window and show themselves in a notebook."""

import functools
import io
from typing import Any


def new_figure(**options: Any) -> Any:
    """A `matplotlib.figure.Figure`: nothing pops up, and nothing has to be closed.

    Takes the options of `Figure`. As the last value of a notebook cell it is drawn, with or
    without `%matplotlib inline`.
    """
    return _figure_class()(**options)


@functools.cache
def _figure_class() -> Any:
    # Made on demand: importing matplotlib takes longer than importing everything else here.
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):
        def _repr_png_(self) -> bytes:
            buffer = io.BytesIO()
            self.savefig(buffer, format="png", dpi=72)
            return buffer.getvalue()

    return NotebookFigure
