"""Real numbers whose unit coordinate is their cumulative probability: the base of distributions.

Coordinates are float32 numbers between 0 and 1. Coordinates 0 and 1 stand for the outermost
probabilities that float32 distinguishes from 0 and 1, so all quantiles are finite.
"""

import abc
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import jax.scipy as jsp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, PyTree

from verifai_jax.core.compute.precision import in_precision
from verifai_jax.features.domain import (
    MAX_REAL,
    MIN_REAL,
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
from verifai_jax.features.english import number

OUTERMOST = 2.0**-26
"""The probability beyond the outermost points: what float32 rounds away when taken from 1."""
REACH = 5.6
"""Standard deviations beyond the outermost points of a normal distribution, at 5.54."""
HIGHEST = 1 - 2.0**-24
"""The greatest float32 number below 1, where a distribution has only one function for both ends."""


class Continuous(Domain):
    """A real number whose unit coordinate is its cumulative probability."""

    _english: ClassVar[str] = ""
    """Its name in English with its arguments by their names, if these say all."""

    def words(self) -> str:
        arguments = {name: number(getattr(self, name)) for name in self.arguments or ()}
        return self._english.format(**arguments) or super().words()

    @property
    @abc.abstractmethod
    def support(self) -> tuple[float, float]:
        """The interval that contains all values; its ends may be infinite."""

    @abc.abstractmethod
    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        """Return the value with this probability to its left; finite at 0 and 1."""

    @abc.abstractmethod
    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        """Return the probability to the left of this value."""

    @property
    def closed(self) -> str:
        """The ends of the support that are values, as in `Box`."""
        return "both"

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Return the natural logarithm of the probability density, in double precision.

        **Arguments:**
        - `value`: numbers in double precision; the result is minus infinity outside the support.
        **Raises:** `NotImplementedError` for a distribution that does not define it.
        """
        raise NotImplementedError(f"{self!r} has no density")

    def tail(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Return the probability of a value at least as far out, on either side.

        It is twice the smaller of the probabilities on the two sides of the value.
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

    def coerce(self, value: PyTree) -> Float[Array, "*shape"]:
        return on_device(self.rounded(real_numbers(value)))

    def rounded(self, value: Reals) -> Reals:
        """Return real numbers; those that rounding has moved past an end are set to that end."""
        return round_inwards(value, *self.support, self.closed)

    @property
    def _bounded(self) -> bool:
        return bool(np.any(np.isfinite(self.support)))

    def contains(self, numbers: Float[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
        """Return which numbers of double precision are values, up to rounding."""
        fits = np.abs(numbers) <= MAX_REAL
        return np.asarray(is_inside(numbers, *self.support, self.closed) & fits)

    def check(self, value: object, name: str) -> None:
        number = as_numbers(value, name)
        if number.shape != ():
            raise ValueError(f"{name} must be one number; got shape {list(number.shape)}")
        if not self.contains(number):
            # A value of double precision that single precision cannot hold is none.
            first, last = (end.item() for end in self.ends(np.float32))
            bounds = _bounds_text(*self.support, self.closed)
            if MAX_REAL < abs(number) < math.inf and not math.isfinite(sum(self.support)):
                bounds = "fit into float32"
            raise ValueError(
                f"{name} must {bounds}; got {short(number.item())}"
                f"{nearest(number.item(), max(first, -MAX_REAL), min(last, MAX_REAL))}"
            )

    def check_reachable(self, value: Numbers, name: str) -> None:
        value = float(np.asarray(value))
        if self._is_central(value):
            return  # What follows takes JAX a second the first time.
        reached = np.float64(self.from_unit(self.to_unit(jnp.float32(value))))
        lower, upper = (float(self.quantile(jnp.float32(u))) for u in (0.25, 0.75))
        if not abs(reached - value) <= 0.1 * (upper - lower) + 1e-5 * abs(value):
            raise ValueError(
                f"{name} is so far in the tail of {self!r} that a float32 coordinate cannot reach "
                f"it; the nearest value is {reached:z.6g}; got {short(value)}"
            )

    def _is_central(self, value: float) -> bool:
        """Return whether a float32 coordinate surely reaches a value of the support."""
        return False

    @property
    def monotone(self) -> bool:
        return True

    def columns(self, name: str) -> tuple[str, ...]:
        return (name,)

    def to_columns(
        self, values: Float[Array, " n"] | Float[np.ndarray, " n"], name: str
    ) -> dict[str, np.ndarray]:
        return {name: np.asarray(values)}

    def from_columns(self, row: Row, name: str) -> Float[Array, ""]:
        number = as_numbers(row[name], name).astype(jnp.result_type(float))
        return on_device(self.rounded(number))

    @property
    def tailed(self) -> tuple[bool, ...]:
        return (True,)


class Bounded(Continuous):
    """A real number between two ends, `low` and `high`."""

    low: float
    high: float

    @property
    def support(self) -> tuple[float, float]:
        return (self.low, self.high)


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
    """Convert these arguments of a distribution to finite numbers, or refuse them."""
    kind = type(domain).__name__
    for name in names:
        given = as_number(getattr(domain, name), f"{name} of a {kind}")
        if not math.isfinite(given):
            raise ValueError(f"{name} of a {kind} must be finite; got {given!r}")
        object.__setattr__(domain, name, given)


def check_scale(domain: Domain, mean: float, std: float) -> None:
    """Refuse a standard deviation that is not positive, or values beyond float32."""
    if std <= 0:
        hint = f" (a single value is Constant({short(mean)}))" if std == 0 else ""
        raise ValueError(f"the standard deviation must be positive{hint}; got {domain!r}")
    if std < MIN_REAL or abs(mean) + 6 * std > MAX_REAL:
        raise ValueError(f"its values must fit into float32; got {domain!r}")


def check_ends(domain: Domain, low: float, high: float) -> None:
    """Refuse ends that are reversed, or equal in float32."""
    if low == high:
        raise ValueError(
            f"an interval of zero width has one value: use Constant({short(low)}); got {domain!r}"
        )
    if low > high:
        raise ValueError(f"low must be below high; got {domain!r}")
    if max(abs(low), abs(high)) > MAX_REAL or np.float32(low) == np.float32(high):
        raise ValueError(f"low and high must be different float32 numbers; got {domain!r}")


def check_positive(domain: Domain, *names: str) -> None:
    """Refuse arguments of a distribution that are not positive."""
    for name in names:
        if not getattr(domain, name) > 0:
            raise ValueError(
                f"{name} of a {type(domain).__name__} must be positive; got {domain!r}"
            )


def check_logs(domain: Domain, middle: float, greatest: float) -> None:
    """Refuse positive values beyond float32, given logarithms of the median and the maximum."""
    if not (math.log(MIN_REAL) <= middle and greatest < math.log(MAX_REAL)):
        raise ValueError(f"its values must fit into float32; got {domain!r}")


def scipy_special() -> Any:
    """Return SciPy's special functions; importing them takes as long as a small run."""
    from scipy import special

    return special


def sides(u: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the probabilities on both sides of a value, both kept above zero."""
    return at_least(u, OUTERMOST), at_least(1 - u, OUTERMOST)


def hazard(u: Float[Array, ""]) -> Float[Array, ""]:
    """Map a coordinate to the value of an exponential distribution with mean one."""
    left, right = sides(u)
    lower = u < 0.5
    # Each logarithm only where it is wanted: where it is not, its derivative may be infinite.
    small = jnp.log1p(-jnp.where(lower, left, 0.5))
    return -jnp.where(lower, small, jnp.log(jnp.where(lower, 0.5, right)))


def normal_score(u: Float[Array, ""]) -> Float[Array, ""]:
    """Map a coordinate to the value of a standard normal distribution, from -5.54 to 5.54."""
    left = u < 0.5
    z = jsp.special.ndtri(at_least(jnp.where(left, u, 1 - u), OUTERMOST))
    return jnp.where(left, z, -z)


def at_least(x: Float[Array, ""], bound: float) -> Float[Array, ""]:
    """Return `x`, or `bound` if that is larger, with the derivative of `x`."""
    return replace_where(x, x < bound, bound)
