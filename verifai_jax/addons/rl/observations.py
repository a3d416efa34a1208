"""Running mean and variance of observations, for networks that want inputs of unit scale.

statistics = update(Statistics.initial(size), observations)
mean, scale = mean_and_scale(statistics)
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Statistics(NamedTuple):
    """Statistics of the observations so far.

    - `count`: number of observations.
    - `mean`, `variance`: mean and variance of each of the `k` numbers of an observation.
    """

    count: Float[Array, ""]
    mean: Float[Array, " k"]
    variance: Float[Array, " k"]

    @classmethod
    def initial(cls, size: int) -> "Statistics":
        """Return mean 0 and variance 1 as initial statistics of observations of `size` numbers."""
        return cls(jnp.zeros(()), jnp.zeros(size), jnp.ones(size))


def update(
    statistics: Statistics, observation: Float[Array, "*batch k"], enabled: bool = True
) -> Statistics:
    """Merge the statistics of a batch: Chan, Golub and LeVeque (1979), eqs. 2.1; if `enabled`."""
    if not enabled:
        return statistics
    rows = observation.reshape(-1, observation.shape[-1])
    count = jnp.float32(rows.shape[0])
    mean, variance = jnp.mean(rows, axis=0), jnp.var(rows, axis=0)
    total = statistics.count + count
    shift = mean - statistics.mean
    squares = statistics.variance * statistics.count + variance * count
    squares = squares + shift**2 * statistics.count * count / total
    return Statistics(total, statistics.mean + shift * count / total, squares / total)


def mean_and_scale(
    statistics: Statistics,
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Return the number to subtract from an observation, and the number to divide by."""
    return statistics.mean, jnp.sqrt(statistics.variance + 1e-8)


def normalise(
    statistics: Statistics, observation: Float[Array, "*batch k"], enabled: bool = True
) -> Float[Array, "*batch k"]:
    """Return the observation normalised by its running statistics; unchanged if not `enabled`."""
    if not enabled:
        return observation
    mean, scale = mean_and_scale(statistics)
    return (observation - mean) / scale
