"""Points of the cube and their robustness, as a Gaussian process takes them.

    process_of(cube)                                    # which coordinates are codes
    training_data(u, score, cube)                       # rows whose score is not finite are absent

All failures are equally good, and huge values do not hide the rest.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from verifai_jax.core.cube import Cube
from verifai_jax.search.base import Observations
from verifai_jax.search.gaussian_process import GaussianProcess, TrainingData

CAP = 30.0
"""Quartiles of the robustness above which all values are the same to the process, so that a few
huge ones do not hide the rest. Chosen by hand; no comparison with other values is recorded."""

LARGEST = 1e30
"""Robustness above which nothing differs: sums of such stay finite in float32."""

NO_VERDICT = 2e30
"""Score of a simulation without a verdict."""


def scores(observations: Observations) -> Float[Array, " n"]:
    """Return the robustness, 0 for all failures, `NO_VERDICT` for NaN; infinite in other rows."""
    rho = observations.rho
    score = jnp.where(jnp.isnan(rho), NO_VERDICT, jnp.clip(rho, 0.0, LARGEST))
    return jnp.where(observations.valid & ~(rho == jnp.inf), score, jnp.inf)


def process_of(cube: Cube) -> GaussianProcess:
    """Return the process over the coordinates of this cube; unordered choices are codes."""
    return GaussianProcess(
        tuple(
            level > 0 and not ordered
            for level, ordered in zip(cube.levels, cube.ordered, strict=True)
        )
    )


def snap(u: Float[Array, "n d"], cube: Cube) -> Float[Array, "n d"]:
    """Move discrete coordinates to the middles of their cells."""
    if len(cube.discrete) == 0:
        return u
    return u.at[:, cube.discrete].set(cube.centres(cube.cells(u)))


def encode(u: Float[Array, "n d"], cube: Cube) -> Float[Array, "n d"]:
    """Encode points for the process: middles of ordered cells, numbers of unordered ones."""
    if len(cube.discrete) == 0:
        return u
    cells = cube.cells(u)
    codes = ~np.array(cube.ordered)[cube.discrete]
    return u.at[:, cube.discrete].set(jnp.where(codes, cells, cube.centres(cells)))


def training_data(u: Float[Array, "n d"], score: Float[Array, " n"], cube: Cube) -> TrainingData:
    """Return the process' data: a logarithm of the robustness, with mean 0 and deviation 1."""
    mask = score <= LARGEST
    score = jnp.where(mask, score, 0.0)
    positive = jnp.sort(jnp.where(score > 0, score, jnp.inf))
    quartile = positive[jnp.sum(score > 0) // 4]
    y = score / jnp.where(jnp.isfinite(quartile), quartile, 1.0)
    y = jnp.log1p(jnp.minimum(y, CAP))
    count = jnp.maximum(jnp.sum(mask), 1)
    y = y - jnp.sum(y, where=mask) / count
    std = jnp.sqrt(jnp.sum(y**2, where=mask) / count)
    return TrainingData(encode(u, cube), y / jnp.where(std > 0, std, 1.0), mask)


def rows_to_keep(
    score: Float[Array, " n"], luck: Float[Array, " n"], count: int
) -> Int[Array, " count"]:
    """Choose rows to keep: the best half and the luckiest others; present rows come first."""
    rank = jnp.argsort(jnp.lexsort((luck, score)))
    best = (rank < count // 2) & jnp.isfinite(score)
    return jnp.argsort(jnp.where(best, -1.0, jnp.where(jnp.isfinite(score), luck, 2.0)))[:count]
