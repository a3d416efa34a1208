"""One look for all pictures; colour-blind readers can distinguish its colours."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from verifai_jax.core.display import figure
from verifai_jax.core.display.figure import Axes, Figure
from verifai_jax.core.messages.text import shorten
from verifai_jax.core.store.atomic_files import replacing

if TYPE_CHECKING:
    from matplotlib.axis import Axis
else:
    Axis = object
Positions = Float[np.ndarray, " n"]
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


def log_ticks(axis: Axis) -> None:
    """Label a few numbers on a logarithmic axis: powers of ten, or round numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

    low, high = axis.get_view_interval()
    narrow = high / low < 100
    locator: Any = LogLocator(subs=(1.0, 2.0, 5.0) if narrow else (1.0,), numticks=6)
    if high / low < 5:  # Powers of ten, twice and five times these, are one at most.
        locator = MaxNLocator(4)
        axis.set_minor_locator(NullLocator())
    axis.set_major_locator(locator)
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:zg}"))
    axis.set_minor_formatter(NullFormatter())


def name_points(
    axes: Axes, names: Sequence[str], x: Positions, y: Positions, low: Positions, high: Positions
) -> None:
    """Write names next to points without overlaps; call it after the limits are set.

    A name without room at its point is moved up or down, and joined to it by a line.

    **Arguments:**
    - `names`: the names of the points at `x` and `y`, in the units of the data.
    - `low`, `high`: ends of a horizontal bar at each point that no name may cover.
    """
    figure: Any = axes.figure
    figure.draw_without_rendering()
    renderer = _renderer(figure)
    points = axes.transData.transform(np.column_stack([x, y]))
    ends = [axes.transData.transform(np.column_stack([at, y])) for at in (low, high)]
    taken = [(a - 4, py - 2, b + 4, py + 2) for (a, py), (b, _) in zip(*ends, strict=True)]
    taken += [(px - 4, py - 4, px + 4, py + 4) for px, py in points]
    middle = axes.bbox.x0 + 0.6 * axes.bbox.width
    for name, (px, py) in sorted(zip(names, points.tolist(), strict=True), key=lambda n: -n[1][1]):
        left = px > middle
        text = axes.annotate(
            name, (px, py), xycoords="figure pixels", fontsize=8, ha="right" if left else "left",
            va="center", textcoords="offset pixels", xytext=(-8 if left else 8, 0),
        )  # fmt: skip
        box = text.get_window_extent(renderer)
        step = 0.55 * box.height
        for shift in sorted((k * step for k in range(-40, 41)), key=abs):
            if py + shift < axes.bbox.y0 + step or py + shift > axes.bbox.y1 - step:
                continue
            away = 8 if abs(shift) < step else 18
            x0 = px - away - box.width if left else px + away
            area = (x0, py + shift - box.height / 2, x0 + box.width, py + shift + box.height / 2)
            if not any(_overlap(area, other) for other in taken):
                break
        else:
            text.remove()
            continue
        taken.append(area)
        text.remove()
        # In the units of the data, so that it stays there in a picture of another size.
        at = axes.transData.inverted().transform((px, py))
        scale = 72 / figure.dpi
        axes.annotate(
            name, tuple(at), fontsize=8, ha="right" if left else "left", va="center",
            textcoords="offset points", xytext=((-away if left else away) * scale, shift * scale),
            arrowprops=None if away == 8 else {"arrowstyle": "-", "color": BOUND, "linewidth": 0.5},
        )  # fmt: skip


def _overlap(one: Sequence[float], other: Sequence[float]) -> bool:
    across = min(one[2], other[2]) > max(one[0], other[0])
    return bool(across and min(one[3], other[3]) > max(one[1], other[1]))


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


def _renderer(drawn: Figure) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    return FigureCanvasAgg(drawn).get_renderer()


def _wrap_texts(drawn: Figure) -> None:
    """Break titles and labels of axes that are longer than what they belong to."""
    renderer = _renderer(drawn)
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
