"""Real numbers that are not uniform: `Normal`, `TruncatedNormal`, `LogUniform`, one's own.

The unit cube is the probability space: a coordinate is the probability of a smaller value, and a
value the quantile of its coordinate. Both tails are computed from their own end, so that float32
resolves them; at 0 and 1, where a quantile may be infinite, the nearest probability that float32
can tell from them is taken.
"""

import abc
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Float

from verifai_jax.features.domain import (
    LEAST_REAL,
    MOST_REAL,
    Domain,
    as_number,
    as_numbers,
    as_real,
    short,
)

LEAST_TAIL = 2.0**-25
"""The least probability of a tail: a quarter of the distance of float32 numbers below 1."""


class Continuous(Domain):
    """A real number with a distribution of its own; the base of those below."""

    low: float = -math.inf
    high: float = math.inf

    @abc.abstractmethod
    def quantile(self, u: Float[Array, ""], tail: Float[Array, ""]) -> Float[Array, ""]:
        """The value with probability `u` below and `tail = 1 - u` above it; neither is zero."""

    @abc.abstractmethod
    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        """The probability of a smaller value."""

    @property
    def levels(self) -> tuple[int, ...]:
        return (0,)

    def from_unit(self, u: Float[Array, "1"]) -> Float[Array, ""]:
        u = u[0]
        return self.quantile(jnp.maximum(u, LEAST_TAIL), jnp.maximum(1 - u, LEAST_TAIL))

    def to_unit(self, value: Any) -> Float[Array, "1"]:
        return jnp.clip(jnp.reshape(self.probability(as_real(value)), (1,)), 0.0, 1.0)

    def coerce(self, value: Any) -> Float[Array, ""]:
        return as_real(value)

    def check(self, value: Any, name: str) -> None:
        number = as_numbers(value, name)
        if number.shape != ():
            raise ValueError(f"{name} must be one number; got shape {list(number.shape)}")
        slack = np.finfo(np.float32).eps * max(
            (abs(end) for end in (self.low, self.high) if math.isfinite(end)), default=0.0
        )
        if not (self.low - slack <= number <= self.high + slack and math.isfinite(number)):
            raise ValueError(
                f"{name} must lie in [{short(self.low)}, {short(self.high)}]; "
                f"got {short(number.item())}"
            )

    def columns(self, name: str) -> tuple[str, ...]:
        return (name,)

    def to_columns(self, values: Any, name: str) -> dict[str, np.ndarray]:
        return {name: np.asarray(values)}

    def from_columns(self, row: Mapping[str, Any], name: str) -> Float[Array, ""]:
        return as_real(as_numbers(row[name], name).item())


@dataclass(frozen=True, repr=False)
class Normal(Continuous):
    """Normally distributed numbers.

    Unbounded; a coordinate in float32 reaches 5.4 standard deviations.

    **Raises:** `ValueError` for a mean that is not finite or a `std` that is not positive.
    """

    mean: float
    std: float

    def __post_init__(self) -> None:
        _check_normal(self)

    def quantile(self, u: Float[Array, ""], tail: Float[Array, ""]) -> Float[Array, ""]:
        return self.mean + self.std * _standard_quantile(u, tail)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        z = (value - self.mean) / self.std
        return jnp.where(z < 0, ndtr(z), 1 - ndtr(-z))

    def __repr__(self) -> str:
        return f"Normal({short(self.mean)}, {short(self.std)})"


@dataclass(frozen=True, repr=False)
class TruncatedNormal(Continuous):
    """Normally distributed numbers, given that they lie between `low` and `high`.

    **Raises:** `ValueError` as `Normal`, for ends that are reversed, equal or not finite, and for
    an interval so far in the tail that float32 has no probabilities there.
    """

    mean: float
    std: float
    low: float
    high: float

    def __post_init__(self) -> None:
        _check_normal(self)
        _check_ends(self)
        if self._mass[2] < 1e-30:
            raise ValueError(
                f"the interval is too far from the mean for float32: its probability is "
                f"{self._mass[2]:.2g}; got {self!r}"
            )

    @property
    def _mass(self) -> tuple[float, float, float]:
        """Probabilities below and above the interval, and within; of the nearer tail's mirror."""
        low, high = ((end - self.mean) / self.std for end in (self.low, self.high))
        if self._mirrored:
            low, high = -high, -low
        below, above = _tail(low), _tail(-high)
        within = _tail(high) - below if high < 0 else 1 - below - above
        return below, above, within

    @property
    def _mirrored(self) -> bool:
        """Whether the interval lies more above the mean than below."""
        return self.low + self.high > 2 * self.mean

    def quantile(self, u: Float[Array, ""], tail: Float[Array, ""]) -> Float[Array, ""]:
        below, above, within = self._mass
        if self._mirrored:
            u, tail = tail, u
        z = _standard_quantile(below + u * within, above + tail * within)
        value = self.mean + self.std * (-z if self._mirrored else z)
        return jnp.clip(value, self.low, self.high)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        below, above, within = self._mass
        z = (value - self.mean) / self.std
        z = -z if self._mirrored else z
        u = jnp.where(z < 0, (ndtr(z) - below) / within, 1 - (ndtr(-z) - above) / within)
        return 1 - u if self._mirrored else u

    def __repr__(self) -> str:
        parts = (self.mean, self.std, self.low, self.high)
        return f"TruncatedNormal({', '.join(map(short, parts))})"


