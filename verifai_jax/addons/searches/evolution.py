"""One step of CMA-ES: a Gaussian learns from points and their ranks.

Hansen, The CMA Evolution Strategy: A Tutorial, 2016, revised 2023: rates and weights are the
defaults of its table 1, where those of the worse points are negative. A Cholesky factor stands for
the symmetric root of the covariance
(Krause, Arbones, Igel, A CMA-ES with optimal covariance update and storage complexity, 2016). A
covariance of shape `[n]` is a diagonal one, which learns faster by a factor (Ros, Hansen, A simple
modification in CMA-ES achieving linear time and space complexity, 2008).
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float


class Evolution(NamedTuple):
    mean: Float[Array, " n"]
    size: Float[Array, ""]  # of the step
    covariance: Float[Array, "n *n"]  # over the squared size; or its diagonal
    path: Float[Array, " n"]  # evolution paths, of the covariance and of the size
    whitened: Float[Array, " n"]
    age: Float[Array, ""]  # steps taken

    @classmethod
    def begin(cls, mean: Float[Array, " n"], size: Float[Array, ""], full: bool) -> "Evolution":
        n = len(mean)
        return cls(
            mean=mean,
            size=size,
            covariance=jnp.eye(n, dtype=jnp.float32) if full else jnp.ones(n, jnp.float32),
            path=jnp.zeros(n, jnp.float32),
            whitened=jnp.zeros(n, jnp.float32),
            age=jnp.float32(0),
        )

    def variance(self) -> Float[Array, " n"]:
        """Return the variance of each coordinate, divided by the squared step size."""
        return jnp.diagonal(self.covariance) if self.covariance.ndim == 2 else self.covariance

    def draw(self, normal: Float[Array, "m n"]) -> Float[Array, "m n"]:
        """Draw points of the Gaussian from standard normal numbers."""
        if self.covariance.ndim == 1:
            return self.mean + self.size * jnp.sqrt(self.covariance) * normal
        return self.mean + self.size * normal @ jnp.linalg.cholesky(self.covariance).T

    def learn(
        self, points: Float[Array, "m n"], weights: Float[Array, " m"],
        worse: Float[Array, " m"] | float = 0.0,
    ) -> "Evolution":  # fmt: skip
        """Update from the points of a generation; comments give the names of the CMA-ES tutorial.

        **Arguments:**
        - `points`: the points of a generation.
        - `weights`: recombination weights, which sum to one.
        - `worse`: weights of the points along which the covariance shrinks; they sum to one or are
          all zero.
        """
        n = len(self.mean)
        if n == 0:
            return self
        steps = (points - self.mean) / self.size
        white = self._white(steps)
        # Points that others replaced may be far out: as for injected ones, their steps are cut
        # (Hansen, Injecting external solutions into CMA-ES, 2011).
        norm = jnp.sqrt(jnp.sum(white**2, axis=1, keepdims=True))
        limit = math.sqrt(n) + 2 * n / (n + 2)
        cut = jnp.minimum(1.0, limit / jnp.maximum(norm, 1e-12))
        steps, white = steps * cut, white * cut
        mass = _mass(weights)  # mu_eff
        size_rate = (mass + 2) / (n + mass + 5)  # c_sigma
        damping = 1 + 2 * jnp.maximum(0, jnp.sqrt((mass - 1) / (n + 1)) - 1) + size_rate
        path_rate = (4 + mass / n) / (n + 4 + 2 * mass / n)  # c_c
        one, many = rates(mass, n, self.covariance.ndim == 2)
        # The sum of the negative weights; the last limit keeps the covariance positive definite.
        learned = jnp.maximum(many, 1e-12)
        shrinking = jnp.minimum(1 + one / learned, 1 + 2 * _mass(worse) / (mass + 2))
        shrinking = jnp.minimum(shrinking, (1 - one - many) / (n * learned)) * jnp.sum(worse)
        length = jnp.sum(white**2, axis=1)
        signed = weights - shrinking * worse * n / jnp.maximum(length, 1e-12)
        step = weights @ steps
        gain = jnp.sqrt(size_rate * (2 - size_rate) * mass)
        whitened = (1 - size_rate) * self.whitened + gain * (weights @ white)
        length = jnp.sqrt(jnp.sum(whitened**2))
        expected = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
        growth = size_rate / damping * (length / expected - 1)
        unbiased = jnp.sqrt(1 - (1 - size_rate) ** (2 * (self.age + 1)))
        steady = length / unbiased < (1.4 + 2 / (n + 1)) * expected  # h_sigma
        gain = jnp.sqrt(path_rate * (2 - path_rate) * mass)
        path = (1 - path_rate) * self.path + steady * gain * step
        kept = 1 - one - many * (1 - shrinking) + one * (1 - steady) * path_rate * (2 - path_rate)
        if self.covariance.ndim == 1:
            covariance = kept * self.covariance + one * path**2 + many * (signed @ steps**2)
        else:
            spread = (signed * steps.T) @ steps
            covariance = kept * self.covariance + one * jnp.outer(path, path) + many * spread
        return Evolution(
            mean=self.mean + self.size * step, size=self.size * jnp.exp(jnp.minimum(growth, 1.0)),
            covariance=covariance, path=path, whitened=whitened, age=self.age + 1,
        )  # fmt: skip

    def widened(self, min_std: Float[np.ndarray, " n"]) -> "Evolution":
        """Raise standard deviations to at least `min_std`, and scale the covariance by a factor."""
        if len(self.mean) == 0:
            return self
        # A direction may become narrow, but not so that 32 bits lose it.
        variance = self.variance()
        floor = jnp.maximum(1e-6 * jnp.max(variance), 1e-12)
        std = self.size * jnp.sqrt(jnp.maximum(variance, floor))
        factor = jnp.maximum(min_std.astype(np.float32) / std, 1.0)
        if self.covariance.ndim == 1:
            return self._replace(covariance=factor**2 * jnp.maximum(variance, floor))
        covariance = self.covariance + floor * jnp.eye(len(self.mean), dtype=jnp.float32)
        return self._replace(covariance=factor[:, None] * covariance * factor)

    def _white(self, steps: Float[Array, "m n"]) -> Float[Array, "m n"]:
        if self.covariance.ndim == 1:
            return steps / jnp.sqrt(self.covariance)
        factor = jnp.linalg.cholesky(self.covariance)
        return solve_triangular(factor, steps.T, lower=True).T


def _mass(weights: Float[Array, " m"] | float) -> Float[Array, ""]:
    """Return as how many equal weights these count."""
    return jnp.sum(weights) ** 2 / jnp.maximum(jnp.sum(weights**2), 1e-12)


def rates(
    mass: float | Float[Array, ""], n: int, full: bool
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the learning rates of the covariance: for its path, and for a generation's points.

    **Arguments:**
    - `mass`: effective number of equal weights of the better points.
    - `n`: number of coordinates.
    - `full`: whether the covariance is a full matrix, not a diagonal.
    """
    one = 2 / ((n + 1.3) ** 2 + mass)  # c_1
    many = 2 * (0.25 + mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass)  # c_mu
    if not full:
        one, many = (jnp.minimum(rate * (n + 2) / 3, 0.5) for rate in (one, many))
    one = jnp.asarray(one)
    return one, jnp.clip(many, 0.0, 1 - one)


