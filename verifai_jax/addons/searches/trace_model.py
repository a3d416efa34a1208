"""Regression of whole traces on points of the cube, with functions drawn from its posterior.

    model = condition(hyper, x, mask, coefficients, mean, components)     # the rows so far
    waves, weights = draw(model, key, 8)                # eight simulators that agree with all rows
    model.decode(basis(model, waves, x) @ weights[j])   # the traces that one of them gives at x

Traces are means plus a few principal components, whose coefficients are Gaussian processes over the
points with one covariance: constant, linear, quadratic and Matern-5/2 parts over shared length
scales. So a nearly linear system is learned from about as many rows as it has inputs, and any other
system as by a usual process (for traces of simulators: Higdon, Gattiker, Williams, Rightley,
Computer model calibration using high-dimensional output, JASA 2008). Functions are drawn by
pathwise conditioning, as in `gaussian`; the quadratic part by random products (Kar,
Karnick, Random feature maps for dot product kernels, AISTATS 2012).
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.addons.searches.gaussian import SMALLEST, adam, finite_factor
from verifai_jax.addons.searches.process_data import snap
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.surrogate import matern

# The numbers without another reason were chosen by hand; no comparison with other values is
# recorded.
COMPONENTS = 24  # maximum number of principal components
NEGLIGIBLE = 1e-5  # share of the variance below which a component is left out
WAVES = 256  # random waves of the Matern part of a drawn function
PRODUCTS = 256  # random products of its quadratic part
STEPS = 40  # steps of Adam in a fit
RATE = 0.1  # its rate
PARTS = np.array([0.0, 0.0, -2.0, -1.0], np.float32)
"""Prior means of the logarithms of the variances: constant, linear, quadratic, Matern."""
NOISE = -8.0  # prior mean of the logarithm of the noise's variance
MIN_NOISE = -10.0  # minimum of it, which keeps 32-bit factors finite
PATIENCE = 8
"""Rows for each dimension without progress, before any failure, from which on the model is believed
less."""
PROGRESS = 0.9
"""A row is progress if its robustness is below this share of the least so far."""
MAX_SPREAD = 5.0
"""Maximum factor on the standard deviations of the model."""
SPREADS = 4
"""Number of factors, from one to the maximum, used in turn."""


class TraceHyper(NamedTuple):
    """Natural logarithms of the hyper-parameters; variances are relative to a component's."""

    lengths: Float[Array, " x"]
    parts: Float[Array, " 4"]
    noise: Float[Array, ""]


def first_hyper(width: int) -> TraceHyper:
    """Return the start of the first fit, the mode of the prior."""
    return TraceHyper(
        jnp.full(width, _mean_length(width), jnp.float32), jnp.asarray(PARTS), jnp.float32(NOISE)
    )


def width_of(cube: Cube) -> int:
    """Return the number of coordinates of embedded points."""
    codes = [n for n, ordered in zip(cube.levels, cube.ordered, strict=True) if n and not ordered]
    return cube.dim - len(codes) + sum(codes)


def embed(u: Float[Any, "n d"], cube: Cube) -> Float[Array, "n x"]:
    """Return points as model inputs: centred, with a coordinate for each unordered choice."""
    u = snap(jnp.asarray(u), cube)
    columns: list[Array] = []
    cells = cube.cells(u)
    for i, (levels, ordered) in enumerate(zip(cube.levels, cube.ordered, strict=True)):
        if levels and not ordered:
            cell = cells[:, int(np.searchsorted(cube.discrete, i))]
            columns.append(0.7 * jax.nn.one_hot(cell, levels, dtype=jnp.float32))
        else:
            columns.append(u[:, i : i + 1] - 0.5)
    return jnp.concatenate(columns, axis=1)


