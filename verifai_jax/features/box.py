"""Intervals: of real numbers (`Box`), of vectors (`Box`), of integers (`DiscreteBox`)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.features.domain import (
    LEAST_REAL,
    MOST_LEVELS,
    MOST_REAL,
    Domain,
    as_number,
    as_numbers,
    as_real,
    cell,
    centre,
    indexed,
    short,
)


@dataclass(frozen=True, repr=False)
class Box(Domain):
    """Real numbers from `low` to `high`, uniform; vectors if the ends are sequences.

    **Arguments:** `low < high`, two finite numbers or two sequences of one length.

    **Raises:** `ValueError` for ends that are reversed, equal (use `Constant`), not finite,
    farther apart or nearer than float32 can hold, or of different lengths.
    """

    low: Any
    high: Any

    def __post_init__(self) -> None:
        shown = f"got (low={self.low!r}, high={self.high!r})"
        vector = [
            isinstance(end, Sequence | np.ndarray) and not isinstance(end, str)
            for end in (self.low, self.high)
        ]
        if vector[0] != vector[1]:
            raise ValueError(f"both ends of a Box are numbers, or both are sequences; {shown}")
        if not vector[0]:
            object.__setattr__(self, "low", as_number(self.low, "low of a Box"))
            object.__setattr__(self, "high", as_number(self.high, "high of a Box"))
        else:
            for end in ("low", "high"):
                entries = [as_number(x, f"{end} of a Box") for x in getattr(self, end)]
                object.__setattr__(self, end, tuple(entries))
            if len(self.low) != len(self.high):
                raise ValueError(f"low and high of a Box must have one length; {shown}")
            if not self.low:
                raise ValueError(f"a vector Box needs at least one entry; {shown}")
        for low, high in zip(np.ravel(self.low), np.ravel(self.high), strict=True):
            low, high = low.item(), high.item()
            if not (math.isfinite(low) and math.isfinite(high)):
                raise ValueError(f"the ends of a Box must be finite; {shown}")
            if low == high:
                raise ValueError(
                    f"a Box of zero width has one value: use Constant({short(low)}); {shown}"
                )
            if low > high:
                raise ValueError(f"low must be below high in a Box; {shown}")
            if max(high - low, abs(low), abs(high)) > MOST_REAL or high - low < LEAST_REAL:
                raise ValueError(f"a Box must fit into float32, as must its width; {shown}")

    @classmethod
    def from_intervals(cls, *intervals: Sequence[float]) -> "Box":
        """VerifAI's notation, an interval for each entry, whose ends may come in any order."""
        if not intervals or not all(np.shape(interval) == (2,) for interval in intervals):
            raise ValueError(f"an interval is a pair of numbers; got {intervals!r}")
        ends = [sorted(interval) for interval in intervals]
        if len(ends) == 1:
            return cls(*ends[0])
        low, high = zip(*ends, strict=True)
        return cls(low, high)

    @property
    def levels(self) -> tuple[int, ...]:
        return (0,) * np.size(self.low)

    def from_unit(self, u: Float[Array, " size"]) -> Float[Array, "*size"]:
        low, high, _, width = self._ends(u.dtype)
        u = u.reshape(low.shape)
        # From the nearer end: exact at both ends and never outside, whatever the rounding.
        return jnp.where(u < 0.5, low + u * width, high - (1 - u) * width)

    def to_unit(self, value: Any) -> Float[Array, " size"]:
        value = as_real(value)
        low, high, middle, width = self._ends(value.dtype)
        u = jnp.where(value < middle, (value - low) / width, 1 - (high - value) / width)
        return jnp.ravel(u)

    def coerce(self, value: Any) -> Float[Array, "*size"]:
        return as_real(value)

    def check(self, value: Any, name: str) -> None:
        value = as_numbers(value, name)
        if value.shape != np.shape(self.low):
            raise ValueError(
                f"{name} must have shape {list(np.shape(self.low))}; got {list(value.shape)}"
            )
        # A bound that float32 has rounded is still inside.
        slack = np.finfo(np.float32).eps * np.maximum(np.abs(self.low), np.abs(self.high))
        inside = (value >= self.low - slack) & (value <= self.high + slack)
        for column, ok, x, low, high in zip(
            self.columns(name), *map(np.ravel, (inside, value, self.low, self.high)), strict=True
        ):
            if not ok:
                raise ValueError(
                    f"{column} must lie in [{short(low.item())}, {short(high.item())}]; "
                    f"got {short(x.item())}"
                )

    def columns(self, name: str) -> tuple[str, ...]:
        return (name,) if np.ndim(self.low) == 0 else indexed(name, self.size)

    def to_columns(self, values: Any, name: str) -> dict[str, np.ndarray]:
        values = np.asarray(values)
        if np.ndim(self.low) == 0:
            return {name: values}
        return {column: values[:, i] for i, column in enumerate(self.columns(name))}

    def from_columns(self, row: Mapping[str, Any], name: str) -> Float[Array, "*size"]:
        entries = [as_numbers(row[column], column).item() for column in self.columns(name)]
        return as_real(entries[0] if np.ndim(self.low) == 0 else entries)

    def _ends(self, dtype: Any) -> tuple[Any, Any, Any, Any]:
        low, high = np.float64(self.low), np.float64(self.high)
        ends = (low, high, low + (high - low) / 2, high - low)
        return tuple(np.asarray(end, dtype) for end in ends)  # pyright: ignore[reportReturnType]

    def __repr__(self) -> str:
        return f"Box({short(self.low)}, {short(self.high)})"


