"""Normal, truncated normal and log-uniform distributions of real numbers.

    FeatureSpace({"wind": Normal(0, 2), "mass": LogUniform(0.01, 10)})

A unit coordinate is the probability to its left, so that uniform coordinates sample the
distribution (inverse transform sampling). Both tails are computed from the smaller probability;
0 and 1 give finite values, and derivatives there are finite and not zero.
"""

import math
from dataclasses import dataclass

import jax.numpy as jnp
import jax.scipy as jsp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.features import continuous
from verifai_jax.features.domain import MIN_REAL, Tuning, short
from verifai_jax.features.ends import replace_where

CENTRAL = 4.0
"""Standard deviations from the mean within which float32 coordinates are closely spaced."""
HALF_LOG_2PI = math.log(2 * math.pi) / 2
"""Half the logarithm of two pi, from the density of a normal distribution."""
DEEPEST = 1e-29
"""Share of a normal distribution that has to lie between the ends of a truncated one: times the
outermost probability of a coordinate, 2^-26, it is still a normal number of float32."""


@dataclass(frozen=True, repr=False)
class Normal(continuous.Continuous):
    """A normal distribution: `Normal(mean, std)`.

    A float32 coordinate reaches 5.5 standard deviations to either side; the probability beyond is
    3e-8. The coordinates 0 and 1 stand for these outermost values.

    **Arguments:**
    - `mean`: the mean of the distribution.
    - `std`: its standard deviation, positive.
    **Raises:** `ValueError` for parameters that are not finite, a standard deviation that is not
    positive, or values that do not fit into float32.
    """

    arguments = ("mean", "std")
    _english = "normal with mean {mean} and standard deviation {std}"
    mean: float
    std: float

    def __post_init__(self) -> None:
        continuous.check_numbers(self, "mean", "std")
        continuous.check_scale(self, self.mean, self.std)

    @property
    def support(self) -> tuple[float, float]:
        return (-math.inf, math.inf)

    def _is_central(self, value: float) -> bool:
        return abs(value - self.mean) <= CENTRAL * self.std

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        return self.mean + self.std * continuous.normal_score(u)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        return jsp.special.ndtr((value - self.mean) / self.std)

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        z = (np.asarray(value, np.float64) - self.mean) / self.std
        return -(z**2) / 2 - HALF_LOG_2PI - math.log(self.std)

    def tail(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return 2 * continuous.scipy_special().ndtr(
            -np.abs((np.asarray(value, np.float64) - self.mean) / self.std)
        )


@dataclass(frozen=True, repr=False)
class TruncatedNormal(continuous.Bounded):
    """A normal distribution given that the value lies in `[low, high]`.

    **Arguments:**
    - `mean`, `std`: those of the distribution before truncation.
    - `low`, `high`: the ends; `low < high`.

    The coordinates 0 and 1 are exactly `low` and `high`. If an end is more than 5 standard
    deviations away, values near it are too improbable for a float32 coordinate.

    **Raises:** `ValueError` for parameters that are not finite, a standard deviation that is not
    positive, ends that are reversed or equal, ends so close that the distribution is uniform
    between them, or so far out in one tail (11 standard deviations) that float32 cannot hold the
    probabilities.
    """

    arguments = ("mean", "std", "low", "high")
    _english = "normal with mean {mean} and standard deviation {std}, cut off at {low} and {high}"
    mean: float
    std: float
    low: float
    high: float

    def __post_init__(self) -> None:
        continuous.check_numbers(self, "mean", "std", "low", "high")
        continuous.check_scale(self, self.mean, self.std)
        continuous.check_ends(self, self.low, self.high)
        if self.high - self.low < 0.05 * self.std:
            raise ValueError(
                "low and high are less than 0.05 standard deviations apart, where the "
                f"distribution is uniform: use Box({short(self.low)}, {short(self.high)}); "
                f"got {self!r}"
            )
        if self._inside < DEEPEST:
            raise ValueError(
                f"only {self._inside:z.1g} of the normal distribution lies between low and high, "
                f"which float32 cannot resolve (at least {DEEPEST:zg} is needed); got {self!r}"
            )

    @property
    def _mirrored(self) -> bool:
        """True if the interval lies in the upper tail, so that its mirror image is computed."""
        return self.low > self.mean

    @property
    def _tails(self) -> tuple[float, float, float, float]:
        """Probabilities below and above the lower end, below and above the upper end."""
        ends = [(self.low - self.mean) / self.std, (self.high - self.mean) / self.std]
        if self._mirrored:
            ends = [-ends[1], -ends[0]]
        below = [math.erfc(-end / math.sqrt(2)) / 2 for end in ends]
        above = [math.erfc(end / math.sqrt(2)) / 2 for end in ends]
        return (below[0], above[0], below[1], above[1])

    @property
    def _inside(self) -> float:
        below_low, _, below_high, above_high = self._tails
        # The difference of the smaller ones cancels least.
        return below_high - below_low if below_high < 0.5 else 1 - below_low - above_high

    def _is_central(self, value: float) -> bool:
        return abs(value - self.mean) <= CENTRAL * self.std

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        below, _, _, above = self._tails
        left, right = (1 - u, u) if self._mirrored else (u, 1 - u)
        p = below + self._inside * continuous.at_least(left, continuous.OUTERMOST)
        q = above + self._inside * continuous.at_least(right, continuous.OUTERMOST)
        lower = p < 0.5
        z = jsp.special.ndtri(jnp.where(lower, p, q))
        x = self.mean + self.std * jnp.where(lower ^ self._mirrored, z, -z)
        low, high = np.asarray([self.low, self.high], u.dtype)
        x = replace_where(x, (u <= 0) | (x < low), low)
        return replace_where(x, (u >= 1) | (x > high), high)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        low, high = np.asarray([self.low, self.high], value.dtype)
        z = (jnp.clip(value, low, high) - self.mean) / self.std
        z = -z if self._mirrored else z
        below_low, above_low, below_high, above_high = (t / self._inside for t in self._tails)
        tail = jsp.special.ndtr(-jnp.abs(z)) / self._inside
        left = jnp.where(z < 0, tail - below_low, above_low - tail)
        right = jnp.where(z < 0, below_high - tail, tail - above_high)
        left, right = (right, left) if self._mirrored else (left, right)
        u = jnp.where(left < 0.5, left, 1 - right)
        return replace_where(replace_where(u, value <= low, 0), value >= high, 1)

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value = np.asarray(value, np.float64)
        whole = Normal(self.mean, self.std).log_density(value) - math.log(self._inside)
        return np.where(self.contains(value), whole, -np.inf)

    @property
    def tuning(self) -> Tuning:
        return Tuning("other", self.low, self.high)


@dataclass(frozen=True, repr=False)
class LogUniform(continuous.Bounded):
    """Positive numbers whose logarithm is uniform: learning rates, masses, stiffnesses.

    **Arguments:**
    - `low`, `high`: the ends; `0 < low < high`.
    **Raises:** `ValueError` for ends that are not finite, not positive, reversed or equal.
    """

    arguments = ("low", "high")
    _english = "log-uniform between {low} and {high}"
    low: float
    high: float

    def __post_init__(self) -> None:
        continuous.check_numbers(self, "low", "high")
        if self.low <= 0:
            raise ValueError(f"low of a LogUniform must be positive; got {self!r}")
        if self.low < MIN_REAL:
            raise ValueError(f"low of a LogUniform must be at least {MIN_REAL:zg}; got {self!r}")
        continuous.check_ends(self, self.low, self.high)

    @property
    def _width(self) -> float:
        return math.log(self.high) - math.log(self.low)

    def _is_central(self, value: float) -> bool:
        return True

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        left = u < 0.5
        # From the nearer end: exact at both.
        end = jnp.where(left, jnp.asarray(self.low, u.dtype), jnp.asarray(self.high, u.dtype))
        return end * jnp.exp(jnp.where(left, u, u - 1) * self._width)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        value = jnp.maximum(value, MIN_REAL)
        from_low = jnp.log(value / self.low) / self._width
        from_high = jnp.log(value / self.high) / self._width
        middle = math.sqrt(self.low) * math.sqrt(self.high)
        return jnp.where(value < middle, from_low, 1 + from_high)

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value = np.asarray(value, np.float64)
        inside = self.contains(value)
        density = -np.log(np.where(inside, value, 1.0)) - math.log(self._width)
        return np.where(inside, density, -np.inf)

    @property
    def tailed(self) -> tuple[bool, ...]:
        return (False,)

    @property
    def tuning(self) -> Tuning:
        return Tuning("log", self.low, self.high)