def recombination(score: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return weights of points: logarithmic in the rank, zero in the worse half, equal for ties.

    Points with an infinite score get weight zero.
    """
    there = jnp.isfinite(score)
    # A single point is all that there is.
    weight = jnp.where(jnp.sum(there) > 1, jnp.maximum(_log_ranks(score), 0.0), 1.0)
    return _shared(jnp.where(there, weight, 0.0), score)


def reverse_recombination(score: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return weights for the worse half, as `recombination` does for the better half.

    A point that ties with one of the better half gets weight zero.
    """
    there = jnp.isfinite(score)
    worse = there & (recombination(score) == 0)
    return _shared(jnp.where(worse, jnp.maximum(-_log_ranks(score), 0.0), 0.0), score)


def _log_ranks(score: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return weights by rank: positive in the better half, negative in the worse one."""
    count = jnp.sum(jnp.isfinite(score)).astype(jnp.float32)
    rank = jnp.argsort(jnp.argsort(score)).astype(jnp.float32)
    return jnp.log((count + 1) / 2) - jnp.log(rank + 1)


def _shared(weight: Float[Array, " m"], score: Float[Array, " m"]) -> Float[Array, " m"]:
    """Share weights evenly among points of the same score, and let all sum to one."""
    there = jnp.isfinite(score)
    tied = (score[:, None] == score[None]) & there
    weight = jnp.where(there, (tied @ weight) / jnp.maximum(jnp.sum(tied, axis=1), 1), 0.0)
    return weight / jnp.maximum(jnp.sum(weight), 1e-12)
