"""Densities on standard normal space, relative to the prior: the components of proposals.

component = Gaussian(mean, axes, stds)
z = component.sample(rng, 1000)
component.log_ratio(z)                          # its density over the prior's, logarithmic
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.estimation.normal_space import to_normal_space


@runtime_checkable
class Component(Protocol):
    """A density over standard normal space, relative to the prior."""

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        """Draw independent points."""
        ...

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Return the logarithm of this density divided by the standard normal one."""
        ...


@dataclass(frozen=True)
class Prior:
    """The prior itself: the defensive part of a mixture."""

    dim: int

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        return rng.standard_normal((n, self.dim))

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        return np.zeros(len(z))


@dataclass(frozen=True)
class Gaussian:
    """A normal density.

    - `mean`: its centre.
    - `axes`: principal axes, one a column.
    - `stds`: standard deviations along the axes.
    """

    mean: Float[np.ndarray, " d"]
    axes: Float[np.ndarray, "d d"]
    stds: Float[np.ndarray, " d"]

    def widened(self, factor: float) -> "Gaussian":
        """Return this density with standard deviations below the prior's increased towards it."""
        stds = np.where(self.stds < 1, np.minimum(factor * self.stds, 1.0), self.stds)
        return Gaussian(self.mean, self.axes, stds)

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        return self.mean + (rng.standard_normal((n, len(self.mean))) * self.stds) @ self.axes.T

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        white = (z - self.mean) @ self.axes / self.stds
        return (np.sum(z * z, axis=1) - np.sum(white * white, axis=1)) / 2 - np.sum(
            np.log(self.stds)
        )


@dataclass(frozen=True)
class Marginals:
    """Independent coordinates, each the prior times a step function of the coordinate.

    - `edges`: for each coordinate, borders of the steps in normal space, from -inf to inf.
    - `log_steps`: for each coordinate, logarithms of the density divided by the prior's.
    - `masses`: for each coordinate, probabilities of the steps.
    """

    edges: tuple[Float[np.ndarray, " _"], ...]
    log_steps: tuple[Float[np.ndarray, " _"], ...]
    masses: tuple[Float[np.ndarray, " _"], ...]

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        z = rng.standard_normal((n, len(self.edges)))
        for i, (edges, mass) in enumerate(zip(self.edges, self.masses, strict=True)):
            if len(mass) > 1:
                step = rng.choice(len(mass), n, p=mass)
                z[:, i] = _between(edges[step], edges[step + 1], rng.random(n))
        return z

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        total = np.zeros(len(z))
        for i, (edges, log) in enumerate(zip(self.edges, self.log_steps, strict=True)):
            if len(log) > 1:
                total += log[np.searchsorted(edges[1:-1], z[:, i], side="right")]
        return total


@dataclass(frozen=True)
class Copula:
    """A density with given marginals and the dependence of a normal vector.

    - `marginals`: densities of the coordinates.
    - `axes`: eigenvectors of the correlation matrix, one a column.
    - `stds`: square roots of its eigenvalues.
    """

    marginals: Marginals
    axes: Float[np.ndarray, "d d"]
    stds: Float[np.ndarray, " d"]

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        from scipy.special import ndtr, ndtri

        v = (rng.standard_normal((n, len(self.stds))) * self.stds) @ self.axes.T
        z = v.copy()
        for i, (edges, mass) in enumerate(
            zip(self.marginals.edges, self.marginals.masses, strict=True)
        ):
            if len(mass) > 1:
                rank, total = ndtr(v[:, i]), np.append(0, np.cumsum(mass))
                step = np.clip(np.searchsorted(total, rank, side="right") - 1, 0, len(mass) - 1)
                within = (rank - total[step]) / mass[step]
                z[:, i] = _between(edges[step], edges[step + 1], within)
            else:
                z[:, i] = ndtri(ndtr(v[:, i]))
        return z

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        v = rank_scores(self.marginals, z)
        white = v @ self.axes / self.stds
        dependence = (np.sum(v * v, axis=1) - np.sum(white * white, axis=1)) / 2
        return self.marginals.log_ratio(z) + dependence - np.sum(np.log(self.stds))


def rank_scores(marginals: Marginals, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Map each coordinate to the standard normal number of the same rank."""
    from scipy.special import ndtr, ndtri

    v = z.copy()
    for i, (edges, mass) in enumerate(zip(marginals.edges, marginals.masses, strict=True)):
        if len(mass) > 1:
            borders = ndtr(edges)
            step = np.searchsorted(edges[1:-1], z[:, i], side="right")
            within = (ndtr(z[:, i]) - borders[step]) / (borders[step + 1] - borders[step])
            rank = np.append(0, np.cumsum(mass))[step] + within * mass[step]
            v[:, i] = ndtri(np.clip(rank, 1e-12, 1 - 1e-12))
    return v


@dataclass(frozen=True)
class Shell:
    """A rotationally symmetric density: the prior times a step function of the distance.

    - `dim`: number of coordinates.
    - `steps`: the step function over normal scores of the distance from the origin.
    """

    dim: int
    steps: Marginals

    def sample(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n d"]:
        from scipy.special import gammainccinv, gammaincinv, ndtr

        score = self.steps.sample(rng, n)[:, 0]
        half = self.dim / 2
        square = np.where(
            score > 0, gammainccinv(half, ndtr(-score)), gammaincinv(half, ndtr(score))
        )
        direction = rng.standard_normal((n, self.dim))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return direction * np.sqrt(2 * square)[:, None]

    def log_ratio(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        return self.steps.log_ratio(radial_score(z)[:, None])


def radial_score(z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Map the distance from the origin to the standard normal number of the same rank."""
    from scipy.special import gammainc, gammaincc, ndtri

    half, square = z.shape[1] / 2, np.sum(z * z, axis=1) / 2
    above = gammaincc(half, square)
    outer = -ndtri(np.maximum(above, 1e-300))
    return np.where(above < 0.5, outer, ndtri(np.maximum(gammainc(half, square), 1e-300)))


def _between(low: np.ndarray, high: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Return standard normal numbers between two borders, exact in both tails."""
    from scipy.special import ndtr

    mirrored = low > 0
    a, b = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    rank = np.where(mirrored, 1 - uniform, uniform)  # It must still grow with the result.
    z = to_normal_space(ndtr(a) + rank * (ndtr(b) - ndtr(a)))
    return np.where(mirrored, -z, z)


def log_ratios(
    components: Sequence[Component], z: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "n k"]:
    """Return logarithms of each component's density over the prior's, clipped to be finite."""
    if not len(z):
        return np.zeros((0, len(components)))
    columns = [np.clip(component.log_ratio(z), -700, 700) for component in components]
    return np.stack(columns, axis=1)
