"""One look for all pictures; colour-blind readers can distinguish its colours."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from verifai_jax.core.display import figure
from verifai_jax.core.display.figure import Axes, Figure
from verifai_jax.core.messages.text import shorten
from verifai_jax.core.store.atomic_files import replacing

SAFE = "#3a9e7d"
FAILING = "#d1495b"
WITHOUT_VERDICT = "#7f7f7f"
NOT_CLAIMED = "#e0a030"
BOUND = "#30323d"
INPUT = "#4f6d9c"
DPI = 110


def new_figure(**options: Any) -> Figure:
    """Return an empty figure with the common layout and resolution."""
    return figure.new_figure(layout="constrained", dpi=DPI, **options)


def tidy(axes: Axes) -> None:
    """Remove the frame around the data, and draw a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.set_axisbelow(True)


def show_or_save(drawn: Figure, path: str | Path | None) -> Figure:
    """Wrap text that would be cut off, and write the figure if a path is given.

    **Returns:** the figure, for a notebook to show.
    """
    with figure.missing_glyphs():
        _wrap_texts(drawn)
    if path is not None:
        with replacing(path) as partial:
            drawn.savefig(partial)
    return drawn


def wrap_name(name: str, width: int = 20, lines: int = 2) -> str:
    """Break a name into lines after blanks and signs; if it is too long its middle is left out."""
    return "\n".join(_broken(shorten(name, width * lines), width))


def _broken(line: str, width: int) -> list[str]:
    """Break a line after blanks so that each part has at most so many characters.

    What is longer without a blank is broken after signs.
    """
    lines, parts = [""], list[str]()
    for word in re.findall(r"\S*\s|\S+", line):
        signs = len(word.rstrip()) > width
        parts += re.findall(r"[^\s_.,;=]*[\s_.,;=]|[^\s_.,;=]+", word) if signs else [word]
    for part in parts:
        fits = not lines[-1] or len((lines[-1] + part).rstrip()) <= width
        lines = [*lines[:-1], lines[-1] + part] if fits else [*lines, part]
    return [each.rstrip() for each in lines]


def renderer_of(drawn: Figure) -> Any:
    """Return what measures the texts of a figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    return FigureCanvasAgg(drawn).get_renderer()


def _wrap_texts(drawn: Figure) -> None:
    """Break titles and labels of axes that are longer than what they belong to."""
    renderer = renderer_of(drawn)
    if title := getattr(drawn, "_suptitle", None):
        _wrap(title, 0.96 * drawn.bbox.width, renderer)
    panels = [axes for axes in drawn.axes if axes.get_visible()]
    # To lay a picture out takes longer than to measure its texts: only where one may be too long.
    narrow = drawn.bbox.width / max(1, len({axes.get_subplotspec() for axes in panels})) * 0.6
    texts = [text for axes in panels for text, _ in _labels(axes)]
    if all(_length(text, renderer) < narrow for text in texts):
        return
    drawn.draw_without_rendering()
    for axes in panels:
        for text, room in _labels(axes):
            _wrap(text, room, renderer)


def _labels(axes: Axes) -> Iterator[tuple[Any, float]]:
    """Yield titles and labels of axes, each with the pixels that it has."""
    parts: Any = axes
    for text in (axes.title, parts._left_title, parts._right_title, axes.xaxis.label):
        if text.get_text():
            yield text, axes.bbox.width
    if axes.yaxis.label.get_text() and axes.yaxis.label.get_rotation() == 90:
        yield axes.yaxis.label, 1.05 * axes.bbox.height


def _length(text: Any, renderer: Any) -> float:
    box = text.get_window_extent(renderer)
    return box.height if text.get_rotation() == 90 else box.width


def _wrap(text: Any, room: float, renderer: Any) -> None:
    length = _length(text, renderer)
    if length > room:
        lines = text.get_text().split("\n")
        width = max(12, int(max(map(len, lines)) * room / length))
        parts = [part for line in lines for part in _broken(line, width)]
        # A word that is longer than the room is broken anywhere; its letters may be wide ones.
        piece = int(0.9 * width)
        text.set_text("\n".join(
            part[i : i + piece] if len(part) > width else part
            for part in parts
            for i in range(0, len(part) if len(part) > width else 1, piece)
        ))  # fmt: skip
