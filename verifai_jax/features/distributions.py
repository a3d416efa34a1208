"""Distributions of real numbers: `Normal`, `TruncatedNormal`, `LogUniform`, one of your own.

    FeatureSpace({"wind": Normal(0, 2), "mass": LogUniform(0.01, 10)})

A unit coordinate is the probability to its left, so that uniform coordinates sample the
distribution (inverse transform sampling). Both tails are computed from the smaller probability;
0 and 1 give finite values, and derivatives there are finite and not zero.
"""

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from verifai_jax.core.precision import in_precision
from verifai_jax.features.domain import (
    LEAST_REAL,
    MOST_REAL,
    Domain,
    Numbers,
    Row,
    as_number,
    as_numbers,
    as_real,
    nearest,
    on_device,
    real_numbers,
    short,
)
from verifai_jax.features.ends import (
    Reals,
    clip_to_ends,
    ends_within,
    is_inside,
    replace_where,
    round_inwards,
)

OUTERMOST = 2.0**-26
"""The probability beyond the outermost points: what float32 rounds away when taken from 1."""
HIGHEST = 1 - 2.0**-24
"""The greatest float32 number below 1, where a distribution has only one function for both ends."""
CENTRAL = 4.0
"""Standard deviations from the mean within which float32 coordinates are closely spaced."""
DEEPEST = 1e-29
"""Share of a normal distribution that has to lie between the ends of a truncated one."""


