"""Matplotlib figures that belong to no window and show themselves in a notebook."""

import contextlib
import functools
import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from verifai_jax.core.display.extensions import verb
from verifai_jax.core.display.lazy import lazy_import, uncollected

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    # Importing matplotlib takes longer than importing everything else here.
    Axes = Figure = object


class Drawn:
    """A result that has a picture.

    - `_picture`: a module, and its drawing function.
    """

    _picture: ClassVar[tuple[str, str]]

    def plot(self, path: str | Path | None = None) -> Figure:
        """Draw the result.

        **Arguments:**
        - `path`: file to which the picture is written, if given.
        **Returns:** the Matplotlib figure.
        """
        module, function = self._picture
        return lazy_import(module, function)(self, path)


class Reported:
    """A result on which an evidence report can be written.

    - `_report`: a module, and its function `(result, about, problem)` that returns the page.
    """

    _report: ClassVar[tuple[str, str]]

    def report(self, path: str | Path, **options: Any) -> Path:
        """Write the evidence report as one HTML file, and its claims as JSON next to it.

        **Arguments:**
        - `path`: the path of the HTML file.
        - `options`: the options of `reports.write_report` for this kind of result. For a run:
          `units` and `reasons` of features, `traces`, `studies`, `modes`, `odd`, `assessment`. For
          a sweep: `units` and `reasons` of hyper-parameters. For a transfer: `units` and `reasons`
          of features. For any other result these and its `problem`; for an estimate and a
          comparison also `errors`.
        **Returns:** the path of the HTML file.
        """
        return verb("report")(self, path, **options)


def new_figure(**options: Any) -> Figure:
    """Return an empty figure that opens no window and needs no closing.

    As the last value of a notebook cell it is displayed, with or without `%matplotlib inline`.

    **Arguments:**
    - `options`: the options of `matplotlib.figure.Figure`.
    """
    return _figure_class()(**options)


def load() -> None:
    """Import the libraries for figures, which takes half a second."""
    _figure_class()


@contextlib.contextmanager
def missing_glyphs() -> Iterator[None]:
    """Draw characters missing from the font as boxes, without a warning for each."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        yield


@functools.cache
@uncollected()
def _figure_class() -> Any:
    # Made on demand: importing matplotlib takes longer than importing everything else here.
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    class NotebookFigure(Figure):
        def draw(self, renderer: Any) -> None:
            layout = self.get_layout_engine()
            if isinstance(layout, ConstrainedLayoutEngine) and self.canvas.is_saving():
                # For a layout matplotlib draws twice; the second time alone is seen.
                return layout.execute(self) if self.axes else None
            return super().draw(renderer)

        def savefig(self, *arguments: Any, **options: Any) -> None:
            with missing_glyphs():
                super().savefig(*arguments, **options)

        def _repr_png_(self) -> bytes:
            buffer = io.BytesIO()
            self.savefig(buffer, format="png", dpi=72)
            return buffer.getvalue()

    return NotebookFigure
