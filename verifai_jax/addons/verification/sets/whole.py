"""Sets of whole numbers and of truth values: intervals, one for each box of a batch.

An undecided truth value is the interval from 0 to 1.
"""

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

Numbers = np.ndarray
"""Whole numbers, `[boxes, *shape]`, or `[1, *shape]` where all boxes have the same."""
FAR = 2**62
"""A number from which on nothing is computed: it counts as one that leaves any type."""


class Whole:
    """Integers between `low` and `high`, of one type; truth values are 0 and 1.

    Integers that may leave the type wrap around: then the set is all numbers of the type. Every set
    is made here, so that no operation needs to think of it; `exactly` computes its ends.
    """

    __slots__ = ("dtype", "high", "low")

    def __init__(self, low: Numbers, high: Numbers, dtype: np.dtype) -> None:
        lower, upper = limits(dtype)
        if low is not high:
            wraps = (low < max(lower, -FAR)) | (high > min(upper, FAR))
            if np.any(wraps):
                low, high = np.where(wraps, lower, low), np.where(wraps, upper, high)
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
        low = move(self.low, 1)
        return Whole(low, low if self.high is self.low else move(self.high, 1), self.dtype)


@cache
def limits(dtype: np.dtype) -> tuple[int, int]:
    """Return the smallest and the greatest number of a type that fits into 64 bits with a sign."""
    if dtype == np.bool_:
        return 0, 1
    info = np.iinfo(dtype)
    if info.max > 2**63 - 1:
        raise NotImplementedError("whole numbers of 64 bits without a sign")
    return int(info.min), int(info.max)


def exactly(operation: Callable[..., Numbers], *ends: Numbers) -> Numbers:
    """Compute in whole numbers; what is `FAR`, or not defined, becomes an end of 64 bits.

    The operation is applied to real numbers, too, to know the size of its result.
    """
    size, result = operation(*(np.asarray(end, float) for end in ends)), operation(*ends)
    far = ~(np.abs(size) < FAR)
    lower, upper = limits(np.dtype(np.int64))
    return np.where(far, np.where(size > 0, upper, lower), result) if np.any(far) else result


def by_corners(
    operation: Callable[..., Numbers], a: Whole, b: Whole, *others: Numbers, dtype: np.dtype
) -> Whole:
    """Return the results of an operation that is monotone between corners, and `others` of `b`."""
    values = [exactly(operation, x, y) for x in (a.low, a.high) for y in (b.low, b.high, *others)]
    return Whole(np.minimum.reduce(values), np.maximum.reduce(values), dtype)


def _logic(operation: Callable[..., np.ndarray]) -> Callable[[Whole, Whole], Whole]:
    """Return an operation on bits: of truth values, of single numbers, and with a mask."""

    def applied(a: Whole, b: Whole) -> Whole:
        if a.dtype == np.bool_ and operation is np.bitwise_xor:
            true, false = a.true & b.false | a.false & b.true, a.true & b.true | a.false & b.false
            return Whole.truth(true, false)
        if a.dtype == np.bool_ or (a.is_point and b.is_point):
            return Whole(operation(a.low, b.low), operation(a.high, b.high), a.dtype)
        ends = np.broadcast_arrays(a.low, b.low, a.high, b.high)
        low, high = (np.full(ends[0].shape, end) for end in limits(a.dtype))
        if operation is np.bitwise_and:
            # A mask without a sign leaves nothing greater than itself.
            for lower, upper in (ends[::2], ends[1::2]):
                low = np.where(lower >= 0, 0, low)
                high = np.where(lower >= 0, np.minimum(upper, high), high)
        return Whole(low, high, a.dtype)

    return applied


def _quotient(x: Numbers, y: Numbers) -> Numbers:
    return (x - np.fmod(x, y)) // y


def _divided(a: Whole, b: Whole) -> Whole:
    # By zero, if it is among the divisors, the quotient is not defined, and may be anything.
    return by_corners(_quotient, a, b, np.clip(0, b.low, b.high), dtype=a.dtype)


