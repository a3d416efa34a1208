"""The film of a simulation that its simulator draws, and what may be asked of a film."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from verifai_jax.core.messages.checks import check_count

MAX_FRAMES = 150
"""Frames of a film without a given frame rate; a longer film is played faster."""
MAX_WANTED = 1000
"""Frames of a film for which somebody does."""
LAST = 1500
"""Milliseconds that the last frame stays, which is the one that matters."""


@runtime_checkable
class Film(Protocol):
    """Pictures of one simulation that its own simulator draws; `System.filmed` returns them.

    - `draws`: whether the simulator draws pictures as it is set up.
    - `has_cameras`: whether a picture may be taken by a camera with a name.
    """

    draws: bool
    has_cameras: bool

    def gif(
        self, size: Sequence[int] | None = None, camera: str | None = None, fps: float | None = None
    ) -> bytes:
        """Return an animated GIF; sizes in pixels, frames per second.

        **Raises:** `NoRenderer` if drawing is not possible here; `UnknownNameError` for a camera.
        """
        ...

    def strip(self, path: Path) -> Path | None:
        """Write frames side by side as a PNG, and return its path; None without such a picture."""
        ...


class NoRenderer(RuntimeError):
    """An error if there is no OpenGL for drawing; the message says what to install or set."""


def check_film(size: Sequence[int] | None, fps: float | None) -> None:
    """Check the size in pixels and the frame rate of a film.

    **Raises:** `ValueError`, `TypeError`.
    """
    if size is not None:
        if not isinstance(size, tuple | list) or len(size) != 2:
            raise ValueError(f"size is a width and a height in pixels, (480, 320); got {size!r}")
        for pixels, what in zip(size, ("width", "height"), strict=True):
            check_count(f"the {what} of size", pixels)
    if fps is not None and not 0 < fps <= 100:
        raise ValueError(f"fps is a number of frames a second, from 0 to 100; got {fps!r}")