def spread_factor(rho: Float[np.ndarray, " n"], number: int, dim: int) -> float:
    """Return the factor on the model's standard deviations; it grows while no row improves.

    An overconfident model proposes points near one local minimum again and again; with a wider
    spread its simulators have minima elsewhere. After a failure this is not needed.

    **Arguments:**
    - `rho`: robustness of the rows, in the order in which they were simulated.
    - `number`: number of the round.
    - `dim`: the dimension of the cube.
    """
    lowest = np.minimum.accumulate(rho)
    if lowest[-1] <= 0:
        return 1.0
    best, last = rho[0], 0
    for i in np.flatnonzero(np.diff(lowest)) + 1:
        if rho[i] < PROGRESS * best:
            best, last = rho[i], i
    idle = len(rho) - 1 - last
    maximum = min(max(1.0, idle / (PATIENCE * dim)), MAX_SPREAD)
    return maximum ** (number % SPREADS / (SPREADS - 1))


class TraceModel(NamedTuple):
    """A model of traces `[samples]` over points `[x]`; absent rows have no effect.

    - `hyper`: hyper-parameters.
    - `x`: points of the rows, centred at zero.
    - `mask`: which rows are present.
    - `coefficients`: the coefficients of the components, by row.
    - `factor`: Cholesky factor of the covariance of the rows.
    - `scale`: standard deviations of the components under the process.
    - `mean`, `components`: the mean trace, and the components as traces.
    """

    hyper: TraceHyper
    x: Float[Array, "n x"]
    mask: Bool[Array, " n"]
    coefficients: Float[Array, "n c"]
    factor: Float[Array, "n n"]
    scale: Float[Array, " c"]
    mean: Float[Array, " samples"]
    components: Float[Array, "c samples"]

    def decode(self, coefficients: Float[Array, "*m c"]) -> Float[Array, "*m samples"]:
        """Return traces from coefficients of the components."""
        return self.mean + coefficients @ self.components


class Waves(NamedTuple):
    """Random functions of the prior, as a basis that all components share."""

    products: Float[Array, "2 x p"]
    frequencies: Float[Array, "x f"]
    phases: Float[Array, " f"]


def fit(
    hyper: TraceHyper, x: Float[Array, "n x"], mask: Bool[Array, " n"],
    coefficients: Float[Array, "n c"],
) -> TraceHyper:  # fmt: skip
    """Find the most probable hyper-parameters with Adam, starting from `hyper`.

    The variance of each component is the most probable one given the other parameters, in closed
    form; components are weighted by their share of the variance.
    """
    variance = jnp.sum(coefficients**2, axis=0)
    share = variance / jnp.maximum(jnp.sum(variance), 1e-30)
    worth = share / jnp.maximum(jnp.sum(share**2), 1e-30)  # as many as there are in effect
    count = jnp.maximum(jnp.sum(mask), 1).astype(jnp.float32)

    def loss(hyper: TraceHyper) -> Float[Array, ""]:
        surprise = _surprise(_noisy(hyper, x, mask), coefficients, worth, count)
        prior = jnp.sum((hyper.lengths - _mean_length(x.shape[1])) ** 2) / 2
        prior += jnp.sum((hyper.parts - PARTS) ** 2) / 8 + (hyper.noise - NOISE) ** 2 / 8
        return surprise + prior

    return adam(loss, hyper, STEPS, RATE, _bounded)


def condition(
    hyper: TraceHyper,
    x: Float[Array, "n x"],
    mask: Bool[Array, " n"],
    coefficients: Float[Array, "n c"],
    mean: Float[Array, " samples"],
    components: Float[Array, "c samples"],
) -> TraceModel:
    """Return the model conditioned on these rows."""
    noisy = _noisy(hyper, x, mask)
    factor, _ = finite_factor(noisy, jnp.trace(noisy) / len(noisy))
    half = jax.scipy.linalg.solve_triangular(factor, coefficients, lower=True)
    scale = jnp.sqrt(jnp.sum(half**2, axis=0) / jnp.maximum(jnp.sum(mask), 1))
    return TraceModel(hyper, x, mask, coefficients, factor, scale, mean, components)