def _left(a: Whole, b: Whole) -> Whole:
    lower, upper = limits(a.dtype)
    top = np.maximum(exactly(np.abs, b.low), exactly(np.abs, b.high)) - 1
    zero = (b.low <= 0) & (b.high >= 0)
    low = np.where(a.low >= 0, 0, np.maximum(a.low, -top))
    high = np.where(a.high <= 0, 0, np.minimum(a.high, top))
    return Whole(np.where(zero, lower, low), np.where(zero, upper, high), a.dtype)


OPERATIONS: dict[str, Callable[[Whole, Whole], Whole]] = {
    "add": lambda a, b: by_corners(np.add, a, b, dtype=a.dtype),
    "sub": lambda a, b: by_corners(np.subtract, a, b, dtype=a.dtype),
    "mul": lambda a, b: by_corners(np.multiply, a, b, dtype=a.dtype), "div": _divided, "rem": _left,
    "max": lambda a, b: Whole(np.maximum(a.low, b.low), np.maximum(a.high, b.high), a.dtype),
    "min": lambda a, b: Whole(np.minimum(a.low, b.low), np.minimum(a.high, b.high), a.dtype),
    "and": _logic(np.bitwise_and), "or": _logic(np.bitwise_or), "xor": _logic(np.bitwise_xor),
}  # fmt: skip
"""Operations on two sets, by the name of JAX's primitive."""


def total(a: Whole, axes: Sequence[int]) -> Whole:
    """Return the sum over axes."""
    lead = tuple(axis + 1 for axis in axes)
    low, high = (exactly(lambda end: end.sum(lead), end) for end in (a.low, a.high))
    return Whole(low, high, a.dtype)


def power(a: Whole, n: int) -> Whole:
    """Return `a ** n`, for `n` of 0 or more."""
    size = _absolute(a) if n % 2 == 0 else a
    low, high = (exactly(lambda end: end**n, end) for end in (size.low, size.high))
    return Whole(low, high, a.dtype)


def _absolute(a: Whole) -> Whole:
    ends = exactly(np.abs, a.low), exactly(np.abs, a.high)
    low = np.where((a.low <= 0) & (a.high >= 0), 0, np.minimum(*ends))
    return Whole(low, np.maximum(*ends), a.dtype)


def _inverted(a: Whole) -> Whole:
    if a.dtype == np.bool_:
        return Whole(1 - a.high, 1 - a.low, a.dtype)
    top = np.iinfo(a.dtype).max if a.dtype.kind == "u" else -1
    return Whole(top - a.high, top - a.low, a.dtype)


FUNCTIONS: dict[str, Callable[[Whole], Whole]] = {
    "abs": _absolute, "not": _inverted, "square": lambda a: power(a, 2),
    "neg": lambda a: Whole(exactly(np.negative, a.high), exactly(np.negative, a.low), a.dtype),
    "sign": lambda a: Whole(np.sign(a.low), np.sign(a.high), a.dtype),
}  # fmt: skip
"""Operations on one set, by the name of JAX's primitive."""
COMPARISONS = ("eq", "ne", "lt", "le", "gt", "ge")


def compared(name: str, low: np.ndarray, high: np.ndarray) -> Whole:
    """Return a comparison of two numbers, decided by the ends of their difference."""
    same, different = (low == 0) & (high == 0), (low > 0) | (high < 0)
    cases = {
        "lt": (high < 0, low >= 0), "le": (high <= 0, low > 0), "gt": (low > 0, high <= 0),
        "ge": (low >= 0, high < 0), "eq": (same, different), "ne": (different, same),
    }  # fmt: skip
    return Whole.truth(*cases[name])


def selected(truth: np.ndarray, maybe: np.ndarray, no: Whole, yes: Whole) -> Whole:
    """Select one of two cases by a truth value; an interval around both if it is undecided."""
    low = np.where(truth, yes.low, no.low)
    high = np.where(truth, yes.high, no.high)
    if np.any(maybe):
        low = np.where(maybe, np.minimum(no.low, yes.low), low)
        high = np.where(maybe, np.maximum(no.high, yes.high), high)
    return Whole(low, high, no.dtype)