class Continuous(Domain):
    """A real number whose unit coordinate is its cumulative probability."""

    @property
    @abc.abstractmethod
    def support(self) -> tuple[float, float]:
        """The interval that holds all values; its ends may be infinite."""

    @abc.abstractmethod
    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        """Return the value with this probability to its left; finite at 0 and 1."""

    @abc.abstractmethod
    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        """Return the probability to the left of this value."""

    @property
    def closed(self) -> str:
        """The ends of the support that are values themselves, in the words of `Box`."""
        return "both"

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Return the natural logarithm of the probability density, in double precision.

        **Arguments:**

        - `value`: numbers of double precision; minus infinity comes for those beyond the support.

        **Raises:** `NotImplementedError` for a distribution that does not say it.
        """
        raise NotImplementedError(f"{self!r} has no density")

    def tail(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Return the probability of a value at least as far out, on either side.

        It is twice the probability of the smaller of both sides of the value.
        """
        with in_precision("float64"):
            u = np.asarray(jax.vmap(self.probability)(jnp.ravel(jnp.asarray(value))), np.float64)
        return (2 * np.minimum(u, 1 - u)).reshape(np.shape(value))

    @property
    def levels(self) -> tuple[int, ...]:
        return (0,)

    def ends(self, dtype: DTypeLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest value in this precision; they may be infinite."""
        return ends_within(*self.support, dtype, self.closed)

    def from_unit(self, u: Float[Array, "1"]) -> Float[Array, ""]:
        value = self.quantile(u[0]).astype(u.dtype)
        return clip_to_ends(value, *self.ends(u.dtype)) if self._bounded else value

    def to_unit(self, value: Numbers) -> Float[Array, "1"]:
        value = as_real(value)
        u = jnp.clip(self.probability(value), 0, 1)
        if self._bounded:
            first, last = self.ends(value.dtype)
            u = replace_where(replace_where(u, value == first, 0.0), value == last, 1.0)
        return u[None]

    def coerce(self, value: Numbers) -> Float[Array, "*shape"]:
        return on_device(self.rounded(real_numbers(value)))

    def rounded(self, value: Reals) -> Reals:
        """Return real numbers, those that their precision has rounded over an end at that end."""
        return round_inwards(value, *self.support, self.closed)

    @property
    def _bounded(self) -> bool:
        return bool(np.any(np.isfinite(self.support)))

    def contains(self, numbers: Float[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
        """Return which numbers of double precision are values, up to rounding."""
        fits = np.abs(numbers) <= MOST_REAL
        return np.asarray(is_inside(numbers, *self.support, self.closed) & fits)

    def check(self, value: object, name: str) -> None:
        number = as_numbers(value, name)
        if number.shape != ():
            raise ValueError(f"{name} must be one number; got shape {list(number.shape)}")
        if not self.contains(number):
            # A value of double precision that single precision cannot hold is none.
            first, last = (end.item() for end in self.ends(np.float32))
            bounds = _bounds_text(*self.support, self.closed)
            if MOST_REAL < abs(number) < math.inf and not math.isfinite(sum(self.support)):
                bounds = "fit into float32"
            raise ValueError(
                f"{name} must {bounds}; got {short(number.item())}"
                f"{nearest(number.item(), max(first, -MOST_REAL), min(last, MOST_REAL))}"
            )

    def check_reachable(self, value: float, name: str) -> None:
        """Check that a coordinate of the unit cube reaches a value nearly, where only that will do.

        **Raises:** `ValueError` for a value so far in a tail that none does.
        """
        if self._is_central(value):
            return  # What follows takes JAX a second the first time.
        reached = np.float64(self.from_unit(self.to_unit(jnp.float32(value))))
        lower, upper = (float(self.quantile(jnp.float32(u))) for u in (0.25, 0.75))
        if not abs(reached - value) <= 0.1 * (upper - lower) + 1e-5 * abs(value):
            raise ValueError(
                f"{name} is so far in the tail of {self!r} that a float32 coordinate cannot reach "
                f"it; the nearest value is {reached:.6g}; got {short(value)}"
            )

    def _is_central(self, value: float) -> bool:
        """Return whether a float32 coordinate surely reaches a value of the support."""
        return False

    def columns(self, name: str) -> tuple[str, ...]:
        return (name,)

    def to_columns(
        self, values: Float[Array, " n"] | Float[np.ndarray, " n"], name: str
    ) -> dict[str, np.ndarray]:
        return {name: np.asarray(values)}

    def from_columns(self, row: Row, name: str) -> Float[Array, ""]:
        number = as_numbers(row[name], name).astype(jnp.result_type(float))
        return on_device(self.rounded(number))


@dataclass(frozen=True, repr=False)
class Normal(Continuous):
    """A normal distribution: `Normal(mean, std)`.

    A float32 coordinate reaches 5.5 standard deviations to either side, beyond which lies a
    probability of 3e-8; the coordinates 0 and 1 stand for these outermost values.

    **Arguments:**

    - `mean`: of the distribution.
    - `std`: its standard deviation, positive.

    **Raises:** `ValueError` for parameters that are not finite, a standard deviation that is not
    positive, or values that do not fit into float32.
    """

    mean: float
    std: float

    def __post_init__(self) -> None:
        check_numbers(self, "mean", "std")
        check_scale(self, self.mean, self.std)

    @property
    def support(self) -> tuple[float, float]:
        return (-math.inf, math.inf)

    def _is_central(self, value: float) -> bool:
        return abs(value - self.mean) <= CENTRAL * self.std

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        left = u < 0.5
        z = ndtri(at_least(jnp.where(left, u, 1 - u), OUTERMOST))
        return self.mean + self.std * jnp.where(left, z, -z)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        return ndtr((value - self.mean) / self.std)

    def __repr__(self) -> str:
        return f"Normal({short(self.mean)}, {short(self.std)})"


@dataclass(frozen=True, repr=False)
class TruncatedNormal(Continuous):
    """A normal distribution given that the value lies in `[low, high]`.

    **Arguments:**

    - `mean`, `std`: of the distribution before it is cut off.
    - `low`, `high`: the ends; `low < high`.

    The coordinates 0 and 1 are `low` and `high` exactly. Where an end is more than 5 standard
    deviations away, values near it are too improbable for a float32 coordinate.

    **Raises:** `ValueError` for parameters that are not finite, a standard deviation that is not
    positive, ends that are reversed or equal, ends so near that it is uniform between them, or so
    far in one tail (11 standard deviations) that float32 cannot hold the probabilities.
    """

    mean: float
    std: float
    low: float
    high: float

    def __post_init__(self) -> None:
        check_numbers(self, "mean", "std", "low", "high")
        check_scale(self, self.mean, self.std)
        check_ends(self, self.low, self.high)
        if self.high - self.low < 0.05 * self.std:
            raise ValueError(
                "low and high are less than 0.05 standard deviations apart, where the "
                f"distribution is uniform: use Box({short(self.low)}, {short(self.high)}); "
                f"got {self!r}"
            )
        if self._inside < DEEPEST:
            raise ValueError(
                f"only {self._inside:.1g} of the normal distribution lies between low and high, "
                f"which float32 cannot resolve (at least {DEEPEST:g} is needed); got {self!r}"
            )

    @property
    def support(self) -> tuple[float, float]:
        return (self.low, self.high)

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
        p = below + self._inside * at_least(left, OUTERMOST)
        q = above + self._inside * at_least(right, OUTERMOST)
        lower = p < 0.5
        z = ndtri(jnp.where(lower, p, q))
        x = self.mean + self.std * jnp.where(lower ^ self._mirrored, z, -z)
        low, high = np.asarray([self.low, self.high], u.dtype)
        x = replace_where(x, (u <= 0) | (x < low), low)
        return replace_where(x, (u >= 1) | (x > high), high)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        low, high = np.asarray([self.low, self.high], value.dtype)
        z = (jnp.clip(value, low, high) - self.mean) / self.std
        z = -z if self._mirrored else z
        below_low, above_low, below_high, above_high = (t / self._inside for t in self._tails)
        tail = ndtr(-jnp.abs(z)) / self._inside
        left = jnp.where(z < 0, tail - below_low, above_low - tail)
        right = jnp.where(z < 0, below_high - tail, tail - above_high)
        left, right = (right, left) if self._mirrored else (left, right)
        u = jnp.where(left < 0.5, left, 1 - right)
        return replace_where(replace_where(u, value <= low, 0), value >= high, 1)

    def __repr__(self) -> str:
        shown = ", ".join(short(x) for x in (self.mean, self.std, self.low, self.high))
        return f"TruncatedNormal({shown})"


@dataclass(frozen=True, repr=False)
class LogUniform(Continuous):
    """Positive numbers whose logarithm is uniform: learning rates, masses, stiffnesses.

    **Arguments:**

    - `low`, `high`: the ends; `0 < low < high`.

    **Raises:** `ValueError` for ends that are not finite, not positive, reversed or equal.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        check_numbers(self, "low", "high")
        if self.low <= 0:
            raise ValueError(f"low of a LogUniform must be positive; got {self!r}")
        if self.low < LEAST_REAL:
            raise ValueError(f"low of a LogUniform must be at least {LEAST_REAL:g}; got {self!r}")
        check_ends(self, self.low, self.high)

    @property
    def support(self) -> tuple[float, float]:
        return (self.low, self.high)

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
        value = jnp.maximum(value, LEAST_REAL)
        from_low = jnp.log(value / self.low) / self._width
        from_high = jnp.log(value / self.high) / self._width
        middle = math.sqrt(self.low) * math.sqrt(self.high)
        return jnp.where(value < middle, from_low, 1 + from_high)

    def __repr__(self) -> str:
        return f"LogUniform({short(self.low)}, {short(self.high)})"


@dataclass(frozen=True, repr=False)
class Distribution(Continuous):
    """A distribution of your own, by two JAX functions of one number that are each other's inverse.

        Distribution(lambda u: 3 * jnp.sqrt(u), lambda x: (x / 3) ** 2, name="triangle")

    `inverse_cdf` is never evaluated at 0 or 1, but at 2^-26 and 1 - 2^-24 there, the outermost
    probabilities that float32 tells from these: what would be infinite, or a limit that no value
    has, is never simulated.

    **Arguments:**

    - `inverse_cdf`: probability -> value, increasing.
    - `cdf`: value -> probability.
    - `name`: for people and JSON.

    **Raises:** `ValueError` for functions that raise, return no number, do not increase, are not
    finite inside, or are not each other's inverse.
    """

    inverse_cdf: Callable[[Array], Array]
    cdf: Callable[[Array], Array]
    name: str = "custom"
    _ends: tuple[float, float] = field(default=(-math.inf, math.inf), init=False, compare=False)

    def __post_init__(self) -> None:
        for role in ("inverse_cdf", "cdf"):
            function = getattr(self, role)
            if not callable(function):
                raise TypeError(f"{role} of a Distribution must be a function; got {function!r}")
        if not isinstance(self.name, str) or not self.name.strip():
            raise ValueError(f"name of a Distribution must be a text; got {self.name!r}")
        with jax.ensure_compile_time_eval():
            self._check_inverse()
            object.__setattr__(self, "_ends", self._measured_ends())

    def _check_inverse(self) -> None:
        """Check that both functions fit each other."""
        u = np.linspace(0, 1, 129, dtype=np.float32)[1:-1]
        values = self._sampled("inverse_cdf", self.inverse_cdf, u)
        for i in range(len(u)):
            if not np.isfinite(values[i]):
                raise ValueError(f"inverse_cdf of {self!r} gives {values[i]} at u = {u[i]:.3g}")
            if i and values[i] <= values[i - 1]:
                raise ValueError(
                    f"inverse_cdf of {self!r} must increase; it gives {values[i - 1]:.3g} at "
                    f"u = {u[i - 1]:.3g} and {values[i]:.3g} at u = {u[i]:.3g}"
                )
        back = self._sampled("cdf", self.cdf, values)
        worst = int(np.argmax(np.nan_to_num(np.abs(back - u), nan=np.inf)))
        if not abs(back[worst] - u[worst]) <= 1e-3:
            raise ValueError(
                f"cdf of {self!r} must be the inverse of inverse_cdf; inverse_cdf({u[worst]:.3g}) "
                f"is {values[worst]:.3g} and cdf({values[worst]:.3g}) is {back[worst]:.3g}"
            )

    def _measured_ends(self) -> tuple[float, float]:
        """Return the values at 0 and 1 in double precision, infinite where there is no end."""
        with in_precision("float64"):
            low, high = self._sampled("inverse_cdf", self.inverse_cdf, np.array([0.0, 1.0]))
        return (
            float(low) if np.isfinite(low) else -math.inf,
            float(high) if np.isfinite(high) else math.inf,
        )

    def _sampled(
        self, role: str, function: Callable[[Array], Array], points: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        try:
            array = np.asarray(jax.vmap(function)(jnp.asarray(points)))
        except Exception as error:
            raise ValueError(
                f"{role} of {self!r} raised {type(error).__name__} on a number: {error}"
            ) from error
        if array.shape != points.shape or array.dtype.kind != "f":
            raise ValueError(
                f"{role} of {self!r} must give one real number for one; got {array.dtype} of shape "
                f"{list(array.shape[1:])}"
            )
        return array

    @property
    def support(self) -> tuple[float, float]:
        return self._ends

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        # Never at 0 and 1, where a value of probability zero may stand, such as exp(-inf).
        inner = replace_where(at_least(u, OUTERMOST), u > HIGHEST, HIGHEST)
        return jnp.asarray(self.inverse_cdf(inner))

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.asarray(self.cdf(value))

    def __repr__(self) -> str:
        return f"Distribution(name={self.name!r})"


def _bounds_text(low: float, high: float, closed: str) -> str:
    """Describe the ends of a distribution for a message."""
    left, right = closed in ("both", "left"), closed in ("both", "right")
    if math.isfinite(low) and math.isfinite(high):
        return f"lie in {'[' if left else '('}{short(low)}, {short(high)}{']' if right else ')'}"
    if math.isfinite(low):
        return f"be finite and {'at least' if left else 'above'} {short(low)}"
    if math.isfinite(high):
        return f"be finite and {'at most' if right else 'below'} {short(high)}"
    return "be finite"


def check_numbers(domain: Domain, *names: str) -> None:
    kind = type(domain).__name__
    for name in names:
        given = as_number(getattr(domain, name), f"{name} of a {kind}")
        if not math.isfinite(given):
            raise ValueError(f"{name} of a {kind} must be finite; got {given!r}")
        object.__setattr__(domain, name, given)


def check_scale(domain: Domain, mean: float, std: float) -> None:
    if std <= 0:
        hint = f" (a single value is Constant({short(mean)}))" if std == 0 else ""
        raise ValueError(f"the standard deviation must be positive{hint}; got {domain!r}")
    if std < LEAST_REAL or abs(mean) + 6 * std > MOST_REAL:
        raise ValueError(f"its values must fit into float32; got {domain!r}")


def check_ends(domain: Domain, low: float, high: float) -> None:
    if low == high:
        raise ValueError(
            f"an interval of zero width has one value: use Constant({short(low)}); got {domain!r}"
        )
    if low > high:
        raise ValueError(f"low must be below high; got {domain!r}")
    if max(abs(low), abs(high)) > MOST_REAL or np.float32(low) == np.float32(high):
        raise ValueError(f"low and high must be different float32 numbers; got {domain!r}")


def at_least(x: Float[Array, ""], least: float) -> Float[Array, ""]:
    return replace_where(x, x < least, least)