@dataclass(frozen=True, repr=False)
class LogUniform(Continuous):
    """Positive numbers whose logarithm is uniform: learning rates, masses, stiffnesses.

    **Raises:** `ValueError` for ends that are not positive, reversed, equal or not finite.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        _check_ends(self)
        if self.low <= 0:
            raise ValueError(f"a LogUniform needs positive ends; got {self!r}")

    def from_unit(self, u: Float[Array, "1"]) -> Float[Array, ""]:
        # Finite at 0 and 1, so exact there.
        return self.quantile(u[0], 1 - u[0])

    def quantile(self, u: Float[Array, ""], tail: Float[Array, ""]) -> Float[Array, ""]:
        width = math.log(self.high / self.low)
        value = jnp.where(
            u < 0.5, self.low * jnp.exp(u * width), self.high * jnp.exp(-tail * width)
        )
        return jnp.clip(value, self.low, self.high)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        width = math.log(self.high / self.low)
        middle = math.sqrt(self.low) * math.sqrt(self.high)
        positive = jnp.maximum(value, LEAST_REAL)
        return jnp.where(
            value < middle,
            jnp.log(positive / self.low) / width,
            1 - jnp.log(self.high / positive) / width,
        )

    def __repr__(self) -> str:
        return f"LogUniform({short(self.low)}, {short(self.high)})"


@dataclass(frozen=True, repr=False)
class Distribution(Continuous):
    """A distribution by its inverse cumulative distribution function and that function itself.

    **Arguments:** two JAX functions of one number, `inverse_cdf` from `(0, 1)` to values and `cdf`
    back; `name` for people.

    **Raises:** `ValueError` for functions that are not finite, do not rise, or do not undo each
    other.
    """

    inverse_cdf: Callable[[Any], Any]
    cdf: Callable[[Any], Any]
    name: str = field(default="custom")

    def __post_init__(self) -> None:
        u = jnp.linspace(0.001, 0.999, 65, dtype=jnp.float32)
        try:
            values = jax.vmap(self.inverse_cdf)(u)
            back = jax.vmap(self.cdf)(values)
        except Exception as error:
            raise ValueError(
                f"the functions of Distribution {self.name!r} must be JAX functions of one number; "
                f"{type(error).__name__}: {error}"
            ) from error
        if values.shape != u.shape or not np.all(np.isfinite(values)):
            raise ValueError(f"inverse_cdf of {self.name!r} must give a finite number on (0, 1)")
        if not np.all(np.diff(values) > 0):
            raise ValueError(f"inverse_cdf of {self.name!r} must rise on (0, 1)")
        worst = int(np.argmax(np.abs(back - u)))
        if not abs(float(back[worst] - u[worst])) < 1e-3:
            raise ValueError(
                f"cdf of {self.name!r} must undo its inverse_cdf; at {float(u[worst]):.3f} it "
                f"gives {float(back[worst]):.3f}"
            )

    def quantile(self, u: Float[Array, ""], tail: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.asarray(self.inverse_cdf(jnp.minimum(u, 1 - 2.0**-24))).astype(u.dtype)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.asarray(self.cdf(value)).astype(value.dtype)

    def __repr__(self) -> str:
        return f"Distribution({self.name})"


def _standard_quantile(u: Float[Array, ""], tail: Float[Array, ""]) -> Float[Array, ""]:
    """Of the standard normal distribution, from the nearer end."""
    lower = u < tail
    z = ndtri(jnp.where(lower, u, tail))
    return jnp.where(lower, z, -z)


def _tail(z: float) -> float:
    """The probability of a smaller standard normal number, in double precision."""
    return 0.5 * math.erfc(-z / math.sqrt(2))


def _check_normal(domain: Any) -> None:
    for name in ("mean", "std"):
        object.__setattr__(domain, name, as_number(getattr(domain, name), f"{name} of a normal"))
    if not abs(domain.mean) <= MOST_REAL:
        raise ValueError(f"mean must be finite; got {domain!r}")
    if not LEAST_REAL <= domain.std <= MOST_REAL / 10:
        raise ValueError(f"std must be positive and finite; got {domain!r}")


def _check_ends(domain: Any) -> None:
    kind = type(domain).__name__
    for name in ("low", "high"):
        object.__setattr__(domain, name, as_number(getattr(domain, name), f"{name} of a {kind}"))
    if not all(abs(end) <= MOST_REAL for end in (domain.low, domain.high)):
        raise ValueError(f"the ends of a {kind} must be finite; got {domain!r}")
    if domain.low == domain.high:
        raise ValueError(
            f"a {kind} of zero width has one value: use Constant({short(domain.low)}); "
            f"got {domain!r}"
        )
    if domain.low > domain.high:
        raise ValueError(f"low must be below high in a {kind}; got {domain!r}")
