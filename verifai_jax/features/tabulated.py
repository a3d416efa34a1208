"""Distributions whose quantiles are read from a table: gamma, beta, and those of measured data.

    FeatureSpace({"delay": Gamma(2.0, 0.1), "grip": Beta(5, 2), "mass": Empirical(measured)})

The quantile of a gamma or beta distribution has no closed form. Its logarithm (its logit, of a
beta) is smooth in the value of a standard normal distribution with the same probability, so a table
of it in double precision is interpolated by cubics with exact slopes, to within float32's rounding.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import jax.scipy as jsp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.features import continuous
from verifai_jax.features.domain import MAX_REAL, MIN_REAL, as_numbers, short
from verifai_jax.features.ends import replace_where
from verifai_jax.features.english import number, quantile_words
from verifai_jax.features.families import Positive

KNOTS = 1025
"""Entries of a table: a cubic between two of them is off by 1e-9 of a deviation or less."""
MAX_DATA = 2**16
"""Greatest number of different values of an empirical distribution: a coordinate in float32 can
address them all, and the table is a constant of a compiled program."""


class _Table(NamedTuple):
    """A smooth increasing function of the normal score, at even knots, with its slopes."""

    values: Float[np.ndarray, " k"]
    slopes: Float[np.ndarray, " k"]

    def at(self, z: Float[Array, ""]) -> Float[Array, ""]:
        """Return the value at a normal score."""
        step = 2 * continuous.REACH / (KNOTS - 1)
        position = (jnp.clip(z, -continuous.REACH, continuous.REACH) + continuous.REACH) / step
        i = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, KNOTS - 2)
        t = position - i
        values, slopes = (jnp.asarray(part, z.dtype) for part in self)
        low, high = values[i], values[i + 1]
        # From the nearer knot, of which the rest is a small part.
        gap, first, last = high - low, slopes[i] * step, slopes[i + 1] * step
        curved = t * (1 - t) * ((first - gap) * (1 - t) - (last - gap) * t)
        return jnp.where(t < 0.5, low + t * gap, high - (1 - t) * gap) + curved

    def score(self, value: Float[Array, ""]) -> Float[Array, ""]:
        """Return the normal score of a value: the inverse, by Newton's method on the cubic."""
        step = 2 * continuous.REACH / (KNOTS - 1)
        values, slopes = (jnp.asarray(part, value.dtype) for part in self)
        i = jnp.clip(jnp.searchsorted(values, value, side="right") - 1, 0, KNOTS - 2)
        low, gap = values[i], values[i + 1] - values[i]
        first, last = slopes[i] * step, slopes[i + 1] * step
        t = jnp.clip((value - low) / gap, 0.0, 1.0)
        for _ in range(2):
            bend = (first - gap) * (1 - t) - (last - gap) * t
            curve = t * gap + t * (1 - t) * bend
            slope = gap + (1 - 2 * t) * bend - t * (1 - t) * (first + last - 2 * gap)
            t = jnp.clip(t - (curve - (value - low)) / slope, 0.0, 1.0)
        return (i + t) * step - continuous.REACH


