"""The table of a run in a notebook: scatter, parallel coordinates, and a trace for every click.

explore(run)                                        # what run.explore() shows
"""

import functools
import logging
from typing import Any

from verifai_jax.addons.reports.page import asset
from verifai_jax.addons.reports.studies import png
from verifai_jax.addons.reports.view import trace_data, view_data
from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.falsification.run import Run
from verifai_jax.pictures.scatter import plot_features


def explore(run: Run) -> Any:
    """Return a widget of a run's table, or a picture if widgets are not available.

    Hovering over a row shows its values. Clicking on it simulates it again and shows its trace.
    Without the package anywidget it is the figure of `run.plot()`.
    """
    try:
        widget = _widget_class()
    except ImportError:
        logging.getLogger(__name__).warning(
            "a picture instead of a widget: run.explore() needs anywidget, "
            "pip install 'verifai_jax[widget]'"
        )
        return plot_features(run)
    return widget(run)


@functools.cache
def _widget_class() -> Any:
    # Made on demand: anywidget is an extra.
    import anywidget  # pyright: ignore[reportMissingImports]
    import traitlets

    class TableView(anywidget.AnyWidget):
        """A run's table; the picture next to it is for viewers that show no widgets."""

        _esm = asset("view.js") + asset("widget.js")
        _css = asset("view.css")
        data = traitlets.Dict().tag(sync=True)

        def __init__(self, run: Run) -> None:
            data = view_data(run, {})
            if run.problem is None:
                data["replay"] = "The run was loaded without its problem, which a trace needs."
            super().__init__(data=data)
            self._run = run
            self.on_msg(lambda _, message, __: self.answer(message))

        def answer(self, message: dict[str, Any]) -> None:
            """Send the trace of the requested row, or the reason why it is missing."""
            row = message.get("row")
            if not isinstance(row, int):
                return
            try:
                trace = trace_data(self._run.replay(row))
            except Exception as error:  # A system of somebody else may raise anything.
                trace = {"text": one_line(format_error(error)), "signals": [], "time": []}
            self.send({"row": row, "trace": trace})

        def _repr_mimebundle_(self, **options: Any) -> Any:
            bundle = super()._repr_mimebundle_(**options)
            known = bundle[0] if isinstance(bundle, tuple) else bundle
            if known is not None:
                known["image/png"] = png(plot_features(self._run))
            return bundle

    return TableView
