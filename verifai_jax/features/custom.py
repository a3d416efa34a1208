"""A distribution of your own, by its quantiles and its probabilities (`Distribution`)."""

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.core.compute.precision import in_precision
from verifai_jax.features.continuous import HIGHEST, OUTERMOST, Continuous, at_least
from verifai_jax.features.ends import replace_where
from verifai_jax.features.english import quantile_words


@dataclass(frozen=True, repr=False)
class Distribution(Continuous):
    """A distribution of your own, given by two JAX functions of one number that are inverses.

        Distribution(lambda u: 3 * jnp.sqrt(u), lambda x: (x / 3) ** 2, name="triangle")

    The coordinates 0 and 1 give `inverse_cdf` of 0 and 1 only if these are finite and values near
    them are probable (a finite positive slope). Otherwise they stand for 2^-26 and 1 - 2^-24, the
    outermost probabilities that float32 distinguishes from 0 and 1: an infinite value, or a limit
    that no value reaches, is never simulated.

    **Arguments:**
    - `inverse_cdf`: probability -> value, increasing.
    - `cdf`: value -> probability.
    - `name`: the name in messages and JSON.
    **Raises:** `ValueError` for functions that raise, return no number, do not increase, are not
    finite inside, or are not inverses of each other.
    """

    inverse_cdf: Callable[[Array], Array]
    cdf: Callable[[Array], Array]
    name: str = "custom"
    _range: tuple[float, float] = field(default=(0.0, 1.0), init=False, compare=False)
    _ends: tuple[float, float] = field(default=(-math.inf, math.inf), init=False, compare=False)

    def __post_init__(self) -> None:
        for role in ("inverse_cdf", "cdf"):
            function = getattr(self, role)
            if not callable(function):
                raise TypeError(f"{role} of a Distribution must be a function; got {function!r}")
        if not isinstance(self.name, str) or not self.name.strip():
            raise ValueError(f"name of a Distribution must be a text; got {self.name!r}")
        with jax.ensure_compile_time_eval():
            object.__setattr__(self, "_range", self._measured_range())
            object.__setattr__(self, "_ends", self._measured_ends())

    def _measured_range(self) -> tuple[float, float]:
        """Check both functions and return the probabilities that the coordinates 0 and 1 mean."""
        u = np.linspace(0, 1, 129, dtype=np.float32)[1:-1]
        values = self._sampled("inverse_cdf", self.inverse_cdf, u)
        for i in range(len(u)):
            if not np.isfinite(values[i]):
                raise ValueError(f"inverse_cdf of {self!r} gives {values[i]} at u = {u[i]:z.3g}")
            if i and values[i] <= values[i - 1]:
                raise ValueError(
                    f"inverse_cdf of {self!r} must increase; it gives {values[i - 1]:z.3g} at "
                    f"u = {u[i - 1]:z.3g} and {values[i]:z.3g} at u = {u[i]:z.3g}"
                )
        back = self._sampled("cdf", self.cdf, values)
        worst = int(np.argmax(np.nan_to_num(np.abs(back - u), nan=np.inf)))
        if not abs(back[worst] - u[worst]) <= 1e-3:
            raise ValueError(
                f"cdf of {self!r} must be the inverse of inverse_cdf; inverse_cdf({u[worst]:z.3g}) "
                f"is {values[worst]:z.3g} and cdf({values[worst]:z.3g}) is {back[worst]:z.3g}"
            )
        ends = np.array([0, 1], np.float32)
        slopes = self._sampled("inverse_cdf", jax.grad(self.inverse_cdf), ends)
        bounded = np.all(np.isfinite(self._sampled("inverse_cdf", self.inverse_cdf, ends)))
        reached = bounded & np.isfinite(slopes) & (slopes > 0)
        return 0.0 if reached[0] else OUTERMOST, 1.0 if reached[1] else HIGHEST

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
        # A value of probability zero may stand at 0 and 1, such as exp(-inf).
        low, high = self._range
        return jnp.asarray(self.inverse_cdf(replace_where(at_least(u, low), u > high, high)))

    def probability(self, value: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.asarray(self.cdf(value))

    def log_density(self, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Return the logarithm of the derivative of `cdf`; see `Continuous.log_density`."""
        value = np.asarray(value, np.float64)
        with in_precision("float64"):
            slopes = np.asarray(jax.vmap(jax.grad(self.cdf))(jnp.ravel(jnp.asarray(value))))
        inside = self.contains(value)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(inside, np.log(slopes.reshape(value.shape)), -np.inf)

    @property
    def source(self) -> str:
        """The source of `inverse_cdf` in one line; its name if there is no source."""
        try:
            return " ".join(inspect.getsource(self.inverse_cdf).split())
        except (OSError, TypeError):
            return getattr(self.inverse_cdf, "__qualname__", repr(self.inverse_cdf))

    def words(self) -> str:
        return (
            f"the distribution {self.name!r} of the user's own, {quantile_words(self)}; "
            f"its quantiles are computed by {self.source}"
        )

    def __repr__(self) -> str:
        return f"Distribution(name={self.name!r})"
