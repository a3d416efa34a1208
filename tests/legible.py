"""Whether the texts of a picture can be read: none is cut off, none lies on another."""

from itertools import combinations, pairwise

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

CUT, OVER = 1.0, 1.5
"""Pixels of a text that may lie outside of the picture, and on another text."""


def shown_texts(figure):
    """Yield each text that is drawn, with its box in pixels."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    inside = set()
    for axes in figure.findobj(lambda artist: hasattr(artist, "xaxis")):
        # Ticks beyond the limits have labels that are not drawn.
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            slack = 1e-9 * (high - low if axis.get_scale() == "linear" else low)
            for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
                seen = axes.axison and axes.get_visible() and axis.get_visible()
                if not (seen and low - slack <= tick.get_loc() <= high + slack):
                    inside |= {tick.label1, tick.label2}
    for text in figure.findobj(Text):
        said = text.get_text().strip()
        if said and text.get_visible() and text not in inside and in_sight(text):
            box = Text.get_window_extent(text, renderer)  # An annotation has an arrow, too.
            if box.width and box.height:
                yield text, box


def in_sight(text):
    """Return whether the text is drawn: not on axes that are hidden, not where it is clipped."""
    axes = text.axes
    if axes is None:
        return True
    return axes.get_visible() and (axes.axison or text not in axis_texts(axes))


def axis_texts(axes):
    texts = [axes.xaxis.label, axes.yaxis.label, *axes.get_xticklabels(), *axes.get_yticklabels()]
    return set(texts)


def faults(figure):
    """Return sentences on texts that are cut off or lie on one another."""
    width, height = figure.bbox.width, figure.bbox.height
    texts = list(shown_texts(figure))
    found = []
    for text, box in texts:
        beyond = max(-box.x0, -box.y0, box.x1 - width, box.y1 - height)
        if beyond > CUT:
            found.append(f"{text.get_text()!r} is cut off by {beyond:.0f} pixels")
    for (one, a), (other, b) in combinations(texts, 2):
        right = min(a.x1, b.x1) - max(a.x0, b.x0)
        up = min(a.y1, b.y1) - max(a.y0, b.y0)
        if min(right, up) > OVER:
            found.append(f"{one.get_text()!r} lies on {other.get_text()!r}")
    return found


def on_curves(figure):
    """Return texts within axes that a curve runs through."""
    found = []
    for text, box in shown_texts(figure):
        axes = text.axes
        if axes is None or text not in axes.texts:
            continue
        for line in axes.lines:
            path = line.get_transform().transform(line.get_xydata())
            if len(path) < 2 or line.get_linestyle() in (":", "None"):
                continue
            steps = np.linspace(0, 1, 20)[:, None]
            dense = np.concatenate([a + steps * (b - a) for a, b in pairwise(path)])
            if ((dense > [box.x0, box.y0]) & (dense < [box.x1, box.y1])).all(1).any():
                found.append(f"{text.get_text()!r} lies on a curve")
                break
    return found
