"""Intervals of real numbers (`Box`) and of integers (`DiscreteBox`), and vectors of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from verifai_jax.core.compute.lifting import is_lifting, lifted
from verifai_jax.features.domain import (
    MAX_LEVELS,
    MAX_REAL,
    MIN_REAL,
    Domain,
    Numbers,
    Row,
    Tuning,
    as_number,
    as_numbers,
    as_real,
    indexed,
    nearest,
    on_device,
    real_numbers,
    short,
    without_objects,
)
from verifai_jax.features.ends import (
    Reals,
    check_closed,
    clip_to_ends,
    ends_within,
    is_inside,
    replace_where,
    round_inwards,
)
from verifai_jax.features.english import numbers
from verifai_jax.features.facts import Facts, integer_facts

NARROW = 16
"""Roundings across a box up to which the map from the unit cube may step over an end. Only in
a box of a few roundings can rounding do that, and 16 leave a margin."""


class _Between(Domain):
    """Numbers between two ends, or vectors of them, all equally likely."""

    def columns(self, name: str) -> tuple[str, ...]:
        low: Any = getattr(self, "low")  # noqa: B009
        return (name,) if np.ndim(low) == 0 else indexed(name, np.size(low))

    def to_columns(self, values: Array | np.ndarray, name: str) -> dict[str, np.ndarray]:
        array, columns = np.asarray(values), self.columns(name)
        if array.ndim == 1:
            return dict.fromkeys(columns, array)
        return {column: array[:, i] for i, column in enumerate(columns)}

    @property
    def monotone(self) -> bool:
        return True

    @property
    def uniform(self) -> bool:
        return True


@dataclass(frozen=True, repr=False)
class Box(_Between):
    """Real numbers from `low` to `high`, uniform; vectors if the ends are sequences.

    `Box(-1, 1)`, `Box([0, 0], [10, 5])`, `Box(0, 1, closed="left")`. A value is a real number, or
    an array with shape `[entries]`. It never lies outside the interval, even in single precision:
    there the greatest value of `Box(0, 61.2)` is 61.199997, since 61.2 would be rounded up.

    **Arguments:**
    - `low`, `high`: the ends, two finite numbers or two sequences of one length; `low < high`.
    - `closed`: the ends that may be values: `"both"`, `"left"` (half-open, without `high`),
      `"right"` or `"neither"`. An end that is left out is replaced by the nearest number of the
      precision.
    **Raises:** `ValueError` for ends that are reversed, equal (use `Constant`), not finite, too far
    apart or too close for float32, or of different lengths; for an unknown `closed`.
    """

    arguments = ("low", "high")
    low: float | Sequence[float] | np.ndarray
    high: float | Sequence[float] | np.ndarray
    closed: str = "both"

    def __post_init__(self) -> None:
        shown = f"got (low={self.low!r}, high={self.high!r})"
        check_closed(self.closed)
        for name, end in zip(("low", "high"), _ends("Box", self.low, self.high), strict=True):
            object.__setattr__(self, name, end)
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
            if max(high - low, abs(low), abs(high)) > MAX_REAL or high - low < MIN_REAL:
                raise ValueError(f"a Box must fit into float32, as must its width; {shown}")
        first, last = self.ends(np.float32)
        if np.any(first > last):
            raise ValueError(f"a Box must have a float32 number inside; {shown}")

    @classmethod
    def from_intervals(cls, *intervals: Sequence[float]) -> "Box":
        """Translate VerifAI's notation: an interval for each entry, its ends in any order.

        **Raises:** `ValueError` for an interval that is not a pair of numbers; the errors of `Box`.
        """
        ends = _in_order(intervals)
        if len(ends) == 1:
            return cls(*ends[0])
        low, high = zip(*ends, strict=True)
        return cls(low, high)

    @property
    def levels(self) -> tuple[int, ...]:
        return (0,) * np.size(self.low)

    def ends(self, dtype: DTypeLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest value in this precision."""
        return ends_within(self.low, self.high, dtype, self.closed)  # pyright: ignore[reportArgumentType]

    def from_unit(self, u: Float[Array, " size"]) -> Float[Array, "*entries"]:
        low, high, _, width = self._limits(u.dtype)
        first, last = self.ends(u.dtype)
        eps = jnp.finfo(u.dtype).eps
        narrow = width < NARROW * eps * np.maximum(np.abs(low), np.abs(high))
        # Where the program is to serve other bounds too, they may need it.
        clips = is_lifting() or bool(np.any(narrow | (low != first) | (high != last)))
        u = u.reshape(low.shape)
        low, high, width, first, last = lifted(
            self, low=low, high=high, width=width, first=first, last=last
        )
        # From the nearer end: exact at both ends and, but for a narrow box, never beyond them.
        value = jnp.where(u < 0.5, low + u * width, high - (1 - u) * width)
        return clip_to_ends(value, first, last) if clips else value

    def to_unit(self, value: Numbers) -> Float[Array, " size"]:
        value = as_real(value)
        low, high, middle, width = self._limits(value.dtype)
        u = jnp.where(value < middle, (value - low) / width, 1 - (high - value) / width)
        first, last = self.ends(value.dtype)
        if np.any((low != first) | (high != last)):
            u = replace_where(replace_where(u, value == first, 0.0), value == last, 1.0)
        return jnp.ravel(u)

    def coerce(self, value: PyTree) -> Float[Array, "*shape"]:
        return on_device(self.rounded(real_numbers(value)))

    def rounded(self, value: Reals) -> Reals:
        """Return real numbers; those that rounding has moved past an end are set to that end."""
        return round_inwards(value, self.low, self.high, self.closed)  # pyright: ignore[reportArgumentType]

    def contains(self, numbers: Float[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
        """Return which numbers of double precision lie in the box, up to rounding."""
        return is_inside(numbers, self.low, self.high, self.closed)  # pyright: ignore[reportArgumentType]

    def check(self, value: object, name: str) -> None:
        numbers = as_numbers(value, name)
        _check_shape(numbers, self.low, name)
        inside = self.contains(numbers)
        opening = "[" if self.closed in ("both", "left") else "("
        closing = "]" if self.closed in ("both", "right") else ")"
        ends = np.ravel(self.low), np.ravel(self.high)
        for column, ok, x, low, high, first, last in zip(
            self.columns(name), np.ravel(inside), np.ravel(numbers), *ends,
            *map(np.ravel, self.ends(np.float64)), strict=True,
        ):  # fmt: skip
            if not ok:
                raise ValueError(
                    f"{column} must lie in {opening}{short(low.item())}, "
                    f"{short(high.item())}{closing}; got {short(x.item())}{nearest(x, first, last)}"
                )

    def from_columns(self, row: Row, name: str) -> Float[Array, "*entries"]:
        entries = [as_numbers(row[column], column).item() for column in self.columns(name)]
        numbers = np.asarray(entries[0] if np.ndim(self.low) == 0 else entries)
        return on_device(self.rounded(numbers.astype(jnp.result_type(float))))

    def _limits(self, dtype: np.dtype) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return low, high, middle and width in this precision."""
        low, high = np.float64(self.low), np.float64(self.high)  # pyright: ignore[reportArgumentType]
        ends = (low, high, low + (high - low) / 2, high - low)
        return tuple(np.asarray(end, dtype) for end in ends)  # pyright: ignore[reportReturnType]

    def words(self) -> str:
        return f"uniform between {numbers(self.low)} and {numbers(self.high)}"

    @property
    def tuning(self) -> Tuning:
        low, high = self.low, self.high
        if self.closed != "both":
            low, high = (end.tolist() for end in self.ends(np.float64))
        return Tuning("linear", low, high)

    def facts(self, name: str) -> Facts:
        known = {"ordered": True, "integer": False, "uniform": True}
        ends = zip(np.ravel(self.low), np.ravel(self.high), strict=True)
        return {
            column: {**known, "bounds": end, "range": end}
            for column, end in zip(self.columns(name), ends, strict=True)
        }

    def __repr__(self) -> str:
        closed = "" if self.closed == "both" else f", closed={self.closed!r}"
        return f"Box({short(self.low)}, {short(self.high)}{closed})"


@dataclass(frozen=True, repr=False)
class DiscreteBox(_Between):
    """Integers from `low` to `high`, equally likely; vectors if the ends are sequences.

    `DiscreteBox(1, 6)`, `DiscreteBox([0, 0], [3, 5])`. Both ends are included. A value is an
    `int32`, or an array of them with shape `[entries]`.

    **Arguments:**
    - `low`, `high`: the ends, two integers or two sequences of one length; `low <= high`.
    **Raises:** `ValueError` for ends that are not integers, reversed, of different lengths, beyond
    32 bits, or with more than 2^20 values between them.
    """

    arguments = ("low", "high")
    low: int | Sequence[int] | np.ndarray
    high: int | Sequence[int] | np.ndarray

    def __post_init__(self) -> None:
        shown = f"got (low={self.low!r}, high={self.high!r})"
        ends = _ends("DiscreteBox", self.low, self.high)
        for number in np.ravel(ends).tolist():
            if not math.isfinite(number) or number != int(number):
                raise ValueError(f"the ends of a DiscreteBox must be integers; {shown}")
            if not -(2**31) <= number < 2**31:
                raise ValueError(f"the ends of a DiscreteBox must fit into 32 bits; {shown}")
        for name, end in zip(("low", "high"), ends, strict=True):
            whole = tuple(map(int, end)) if isinstance(end, tuple) else int(end)
            object.__setattr__(self, name, whole)
        if np.any(np.asarray(self.low) > np.asarray(self.high)):
            raise ValueError(f"low must not be above high in a DiscreteBox; {shown}")
        if max(self.levels) > MAX_LEVELS:
            raise ValueError(
                f"a DiscreteBox has at most {MAX_LEVELS} values, the number that a float32 "
                f"coordinate can distinguish (use a Box and round); {shown}"
            )

    @classmethod
    def from_intervals(cls, *intervals: Sequence[float]) -> "DiscreteBox":
        """Translate VerifAI's notation: an interval for each entry, its ends in any order.

        The ends are rounded inwards.

        **Raises:** `ValueError` for an interval that is not a pair of numbers; the errors of
        `DiscreteBox`.
        """
        ends = [(math.ceil(low), math.floor(high)) for low, high in _in_order(intervals)]
        if len(ends) == 1:
            return cls(*ends[0])
        low, high = zip(*ends, strict=True)
        return cls(low, high)

    @property
    def levels(self) -> tuple[int, ...]:
        low, high = np.asarray(self.low, np.int64), np.asarray(self.high, np.int64)
        return tuple(np.ravel(high - low + 1).tolist())

    def from_unit(self, u: Float[Array, " size"]) -> Int[Array, "*entries"]:
        low, count = self._limits()
        cells = (u.reshape(low.shape) * count).astype(jnp.int32)
        return jnp.clip(cells, 0, count - 1) + low

    def to_unit(self, value: Numbers) -> Float[Array, " size"]:
        low, count = self._limits()
        return jnp.ravel((as_real(jnp.asarray(value) - low) + 0.5) / count)

    def coerce(self, value: PyTree) -> Int[Array, "*shape"]:
        return jnp.asarray(without_objects(value), jnp.int32)

    def check(self, value: object, name: str) -> None:
        numbers = as_numbers(value, name)
        if np.ndim(self.low) == 0 and numbers.shape != ():
            raise ValueError(f"{name} must be one integer; got shape {list(numbers.shape)}")
        _check_shape(numbers, self.low, name)
        for column, x, low, high in zip(
            self.columns(name), *map(np.ravel, (numbers, self.low, self.high)), strict=True
        ):
            if not (low <= x <= high and x == np.floor(x)):
                raise ValueError(
                    f"{column} must be an integer from {low} to {high}; got "
                    f"{short(x.item())}{nearest(np.round(x), low, high)}"
                )

    def from_columns(self, row: Row, name: str) -> Int[Array, "*entries"]:
        entries = []
        for column in self.columns(name):
            number = as_numbers(row[column], column).item()
            if not math.isfinite(number) or number != int(number):
                raise ValueError(f"{column} must be an integer; got {number!r}")
            if not -(2**31) <= number < 2**31:
                raise ValueError(f"{column} must fit into 32 bits; got {short(number)}")
            entries.append(int(number))
        return jnp.asarray(entries[0] if np.ndim(self.low) == 0 else entries, jnp.int32)

    def _limits(self) -> tuple[Int[np.ndarray, "*entries"], Int[np.ndarray, "*entries"]]:
        """Return the lower ends and the numbers of values."""
        low = np.asarray(self.low, np.int32)
        return low, np.asarray(self.levels, np.int32).reshape(low.shape)

    def words(self) -> str:
        ends = f"{numbers(self.low)} to {numbers(self.high)}"
        return f"the integers from {ends}, all equally probable"

    @property
    def tuning(self) -> Tuning:
        return Tuning("integer", self.low, self.high)

    def facts(self, name: str) -> Facts:
        ends = zip(np.ravel(self.low).tolist(), np.ravel(self.high).tolist(), strict=True)
        return {
            column: integer_facts(low, high)
            for column, (low, high) in zip(self.columns(name), ends, strict=True)
        }


def _ends(
    kind: str, low: object, high: object
) -> tuple[float, float] | tuple[tuple[float, ...], tuple[float, ...]]:
    """Return both ends of a box as numbers, or as tuples of one length."""
    shown = f"got (low={low!r}, high={high!r})"
    vector = [
        isinstance(end, Sequence | np.ndarray) and not isinstance(end, str) for end in (low, high)
    ]
    if vector[0] != vector[1]:
        raise ValueError(f"both ends of a {kind} are numbers, or both are sequences; {shown}")
    if not vector[0]:
        return as_number(low, f"low of a {kind}"), as_number(high, f"high of a {kind}")
    lows = tuple(as_number(entry, f"low of a {kind}") for entry in low)  # pyright: ignore[reportGeneralTypeIssues]
    highs = tuple(as_number(entry, f"high of a {kind}") for entry in high)  # pyright: ignore[reportGeneralTypeIssues]
    if len(lows) != len(highs):
        raise ValueError(f"low and high of a {kind} must have one length; {shown}")
    if not lows:
        raise ValueError(f"a vector {kind} needs at least one entry; {shown}")
    return lows, highs


def _in_order(intervals: Sequence[Sequence[float]]) -> list[tuple[float, float]]:
    if not intervals or not all(np.shape(interval) == (2,) for interval in intervals):
        raise ValueError(f"an interval is a pair of numbers; got {intervals!r}")
    return [(min(interval), max(interval)) for interval in intervals]


def _check_shape(numbers: np.ndarray, end: Numbers, name: str) -> None:
    if numbers.shape != np.shape(end):
        raise ValueError(f"{name} must have shape {list(np.shape(end))}; got {list(numbers.shape)}")
