"""Films of pictures: their samples, captions, and the GIF itself."""

import io
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int, UInt8

from verifai_jax.evaluation.replay import Replay
from verifai_jax.pictures.film import LAST, MAX_FRAMES, MAX_WANTED
from verifai_jax.pictures.replay import decisive_instant

Frame: TypeAlias = UInt8[np.ndarray, "height width 3"]
COLORS = 128
"""Colours of a GIF."""
HEADER = 24
"""Pixels above a frame for its caption."""
BACKGROUND = np.array([232, 237, 242], np.uint8)
"""Colour where nothing is."""


def film_samples(
    clock: Float[np.ndarray, " samples"], fps: float | None, usual: float
) -> tuple[Int[np.ndarray, " frames"], float]:
    """Return the samples for a film, in real time unless there are too many.

    **Arguments:**
    - `clock`: time of each sample in seconds.
    - `fps`: frames per second; None for the `usual` rate.
    **Returns:** the samples, and the duration of each frame in milliseconds.
    """
    seconds = float(clock[-1] - clock[0])
    maximum = MAX_FRAMES if fps is None else MAX_WANTED
    rate = usual if fps is None else fps
    count = max(2, min(maximum, round(seconds * rate) + 1))
    instants = np.linspace(clock[0], clock[-1], count)
    samples = np.searchsorted(clock, instants - 1e-9).clip(max=len(clock) - 1)
    return samples, max(20, round(1000 * seconds / (count - 1) / 10) * 10)


def caption_of(replay: Replay) -> str:
    """Return the caption of the frames: the problem, the row and the verdict."""
    row = "" if replay.row is None else f", row {replay.row}"
    verdict = "violated" if replay.violated else replay.status.name.lower()
    return f"{replay.problem.name}{row}: {verdict}"


def decided_at(replay: Replay) -> int | None:
    """Return the sample that decided a failure; None if the property held."""
    if not replay.violated:
        return None
    formula = replay.problem.formulas[replay.worst]
    decided = decisive_instant(formula, replay.trace, replay.problem.end)
    return None if decided is None else decided[1]


def labelled(
    image: Frame, caption: str, seconds: float, failed: bool
) -> UInt8[np.ndarray, "taller width 3"]:
    """Draw caption and time above a frame, with a red edge once the property has `failed`.

    In a caption that is too long for the frame the middle is left out.
    """
    from PIL import Image, ImageDraw, ImageFont

    header = np.full((HEADER, *image.shape[1:]), BACKGROUND, np.uint8)
    picture = Image.fromarray(np.concatenate([header, image]))
    pen = ImageDraw.Draw(picture)
    width, height = picture.size
    font = ImageFont.load_default(size=13)
    ink = (190, 45, 65) if failed else (48, 50, 61)
    time = f"{seconds:z.2f} s"
    room = width - 30 - pen.textlength(time, font=font)
    while caption and pen.textlength(caption, font=font) > room:
        middle = len(caption) // 2
        caption = "" if len(caption) < 8 else f"{caption[: middle - 3]}..{caption[middle + 2 :]}"
    pen.text((10, 5), caption, fill=ink, font=font)
    if room > -20:
        pen.text((width - 10, 5), time, fill=ink, font=font, anchor="ra")
    if failed:
        pen.rectangle((0, 0, width - 1, height - 1), outline=ink, width=3)
    return np.asarray(picture)


def gif(frames: Sequence[Frame], shown: float) -> bytes:
    """Return an animated GIF of frames that are each shown for `shown` milliseconds."""
    from PIL import Image

    # One palette for all and no dithering, so that what does not move keeps its colour and the file
    # stays small. Half of it is for the colours that there are, however few their pixels, or floor
    # and sky would take them all.
    count = len(frames)
    some = np.concatenate([frames[i].reshape(-1, 3) for i in (0, count // 2, count - 1)])
    different = np.unique(some & 0xF8, axis=0) + 4
    share = some[:: max(1, len(some) // len(different))]
    both = np.concatenate([different.astype(np.uint8), share])
    palette = Image.fromarray(both[None]).quantize(COLORS)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    file = io.BytesIO()
    images[0].save(
        file, "GIF", save_all=True, append_images=images[1:], loop=0,
        duration=[shown] * (count - 1) + [LAST],
    )  # fmt: skip
    return file.getvalue()
