"""The part of an environment's prior that is attacked: the centre with most of its probability.

    region = region_of(loop, mass=0.999)
    points = region.project(points)                 # [n, d] of the environment's cube
    region.describe()                               # what is varied, and how far

A search for the least robustness alone goes to the ends of all tails at once, five deviations out
in every feature. This never happens in practice, and perhaps no parameters withstand it. So
features with tails are limited to a ball in normal scores with the given probability. Features
without tails, such as a Box, are equally probable in their corners and are not limited.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.addons.synthesis.parametric import Parametric
from verifai_jax.core.messages.text import format_percent
from verifai_jax.features.continuous import scipy_special

MIN_QUANTILE = 1e-12
"""Distance that normal scores keep from the ends of the cube, where they are infinite."""
MAX_NAMES = 6
"""Features that are named one by one."""


@dataclass(frozen=True)
class Region:
    """A part of the cube of an environment; see the module's docstring.

    - `parameters`, `features`: names of the parameters, and of the features of the environment.
    - `tailed`: for each coordinate, whether its feature has tails.
    - `names`: the names of the features with tails.
    - `mass`: probability of the region, 1 for the whole cube.
    """

    parameters: tuple[str, ...]
    features: tuple[str, ...]
    tailed: Bool[np.ndarray, " d"]
    names: tuple[str, ...]
    mass: float

    @property
    def radius(self) -> float:
        """Distance from the medians in normal scores, over all coordinates with tails."""
        count = int(self.tailed.sum())
        if self.mass >= 1 or not count:
            return math.inf
        return math.sqrt(float(scipy_special().chdtri(count, 1 - self.mass)))

    @property
    def ends(self) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
        """The corners of the bounding box of the region, in the environment's cube."""
        low = np.where(self.tailed, scipy_special().ndtr(-self.radius), 0.0)
        return low, 1 - low

    def contains(self, points: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
        """Return which points lie in the region."""
        return np.linalg.norm(self._scores(points), axis=1) <= self.radius * (1 + 1e-6)

    def project(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
        """Return points; those outside are moved towards the medians to the edge of the region."""
        outside = ~self.contains(points)
        if not outside.any():
            return points
        scores = self._scores(points[outside])
        share = self.radius / np.linalg.norm(scores, axis=1, keepdims=True)
        moved = np.array(points, np.float32)
        moved[np.ix_(outside, self.tailed)] = scipy_special().ndtr(scores * share)
        return moved

    def describe(self) -> str:
        """Describe the parameters, the environment, and the extent of the region."""
        text = f"varied {_listed(self.features)}"
        if self.parameters:
            text = f"chose {_listed(self.parameters)}, {text}"
        if not self.names:
            return f"{text}, everywhere"
        if not math.isfinite(self.radius):
            return f"{text}, everywhere, in the whole of the tails of {_listed(self.names)}"
        together = " together" if self.tailed.sum() > 1 else ""
        return (
            f"{text}, where the prior has a probability of {format_percent(self.mass)}: "
            f"{_listed(self.names)} within {self.radius:z.3g} standard deviations{together} (mass=)"
        )

    def _scores(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n t"]:
        u = np.asarray(points, np.float64)[:, self.tailed]
        return scipy_special().ndtri(np.clip(u, MIN_QUANTILE, 1 - MIN_QUANTILE))


def region_of(loop: Parametric, mass: float) -> Region | None:
    """Return the region in which a loop's environment is attacked; None without an environment.

    **Raises:** `ValueError` for a mass that is not a probability above 0.
    """
    if isinstance(mass, bool) or not isinstance(mass, int | float) or not 0 < mass <= 1:
        raise ValueError(
            f"mass must be a probability above 0, and 1 for the whole prior; got {mass!r}"
        )
    if loop.environment is None:
        return None
    fields = loop.environment.root.fields
    tailed = [(name, domain.tailed) for name, domain in fields]
    each = [has for _, coordinates in tailed for has in coordinates]
    names = tuple(name for name, coordinates in tailed if any(coordinates))
    features = tuple(name for name, domain in fields if domain.size)
    return Region(getattr(loop, "names", ()), features, np.array(each, bool), names, float(mass))


def _listed(names: tuple[str, ...]) -> str:
    shown = ", ".join(names[:MAX_NAMES])
    return f"{shown} and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else shown
