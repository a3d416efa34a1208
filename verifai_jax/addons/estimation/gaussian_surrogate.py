"""A Gaussian process on the robustness over normal space, with or without a cheap model.

surrogate = Surrogate(dim)
surrogate.learn(z, rho)
mean, std = surrogate.predict(z)        # a failure is below zero
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.addons.estimation.answers import Cheap
from verifai_jax.addons.estimation.normal_space import to_unit_cube
from verifai_jax.addons.searches.gaussian import GaussianProcess, Hyper, Posterior, TrainingData
from verifai_jax.core.compute.compilation import jit_each, power_of_two

REACH = 16.0
"""Width of the box of normal space that is the cube of the Gaussian process."""
CAPACITY = 512
"""Simulations that the surrogate knows at most, which bounds its arithmetic."""
CHUNK = 256
"""Points that the surrogate predicts in one call, so that one shape compiles."""
STEPS = 30
"""Steps of a fit of hyper-parameters, which goes on from the last one."""


class Surrogate:
    """A Gaussian process for the robustness over normal space.

    With a cheap model of the same features it models the difference to a multiple of the cheap
    robustness (Kennedy, O'Hagan, Predicting the output from a complex computer code when fast
    approximations are available, Biometrika 87, 2000). For a useless cheap model the multiple is
    zero.

    **Arguments:**
    - `dim`: number of coordinates.
    - `cheap`: the robustness of the cheap model at points of the unit cube; none when left out.
    """

    def __init__(self, dim: int, cheap: Cheap | None = None) -> None:
        self.process = GaussianProcess((False,) * dim)
        self.hyper, self.scale = self.process.first(), 1.0
        self.posterior: Posterior | None = None
        self.cheap, self.cheap_unit = cheap, 0.0
        self.trend = np.zeros(2)
        """Constant, and multiple of the cheap robustness."""

    def learn(self, z: Float[np.ndarray, "n d"], rho: Float[np.ndarray, " n"]) -> None:
        """Fit the robustness of all points so far; only the last ones if they are too many."""
        z, rho = z[-CAPACITY:], rho[-CAPACITY:]
        # Linear near zero, where the sign is, and logarithmic where it is far away.
        y = np.arcsinh(rho / max(float(np.median(np.abs(rho))), 1e-30))
        basis = self._basis(z)
        self.trend = np.linalg.lstsq(basis, y, rcond=None)[0]
        y = y - basis @ self.trend
        self.scale = max(float(y.std()), 1e-6)
        size = max(128, power_of_two(len(z)))
        pad = size - len(z)
        x: Any = np.pad(_boxed(z), ((0, pad), (0, 0)))
        targets: Any = np.pad(y / self.scale, (0, pad)).astype(np.float32)
        mask: Any = np.arange(size) < len(z)
        data = TrainingData(x, targets, mask)
        self.hyper, self.posterior = _fitted(self.process, self.hyper, data)

    def predict(
        self, z: Float[np.ndarray, "n d"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return means and standard deviations, in units in which failures are below zero."""
        parts = []
        for start in range(0, len(z), CHUNK):
            part = _boxed(z[start : start + CHUNK])
            padded = np.pad(part, ((0, CHUNK - len(part)), (0, 0)))
            mean, std = _predicted(self.process, self.posterior, padded)
            parts.append((np.asarray(mean)[: len(part)], np.asarray(std)[: len(part)]))
        mean, std = (np.concatenate(column) for column in zip(*parts, strict=True))
        return mean + self._basis(z) @ self.trend / self.scale, std.astype(float)

    def _basis(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n 2"]:
        if self.cheap is None:
            return np.column_stack([np.ones(len(z)), np.zeros(len(z))])
        rho = self.cheap(to_unit_cube(z))
        known = np.isfinite(rho)
        rho = np.where(known, rho, np.max(rho, where=known, initial=0.0))
        self.cheap_unit = self.cheap_unit or max(float(np.median(np.abs(rho))), 1e-30)
        return np.column_stack([np.ones(len(z)), np.arcsinh(rho / self.cheap_unit)])

    def covariance(self, z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n n"]:
        """Return the covariance of the values at points."""
        return np.asarray(_covariance(self.process, self.posterior, _boxed(z)), float)


def _boxed(z: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    return np.asarray(0.5 + z / REACH, np.float32)


@jit_each()
def _fitted(process: GaussianProcess, hyper: Hyper, data: TrainingData) -> tuple[Hyper, Posterior]:
    hyper = process.fit(hyper, data, STEPS)
    return hyper, process.condition(hyper, data)


@jit_each()
def _predicted(process: GaussianProcess, posterior: Posterior, x: Array) -> tuple[Array, Array]:
    return process.predict(posterior, x)


@jit_each()
def _covariance(process: GaussianProcess, posterior: Posterior, x: Array) -> Array:
    cross = process.cross(posterior, x)
    left = jax.scipy.linalg.solve_triangular(posterior.factor, cross.T, lower=True)
    return process.covariance(posterior.hyper, x, x) - left.T @ left
