"""A simulation as an animated GIF: MuJoCo's picture of it, or what the problem draws itself."""

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from verifai_jax.evaluation.replay import Replay
from verifai_jax.plotting.mujoco_scene import can_draw, film, record
from verifai_jax.plotting.style import new_figure

FRAMES_PER_SECOND = 25
MOST_FRAMES = 150
"""Frames at most; a longer simulation is played faster."""


@dataclass(frozen=True)
class Animation:
    """An animated GIF, which shows itself in a notebook; `gif` is the content of its file."""

    gif: bytes = field(repr=False)

    def save(self, path: str | Path) -> Path:
        """Write the file, and the folders that it needs; returns the path.

        **Raises:** `ValueError` for a path that does not end in `.gif`.
        """
        _check_gif(path)
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.gif)
        return path

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return {"image/gif": base64.b64encode(self.gif).decode(), "text/plain": repr(self)}


def animate(replay: Replay, path: str | Path | None = None) -> Animation:
    """Draw a simulation as a GIF, in real time where it fits into `MOST_FRAMES` frames.

    The problem's `draw(axes, trace, sample, features)` draws one frame. Without it, MuJoCo draws a
    system that is a MuJoCo model.

    **Arguments:**

    - `replay`: what `run.replay` returned.
    - `path`: of a file to write too; folders are made.

    **Raises:** `ValueError` for any other problem without `draw`, and for a path that does not end
    in `.gif`; `mujoco_scene.NoRenderer` where MuJoCo cannot draw.
    """
    _check_gif(path)
    draw = replay.problem.draw
    if draw is not None:
        animation = Animation(_drawn(replay, draw))
    elif can_draw(replay.problem.system):
        with TemporaryDirectory() as folder:
            file = film(record(replay), Path(folder) / "animation.gif")
            animation = Animation(file.read_bytes())
    else:
        raise ValueError(
            f"problem {replay.problem.name!r} cannot be animated: it has no draw function "
            "(axes, trace, sample, features)"
        )
    if path is not None:
        animation.save(path)
    return animation


def _check_gif(path: str | Path | None) -> None:
    if path is not None and Path(path).suffix.lower() != ".gif":
        raise ValueError(f"an animation is a GIF, a file with the ending .gif; got {str(path)!r}")


def _drawn(replay: Replay, draw: Callable[..., None]) -> bytes:
    """Return the GIF of what the problem draws itself."""
    from PIL import Image

    clock = np.asarray(replay.trace.clock())
    seconds = float(clock[-1] - clock[0])
    count = max(2, min(MOST_FRAMES, round(seconds * FRAMES_PER_SECOND)))
    samples = np.searchsorted(clock, np.linspace(clock[0], clock[-1], count)).clip(
        max=len(clock) - 1
    )
    # A sample that is longer than a frame is drawn once, and shown as long.
    samples, repeated = np.unique(samples, return_counts=True)
    frames, layout = [], None
    for sample in samples.tolist():
        frame, layout = _frame(replay, draw, sample, layout)
        frames.append(frame)
    # The last instant is the one that matters: it stays for a while.
    shown = [1000 / FRAMES_PER_SECOND * int(times) for times in repeated]
    shown[-1] += 1500 - 1000 / FRAMES_PER_SECOND
    images = [Image.fromarray(frame).quantize(colors=32) for frame in frames]
    file = io.BytesIO()
    images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=shown, loop=0)
    return file.getvalue()


class _Layout(NamedTuple):
    """Where the axes are in a frame, and what decides on it."""

    place: Any
    reasons: tuple[Any, ...]


def _frame(
    replay: Replay, draw: Callable[..., None], sample: int, before: _Layout | None
) -> tuple[UInt8[np.ndarray, "height width 3"], _Layout | None]:
    """Return the picture of one sample, and its layout.

    - `before`: the layout of the frame before, which stays where nothing has changed that decides
      on it: to lay out a frame takes longer than to draw it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = new_figure(figsize=(5.2, 3.0))
    axes = figure.subplots()
    draw(axes, replay.trace, sample, replay.features)
    texts = (axes.get_title(), axes.get_xlabel(), axes.get_ylabel())
    lines = tuple(text.count("\n") if text else -1 for text in texts)
    reasons = (axes.get_xlim(), axes.get_ylim(), axes.get_aspect(), lines)
    # With a colour bar or a second panel beside them, each frame is laid out.
    alone = figure.axes == [axes] and not figure.texts and axes.get_legend() is None
    if alone and before is not None and before.reasons == reasons:
        figure.set_layout_engine("none")
        axes.set_position(before.place)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    layout = _Layout(axes.get_position(original=True), reasons) if alone else None
    return np.asarray(canvas.buffer_rgba())[..., :3].copy(), layout
