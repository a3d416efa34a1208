"""The front of two mined parameters, as a staircase."""

from pathlib import Path

from verifai_jax.core.figure import Figure
from verifai_jax.mtl.mining import Mined
from verifai_jax.plotting.style import new_figure, show_or_save


def plot_mined(mined: Mined, path: str | Path | None = None) -> Figure:
    """Draw the corners of a front, and the values that were chosen.

    **Raises:** `ValueError` for one parameter, which has no front.
    """
    if len(mined.tightest) < 2:
        raise ValueError("one parameter has a tightest value and no front to draw; see summary()")
    one, other = mined.tightest
    figure = new_figure(figsize=(6.0, 4.5), facecolor="white")
    axis = figure.add_subplot()
    corners = sorted((corner[one], corner[other]) for corner in mined.front)
    axis.plot(*zip(*corners, strict=True), "o", color="#1b2a41", ms=4, label="corners of the front")
    axis.step(
        *zip(*corners, strict=True),
        where="post" if mined.tightest[one] == "least" else "pre",
        color="#7b8794",
    )
    axis.plot(mined.values[one], mined.values[other], "o", color="#cf3f21", ms=8, label="chosen")
    axis.set_xlabel(f"{one} (tight: the {mined.tightest[one]})")
    axis.set_ylabel(f"{other} (tight: the {mined.tightest[other]})")
    axis.set_title(mined.text, fontsize=10)
    axis.legend()
    return show_or_save(figure, path)