def _knots() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return normal scores, their log-densities, and the probabilities on both sides."""
    z = np.linspace(-continuous.REACH, continuous.REACH, KNOTS)
    return (
        z,
        -(z**2) / 2 - math.log(2 * math.pi) / 2,
        continuous.scipy_special().ndtr(z),
        continuous.scipy_special().ndtr(-z),
    )


@dataclass(frozen=True, repr=False)
class Gamma(Positive):
    """Positive numbers such as sums of waits: `Gamma(shape, scale)`, with mean `shape * scale`.

    **Arguments:**
    - `shape`: at least 0.05; below 1 the density is infinite at zero.
    - `scale`: positive, in the unit of the value; one over the rate.
    **Raises:** `ValueError` for parameters that are not finite and positive, a shape below 0.05, or
    values that do not fit into float32.
    """

    arguments = ("shape", "scale")
    _english = "gamma with shape {shape} and scale {scale}"
    shape: float
    scale: float

    def __post_init__(self) -> None:
        continuous.check_numbers(self, "shape", "scale")
        continuous.check_positive(self, "shape", "scale")
        if self.shape < 0.05:
            raise ValueError(f"shape of a Gamma must be at least 0.05; got {self!r}")
        middle, greatest = self._median, self._median + self._table.values[-1]
        continuous.check_logs(self, middle, greatest)

    @cached_property
    def _table(self) -> _Table:
        """The logarithm of the value over the median."""
        z, log_normal, left, right = _knots()
        with np.errstate(divide="ignore"):
            x = np.where(
                z < 0,
                continuous.scipy_special().gammaincinv(self.shape, left),
                continuous.scipy_special().gammainccinv(self.shape, right),
            )
            # What underflows in double precision: the first term of the series.
            first = (np.log(left) + continuous.scipy_special().gammaln(self.shape + 1)) / self.shape
            y = np.where(x > 1e-290, np.log(x), first)
        slopes = np.exp(log_normal - self._log_density_of_log(y))
        return _Table(y - y[KNOTS // 2], slopes)

    @cached_property
    def _median(self) -> float:
        """The logarithm of the median."""
        return math.log(continuous.scipy_special().gammaincinv(self.shape, 0.5)) + math.log(
            self.scale
        )

    def _log_density_of_log(self, y: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return self.shape * y - np.exp(y) - math.lgamma(self.shape)

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        return math.exp(self._median) * jnp.exp(self._table.at(continuous.normal_score(u)))

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        share = jnp.maximum(value, MIN_REAL) / math.exp(self._median)
        return jsp.special.ndtr(self._table.score(jnp.log(jnp.maximum(share, MIN_REAL))))

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value = np.asarray(value, np.float64)
        inside = (value > 0) & np.isfinite(value)
        log = np.log(np.where(inside, value, 1.0))
        density = self._log_density_of_log(log - math.log(self.scale)) - log
        return np.where(inside, density, -np.inf)

    def tail(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        x = np.maximum(np.asarray(value, np.float64), 0) / self.scale
        sides = (
            continuous.scipy_special().gammainc(self.shape, x),
            continuous.scipy_special().gammaincc(self.shape, x),
        )
        return 2 * np.minimum(*sides)


@dataclass(frozen=True, repr=False)
class Beta(continuous.Bounded):
    """Shares, or numbers between two ends: `Beta(a, b)`, `Beta(a, b, low, high)`.

    **Arguments:**
    - `a`, `b`: at least 0.05 each; the mean is `low + (high - low) * a / (a + b)`.
    - `low`, `high`: the ends, which are not values themselves.
    **Raises:** `ValueError` for parameters that are not finite, `a` or `b` below 0.05, or ends that
    are reversed or equal.
    """

    arguments = ("a", "b", "low", "high")
    _english = "beta with a = {a} and b = {b} between {low} and {high}"
    a: float
    b: float
    low: float = 0.0
    high: float = 1.0

    def __post_init__(self) -> None:
        continuous.check_numbers(self, "a", "b", "low", "high")
        for name in ("a", "b"):
            if getattr(self, name) < 0.05:
                raise ValueError(f"{name} of a Beta must be at least 0.05; got {self!r}")
        continuous.check_ends(self, self.low, self.high)

    @property
    def closed(self) -> str:
        return "neither"

    @cached_property
    def _table(self) -> _Table:
        """The logit of the share."""
        _, log_normal, left, right = _knots()
        with np.errstate(divide="ignore", invalid="ignore"):
            below, above = self._logs(left, right)
            y = below - above
        return _Table(y, np.exp(log_normal - self._log_density_of_logit(below, above)))

    def _logs(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the logarithms of the share and of the rest, at probabilities on both sides."""
        share = continuous.scipy_special().betaincinv(self.a, self.b, left)
        rest = continuous.scipy_special().betaincinv(self.b, self.a, right)
        # What underflows in double precision: the first term of the series.
        log = continuous.scipy_special().betaln(self.a, self.b)
        first = (np.log(left) + math.log(self.a) + log) / self.a
        last = (np.log(right) + math.log(self.b) + log) / self.b
        below = np.where(share > 1e-290, np.log(share), first)
        above = np.where(rest > 1e-290, np.log(rest), last)
        # Each from the smaller one, whose digits are all there.
        below, above = (
            np.where(share <= 0.5, below, np.log1p(-rest)),
            np.where(share <= 0.5, np.log1p(-np.minimum(share, 0.5)), above),
        )
        return below, above

    def _log_density_of_logit(self, below: np.ndarray, above: np.ndarray) -> np.ndarray:
        return self.a * below + self.b * above - continuous.scipy_special().betaln(self.a, self.b)

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        y = self._table.at(continuous.normal_score(u))
        # From the nearer end, exact at both.
        small = jnp.exp(-jnp.abs(y)) / (1 + jnp.exp(-jnp.abs(y))) * (self.high - self.low)
        return jnp.where(y < 0, self.low + small, self.high - small)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        width = self.high - self.low
        below = jnp.maximum((value - self.low) / width, MIN_REAL)
        above = jnp.maximum((self.high - value) / width, MIN_REAL)
        return jsp.special.ndtr(self._table.score(jnp.log(below) - jnp.log(above)))

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value, width = np.asarray(value, np.float64), self.high - self.low
        inside = (value > self.low) & (value < self.high)
        share = np.where(inside, (value - self.low) / width, 0.5)
        rest = np.where(inside, (self.high - value) / width, 0.5)
        density = (self.a - 1) * np.log(share) + (self.b - 1) * np.log(rest)
        density = density - continuous.scipy_special().betaln(self.a, self.b) - math.log(width)
        return np.where(inside, density, -np.inf)

    def tail(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        x = (np.asarray(value, np.float64) - self.low) / (self.high - self.low)
        x = np.clip(x, 0.0, 1.0)
        return 2 * np.minimum(
            continuous.scipy_special().betainc(self.a, self.b, x),
            continuous.scipy_special().betaincc(self.a, self.b, x),
        )

    def __repr__(self) -> str:
        ends = "" if self.support == (0, 1) else f", {short(self.low)}, {short(self.high)}"
        return f"Beta({short(self.a)}, {short(self.b)}{ends})"


@dataclass(frozen=True, repr=False, init=False)
class Empirical(continuous.Continuous):
    """Numbers as they were measured: `Empirical(data)`.

    The quantiles are those of the sorted data, interpolated linearly; a number that occurs several
    times gets the middle of its ranks. The coordinates 0 and 1 are the least and the greatest
    number. No value lies beyond them: values rarer than those in the data do not occur.

    **Arguments:**
    - `data`: finite numbers, at least two different ones.
    **Raises:** `ValueError` for fewer numbers, more than 65 536 different ones, or a number that is
    not finite.
    """

    arguments = ("values", "ranks", "count")
    values: tuple[float, ...]
    ranks: tuple[float, ...]
    count: int

    def __init__(self, data: Iterable[float]) -> None:
        given = list(data) if not hasattr(data, "__array__") else data
        numbers = np.ravel(as_numbers(given, "the data of an Empirical"))
        if not np.all(np.isfinite(numbers)) or np.any(np.abs(numbers) > MAX_REAL):
            raise ValueError("the data of an Empirical must be finite numbers of float32")
        # Those that float32 cannot tell apart are one.
        order = np.sort(numbers)
        _, first, counts = np.unique(
            order.astype(np.float32), return_index=True, return_counts=True
        )
        if not 2 <= len(first) <= MAX_DATA:
            raise ValueError(
                f"an Empirical needs 2 to {MAX_DATA} different numbers (a single value is a "
                f"Constant, a few are a Categorical with weights); got {len(first)}"
            )
        middles = first + (counts - 1) / 2
        ranks = (middles - middles[0]) / (middles[-1] - middles[0])
        self._set(order[first].tolist(), ranks.tolist(), len(numbers))

    @classmethod
    def from_ranks(cls, values: Iterable[float], ranks: Iterable[float], count: int) -> "Empirical":
        """Build it from increasing numbers with their cumulative probabilities, from 0 to 1.

        **Raises:** `ValueError` for numbers that are not increasing, or other probabilities.
        """
        made = cls.__new__(cls)
        made._set([*map(float, values)], [*map(float, ranks)], int(count))
        steps = np.diff(made.values), np.diff(made.ranks)
        fits = len(made.values) == len(made.ranks) >= 2 and all(np.all(step > 0) for step in steps)
        if not (fits and (made.ranks[0], made.ranks[-1]) == (0, 1)):
            raise ValueError("an Empirical has increasing numbers, and ranks from 0 to 1")
        return made

    def _set(self, values: list[float], ranks: list[float], count: int) -> None:
        for name, given in (("values", tuple(values)), ("ranks", tuple(ranks)), ("count", count)):
            object.__setattr__(self, name, given)

    @property
    def support(self) -> tuple[float, float]:
        return (self.values[0], self.values[-1])

    def _between(
        self, at: Float[Array, ""], of: tuple[float, ...], to: tuple[float, ...]
    ) -> Float[Array, ""]:
        """Interpolate linearly, and give both ends exactly."""
        knots, values = (np.asarray(part, at.dtype) for part in (of, to))
        i = jnp.clip(jnp.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
        # Differences in double precision: of neighbours in single precision little is left.
        slopes = np.asarray(np.diff(to) / np.diff(of), at.dtype)
        line = jnp.asarray(values)[i] + (at - jnp.asarray(knots)[i]) * jnp.asarray(slopes)[i]
        line = jnp.clip(line, jnp.asarray(values)[i], jnp.asarray(values)[i + 1])
        return replace_where(line, at >= knots[-1], values[-1])

    def quantile(self, u: Float[Array, ""]) -> Float[Array, ""]:
        return self._between(u, self.ranks, self.values)

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        return self._between(value, self.values, self.ranks)

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        value, knots = np.asarray(value, np.float64), np.asarray(self.values)
        i = np.clip(np.searchsorted(knots, value, side="right") - 1, 0, len(knots) - 2)
        density = np.diff(self.ranks) / np.diff(self.values)
        return np.where(self.contains(value), np.log(density[i]), -np.inf)

    def words(self) -> str:
        low, high = self.support
        return (
            f"as {self.count} measured numbers between {number(low)} and {number(high)}, "
            f"{quantile_words(self)}"
        )

    def __repr__(self) -> str:
        low, high = self.support
        return f"Empirical({self.count} numbers from {short(low)} to {short(high)})"
