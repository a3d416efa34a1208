"""Gaussian process regression with a Matern-5/2 covariance, on a buffer of fixed size.

Rasmussen, Williams, Gaussian Processes for Machine Learning, 2006: posterior and evidence are those
of algorithm 2.1, the gradient of the evidence is that of section 5.4.1. Every coordinate has its
own length scale; unordered coordinates hold codes, and contribute a factor that only asks whether
two codes are the same. Samples of the posterior are whole functions, drawn by pathwise conditioning
(Wilson et al., Efficiently sampling functions from Gaussian process posteriors, ICML 2020): a
random function of the prior, plus the update that takes it to the observations.

Shapes do not depend on the number of observations: absent rows have the covariance of independent
noise and the target zero, so they have no effect.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float, Key, PyTree

from verifai_jax.search.surrogate import matern, squared_distances

VARIANCE = (-3.0, 4.0)
"""Range of the logarithm of the variance. Data have variance 1, whose logarithm is well inside."""
LENGTH = (-4.0, 8.0)
"""Range of the logarithms of the length scales, in cubes: from a fiftieth of a cube, below which a
few hundred points say nothing about what lies between them, to 3000 cubes, where a coordinate is of
no influence."""
NOISE = (-11.0, 0.0)  # range of the logarithm of the noise, which keeps 32-bit factors finite
SMALLEST = 2.0**-24  # smallest uniform number above zero, where a normal quantile is infinite
Fitted = TypeVar("Fitted", bound=PyTree)
"""Hyper-parameters: a pytree of arrays."""


class Hyper(NamedTuple):
    """Natural logarithms of the hyper-parameters."""

    variance: Float[Array, ""]
    lengths: Float[Array, " d"]
    noise: Float[Array, ""]  # variance of the noise


class TrainingData(NamedTuple):
    """Points `x`, their targets `y`, and a `mask` of the rows that are present."""

    x: Float[Array, "n d"]
    y: Float[Array, " n"]
    mask: Bool[Array, " n"]


class Posterior(NamedTuple):
    hyper: Hyper
    x: Float[Array, "n d"]
    mask: Bool[Array, " n"]
    residual: Float[Array, " n"]  # targets less the mean of the prior
    factor: Float[Array, "n n"]  # Cholesky factor of the covariance of the observations
    weights: Float[Array, " n"]  # its inverse times the targets


class Paths(NamedTuple):
    """Functions drawn from a posterior, as weights of random waves and of covariances."""

    frequencies: Float[Array, "f c"]
    phases: Float[Array, " f"]
    ignored: Bool[Array, "f k"]  # which unordered coordinates a wave ignores
    multiply: Array  # [f, k] unsigned: the sign of a wave at a code is a hash of it
    add: Array
    weights: Float[Array, "terms paths"]


@dataclass(frozen=True)
class GaussianProcess:
    """Gaussian process regression over points with these coordinates; the prior mean is zero.

    **Arguments:**
    - `unordered`: for each coordinate, whether it holds codes, not a quantity in `[0, 1]`.
    """

    unordered: tuple[bool, ...]

    def first(self) -> Hyper:
        """Return the start of the fit, with a correlation length of half the cube's diagonal."""
        plain, codes = self._indices()
        lengths = np.zeros(len(self.unordered))
        lengths[plain] = math.log(0.5 * math.sqrt(max(len(plain), 1)))
        lengths[codes] = math.log(max(len(codes), 1))
        return Hyper(jnp.float32(0.0), jnp.asarray(lengths, jnp.float32), jnp.float32(-6.0))

    def covariance(
        self, hyper: Hyper, a: Float[Array, "n d"], b: Float[Array, "m d"]
    ) -> Float[Array, "n m"]:
        """Return the covariance of the values at the points `a` and `b`, without noise."""
        plain, codes = self._indices()
        inverse = jnp.exp(-hyper.lengths)
        # About the middle, so that the difference below loses few digits.
        left, right = ((x[:, plain] - 0.5) * inverse[plain] for x in (a, b))
        value = jnp.exp(hyper.variance) * matern(squared_distances(left, right))
        if len(codes) == 0:
            return value
        differ = (a[:, None, codes] != b[None, :, codes]).astype(value.dtype)
        return value * jnp.exp(-differ @ inverse[codes])

    def evidence(self, hyper: Hyper, data: TrainingData) -> Float[Array, ""]:
        """Return the log marginal likelihood of the observations."""
        return _evidence(self._noisy(hyper, data.x, data.mask), _masked(data)) - (
            0.5 * math.log(2 * math.pi) * jnp.sum(data.mask)
        )

    def log_prior(self, hyper: Hyper) -> Float[Array, ""]:
        """Return the log density of the hyper-parameters, up to a constant.

        Length scales grow with the square root of the dimension, so that the prior's complexity
        does not grow (Hvarfner, Hellsten, Nardi, Vanilla Bayesian optimization performs great in
        high dimensions, ICML 2024).
        """
        plain, codes = self._indices()
        mean = math.sqrt(2) + 0.5 * math.log(max(len(plain), 1))
        lengths = jnp.sum((hyper.lengths[plain] - mean) ** 2) / 3
        mean = math.log(max(len(codes), 1))
        lengths = lengths + jnp.sum((hyper.lengths[codes] - mean) ** 2)
        return -0.5 * (lengths + hyper.variance**2 + (hyper.noise + 6.0) ** 2 / 2)

    def fit(self, hyper: Hyper, data: TrainingData, steps: int, rate: float = 0.15) -> Hyper:
        """Find the most probable hyper-parameters with Adam, starting from `hyper`.

        Steps that are not finite are skipped.
        """

        def loss(hyper: Hyper) -> Float[Array, ""]:
            return -self.evidence(hyper, data) - self.log_prior(hyper)

        return adam(loss, hyper, steps, rate, _bounded)

    def condition(self, hyper: Hyper, data: TrainingData) -> Posterior:
        """Return the process conditioned on these observations."""
        y = _masked(data)
        noisy = self._noisy(hyper, data.x, data.mask)
        factor, _ = finite_factor(noisy, jnp.exp(hyper.variance))
        weights = cho_solve((factor, True), y)
        return Posterior(hyper, data.x, data.mask, y, factor, weights)

    def predict(
        self, posterior: Posterior, x: Float[Array, "m d"]
    ) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Return mean and standard deviation of the values at these points, without noise."""
        return self.predictor(posterior)(x)

    def predictor(self, posterior: Posterior) -> Callable[[Float[Array, "m d"]], tuple]:
        """Return `predict` as a function of points that only needs products of matrices."""
        identity = jnp.eye(len(posterior.residual), dtype=posterior.factor.dtype)
        inverse = solve_triangular(posterior.factor, identity, lower=True)

        def predict(x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
            cross = self.cross(posterior, x)
            variance = jnp.exp(posterior.hyper.variance)
            variance = variance - jnp.sum((cross @ inverse.T) ** 2, axis=1)
            return cross @ posterior.weights, jnp.sqrt(jnp.maximum(variance, 1e-12))

        return predict

    def paths(self, posterior: Posterior, key: Key[Array, ""], count: int, waves: int) -> Paths:
        """Draw `count` functions from the posterior; the prior part has `waves` random waves."""
        hyper, n = posterior.hyper, len(posterior.residual)
        plain, codes = self._indices()
        c, k = len(plain), len(codes)
        # One call for all random numbers: each costs a good part of a second to compile.
        sizes = [waves * (c + 5), waves * (1 + 3 * k), (waves + n) * count]
        random = jax.random.uniform(key, (sum(sizes),), posterior.factor.dtype)
        # Or else every use of them computes them anew.
        random = jnp.split(jax.lax.optimization_barrier(random), np.cumsum(sizes)[:-1])
        normal = ndtri(jnp.maximum(jnp.concatenate([random[0], random[2]]), SMALLEST))
        spectrum = normal[: sizes[0]].reshape(waves, c + 5)
        amplitudes, noise = jnp.split(normal[sizes[0] :].reshape(waves + n, count), [waves])
        # The spectral density of Matern-5/2 is a t distribution with five degrees of freedom.
        scale = jnp.sqrt(5 / jnp.maximum(jnp.sum(spectrum[:, c:] ** 2, axis=1), 1e-6))
        phases, ignore, multiply, add = jnp.split(
            random[1].reshape(waves, 1 + 3 * k), [1, 1 + k, 1 + 2 * k], axis=1
        )
        drawn = Paths(
            frequencies=spectrum[:, :c] * scale[:, None] * jnp.exp(-hyper.lengths[plain]),
            phases=2 * math.pi * phases[:, 0],
            ignored=ignore < jnp.exp(-jnp.exp(-hyper.lengths[codes])),
            multiply=(multiply * 2.0**31).astype(jnp.uint32) * 2 + 1,
            add=(add * 2.0**31).astype(jnp.uint32) * 2,
            weights=amplitudes,
        )
        prior = self._waves(hyper, drawn, posterior.x) @ amplitudes
        noise = jnp.exp(hyper.noise / 2) * noise
        left = jnp.where(posterior.mask[:, None], posterior.residual[:, None] - prior - noise, 0.0)
        update = cho_solve((posterior.factor, True), left)
        return drawn._replace(weights=jnp.concatenate([amplitudes, update]))

    def basis(
        self, posterior: Posterior, paths: Paths, x: Float[Array, "m d"]
    ) -> Float[Array, "m terms"]:
        """Return basis functions at these points, to be multiplied by the weights of paths."""
        waves = self._waves(posterior.hyper, paths, x)
        return jnp.concatenate([waves, self.cross(posterior, x)], axis=1)

    def cross(self, posterior: Posterior, x: Float[Array, "m d"]) -> Float[Array, "m n"]:
        """Return covariances of the values with the observations; zero for absent ones."""
        return jnp.where(posterior.mask, self.covariance(posterior.hyper, x, posterior.x), 0.0)

    def _waves(self, hyper: Hyper, paths: Paths, x: Float[Array, "m d"]) -> Float[Array, "m f"]:
        plain, codes = self._indices()
        size = jnp.sqrt(2 * jnp.exp(hyper.variance) / len(paths.phases))
        waves = size * jnp.cos((x[:, plain] - 0.5) @ paths.frequencies.T + paths.phases)
        if len(codes) == 0:
            return waves
        # Multiply-shift hashing: signs at two codes are equal half of the time (Dietzfelbinger,
        # Universal hashing and k-wise independent random variables, 1996).
        code = x[:, None, codes].astype(jnp.uint32)
        odd = (paths.multiply * code + paths.add) >> 31
        flips = jnp.sum(jnp.where(paths.ignored, 0, odd), axis=-1)
        return jnp.where(flips % 2 == 0, waves, -waves)

    def _noisy(
        self, hyper: Hyper, x: Float[Array, "n d"], mask: Bool[Array, " n"]
    ) -> Float[Array, "n n"]:
        """Return the covariance of the observations; that of the absent ones is the identity."""
        both = mask[:, None] & mask[None]
        value = jnp.where(both, self.covariance(hyper, x, x), 0.0)
        return value + jnp.diag(jnp.where(mask, jnp.exp(hyper.noise), 1.0))

    def _indices(self) -> tuple[np.ndarray, np.ndarray]:
        """Return indices of the quantities and of the codes."""
        codes = np.array(self.unordered, bool)
        return np.flatnonzero(~codes), np.flatnonzero(codes)


def adam(
    loss: Callable[[Fitted], Array], start: Fitted, steps: int, rate: float,
    bounded: Callable[[Fitted], Fitted],
) -> Fitted:  # fmt: skip
    """Minimise a loss with Adam (Kingma, Ba, A method for stochastic optimization, ICLR 2015).

    Steps that are not finite are skipped; `bounded` maps the result of a step into its range.
    """

    def step(carry: tuple[Fitted, Fitted, Fitted], count: Array) -> tuple:
        value, first, second = carry
        slope = jax.grad(loss)(value)
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(slope)]
        ok = jnp.all(jnp.stack(finite))
        slope = jax.tree.map(lambda g: jnp.where(ok, g, 0.0), slope)
        first = jax.tree.map(lambda m, g: 0.8 * m + 0.2 * g, first, slope)
        second = jax.tree.map(lambda v, g: 0.95 * v + 0.05 * g**2, second, slope)

        def update(h: Array, m: Array, v: Array) -> Array:
            root = jnp.sqrt(v / (1 - 0.95**count)) + 1e-8
            return h - rate * (m / (1 - 0.8**count)) / root

        return (bounded(jax.tree.map(update, value, first, second)), first, second), None

    zero = jax.tree.map(jnp.zeros_like, start)
    counts = jnp.arange(1, steps + 1, dtype=jax.tree.leaves(start)[0].dtype)
    (fitted, _, _), _ = jax.lax.scan(step, (start, zero, zero), counts)
    return fitted


def finite_factor(
    covariance: Float[Array, "n n"], variance: Float[Array, ""]
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Return the Cholesky factor of a covariance with enough noise to be finite, and that noise.

    - `variance`: the variance of a value; the noise is zero at first, then a millionth of this
      variance, and ten times more in each further attempt.
    """

    def extra(jitter: Array) -> Array:
        return jitter * variance * jnp.eye(len(covariance), dtype=covariance.dtype)

    def bad(carry: tuple[Array, Array]) -> Array:
        return ~jnp.isfinite(carry[0][-1, -1]) & (carry[1] < 1)

    def more(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        jitter = jnp.maximum(10 * carry[1], 1e-6)
        return jnp.linalg.cholesky(covariance + extra(jitter)), jitter

    start = (jnp.linalg.cholesky(covariance), jnp.zeros((), covariance.dtype))
    factor, jitter = jax.lax.while_loop(bad, more, start)
    return factor, extra(jitter)


def _masked(data: TrainingData) -> Float[Array, " n"]:
    return jnp.where(data.mask, data.y, 0.0)


def _bounded(hyper: Hyper) -> Hyper:
    return Hyper(
        jnp.clip(hyper.variance, *VARIANCE),
        jnp.clip(hyper.lengths, *LENGTH),
        jnp.clip(hyper.noise, *NOISE),
    )


@jax.custom_vjp
def _evidence(covariance: Float[Array, "n n"], y: Float[Array, " n"]) -> Float[Array, ""]:
    return _evidence_forward(covariance, y)[0]


def _evidence_forward(covariance: Array, y: Array) -> tuple[Array, tuple[Array, Array]]:
    factor = jnp.linalg.cholesky(covariance)
    weights = cho_solve((factor, True), y)
    value = -0.5 * y @ weights - jnp.sum(jnp.log(jnp.diag(factor)))
    return value, (factor, weights)


def _evidence_backward(saved: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    factor, weights = saved
    inverse = cho_solve((factor, True), jnp.eye(len(weights), dtype=weights.dtype))
    return 0.5 * cotangent * (jnp.outer(weights, weights) - inverse), -cotangent * weights


_evidence.defvjp(_evidence_forward, _evidence_backward)
