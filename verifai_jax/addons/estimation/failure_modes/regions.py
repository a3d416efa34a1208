"""Failing regions of standard normal space, and the one that a failure belongs to.

    regions.assign(failures)                        # the region [n] of each failure
    regions.design_points                           # [k, d], the likeliest failure of each

A failure belongs to the region of the nearest point. Plain distances fail for a region that is
narrow in a few coordinates and wide in many others. So distances are measured in standard
deviations of the region if this separates the known points better.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import digamma

from verifai_jax.addons.estimation.normal_space import squared_distances

NEIGHBOURS = 5
"""Regions whose nearest point a path is tried to, and further nearest points, at most."""
PRIOR_FREEDOM = 4
"""Weight of the prior's standard deviations, in samples, when those of a region are fitted."""
MIN_SCALE, MAX_SCALE = 1e-4, 3.0
"""Least and greatest standard deviation of a region."""


@dataclass
class Regions:
    """Regions of failures.

    - `points`: failures `[m, d]`, several for each region.
    - `region`: the region `[m]` of each failure.
    """

    points: Float[np.ndarray, "m d"]
    region: Int[np.ndarray, " m"]

    @property
    def count(self) -> int:
        """Number of regions."""
        return int(self.region.max()) + 1 if len(self.region) else 0

    @property
    def design_rows(self) -> list[int]:
        """Row of each region's failure nearest to the origin."""
        norms = np.linalg.norm(self.points, axis=1)
        return [
            int(np.flatnonzero(self.region == k)[norms[self.region == k].argmin()])
            for k in range(self.count)
        ]

    @property
    def design_points(self) -> Float[np.ndarray, "k d"]:
        """Each region's failure nearest to the origin."""
        return self.points[self.design_rows]

    def assign(self, z: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
        """Return the region of each failure: that of the nearest point."""
        return np.argmin(self._nearest(z, self._scales())[0], axis=1)

    def candidates(self, z: Float[np.ndarray, "n d"]) -> Int[np.ndarray, "n tried"]:
        """Return rows of points to try paths to: the nearest of each near region, then others."""
        distances, rows = self._nearest(z, self._scales())
        order = np.argsort(distances, axis=1)[:, :NEIGHBOURS]
        others = np.argsort(squared_distances(z, self.points), axis=1)[:, :NEIGHBOURS]
        return np.concatenate([np.take_along_axis(rows, order, axis=1), others], axis=1)

    def add(self, points: Float[np.ndarray, "n d"], region: Int[np.ndarray, " n"] | int) -> None:
        """Add points to one region, or each point to its own region."""
        self.points = np.concatenate([self.points, points])
        self.region = np.append(self.region, np.broadcast_to(region, len(points)))

    def standard_deviations(self) -> Float[np.ndarray, "k d"]:
        """Return the deviations of each region, shrunk to the prior's if it has few points."""
        stds = np.ones((self.count, self.points.shape[1]))
        for k in range(self.count):
            points = self.points[self.region == k]
            freedom = len(points) - 1
            if not freedom:
                continue
            # The logarithm of a standard deviation of few points is too low in the mean.
            bias = (digamma(freedom / 2) - np.log(freedom / 2)) / 2
            own = np.clip(points.std(axis=0, ddof=1) * np.exp(-bias), MIN_SCALE, MAX_SCALE)
            stds[k] = own ** (freedom / (freedom + PRIOR_FREEDOM))
        return stds

    def _scales(self) -> Float[np.ndarray, "k d"]:
        """Return the standard deviations that distances from each region are measured in."""
        own = self.standard_deviations()
        ones = np.ones_like(own)
        return own if self._mistaken(own) < self._mistaken(ones) else ones

    def _mistaken(self, scales: Float[np.ndarray, "k d"]) -> int:
        """Count the points nearer to another region than to the other points of their own."""
        distances, _ = self._nearest(self.points, scales, itself=False)
        alone = np.bincount(self.region)[self.region] < 2
        return int(np.sum((distances.argmin(axis=1) != self.region) & ~alone))

    def _nearest(
        self, z: Float[np.ndarray, "n d"], scales: Float[np.ndarray, "k d"], itself: bool = True
    ) -> tuple[Float[np.ndarray, "n k"], Int[np.ndarray, "n k"]]:
        """Return the distance of each point from each region, and the row of the nearest point.

        These are logarithms of normal densities around the points, up to sign and factor. Where `z`
        are the points of the regions, `itself` says whether a point counts as its own neighbour.
        """
        distances = np.full((len(z), self.count), np.inf)
        rows = np.zeros((len(z), self.count), int)
        for k, scale in enumerate(scales):
            own = np.flatnonzero(self.region == k)
            gaps = squared_distances(z / scale, self.points[own] / scale)
            if not itself:
                gaps[own, np.arange(len(own))] = np.inf
            rows[:, k] = own[gaps.argmin(axis=1)]
            distances[:, k] = gaps.min(axis=1) + 2 * np.sum(np.log(scale))
        return distances, rows