@dataclass(frozen=True, repr=False)
class DiscreteBox(Domain):
    """Integers from `low` to `high`, both included, equally likely; an `int32` value.

    **Raises:** `ValueError` for ends that are no integers, reversed, or more than 2^20 values.
    """

    low: int
    high: int

    def __post_init__(self) -> None:
        shown = f"got (low={self.low!r}, high={self.high!r})"
        for end in ("low", "high"):
            value = getattr(self, end)
            number = as_number(value, f"{end} of a DiscreteBox")
            if not math.isfinite(number) or number != int(number):
                raise ValueError(f"the ends of a DiscreteBox must be integers; {shown}")
            if not -(2**31) <= number < 2**31:
                raise ValueError(f"the ends of a DiscreteBox must fit into 32 bits; {shown}")
            object.__setattr__(self, end, int(number))
        if self.low > self.high:
            raise ValueError(f"low must not be above high in a DiscreteBox; {shown}")
        if self.count > MOST_LEVELS:
            raise ValueError(
                f"a DiscreteBox has at most {MOST_LEVELS} values, which a float32 coordinate can "
                f"tell apart (use a Box and round); {shown}"
            )

    @classmethod
    def from_interval(cls, one: float, other: float) -> "DiscreteBox":
        """The integers between two numbers, which may come in any order, as in VerifAI."""
        low, high = sorted((one, other))
        return cls(math.ceil(low), math.floor(high))

    @property
    def count(self) -> int:
        """Number of values."""
        return self.high - self.low + 1

    @property
    def levels(self) -> tuple[int, ...]:
        return (self.count,)

    def from_unit(self, u: Float[Array, "1"]) -> Any:
        return self.low + cell(u[0], self.count)

    def to_unit(self, value: Any) -> Float[Array, "1"]:
        return centre(jnp.asarray(value) - self.low, self.count)

    def coerce(self, value: Any) -> Any:
        return jnp.asarray(value, jnp.int32)

    def check(self, value: Any, name: str) -> None:
        number = as_numbers(value, name)
        if number.shape != ():
            raise ValueError(f"{name} must be one integer; got shape {list(number.shape)}")
        if not (self.low <= number <= self.high and number == np.floor(number)):
            raise ValueError(
                f"{name} must be an integer from {self.low} to {self.high}; "
                f"got {short(number.item())}"
            )

    def columns(self, name: str) -> tuple[str, ...]:
        return (name,)

    def to_columns(self, values: Any, name: str) -> dict[str, np.ndarray]:
        return {name: np.asarray(values)}

    def from_columns(self, row: Mapping[str, Any], name: str) -> Any:
        number = as_numbers(row[name], name).item()
        if not math.isfinite(number) or number != int(number):
            raise ValueError(f"{name} must be an integer; got {number!r}")
        return jnp.asarray(int(number), jnp.int32)

    def __repr__(self) -> str:
        return f"DiscreteBox({self.low}, {self.high})"
