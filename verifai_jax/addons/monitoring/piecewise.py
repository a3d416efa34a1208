"""Functions of time that are linear between breakpoints, where they may jump.

joined([f, g], 1)                                   # the maximum, exact also where they cross
window(f, 0.0, 0.3, -1)                             # the least of the next 0.3 s, at every time
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Values = Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Piecewise:
    """A function on `[times[0], inf)`.

    - `times`: breakpoints in seconds.
    - `point`: the value at each breakpoint; `right` and `left`: the limits at the start and at the
      end of the piece that follows it. The last piece is constant and has no end.
    - `snap`: times that differ by less than this many seconds are equal.
    """

    times: Values
    point: Values
    right: Values
    left: Values
    snap: float = 0.0

    def map(self, function: Callable[..., Values], *others: "Piecewise") -> "Piecewise":
        """Apply a function to several functions with equal times; it must be linear in pieces."""
        with np.errstate(all="ignore"):
            point, right, left = (
                function(*(getattr(f, part) for f in (self, *others)))
                for part in ("point", "right", "left")
            )
        return Piecewise(self.times, point, right, left, self.snap)

    @property
    def steps(self) -> bool:
        """True if every piece is constant."""
        return bool(np.all((self.right == self.left) | np.isnan(self.right)))

    def index(self, times: Values, after: bool = False) -> np.ndarray:
        """Count the breakpoints before each time, including those at it if `after`."""
        return np.searchsorted(self.times, times + (self.snap if after else -self.snap), "right")

    def pieces(self, times: Values, shift: float = 0.0) -> tuple[Values, Values]:
        """Compute the limits at both ends of each piece between times, shifted by `shift`.

        No breakpoint may lie inside such a piece. Before its start the function is -inf.
        """
        gaps = np.append(np.diff(times), 1.0)
        k = self.index(times + gaps / 2 + shift, after=True) - 1
        right, left = (self._on_piece(k, at + shift) for at in (times, times + gaps))
        return np.where(k < 0, -np.inf, right), np.where(k < 0, -np.inf, left)

    def _on_piece(self, k: np.ndarray, at: Values) -> Values:
        k = np.maximum(k, 0)
        start, end = self.times[k], np.append(self.times[1:], np.inf)[k]
        right, left = self.right[k], self.left[k]
        with np.errstate(invalid="ignore"):
            share = np.where(np.isfinite(end), (at - start) / (end - start), 0.0)
            value = np.where(right == left, right, right + (left - right) * share)
            value = np.where(np.abs(at - start) <= self.snap, right, value)
            return np.where(np.abs(end - at) <= self.snap, left, value)

    def inside(self, times: Values) -> Values:
        """Compute the values at times inside pieces."""
        return self._on_piece(self.index(times, after=True) - 1, times)

    def __call__(self, times: Values) -> Values:
        """Compute the values at times that are no earlier than the first."""
        k = self.index(times, after=True) - 1
        at = np.abs(times - self.times[k]) <= self.snap
        return np.where(at, self.point[k], self._on_piece(k, times))

    def at(self, times: Values) -> "Piecewise":
        """Return the same function with more breakpoints, which must include its own."""
        return Piecewise(times, self(times), *self.pieces(times), self.snap)


def merged(times: Sequence[Values], snap: float) -> Values:
    """Return the times of all functions, each once."""
    ordered = np.sort(np.concatenate(times))
    return ordered[np.append(True, np.diff(ordered) > snap)]


def aligned(*functions: Piecewise, crossings: bool = False) -> tuple[Piecewise, ...]:
    """Return the functions on common breakpoints, including those where two of them cross."""
    snap = functions[0].snap
    times = merged([f.times for f in functions], snap)
    made = tuple(f.at(times) for f in functions)
    pairs = itertools.combinations(made, 2) if crossings else ()
    found = [_crossing(f, g) for f, g in pairs]
    if any(len(each) for each in found):
        times = merged([times, *found], snap)
        made = tuple(f.at(times) for f in made)
    return made


def _crossing(f: Piecewise, g: Piecewise) -> Values:
    with np.errstate(all="ignore"):
        begin, end = (f.right - g.right)[:-1], (f.left - g.left)[:-1]
        after = begin / (begin - end) * (gaps := np.diff(f.times))
        # A crossing next to a breakpoint is that breakpoint.
        real = (begin * end < 0) & (after > f.snap) & (gaps - after > f.snap)
    return (f.times[:-1] + after)[real]


def joined(functions: Sequence[Piecewise], sign: int) -> Piecewise:
    """Return the maximum (minimum, for sign -1) of several functions."""
    best = np.maximum if sign > 0 else np.minimum
    result, *others = functions
    for other in others:
        one, two = aligned(result, other, crossings=True)
        result = one.map(best, two)
    return result


def window(
    f: Piecewise, low: float, high: float, sign: int, open_right: bool = False,
    open_left: bool = False,
) -> Piecewise:  # fmt: skip
    """Return the maximum (minimum) of `f` over `[t + low, t + high]`, at every `t`."""
    if sign < 0:
        negated = window(f.map(np.negative), low, high, 1, open_right, open_left)
        return negated.map(np.negative)
    start, snap = f.times[0], f.snap
    edges = [f.times - edge for edge in (low, high) if np.isfinite(edge)]
    times = merged([np.array([start]), *(edge[edge > start + snap] for edge in edges)], snap)
    before = np.append(-np.inf, f.left[:-1])
    highest = _Highest(np.maximum(np.maximum(f.point, f.right), before))
    # At a breakpoint: what is strictly inside, and what each edge sees.
    one, two = times + low, times + high
    first, last = f.index(one), f.index(two, after=True) - 1
    inside_first, inside_last = f.index(one, after=True), f.index(two) - 1
    point = highest(inside_first, inside_last)
    at_one, at_two = first < inside_first, last > inside_last
    begun = two >= start - snap
    if high > low:
        own = np.where(at_one, f.right[np.minimum(first, len(f.times) - 1)], f.inside(one))
        point = np.maximum(point, np.where(one >= start - snap, own, -np.inf))
        ends = np.where(at_two, f.left[np.maximum(last - 1, 0)], f.inside(two))
        before = np.where(at_two, last > 0, begun)
        point = np.maximum(point, np.where(before & begun, ends, -np.inf))
    for at, where, is_open in ((at_one, first, open_left), (at_two, last, open_right)):
        if not is_open:
            own = f.point[np.clip(where, 0, len(f.times) - 1)]
            point = np.where(at, np.maximum(point, own), point)
    if high == low:
        point = np.where(begun, np.where(at_one, point, f.inside(one)), -np.inf)
    # Between breakpoints: two edges that move along pieces, and what is between them.
    middle = times + np.append(np.diff(times), 1.0) / 2
    ends = [f.pieces(times, edge) for edge in (low, high) if np.isfinite(edge)]
    parts = [Piecewise(times, right, right, left, snap) for right, left in ends]
    still = highest(f.index(middle + low, after=True), f.index(middle + high) - 1)
    between = joined([*parts, Piecewise(times, still, still, still, snap)], 1)
    return _with_points(between, times, point)


class _Highest:
    """The greatest of the values from one index to another, both included; -inf for no values."""

    def __init__(self, values: Values) -> None:
        self.rows = [values]  # The greatest of 1, 2, 4, 8 ... neighbours.
        while 2 ** len(self.rows) <= len(values):
            row, half = self.rows[-1], 2 ** (len(self.rows) - 1)
            self.rows.append(np.maximum(row[:-half], row[half:]))

    def __call__(self, first: np.ndarray, last: np.ndarray) -> Values:
        count = len(self.rows[0])
        first, last = np.clip(first, 0, count), np.clip(last, -1, count - 1)
        size = np.maximum(last - first + 1, 1)
        level = np.log2(size).astype(int)
        out = np.full(len(first), -np.inf)
        for k, row in enumerate(self.rows):
            mine = (level == k) & (last >= first)
            begin, end = first[mine], last[mine] - 2**k + 1
            out[mine] = np.maximum(row[begin], row[end])
        return out


def witnessed(f: Piecewise, g: Piecewise, ahead: bool) -> Piecewise:
    """Return `f` until `g` over the whole future (`ahead`), or `f` since `g` over the whole past.

    `f` must hold between now and the witness, but not at the witness.
    """
    f, g = aligned(f, g, crossings=True)
    n = len(f.times)

    # Unlike Python's own they give NaN for NaN.
    def greater(a: float, b: float) -> float:
        return a if a >= b or a != a else b

    def smaller(a: float, b: float) -> float:
        return a if a <= b or a != a else b

    far_g, near_g, near_f = (g.left, g.right, f.right) if ahead else (g.right, g.left, f.left)
    # The least of f between a time within a piece and its far end, and the best from there on.
    lowest = np.minimum(f.right, f.left)
    best, point = np.empty(n), np.empty(n)
    now = -np.inf
    for k in range(n - 1, -1, -1) if ahead else range(n):
        if not ahead:
            now = point[k] = greater(g.point[k], smaller(f.point[k], now))
        best[k] = greater(far_g[k], now)
        now = greater(smaller(near_g[k], near_f[k]), smaller(lowest[k], best[k]))
        if ahead:
            now = point[k] = greater(g.point[k], smaller(f.point[k], now))
    sides = (lowest, f.left) if ahead else (f.right, lowest)
    kept = Piecewise(f.times, point, *sides, f.snap)
    far = joined([kept, Piecewise(g.times, best, best, best, g.snap)], -1)
    return _with_points(joined([g, far], 1), g.times, point)


def _with_points(f: Piecewise, times: Values, point: Values) -> Piecewise:
    values = np.array(f.right)
    values[np.searchsorted(f.times, times)] = point
    return Piecewise(f.times, values, f.right, f.left, f.snap)
