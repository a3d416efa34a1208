"""Films of environments of Gymnasium, which draw themselves (`render_mode="rgb_array"`)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from verifai_jax.addons.simulators.environments import EpisodeFunction
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.evaluation.replay import Replay
from verifai_jax.pictures import film
from verifai_jax.systems.blackbox._blackbox import plain_leaves, seed_of

FRAMES_PER_SECOND = 20


def episode_of(system: object) -> EpisodeFunction | None:
    """Return the episodes of a system made by `vj.gymnasium`; None for any other."""
    function = getattr(getattr(system, "simulation", None), "function", None)
    return function if isinstance(function, EpisodeFunction) else None


def film_episode(
    replay: Replay, size: Sequence[int] | None = None, fps: float | None = None
) -> bytes:
    """Simulate an episode again in this process, and return the environment's pictures as a GIF.

    **Arguments:**
    - `replay`: the replay of a problem with a Gymnasium environment.
    - `size`: width and height in pixels; by default those of the environment.
    - `fps`: frames per second; `FRAMES_PER_SECOND` when left out.
    **Raises:** `ValueError` for an environment that draws no pictures.
    """
    film.check_film(size, fps)
    episode = episode_of(replay.problem.system)
    assert episode is not None
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


def write_episode(replay: Replay, path: Path) -> Path:
    """Write the film of an episode; returns the path."""
    with replacing(path) as partial:
        partial.write_bytes(film_episode(replay))
    return path


def _resized(
    frame: film.Frame, size: Sequence[int] | None
) -> UInt8[np.ndarray, "wanted_height wanted_width 3"]:
    if size is None:
        return frame
    from PIL import Image

    return np.asarray(Image.fromarray(frame).resize((size[0], size[1])))