def draw(
    model: TraceModel, key: Key[Array, ""], count: int, guess: Bool[Array, ""] | bool = True,
    spread: Float[Array, ""] | float = 1.0,
) -> tuple[Waves, Float[Array, "count terms c"]]:  # fmt: skip
    """Draw simulators from the posterior.

    **Arguments:**
    - `count`: the number of simulators.
    - `guess`: whether the first one is the posterior mean.
    - `spread`: factor on the posterior's standard deviations; above 1 if the model has been
      overconfident. The mean and the observed rows are unaffected.
    **Returns:** the input of `basis`, and the weights of its terms for each simulator.
    """
    n, width = model.x.shape
    components = model.coefficients.shape[1]
    terms = 1 + width + PRODUCTS + WAVES
    sizes = [2 * width * PRODUCTS, (width + 5) * WAVES, WAVES, count * (terms + n) * components]
    uniform = jax.random.uniform(key, (sum(sizes),), jnp.float32)
    uniform = jax.lax.optimization_barrier(uniform)
    normal = ndtri(jnp.maximum(uniform, SMALLEST))
    indices = np.cumsum(sizes)[:-1].tolist()
    products, spectrum, _, amplitudes = jnp.split(normal, indices)
    phases = jnp.split(uniform, indices)[2]
    spectrum = spectrum.reshape(width + 5, WAVES)
    # The spectral density of Matern-5/2 is a t distribution with five degrees of freedom.
    size = jnp.sqrt(5 / jnp.maximum(jnp.sum(spectrum[width:] ** 2, axis=0), 1e-6))
    waves = Waves(
        products.reshape(2, width, PRODUCTS), spectrum[:width] * size, 2 * math.pi * phases
    )
    amplitudes = amplitudes.reshape(count, terms + n, components)
    # The mean is the function that the prior's mean, zero, is taken to.
    amplitudes = amplitudes.at[0].multiply(jnp.where(guess, 0.0, 1.0)) * (spread * model.scale)
    prior, noise = amplitudes[:, :terms], amplitudes[:, terms:]
    drawn = jnp.einsum("nt,jtc->jnc", _prior_basis(model, waves, model.x), prior)
    left = model.coefficients - drawn - jnp.exp(model.hyper.noise / 2) * noise
    left = jnp.where(model.mask[:, None], left, 0.0)
    update = jax.vmap(lambda rows: cho_solve((model.factor, True), rows))(left)
    return waves, jnp.concatenate([prior, update], axis=1)


def basis(model: TraceModel, waves: Waves, x: Float[Array, "m x"]) -> Float[Array, "m terms"]:
    """Return the terms of drawn simulators; multiplied by their weights they give coefficients."""
    cross = jnp.where(model.mask, _covariance(model.hyper, x, model.x), 0.0)
    return jnp.concatenate([_prior_basis(model, waves, x), cross], axis=1)


def principal_components(
    traces: Float[np.ndarray, "n samples"],
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "c samples"]]:
    """Return the mean trace and `COMPONENTS` principal components, padded with zeros."""
    mean = traces.mean(axis=0)
    _, size, rows = np.linalg.svd((traces - mean).astype(np.float64), full_matrices=False)
    kept = (size**2 > NEGLIGIBLE * np.sum(size**2))[:COMPONENTS]
    components = np.zeros((COMPONENTS, traces.shape[1]), np.float32)
    components[: kept.sum()] = rows[: len(kept)][kept]
    return mean.astype(np.float32), components


def _prior_basis(
    model: TraceModel, waves: Waves, x: Float[Array, "m x"]
) -> Float[Array, "m terms"]:
    z = x * jnp.exp(-model.hyper.lengths)
    constant, linear, quadratic, rough = jnp.exp(model.hyper.parts / 2)
    one, two = z @ waves.products[0], z @ waves.products[1]
    return jnp.concatenate(
        [
            jnp.full((len(x), 1), constant),
            linear * z,
            quadratic * math.sqrt(1 / PRODUCTS) * one * two,
            rough * math.sqrt(2 / WAVES) * jnp.cos(z @ waves.frequencies + waves.phases),
        ],
        axis=1,
    )


