"""The usual families with quantiles in closed form: log-normal, exponential, Weibull, triangular.

    FeatureSpace({"load": LogNormal(3.0, 0.5), "wait": Exponential(12.0)})

As with `Normal`, coordinates reach tails of probability 2^-26 (1.5e-8); 0 and 1 stand for the
values there.
"""

import math
from dataclasses import dataclass

import jax.numpy as jnp
import jax.scipy as jsp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.features.continuous import (
    OUTERMOST,
    REACH,
    Bounded,
    Continuous,
    check_ends,
    check_logs,
    check_numbers,
    check_positive,
    hazard,
    normal_score,
    sides,
)
from verifai_jax.features.distributions import HALF_LOG_2PI, Normal
from verifai_jax.features.domain import MIN_REAL
from verifai_jax.features.ends import replace_where
from verifai_jax.features.english import number

HAZARDS = (math.log(2), -math.log(OUTERMOST))
"""What an exponential distribution of mean one has at its median and at its outermost point."""


class Positive(Continuous):
    """A distribution of all positive numbers."""

    @property
    def support(self) -> tuple[float, float]:
        return (0.0, math.inf)

    @property
    def closed(self) -> str:
        return "neither"


def _at_positive(value: Float[np.ndarray, "*n"], density: object) -> Float[np.ndarray, "*n"]:
    """Return a logarithm of a density where values are positive, and minus infinity elsewhere."""
    return np.where(value > 0, density, -np.inf)  # pyright: ignore[reportCallIssue, reportArgumentType]


def _positive(value: Float[np.ndarray, "*n"]) -> tuple[np.ndarray, np.ndarray]:
    """Return values in double precision, -1 for infinity, and the same with 1 for those below 0."""
    value = np.asarray(value, np.float64)
    value = np.where(np.isfinite(value), value, -1.0)
    return value, np.where(value > 0, value, 1.0)


@dataclass(frozen=True, repr=False)
class LogNormal(Positive):
    """Positive numbers whose natural logarithm is normal: `LogNormal(mean, std)`.

    Coordinates reach 5.54 standard deviations of the logarithm to either side.

    **Arguments:**
    - `mean`, `std`: those of the logarithm; the median is `exp(mean)`.
    **Raises:** `ValueError` for parameters that are not finite, a standard deviation that is not
    positive, or values that do not fit into float32.
    """

    arguments = ("mean", "std")
    mean: float
    std: float

    def __post_init__(self) -> None:
        check_numbers(self, "mean", "std")
        check_positive(self, "std")
        check_logs(self, self.mean, self.mean + REACH * self.std)

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.exp(self.mean + self.std * normal_score(u))

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        return jsp.special.ndtr((jnp.log(jnp.maximum(value, MIN_REAL)) - self.mean) / self.std)

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value, x = _positive(value)
        z = (np.log(x) - self.mean) / self.std
        return _at_positive(value, -(z**2) / 2 - HALF_LOG_2PI - math.log(self.std) - np.log(x))

    def tail(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value, x = _positive(value)
        whole = Normal(self.mean, self.std).tail(np.log(x))
        return np.where(value > 0, whole, 0.0)

    def words(self) -> str:
        return (
            f"log-normal with median {number(math.exp(self.mean))}, its logarithm with mean "
            f"{number(self.mean)} and standard deviation {number(self.std)}"
        )


@dataclass(frozen=True, repr=False)
class Weibull(Positive):
    """Positive numbers such as times to a failure, or wind speeds: `Weibull(shape, scale)`.

    The probability of a value above `x` is `exp(-(x / scale) ** shape)`.

    **Arguments:**
    - `shape`: positive; below 1 the density is infinite at zero.
    - `scale`: positive, in the unit of the value.
    **Raises:** `ValueError` for parameters that are not finite and positive, or values that do not
    fit into float32.
    """

    arguments = ("shape", "scale")
    _english = "Weibull with shape {shape} and scale {scale}"
    shape: float
    scale: float

    def __post_init__(self) -> None:
        check_numbers(self, "shape", "scale")
        check_positive(self, "shape", "scale")
        check_logs(self, *(math.log(self.scale) + math.log(h) / self.shape for h in HAZARDS))

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        return self.scale * jnp.exp(jnp.log(hazard(u)) / self.shape)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        x = jnp.maximum(value / self.scale, MIN_REAL)
        return -jnp.expm1(-jnp.exp(self.shape * jnp.log(x)))

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value, x = _positive(value)
        log = np.log(x) - math.log(self.scale)
        with np.errstate(over="ignore"):
            density = math.log(self.shape) - math.log(self.scale) + (self.shape - 1) * log
            return _at_positive(value, density - np.exp(self.shape * log))


@dataclass(frozen=True, repr=False)
class Exponential(Positive):
    """Positive numbers such as waits between independent events: `Exponential(mean)`.

    **Arguments:**
    - `mean`: positive; one over the rate.
    **Raises:** `ValueError` for a mean that is not finite and positive, or values that do not fit
    into float32.
    """

    arguments = ("mean",)
    _english = "exponential with mean {mean}"
    mean: float

    def __post_init__(self) -> None:
        check_numbers(self, "mean")
        check_positive(self, "mean")
        check_logs(self, *(math.log(self.mean) + math.log(h) for h in HAZARDS))

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        return self.mean * hazard(u)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        return -jnp.expm1(-value / self.mean)

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value, x = _positive(value)
        return _at_positive(value, -x / self.mean - math.log(self.mean))


@dataclass(frozen=True, repr=False)
class Triangular(Bounded):
    """Numbers between two ends with one most likely value: `Triangular(low, mode, high)`.

    The density is zero at the ends, so the coordinates 0 and 1 stand for a tail probability of
    2^-26, except at an end that is the mode.

    **Arguments:**
    - `low`, `mode`, `high`: `low <= mode <= high` and `low < high`.
    **Raises:** `ValueError` for numbers that are not finite or not in this order.
    """

    arguments = ("low", "mode", "high")
    _english = "triangular between {low} and {high}, most likely {mode}"
    low: float
    mode: float
    high: float

    def __post_init__(self) -> None:
        check_numbers(self, "low", "mode", "high")
        check_ends(self, self.low, self.high)
        if not self.low <= self.mode <= self.high:
            raise ValueError(f"the mode must lie between low and high; got {self!r}")

    @property
    def _rising(self) -> float:
        """Probability below the mode."""
        return (self.mode - self.low) / (self.high - self.low)

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        width, rising = self.high - self.low, self._rising
        left, right = sides(u)
        up = self.low + width * jnp.sqrt(left * rising)
        down = self.high - width * jnp.sqrt(right * (1 - rising))
        if rising in (0, 1):
            return down if rising == 0 else up
        return jnp.where(u < rising, up, down)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        width, rising = self.high - self.low, self._rising
        low, high = np.asarray([self.low, self.high], value.dtype)
        x = jnp.clip(value, low, high)
        up = 0.0 if rising == 0 else ((x - self.low) / width) ** 2 / rising
        down = 0.0 if rising == 1 else ((self.high - x) / width) ** 2 / (1 - rising)
        return replace_where(jnp.where(x < self.mode, up, 1 - down), x >= high, 1.0)

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value = np.asarray(value, np.float64)
        rise, fall = self.mode - self.low, self.high - self.mode
        up = (value - self.low) / rise if rise else np.ones_like(value)
        down = (self.high - value) / fall if fall else np.ones_like(value)
        height = np.where(value < self.mode, up, down) * 2 / (self.high - self.low)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.contains(value), np.log(height), -np.inf)
