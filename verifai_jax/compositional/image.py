"""The image that decides: one for each point of the region of uncertainty."""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from verifai_jax.compositional.region import AbstractLoop
from verifai_jax.core.trace import Trace
from verifai_jax.systems.base import Seed, System

Frame = Callable[[Any, Mapping[str, Array]], Mapping[str, Any]]
"""`(features, sample of a trace) -> signals` of the network's reading of one rendered image."""


class DecisiveImage(System):
    """The network's reading of the last image that the loop cannot do without.

    **Arguments:**

    - `loop`: the loop without images.
    - `frame`: renders one image, and returns the signals of the network's reading.
    - `lanes`: images that are worked on together.
    """

    exact_step = True

    def __init__(self, loop: AbstractLoop, frame: Frame, lanes: int) -> None:
        self.loop, self.frame, self.lanes = loop, frame, lanes
        self.dt = 1.0

    def __call__(self, features: Any, key: Seed = None) -> Trace:
        """Render one image; the trace has one sample."""
        seen = self.frame(features, self.loop.decisive(features).sample)
        if not isinstance(seen, Mapping):
            raise TypeError(f"frame must return a dictionary of signals; got {type(seen).__name__}")
        return Trace({name: jnp.asarray(value)[None] for name, value in seen.items()}, dt=1.0)
