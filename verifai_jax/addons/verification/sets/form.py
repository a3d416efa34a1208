"""Sets of real numbers, one for each box of a batch: affine forms within intervals.

A form is `centre + sum_i slopes[i] symbol_i + [-radius, radius]`, intersected with `[low, high]` if
an operation has a separate interval. Each symbol lies in [-1, 1]. The first symbols are the
features of the box, so numbers that depend on them stay correlated through a whole simulation;
others belong to a `Frame` of a loop (`frames.py`). In a box of width w the radius is of the order
of w squared.

Each set contains both the number in real arithmetic and the computed number: every result is
widened by the rounding of its type and by the smallest normal number, since XLA treats subnormal
numbers as zero, and becomes unbounded if it may overflow. An interval without both ends contains
everything, including NaN; all operations preserve that. Bounds are computed in double precision;
the widening covers its rounding.

Sources: L. de Figueiredo and J. Stolfi, Affine arithmetic: concepts and applications, Numerical
Algorithms 37 (2004); S. Rump, INTLAB, 1999.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from verifai_jax.addons.verification.sets.layers import SLACK, Common, picked, summed

Reals = np.ndarray
"""Numbers of double precision, `[boxes, *shape]`; `[1, *shape]` if they are those of all boxes."""
Ends = tuple[Reals, Reals]


greatest = partial(np.maximum.reduce, axis=None, initial=-np.inf)
least = partial(np.minimum.reduce, axis=None, initial=np.inf)
"""The greatest and the least of numbers, or NaN if it is one of them; without any an infinity."""


class Rounding(NamedTuple):
    """The rounding of a floating-point type: its unit, its smallest and its greatest number."""

    unit: float
    smallest: float
    highest: float


@cache
def rounding(dtype: DTypeLike) -> Rounding:
    """Return the rounding of a type, with a margin for the rounding of the bounds themselves."""
    info = jnp.finfo(dtype)
    unit = float(info.eps) / 2 * 1.01
    return Rounding(max(unit, 2 * SLACK), float(info.tiny), float(info.max))


class Frame(NamedTuple):
    """Symbols of a step of a loop, after so many of features; later frames have greater numbers."""

    number: int
    first: int


class Form:
    """A set of arrays for each box; see the module's docstring.

    - `centre`, `radius`: `[boxes, *shape]`.
    - `slopes`: `[symbols, boxes, *shape]`; None for a set that depends on no symbol.
    - `size`: a bound on the absolute value.
    - `low`, `high`: an additional interval; None without one.
    - `frame`: the frame of the symbols that are not features; None if there are none.
    - `common`: the parts of the radius that are those of layers; None if it has none.
    - `dtype`: the type in which the simulation computes it.
    """

    __slots__ = (
        "_bounds", "_spread", "centre", "common", "dtype", "frame", "high", "low", "radius", "size",
        "slopes",
    )  # fmt: skip

    def __init__(
        self, centre: Reals, slopes: Reals | None, radius: Reals, size: Reals, dtype: np.dtype,
        low: Reals | None = None, high: Reals | None = None, frame: Frame | None = None,
        common: Common | None = None,
    ) -> None:  # fmt: skip
        self.centre, self.slopes, self.radius, self.size = centre, slopes, radius, size
        self.dtype, self.low, self.high = dtype, low, high
        self.frame = frame if slopes is not None else None
        self.common = common if slopes is not None else None
        self._bounds: Ends | None = None
        self._spread: Reals | None = None

    @classmethod
    def constant(cls, value: np.ndarray, dtype: np.dtype) -> "Form":
        """Return an array that is equal for all boxes."""
        exact = np.asarray(value).astype(dtype).astype(np.float64)[None]
        return cls.between(exact, exact, dtype)

    @classmethod
    def between(cls, low: Reals, high: Reals, dtype: np.dtype) -> "Form":
        """Return intervals; NaN as an end means an unbounded interval."""
        kind = rounding(dtype)
        low, high = overflown(low, high, kind.highest)
        # What is below the smallest normal number may be taken for zero.
        low = np.where((low > 0) & (low < kind.smallest), 0.0, low)
        high = np.where((high < 0) & (high > -kind.smallest), 0.0, high)
        centre, size = low / 2 + high / 2, np.maximum(np.abs(low), np.abs(high))
        radius = np.maximum(high - centre, centre - low)
        radius = np.where(radius > 0, radius + SLACK * size, radius)
        if not greatest(size) < np.inf:
            finite = np.isfinite(low) & np.isfinite(high)
            centre, radius = np.where(finite, centre, 0.0), np.where(finite, radius, np.inf)
        return cls(centre, None, radius, size, dtype, low, high)

    @classmethod
    def leaf(cls, low: Reals, high: Reals, symbols: Reals, dtype: np.dtype) -> "Form":
        """Return numbers between ends; `symbols`, `[symbols, *shape]`, are 1 for those of each."""
        whole = cls.between(low, high, dtype)
        finite = np.isfinite(whole.radius)
        slopes = symbols[:, None] * np.where(finite, whole.radius, 0.0)
        radius = np.where((symbols != 0).any(0) & finite, SLACK * whole.size, whole.radius)
        form = cls(whole.centre, slopes, radius, whole.size, dtype, whole.low, whole.high)
        form._bounds = whole.bounds()
        return form

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.centre.shape[1:]

    @property
    def spread(self) -> Reals:
        """The greatest distance from the centre that the affine form allows."""
        spread = self._spread
        if spread is None:
            spread = self.radius
            if self.slopes is not None:
                spread = np.add.reduce(np.abs(self.slopes), 0) + spread
            self._spread = spread
        return spread

    def bounds(self) -> Ends:
        """Return the ends of the set: the intersection of affine form and interval."""
        if self._bounds is None:
            if self.slopes is None and self.low is not None and self.high is not None:
                self._bounds = self.low, self.high
                return self._bounds
            spread = self.spread
            low, high = self.centre - spread, self.centre + spread
            if self.low is not None and self.high is not None:
                # Without bounds on either side the interval says whether NaN is possible.
                low, high = np.maximum(low, self.low), np.minimum(high, self.high)
            self._bounds = low, high
        return self._bounds

    def moved(self, move: Callable[[np.ndarray, int], np.ndarray]) -> "Form":
        """Return the numbers rearranged by `move(array, leading)`."""
        common = self.common
        if common is not None:
            numbers = np.arange(self.centre[0].size)
            moved = move(numbers.reshape(1, *self.shape), 1).ravel()
            common = picked(common, move(common.own, 1), moved, len(numbers))
        low, high = (end if end is None else move(end, 1) for end in (self.low, self.high))
        form = Form(
            move(self.centre, 1), None if self.slopes is None else move(self.slopes, 2),
            move(self.radius, 1), move(self.size, 1), self.dtype, low, high, self.frame, common,
        )  # fmt: skip
        known = self._bounds is not None and self._bounds[0] is self.low
        if known and low is not None and high is not None:
            form._bounds = low, high
        return form

    def of_type(self, dtype: np.dtype) -> "Form":
        """Return the same numbers in another type that represents them exactly."""
        rest = self.low, self.high, self.frame, self.common
        return Form(self.centre, self.slopes, self.radius, self.size, dtype, *rest)

    def forget(self, where: np.ndarray) -> None:
        """Make the set unbounded at some numbers."""
        if not np.any(where):
            return
        self._bounds = self._spread = self.common = None
        for name, value in (
            ("centre", 0.0), ("slopes", 0.0), ("radius", np.inf), ("size", np.inf),
            ("low", -np.inf), ("high", np.inf),
        ):  # fmt: skip
            if getattr(self, name) is not None:
                setattr(self, name, np.where(where, value, getattr(self, name)))

    def unframed(self, keep: Frame | None = None) -> "Form":
        """Return a set whose symbols of a frame are added to the radius, but for that to keep."""
        if self.frame is None or self.frame == keep or self.slopes is None:
            return self
        count, ends = self.frame.first, (self.low, self.high)
        radius = self.radius + np.abs(self.slopes[count:]).sum(0) + SLACK * self.size
        return Form(self.centre, self.slopes[:count], radius, self.size, self.dtype, *ends)


def overflown(low: Reals, high: Reals, highest: float) -> Ends:
    """Return an interval that is unbounded if its numbers may overflow."""
    if greatest(np.abs(low)) <= highest and greatest(np.abs(high)) <= highest:
        return low, high
    low = np.where(np.isnan(low) | (low < -highest), -np.inf, low)
    high = np.where(np.isnan(high) | (high > highest), np.inf, high)
    # What is beyond it for certain is an infinity to the machine, and a number in real arithmetic.
    low = np.where((low > highest) & (low < np.inf), highest, low)
    return low, np.where((high < -highest) & (high > -np.inf), -highest, high)


def unknown(low: Reals, high: Reals) -> Reals:
    """Return where a set is unbounded, including NaN."""
    return (low == -np.inf) & (high == np.inf)


def rounded(
    centre: Reals, slopes: Reals | None, radius: Reals, size: Reals, dtype: np.dtype,
    ends: Ends | None = None, frame: Frame | None = None, units: float = 1.0,
    exact: bool = False, tiny: float = 1.0,
) -> Form:  # fmt: skip
    """Return the result of an operation, widened by its error in so many units of rounding.

    So are the `ends` of its interval; `tiny` is its absolute error, in smallest normal numbers.
    What is `exact` is never rounded, such as a maximum.
    """
    kind = rounding(dtype)
    share, absolute = (SLACK, 0.0) if exact else (kind.unit * units, kind.smallest * tiny)
    radius = radius + (share * size + absolute)
    low, high = (None, None) if ends is None else ends
    if low is not None and high is not None and not exact:
        low, high = widened(low, high, share, kind.smallest, absolute if tiny > 1 else 0.0)
    form = Form(centre, slopes, radius, size, dtype, low, high, frame)
    # The radius has a share of the size, so that what is far within reach is found by one number.
    if not greatest(radius) <= kind.highest * SLACK / 4:
        # What may overflow, or is NaN, is unbounded.
        wild = ~(size + radius <= kind.highest)
        if low is not None and high is not None:
            low, high = overflown(low, high, kind.highest)
        form.forget(wild)
        form.low, form.high = low, high
    return form


def widened(low: Reals, high: Reals, share: float, smallest: float, absolute: float = 0.0) -> Ends:
    """Return ends apart by a share of each and a number more; what is tiny keeps its sign."""
    low, high = low - (share * np.abs(low) + absolute), high + (share * np.abs(high) + absolute)
    if least(np.abs(low)) < smallest:
        low = np.where(np.abs(low) < smallest, np.where(low < 0, -smallest, 0.0), low)
    if least(np.abs(high)) < smallest:
        high = np.where(np.abs(high) < smallest, np.where(high > 0, smallest, 0.0), high)
    return low, high


def spanned(low: Reals, high: Reals, dtype: np.dtype, units: float = 1.0) -> Form:
    """Return an interval, the result of an operation, widened by so many units of rounding."""
    kind = rounding(dtype)
    if units:
        low, high = widened(low, high, kind.unit * units, kind.smallest)
    size = np.maximum(np.abs(low), np.abs(high))
    if not size.max(initial=0.0) <= kind.highest / 2:
        return Form.between(low, high, dtype)
    centre = low / 2 + high / 2
    radius = (high / 2 - low / 2) + SLACK * size
    return Form(centre, None, radius, size, dtype, low, high)


def alike(forms: Sequence[Form]) -> tuple[list[Form], Frame | None, int]:
    """Return forms converted to a common frame, and the number of its symbols."""
    frame = max((f.frame for f in forms if f.frame is not None), default=None)
    forms = [f.unframed(frame) for f in forms]
    return forms, frame, max((0 if f.slopes is None else len(f.slopes) for f in forms), default=0)


def padded(form: Form, count: int) -> Reals:
    """Return slopes padded with zeros to this many symbols."""
    if form.slopes is None:
        return np.zeros((count, *(1,) * form.centre.ndim))
    missing = count - len(form.slopes)
    if not missing:
        return form.slopes
    return np.pad(form.slopes, ((0, missing), *((0, 0),) * form.centre.ndim))


def joint_slopes(a: Form, b: Form, first: Reals | float, second: Reals | float) -> Reals | None:
    """Return the slopes of `first * a + second * b`, for forms of one frame."""
    if a.slopes is None:
        return None if b.slopes is None else b.slopes * second
    if b.slopes is None:
        return a.slopes if isinstance(first, float) and first == 1.0 else a.slopes * first
    count = max(len(a.slopes), len(b.slopes))
    return padded(a, count) * first + padded(b, count) * second


def exactly(centre: Reals, rest: Reals, dtype: np.dtype) -> Form | None:
    """Return what an operation on numbers gives, if the type has all results; otherwise None.

    **Arguments:**
    - `rest`: how far the results are from `centre`.
    """
    exact = (rest == 0) & ((centre == 0) | (np.abs(centre) >= rounding(dtype).smallest))
    exact &= centre.astype(dtype).astype(np.float64) == centre
    return Form.constant(centre[0], dtype) if len(centre) == 1 and exact.all() else None


def add(a: Form, b: Form, sign: float = 1.0) -> Form:
    """Return `a + b`, or `a - b` for sign -1."""
    if is_point(a) and is_point(b):
        end, other = a.centre + sign * b.centre, sign * b.centre
        back = end - a.centre
        rest = (a.centre - (end - back)) + (other - back)
        if (form := exactly(end, rest, a.dtype)) is not None:
            return form
    ends = None
    if a.low is not None and b.low is not None:
        first, last = b.bounds()
        ends = _sum_ends(a.bounds(), (first, last) if sign > 0 else (-last, -first), a.dtype)
        if a.slopes is None and b.slopes is None:
            return spanned(*ends, a.dtype, 0)
        ends = overflown(*ends, rounding(a.dtype).highest)
    if a.frame != b.frame:
        (a, b), *_ = alike([a, b])
    slopes = joint_slopes(a, b, 1.0, sign)
    centre = a.centre + b.centre if sign > 0 else a.centre - b.centre
    radius, size, frame = a.radius + b.radius, a.size + b.size, a.frame or b.frame
    form = rounded(centre, slopes, radius, size, a.dtype, None, frame)
    form.low, form.high = ends or (None, None)
    form.common = summed(form.radius, [(a, 1.0), (b, sign)])
    return form


def _sum_ends(a: Ends, b: Ends, dtype: np.dtype) -> Ends:
    """Return the ends of a sum of intervals, widened by rounding only where there is any."""
    kind, (one, other) = rounding(dtype), (np.array([-low, high]) for low, high in (a, b))
    end = one + other
    back = end - one
    # Knuth's error of the sum: it is zero where the sum is exact.
    exact = one - (end - back) == back - other
    if dtype.itemsize < 8:
        exact &= end.astype(dtype) == end
    size = np.abs(end)
    if least(size) < kind.smallest:
        exact &= (size == 0) | (size >= kind.smallest)
    end = np.where(exact, end, end + (kind.unit * size + kind.smallest))
    # A sum of numbers of one sign has that sign, or is zero.
    end = np.where(np.maximum(one, other) <= 0, np.minimum(end, 0.0), end)
    return -end[0], end[1]


def negative(a: Form) -> Form:
    """Return `-a`, which is exact."""
    slopes = None if a.slopes is None else -a.slopes
    low = None if a.high is None else -a.high
    high = None if a.low is None else -a.low
    common = a.common and summed(a.radius, [(a, -1.0)])
    return Form(-a.centre, slopes, a.radius, a.size, a.dtype, low, high, a.frame, common)


def is_point(a: Form) -> bool:
    """Return whether a set is a single array of exact numbers."""
    return a.slopes is None and not a.radius.any()


def scaled(a: Form, by: Reals) -> Form:
    """Return `a` times exact finite numbers."""
    slopes = None if a.slopes is None else a.slopes * by
    scale, ends = np.abs(by), None
    size = a.size * scale
    if a.low is not None and a.high is not None:
        ends = a.low * by, a.high * by
        if not (by >= 0).all():
            ends = np.minimum(*ends), np.maximum(*ends)
    # Times 0, 1, 2, 4 ... nothing is rounded.
    exact = bool(((np.frexp(scale)[0] == 0.5) & (scale >= 1) | (scale == 0)).all())
    if slopes is None and ends is not None and np.isfinite(size).all():
        return spanned(*ends, a.dtype, 0 if exact else 1)
    form = rounded(
        a.centre * by, slopes, a.radius * scale, size, a.dtype, ends, a.frame, exact=exact
    )
    form.common = a.common and summed(form.radius, [(a, by)])
    return form


def interval_product(low: Reals, high: Reals, first: Reals, last: Reals) -> Ends:
    """Return the product of two intervals; unbounded if zero may meet infinity."""
    ends = low * first, low * last, high * first, high * last
    lowest = np.minimum(np.minimum(ends[0], ends[1]), np.minimum(ends[2], ends[3]))
    highest = np.maximum(np.maximum(ends[0], ends[1]), np.maximum(ends[2], ends[3]))
    if least(lowest) > -np.inf and greatest(highest) < np.inf:
        return lowest, highest
    bad = np.isnan(lowest)
    # An interval with zero inside and one without an end: none of the four products is NaN.
    for ours, theirs in (((low, high), (first, last)), ((first, last), (low, high))):
        bad |= (ours[0] <= 0) & (ours[1] >= 0) & ~(np.isfinite(theirs[0]) & np.isfinite(theirs[1]))
    return np.where(bad, -np.inf, lowest), np.where(bad, np.inf, highest)


def product(a: Form, b: Form, narrow: bool = True) -> Form:
    """Return `a * b` for two different forms; unless `narrow`, an interval only if both are one."""
    if is_point(a) and is_point(b):
        result = a.centre * b.centre
        # Products of numbers of single precision fit double precision; of others, of small ones.
        fits = a.dtype.itemsize <= 4 or bool(_whole(a.centre).all() and _whole(b.centre).all())
        rest = np.full(result.shape, 0.0 if fits else 1.0)
        if (form := exactly(result, rest, a.dtype)) is not None:
            return form
    for one, other in ((a, b), (b, a)):
        if is_point(one) and np.isfinite(one.centre).all():
            return scaled(other, one.centre)
    (a, b), frame, _ = alike([a, b])
    if a.slopes is None and b.slopes is None:
        return spanned(*interval_product(*a.bounds(), *b.bounds()), a.dtype)
    whole = (np.abs(a.centre) + a.spread) * (np.abs(b.centre) + b.spread)
    ends, size = None, whole
    if narrow:
        ends = interval_product(*a.bounds(), *b.bounds())
        size = np.maximum(np.abs(ends[0]), np.abs(ends[1]))
    slopes = joint_slopes(a, b, b.centre, a.centre)
    centre = a.centre * b.centre
    radius = np.abs(a.centre) * b.radius + np.abs(b.centre) * a.radius + a.spread * b.spread
    if a.slopes is not None and b.slopes is not None:
        # The square of a symbol lies in [0, 1], not in [-1, 1].
        count = min(len(a.slopes), len(b.slopes))
        squares = a.slopes[:count] * b.slopes[:count]
        centre = centre + squares.sum(0) / 2
        radius = radius - np.abs(squares).sum(0) / 2
    return rounded(centre, slopes, radius + whole * SLACK, size, a.dtype, ends, frame)


def _whole(numbers: Reals) -> Reals:
    """Return which numbers are whole, halves or quarters, and small."""
    return (np.round(4 * numbers) == 4 * numbers) & (np.abs(numbers) < 2**24)


def total(a: Form, axes: Sequence[int]) -> Form:
    """Return the sum over axes, valid for any order of summation."""
    lead = tuple(axis + 1 for axis in axes)
    count = max(int(np.prod([a.centre.shape[axis] for axis in lead], dtype=np.int64)), 1)
    slopes = None if a.slopes is None else a.slopes.sum(tuple(axis + 2 for axis in axes))
    size, ends = a.size.sum(lead), None
    if a.low is not None and a.high is not None:
        margin = rounding(a.dtype).unit * count * size
        low, high = a.low.sum(lead) - margin, a.high.sum(lead) + margin
        # Numbers of one sign add up to one of that sign.
        low = np.where((a.low >= 0).all(lead), np.maximum(low, 0), low)
        ends = low, np.where((a.high <= 0).all(lead), np.minimum(high, 0), high)
        ends = overflown(*ends, rounding(a.dtype).highest)
    return rounded(
        a.centre.sum(lead), slopes, a.radius.sum(lead), size, a.dtype, ends, a.frame, units=count
    )


def joined(one: Form, other: Form) -> Form:
    """Return a set that contains two sets: their hull, with the mean of their slopes."""
    (a, b), frame, _ = alike([one, other])
    gap = joint_slopes(a, b, 0.5, -0.5)
    apart = np.abs(a.centre - b.centre) / 2
    if gap is not None:
        apart = apart + np.abs(gap).sum(0)
    radius = apart + np.maximum(a.radius, b.radius)
    (low, high), (first, last) = a.bounds(), b.bounds()
    return rounded(
        a.centre / 2 + b.centre / 2, joint_slopes(a, b, 0.5, 0.5), radius,
        np.maximum(a.size, b.size), a.dtype, (np.minimum(low, first), np.maximum(high, last)),
        frame, exact=True,
    )  # fmt: skip


def chosen(masks: Sequence[np.ndarray], cases: Sequence[Form]) -> Form:
    """Return for each number the case whose mask holds; exactly one does."""
    cases, frame, count = alike(cases)

    def pick(arrays: Sequence[np.ndarray]) -> np.ndarray:
        picked = arrays[-1]
        for mask, array in zip(masks[-2::-1], arrays[-2::-1], strict=True):
            picked = np.where(mask, array, picked)
        return picked

    slopes = pick([padded(case, count) for case in cases]) if count else None
    ends = [case.bounds() for case in cases]
    return Form(
        pick([c.centre for c in cases]), slopes, pick([c.radius for c in cases]),
        pick([c.size for c in cases]), cases[0].dtype, pick([low for low, _ in ends]),
        pick([high for _, high in ends]), frame,
    )  # fmt: skip
