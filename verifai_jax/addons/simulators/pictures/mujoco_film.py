"""The film of a MuJoCo model's replay, as `System.filmed` offers it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

from verifai_jax.addons.simulators.pictures.mujoco_motion import Motion, can_draw, record
from verifai_jax.addons.simulators.pictures.mujoco_scene import film, strip
from verifai_jax.evaluation.replay import Replay


@dataclass(frozen=True)
class MuJoCoFilm:
    """Pictures of a replay by MuJoCo; its positions are recorded when they are first drawn."""

    replay: Replay
    draws = True
    has_cameras = True

    @cached_property
    def motion(self) -> Motion:
        """The model, and its positions at each sample."""
        return record(self.replay)

    def gif(
        self, size: Sequence[int] | None = None, camera: str | None = None, fps: float | None = None
    ) -> bytes:
        """Return an animated GIF."""
        pixels = None if size is None else (int(size[0]), int(size[1]))
        with TemporaryDirectory() as folder:
            path = Path(folder) / "animation.gif"
            return film(self.motion, path, pixels, camera=camera, fps=fps).read_bytes()

    def strip(self, path: Path) -> Path:
        """Write a PNG of frames side by side."""
        return strip(self.motion, path)


def filmed(system: object, replay: Replay) -> MuJoCoFilm | None:
    """Return the film of a replay if its system has a MuJoCo model."""
    return MuJoCoFilm(replay) if can_draw(system) else None
