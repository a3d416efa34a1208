"""Sets of whole numbers and of truth values: intervals, one for each box of a batch.

An undecided truth value is the interval from 0 to 1.
"""

from collections.abc import Callable

import numpy as np

Numbers = np.ndarray
"""Whole numbers, `[boxes, *shape]`, or `[1, *shape]` where all boxes have the same."""


class Whole:
    """Integers between `low` and `high`, of one type; truth values are 0 and 1."""

    __slots__ = ("dtype", "high", "low")

    def __init__(self, low: Numbers, high: Numbers, dtype: np.dtype) -> None:
        self.low, self.high, self.dtype = low, high, dtype

    @classmethod
    def constant(cls, value: np.ndarray, dtype: np.dtype) -> "Whole":
        """Return an array that is equal for all boxes."""
        exact = np.asarray(value).astype(dtype).astype(np.int64)[None]
        return cls(exact, exact, dtype)

    @classmethod
    def truth(cls, true: np.ndarray, false: np.ndarray) -> "Whole":
        """Return truth values, given where they are certainly true and certainly false."""
        return cls(true.astype(np.int64), (~false).astype(np.int64), np.dtype(bool))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.low.shape[1:]

    @property
    def is_point(self) -> bool:
        """True if each interval is a single number."""
        return self.low is self.high or bool((self.low == self.high).all())

    @property
    def common(self) -> np.ndarray | None:
        """The array that is equal for all boxes, in its own type; None if there is none."""
        if not self.is_point or (len(self.low) > 1 and (self.low != self.low[:1]).any()):
            return None
        return self.low[0].astype(self.dtype)

    @property
    def true(self) -> np.ndarray:
        """Where a truth value is certainly true."""
        return self.low > 0

    @property
    def false(self) -> np.ndarray:
        """Where a truth value is certainly false."""
        return self.high <= 0

    def moved(self, move: Callable[[np.ndarray, int], np.ndarray]) -> "Whole":
        """Return the numbers rearranged by `move(array, leading)`."""
        return Whole(move(self.low, 1), move(self.high, 1), self.dtype)


def _within(low: Numbers, high: Numbers, dtype: np.dtype) -> Whole:
    """Return an interval, or all numbers of the type where it may wrap around."""
    if dtype == np.bool_:
        return Whole(low, high, dtype)
    info = np.iinfo(dtype)
    wraps = (low < info.min) | (high > min(info.max, 2**62))
    if np.any(wraps):
        low, high = np.where(wraps, info.min, low), np.where(wraps, min(info.max, 2**62), high)
    return Whole(low, high, dtype)


def _by_corners(operation: Callable[..., Numbers]) -> Callable[[Whole, Whole], Whole]:
    def applied(a: Whole, b: Whole) -> Whole:
        values = [operation(x, y) for x in (a.low, a.high) for y in (b.low, b.high)]
        low, high = values[0], values[0]
        for value in values[1:]:
            low, high = np.minimum(low, value), np.maximum(high, value)
        return _within(low, high, a.dtype)

    return applied


def _logic(operation: Callable[..., np.ndarray]) -> Callable[[Whole, Whole], Whole]:
    """Return an operation on bits: of truth values, of single numbers, and with a mask."""

    def applied(a: Whole, b: Whole) -> Whole:
        if a.dtype == np.bool_ and operation is np.bitwise_xor:
            true, false = a.true & b.false | a.false & b.true, a.true & b.true | a.false & b.false
            return Whole.truth(true, false)
        if a.dtype == np.bool_ or (a.is_point and b.is_point):
            return Whole(operation(a.low, b.low), operation(a.high, b.high), a.dtype)
        mask = b if b.is_point else a
        if operation is np.bitwise_and and mask.low.min() >= 0:
            return Whole(np.zeros_like(mask.low), mask.high, a.dtype)
        raise NotImplementedError("a bitwise operation on whole numbers that vary in a box")

    return applied


