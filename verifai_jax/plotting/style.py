"""One look for all pictures; its colours are told apart by colour-blind readers too."""

from pathlib import Path
from typing import Any

from verifai_jax.core import figure
from verifai_jax.core.figure import Axes, Figure

SAFE = "#3a9e7d"
FAILING = "#d1495b"
WITHOUT_VERDICT = "#7f7f7f"
NOT_CLAIMED = "#e0a030"
BOUND = "#30323d"
INPUT = "#4f6d9c"
DPI = 110


def new_figure(**options: Any) -> Figure:
    """Return an empty figure in the common layout and resolution."""
    return figure.new_figure(layout="constrained", dpi=DPI, **options)


def tidy(axes: Axes) -> None:
    """Remove the box around the data, and draw a faint grid behind it."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.set_axisbelow(True)


def show_or_save(drawn: Figure, path: str | Path | None) -> Figure:
    """Write the figure where a path is given; return it for a notebook to show."""
    if path is not None:
        drawn.savefig(path)
    return drawn
