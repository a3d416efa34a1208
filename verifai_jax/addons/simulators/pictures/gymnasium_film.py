"""Films of environments of Gymnasium, which draw themselves (`render_mode="rgb_array"`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from verifai_jax.addons.simulators.environments import EpisodeFunction
from verifai_jax.addons.simulators.pictures import frames as film
from verifai_jax.evaluation.replay import Replay
from verifai_jax.pictures.film import check_film
from verifai_jax.systems.blackbox._blackbox import plain_leaves, seed_of

FRAMES_PER_SECOND = 20


@dataclass(frozen=True)
class EpisodeFilm:
    """Pictures of a replay by its environment of Gymnasium."""

    episode: EpisodeFunction
    replay: Replay
    has_cameras = False

    @property
    def draws(self) -> bool:
        """True for an environment that was made with `render_mode="rgb_array"`."""
        return self.episode.draws

    def gif(
        self, size: Sequence[int] | None = None, camera: str | None = None, fps: float | None = None
    ) -> bytes:
        """Return an animated GIF."""
        return film_episode(self.episode, self.replay, size, fps)

    def strip(self, path: Path) -> None:
        """Write nothing: an environment has no strip of frames."""


def film_episode(
    episode: EpisodeFunction, replay: Replay, size: Sequence[int] | None = None,
    fps: float | None = None,
) -> bytes:  # fmt: skip
    """Simulate an episode again in this process, and return the environment's pictures as a GIF.

    **Arguments:**
    - `episode`: the episodes of the replay's system.
    - `replay`: the replay of a problem with a Gymnasium environment.
    - `size`: width and height in pixels; by default those of the environment.
    - `fps`: frames per second; `FRAMES_PER_SECOND` when left out.
    **Raises:** `ValueError` for an environment that draws no pictures.
    """
    check_film(size, fps)
    clock = np.asarray(replay.trace.clock(), np.float64)
    samples, shown = film.film_samples(clock, fps, FRAMES_PER_SECOND)
    features, seed = plain_leaves(replay.features), seed_of(replay.key)
    drawn = episode.frames(features, seed, set(samples.tolist()))
    decided = film.decided_at(replay)
    frames = []
    for sample in samples.tolist():
        # An episode that ends earlier than before stays where it ended.
        frame = drawn[min(sample, max(drawn))]
        failed = decided is not None and sample >= decided
        frames.append(
            film.labelled(
                _resized(frame, size), film.caption_of(replay), float(clock[sample]), failed
            )
        )
    return film.gif(frames, shown)


def _resized(
    frame: film.Frame, size: Sequence[int] | None
) -> UInt8[np.ndarray, "wanted_height wanted_width 3"]:
    if size is None:
        return frame
    from PIL import Image

    return np.asarray(Image.fromarray(frame).resize((size[0], size[1])))
