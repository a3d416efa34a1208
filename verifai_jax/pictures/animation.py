"""A simulation as an animated GIF, drawn by MuJoCo or by the problem itself."""

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.evaluation.replay import Replay
from verifai_jax.pictures.film import LAST, MAX_FRAMES, MAX_WANTED, Film, check_film
from verifai_jax.pictures.style import DPI, new_figure

FRAMES_PER_SECOND = 25
SIZE = (572, 330)
"""Width and height in pixels of a frame that a problem draws itself."""
LINES = 8
"""Signals that are drawn at most where nothing else is."""


@dataclass(frozen=True)
class Animation:
    """An animated GIF, which notebooks display; `gif` is the content of its file."""

    gif: bytes = field(repr=False)

    def save(self, path: str | Path) -> Path:
        """Write the file, making missing folders; returns the path.

        **Raises:** `ValueError` for a path that does not end in `.gif`.
        """
        _check_gif(path)
        path = Path(path)
        with replacing(path) as partial:
            partial.write_bytes(self.gif)
        return path

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return {"image/gif": base64.b64encode(self.gif).decode(), "text/plain": repr(self)}


def animate(
    replay: Replay, path: str | Path | None = None, *, camera: str | None = None,
    size: Sequence[int] | None = None, fps: float | None = None,
) -> Animation:  # fmt: skip
    """Draw a simulation as a GIF, in real time unless it has too many frames.

    The problem's `draw(axes, trace, sample, features)` draws one frame. Without it, MuJoCo draws a
    system that has a MuJoCo model (`vj.mujoco`, `vj.brax`), and an environment of Gymnasium draws
    itself; of any other one the monitored signals are drawn as they grow.

    **Arguments:**
    - `replay`: the result of `run.replay`.
    - `path`: a file to write as well; missing folders are made.
    - `camera`: name of a camera of a MuJoCo model; by default the one that shows the motion best.
    - `size`: width and height of a frame in pixels.
    - `fps`: frames per second; chosen automatically when left out.
    **Raises:** `ValueError` for a path that does not end in `.gif`, a camera without a MuJoCo
    model, and invalid sizes; `UnknownNameError` for a camera that the model lacks;
    `film.NoRenderer` if MuJoCo cannot draw.
    """
    _check_gif(path)
    check_film(size, fps)
    draw = replay.problem.draw
    filmed: Film | None = None if draw is not None else replay.problem.system.filmed(replay)
    pixels = None if size is None else (int(size[0]), int(size[1]))
    if camera is not None and (filmed is None or not filmed.has_cameras):
        raise ValueError(
            f"camera names a camera of a MuJoCo model, which does not draw problem "
            f"{replay.problem.name!r}; leave it out, got {camera!r}"
        )
    if draw is not None:
        animation = Animation(_drawn(replay, draw, pixels or SIZE, fps))
    elif filmed is not None:
        animation = Animation(filmed.gif(pixels, camera, fps))
    else:
        animation = Animation(_drawn(replay, _signals(replay), pixels or SIZE, fps))
    if path is not None:
        animation.save(path)
    return animation


def _check_gif(path: str | Path | None) -> None:
    if path is not None and Path(path).suffix.lower() != ".gif":
        raise ValueError(f"an animation is a GIF, a file with the ending .gif; got {str(path)!r}")


def _drawn(
    replay: Replay, draw: Callable[..., None], size: tuple[int, int], fps: float | None
) -> bytes:
    """Return the GIF of what the problem draws itself."""
    from PIL import Image

    clock = np.asarray(replay.trace.clock())
    seconds = float(clock[-1] - clock[0])
    rate, maximum = (FRAMES_PER_SECOND, MAX_FRAMES) if fps is None else (fps, MAX_WANTED)
    count = max(2, min(maximum, round(seconds * rate)))
    samples = np.searchsorted(clock, np.linspace(clock[0], clock[-1], count)).clip(
        max=len(clock) - 1
    )
    # A sample that is longer than a frame is drawn once, and shown as long.
    samples, repeated = np.unique(samples, return_counts=True)
    frames, layout = [], None
    for sample in samples.tolist():
        frame, layout = _frame(replay, draw, sample, size, layout)
        frames.append(frame)
    # The last instant is the one that matters: it stays for a while.
    shown = [1000 / rate * int(times) for times in repeated]
    shown[-1] += LAST - 1000 / rate
    images = [Image.fromarray(frame).quantize(colors=32) for frame in frames]
    file = io.BytesIO()
    images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=shown, loop=0)
    return file.getvalue()


def _signals(replay: Replay) -> Callable[..., None]:
    """Return the function that draws the monitored signals up to a sample."""
    clock = np.asarray(replay.trace.clock())
    columns: dict[str, np.ndarray] = {}
    for name in replay.problem.monitored:
        signal = np.asarray(replay.trace.signals[name], float).reshape(len(clock), -1)
        names = [name] if signal.shape[1] == 1 else [f"{name}[{k}]" for k in range(len(signal[0]))]
        columns |= dict(zip(names, signal.T, strict=True))
    shown = dict(list(columns.items())[:LINES])
    every = np.concatenate([each[np.isfinite(each)] for each in shown.values()])
    low, high = (every.min(), every.max()) if every.size else (0.0, 1.0)
    room = 0.05 * (high - low) or 1.0

    def draw(axes: Any, trace: object, sample: int, features: object) -> None:
        for number, (name, values) in enumerate(shown.items()):
            axes.plot(clock[: sample + 1], values[: sample + 1], color=f"C{number}")
            at = (0.02, 0.94 - 0.07 * number)
            axes.text(*at, name, color=f"C{number}", transform=axes.transAxes)
        axes.set_xlim(clock[0], clock[-1])
        axes.set_ylim(low - room, high + room)
        axes.set_xlabel("time (s)")

    return draw


class _Layout(NamedTuple):
    """Where the axes are in a frame, and what decides on it."""

    position: Any
    reasons: tuple[Any, ...]


def _frame(
    replay: Replay, draw: Callable[..., None], sample: int, size: tuple[int, int],
    before: _Layout | None,
) -> tuple[UInt8[np.ndarray, "height width 3"], _Layout | None]:  # fmt: skip
    """Return the picture of one sample, of a width and a height in pixels, and its layout.

    - `before`: the layout of the frame before, which stays where nothing has changed that decides
      on it: to lay out a frame takes longer than to draw it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = new_figure(figsize=(size[0] / DPI, size[1] / DPI))
    axes = figure.subplots()
    draw(axes, replay.trace, sample, replay.features)
    texts = (axes.get_title(), axes.get_xlabel(), axes.get_ylabel())
    lines = tuple(text.count("\n") if text else -1 for text in texts)
    reasons = (axes.get_xlim(), axes.get_ylim(), axes.get_aspect(), lines)
    # With a colour bar or a second panel next to them, each frame is laid out.
    alone = figure.axes == [axes] and not figure.texts and axes.get_legend() is None
    if alone and before is not None and before.reasons == reasons:
        figure.set_layout_engine("none")
        axes.set_position(before.position)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    layout = _Layout(axes.get_position(original=True), reasons) if alone else None
    return np.asarray(canvas.buffer_rgba())[..., :3].copy(), layout