def _covariance(
    hyper: TraceHyper, a: Float[Array, "n x"], b: Float[Array, "m x"]
) -> Float[Array, "n m"]:
    left, right = (x * jnp.exp(-hyper.lengths) for x in (a, b))
    inner = left @ right.T
    constant, linear, quadratic, rough = jnp.exp(hyper.parts)
    rough = rough * matern(_squared_distances(left, right))
    return constant + linear * inner + quadratic * inner**2 + rough


@jax.custom_jvp
def _squared_distances(
    left: Float[Array, "n x"], right: Float[Array, "m x"]
) -> Float[Array, "n m"]:
    # Of differences: where a length scale is short, squares of points have no digits left for it.
    return jnp.sum((left[:, None] - right[None]) ** 2, axis=2)


@_squared_distances.defjvp
def _squared_distances_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    (left, right), (moved_left, moved_right) = primals, tangents
    # A derivative needs no more digits than products of matrices have, which are far faster.
    own = jnp.sum(left * moved_left, axis=1)[:, None] + jnp.sum(right * moved_right, axis=1)
    return _squared_distances(left, right), 2 * (own - left @ moved_right.T - moved_left @ right.T)


@jax.custom_vjp
def _surprise(
    covariance: Float[Array, "n n"], coefficients: Float[Array, "n c"], worth: Float[Array, " c"],
    count: Float[Array, ""],
) -> Float[Array, ""]:  # fmt: skip
    """Return the weighted sum of the components' negative log evidence, each at its best variance.

    Only its derivative by the covariance is there; algorithm 2.1 and section 5.4.1 of Rasmussen and
    Williams, with the variance taken out.
    """
    return _surprise_forward(covariance, coefficients, worth, count)[0]


def _surprise_forward(
    covariance: Array, coefficients: Array, worth: Array, count: Array
) -> tuple[Array, tuple[Array, ...]]:
    factor, _ = finite_factor(covariance, jnp.trace(covariance) / len(covariance))
    half = jax.scipy.linalg.solve_triangular(factor, coefficients, lower=True)
    # Components that are left out are zero, and have no variance.
    square = jnp.maximum(jnp.sum(half**2, axis=0) / count, 1e-12)
    value = jnp.sum(worth * jnp.log(square)) * count / 2
    value += jnp.sum(worth) * jnp.sum(jnp.log(jnp.diag(factor)))
    return value, (factor, half, square, worth)


def _surprise_backward(
    saved: tuple[Array, ...], cotangent: Array
) -> tuple[Array, None, None, None]:
    factor, half, square, worth = saved
    # A product of triangular inverses, which is one triangular solve less than solving twice.
    inverse = jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(factor)), lower=True)
    weights = inverse.T @ half
    slope = jnp.sum(worth) * (inverse.T @ inverse) - (weights * (worth / square)) @ weights.T
    return cotangent * slope / 2, None, None, None


_surprise.defvjp(_surprise_forward, _surprise_backward)


def _noisy(
    hyper: TraceHyper, x: Float[Array, "n x"], mask: Bool[Array, " n"]
) -> Float[Array, "n n"]:
    both = mask[:, None] & mask[None]
    value = jnp.where(both, _covariance(hyper, x, x), 0.0)
    return value + jnp.diag(jnp.where(mask, jnp.exp(hyper.noise), 1.0))


def _mean_length(width: int) -> float:
    """Return the prior mean of the logarithms of length scales: about half the cube's diagonal."""
    return math.log(0.5 * math.sqrt(max(width, 1)))


def _bounded(hyper: TraceHyper) -> TraceHyper:
    return TraceHyper(
        jnp.clip(hyper.lengths, -4.0, 6.0),
        jnp.clip(hyper.parts, -8.0, 5.0),
        jnp.clip(hyper.noise, MIN_NOISE, 0.0),
    )
