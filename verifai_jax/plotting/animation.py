"""A simulation as an animated GIF: MuJoCo's picture of it, or what the problem draws itself."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from verifai_jax.evaluation.replay import Replay
from verifai_jax.plotting.mujoco_scene import can_draw, film, record
from verifai_jax.plotting.style import new_figure

FRAMES_PER_SECOND = 25
MOST_FRAMES = 150
"""Frames at most; a longer simulation is played faster."""


def animate(replay: Replay, path: str | Path) -> Path:
    """Write a simulation as a GIF, in real time where it fits into `MOST_FRAMES` frames.

    The problem's `draw(axes, trace, sample, features)` draws one frame. Without it, MuJoCo draws a
    system that is a MuJoCo model.

    **Arguments:**

    - `replay`: what `run.replay` returned.
    - `path`: of the file; folders are made.

    **Returns:** the path.

    **Raises:** `ValueError` for any other problem without `draw`; `mujoco_scene.NoRenderer` where
    MuJoCo cannot draw.
    """
    draw = replay.problem.draw
    if draw is None and can_draw(replay.problem.system):
        return film(record(replay), path)
    if draw is None:
        raise ValueError(
            f"problem {replay.problem.name!r} cannot be animated: it has no draw function "
            "(axes, trace, sample, features)"
        )
    from PIL import Image

    clock = np.asarray(replay.trace.clock())
    seconds = float(clock[-1] - clock[0])
    count = max(2, min(MOST_FRAMES, round(seconds * FRAMES_PER_SECOND)))
    samples = np.searchsorted(clock, np.linspace(clock[0], clock[-1], count)).clip(
        max=len(clock) - 1
    )
    frames = [_frame(replay, draw, int(sample)) for sample in samples]
    # The last instant is the one that matters: it stays for a while.
    shown = [1000 / FRAMES_PER_SECOND] * (count - 1) + [1500]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    images = [Image.fromarray(frame).quantize(colors=32) for frame in frames]
    images[0].save(path, save_all=True, append_images=images[1:], duration=shown, loop=0)
    return path


def _frame(
    replay: Replay, draw: Callable[..., None], sample: int
) -> UInt8[np.ndarray, "height width 3"]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = new_figure(figsize=(5.2, 3.0))
    draw(figure.subplots(), replay.trace, sample, replay.features)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
