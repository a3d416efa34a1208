"""Running mean and deviation of what is observed, for networks that want inputs of unit scale.

seen = watch(Seen.nothing(size), observations)
mean, scale = normaliser(seen)
"""

from typing import NamedTuple, Self

import jax.numpy as jnp
from jaxtyping import Array, Float


class Seen(NamedTuple):
    """Statistics of the observations so far."""

    count: Float[Array, ""]
    mean: Float[Array, " k"]
    variance: Float[Array, " k"]

    @classmethod
    def nothing(cls, size: int) -> Self:
        """Of no observation of this size: mean 0 and variance 1 until there is one."""
        return cls(jnp.zeros(()), jnp.zeros(size), jnp.ones(size))


def watch(seen: Seen, observation: Float[Array, "*batch k"]) -> Seen:
    """Merge the statistics of a batch: Chan, Golub and LeVeque (1979), eqs. 2.1."""
    rows = observation.reshape(-1, observation.shape[-1])
    count = jnp.float32(rows.shape[0])
    mean, variance = jnp.mean(rows, axis=0), jnp.var(rows, axis=0)
    total = seen.count + count
    shift = mean - seen.mean
    squares = seen.variance * seen.count + variance * count
    squares = squares + shift**2 * seen.count * count / total
    return Seen(total, seen.mean + shift * count / total, squares / total)


def normaliser(seen: Seen) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """What to subtract from an observation, and what to divide by then."""
    return seen.mean, jnp.sqrt(seen.variance + 1e-8)


def normalised(
    seen: Seen, observation: Float[Array, "*batch k"], really: bool = True
) -> Float[Array, "*batch k"]:
    """The observation in units of its running deviation; as it is if not `really`."""
    if not really:
        return observation
    mean, scale = normaliser(seen)
    return (observation - mean) / scale
