"""One look for all pictures; the two colours are told apart by colour-blind readers too."""

from typing import Any

from verifai_jax.core import figure

SAFE = "#3a9e7d"
FAILING = "#d1495b"
WITHOUT_VERDICT = "#7f7f7f"
BOUND = "#30323d"
DPI = 110


def new_figure(**options: Any) -> Any:
    """A figure in the common layout and resolution."""
    return figure.new_figure(layout="constrained", dpi=DPI, **options)


def tidy(axes: Any) -> None:
    """No box around the data, a faint grid behind it."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.set_axisbelow(True)


def show_or_save(drawn: Any, path: Any) -> Any:
    """Write the figure where a path is given; return it for a notebook to show."""
    if path is not None:
        drawn.savefig(path)
    return drawn