def _divided(a: Whole, b: Whole) -> Whole:
    _check_divisor(b)
    trunc = lambda x, y: np.sign(x) * np.sign(y) * (np.abs(x) // np.abs(y))  # noqa: E731
    return _by_corners(trunc)(a, b)


def _left(a: Whole, b: Whole) -> Whole:
    _check_divisor(b)
    top = np.maximum(np.abs(b.low), np.abs(b.high)) - 1
    low, high = np.maximum(a.low, -top), np.minimum(a.high, top)
    return Whole(np.where(a.low >= 0, 0, low), np.where(a.high <= 0, 0, high), a.dtype)


def _check_divisor(b: Whole) -> None:
    if np.any((b.low <= 0) & (b.high >= 0)):
        raise NotImplementedError("a division by whole numbers that may be zero")


OPERATIONS: dict[str, Callable[[Whole, Whole], Whole]] = {
    "add": lambda a, b: _within(a.low + b.low, a.high + b.high, a.dtype),
    "sub": lambda a, b: _within(a.low - b.high, a.high - b.low, a.dtype),
    "mul": _by_corners(np.multiply),
    "div": _divided,
    "rem": _left,
    "max": lambda a, b: Whole(np.maximum(a.low, b.low), np.maximum(a.high, b.high), a.dtype),
    "min": lambda a, b: Whole(np.minimum(a.low, b.low), np.minimum(a.high, b.high), a.dtype),
    "and": _logic(np.bitwise_and),
    "or": _logic(np.bitwise_or),
    "xor": _logic(np.bitwise_xor),
}
"""Operations on two sets, by the name of JAX's primitive."""


def _absolute(a: Whole) -> Whole:
    low = np.where((a.low <= 0) & (a.high >= 0), 0, np.minimum(np.abs(a.low), np.abs(a.high)))
    return _within(low, np.maximum(np.abs(a.low), np.abs(a.high)), a.dtype)


def _inverted(a: Whole) -> Whole:
    if a.dtype == np.bool_:
        return Whole(1 - a.high, 1 - a.low, a.dtype)
    top = np.iinfo(a.dtype).max if a.dtype.kind == "u" else -1
    return Whole(top - a.high, top - a.low, a.dtype)


def _squared(a: Whole) -> Whole:
    size = _absolute(a)
    return OPERATIONS["mul"](size, size)


FUNCTIONS: dict[str, Callable[[Whole], Whole]] = {
    "abs": _absolute,
    "neg": lambda a: _within(-a.high, -a.low, a.dtype),
    "not": _inverted,
    "sign": lambda a: Whole(np.sign(a.low), np.sign(a.high), a.dtype),
    "square": _squared,
}
"""Operations on one set, by the name of JAX's primitive."""
COMPARISONS = ("eq", "ne", "lt", "le", "gt", "ge")


def compared(name: str, low: np.ndarray, high: np.ndarray) -> Whole:
    """Return a comparison of two numbers, decided by the ends of their difference."""
    match name:
        case "lt":
            return Whole.truth(high < 0, low >= 0)
        case "le":
            return Whole.truth(high <= 0, low > 0)
        case "gt":
            return Whole.truth(low > 0, high <= 0)
        case "ge":
            return Whole.truth(low >= 0, high < 0)
    same, different = (low == 0) & (high == 0), (low > 0) | (high < 0)
    return Whole.truth(same, different) if name == "eq" else Whole.truth(different, same)


def selected(truth: np.ndarray, maybe: np.ndarray, no: Whole, yes: Whole) -> Whole:
    """Select one of two cases by a truth value; an interval around both if it is undecided."""
    low = np.where(truth, yes.low, no.low)
    high = np.where(truth, yes.high, no.high)
    if np.any(maybe):
        low = np.where(maybe, np.minimum(no.low, yes.low), low)
        high = np.where(maybe, np.maximum(no.high, yes.high), high)
    return Whole(low, high, no.dtype)
