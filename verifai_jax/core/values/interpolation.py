"""Interpolation between numbers at increasing positions: lines and monotone cubics.

`xp` is `numpy` for a simulator on the host and `jax.numpy` in a traced one.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def between(left: Any, right: Any, share: Any, xp: Any) -> Any:
    """Interpolate between `left` (share 0) and `right` (share 1) without exceeding them."""
    return clamped(left * (1 - share) + right * share, left, right, xp)


def monotone_cubic(knots: Any, gaps: Any, left: Any, share: Any, xp: Any) -> Any:
    """Interpolate with a cubic that is monotone wherever the numbers are.

    Source: F. N. Fritsch and J. Butland, A method for constructing local monotone piecewise cubic
    interpolants, SIAM J. Sci. Stat. Comput. 5 (1984), with the ends of C. Moler, Numerical
    Computing with MATLAB, section 3.6: the scheme of MATLAB's and SciPy's `pchip`.

    **Arguments:**
    - `knots`: `[n, ...]`, at least 2.
    - `gaps`: `[n - 1]`, the distances between their positions.
    - `left`: index of the knot before the position, from 0 to n - 2.
    - `share`: the position as a share of the distance to the next knot, from 0 to 1.
    """
    count = knots.shape[0]
    begin, end = knots[left], knots[left + 1]
    if count == 2:
        return between(begin, end, share, xp)
    gaps = xp.asarray(gaps, knots.dtype)

    def secant(i: Any) -> tuple[Any, Any]:
        i = xp.clip(i, 0, count - 2)
        return gaps[i], (knots[i + 1] - knots[i]) / gaps[i]

    before, own, after = secant(left - 1), secant(left), secant(left + 1)
    first = xp.where(left == 0, _end_slope(own, after, xp), _inner_slope(before, own, xp))
    last = xp.where(left == count - 2, _end_slope(own, before, xp), _inner_slope(own, after, xp))
    rest, gap = 1 - share, own[0]
    value = begin * (1 + 2 * share) * rest**2 + end * share**2 * (3 - 2 * share)
    value = value + gap * share * rest * (first * rest - last * share)
    return clamped(value, begin, end, xp)


def _inner_slope(before: Any, after: Any, xp: Any) -> Any:
    """Return the weighted harmonic mean of two secants; 0 where they differ in sign."""
    (h0, d0), (h1, d1) = before, after
    w0, w1 = 2 * h1 + h0, h1 + 2 * h0
    same = d0 * d1 > 0
    mean = (w0 + w1) * d0 * d1 / xp.where(same, w0 * d1 + w1 * d0, 1)
    return xp.where(same, mean, 0)


def _end_slope(near: Any, far: Any, xp: Any) -> Any:
    """Return the slope of a parabola at an end, limited so that the cubic stays monotone."""
    (h0, d0), (h1, d1) = near, far
    slope = ((2 * h0 + h1) * d0 - h0 * d1) / (h0 + h1)
    steep = (xp.sign(d0) != xp.sign(d1)) & (abs(slope) > 3 * abs(d0))
    return xp.where(xp.sign(slope) != xp.sign(d0), 0, xp.where(steep, 3 * d0, slope))


def clamped(value: Any, one: Any, other: Any, xp: Any) -> Any:
    """Return the value clipped to the interval between two numbers.

    Between two knots at the end of their domain, rounding may move a sum outside. The derivative is
    that of the value, even if both numbers are equal.
    """
    lowest, maximum = xp.minimum(one, other), xp.maximum(one, other)
    if xp is np:
        return np.clip(value, lowest, maximum)
    lowest, maximum, zero = (
        *jax.lax.stop_gradient((lowest, maximum)),
        value - jax.lax.stop_gradient(value),
    )
    value = jnp.where(value < lowest, lowest + zero, value)
    return jnp.where(value > maximum, maximum + zero, value)
