"""Running maxima by scans over time with all lanes side by side: the form for a CPU.

The windows follow van Herk and Gil-Werman: time is divided into blocks of the window's length, so
every window is the end of one block and the beginning of the next, and one scan in each direction
suffices. A minimum is a maximum of negated samples; its `sign` -1 is applied within the scans,
because negated copies cost memory. Smooth maxima are carried as pairs `(m, s)`: the greatest value
and the sum of `exp((x - m) / tau)`.

Reverse-mode rules are written by hand: differentiating through the scans costs ten times the value.
Each is again one or two scans.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Shaped

NEVER = 1e30  # Stands for infinity in smooth arithmetic, where inf - inf would be NaN.
Series = Float[Array, "time *lanes"]
Number = Array | float
Each = Array | np.ndarray  # One entry a sample: NumPy outside of a scan, JAX within.
Pair = tuple[Array, Array]
"""The greatest value so far, and the sum of `exp((x - greatest) / tau)`."""


def _starts(n: int, length: int, reverse: bool) -> np.ndarray:
    """Mark where the blocks begin, in the order of the scan that runs against `reverse`.

    Blocks are aligned so that no window that is cut at the end of the array spans two of them.
    """
    k = np.arange(length)
    return (length - k) % n == 0 if reverse else (k + 1) % n == 0


def _ends(n: int, length: int, reverse: bool) -> np.ndarray:
    """Mark where the blocks end, in the same order."""
    k = np.arange(length)
    return (length - 1 - k) % n == 0 if reverse else k % n == 0


def _far(by: int, length: int, reverse: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the instants `by` samples later (earlier, if not `reverse`), and which exist."""
    k = np.arange(length, dtype=np.int32) + (by if reverse else -by)
    return np.clip(k, 0, length - 1), (k >= 0) & (k < length)


def _row(x: Shaped[Array, "time *lanes"], k: Each) -> Shaped[Array, "*lanes"]:
    # Reading a row within the scan saves the copy that a shifted array would be.
    return lax.dynamic_index_in_dim(x, k, keepdims=False)


# Hard windows


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def windowed(n: int, reverse: bool, sign: int, x: Series) -> Series:
    """Compute the maximum (minimum, for `sign` -1) of `n` samples from (or up to) each instant."""
    return _windowed(n, reverse, sign, x, keep=False)[0]


def _windowed(n: int, reverse: bool, sign: int, x: Series, keep: bool) -> tuple[Series, Any]:
    """Compute windows, and if `keep` what the way back needs: three truth values a sample.

    `newest` says whether the newest sample is a running maximum, in each of the scans; `near`
    whether a window's value comes from the scan that began there.
    """
    length = x.shape[0]
    lowest = jnp.full(x.shape[1:], -jnp.inf, x.dtype)

    def begin(m: Array, row: tuple[Array, Each]) -> tuple[Array, Any]:
        value, start = row
        value = sign * value
        newest = start | (value >= m)
        m = jnp.where(start, value, jnp.maximum(m, value))
        return m, (m, newest) if keep else (m, None)

    if n >= length:
        no_starts = np.zeros(length, bool)
        y, newest = lax.scan(begin, lowest, (x, no_starts), reverse=reverse)[1]
        return sign * y, (newest, None)
    starts = _starts(n, length, reverse)
    ahead, newest_ahead = lax.scan(begin, lowest, (x, starts), reverse=not reverse)[1]

    def finish(m: Array, row: tuple[Array, Each, tuple[Each, Each]]) -> tuple[Array, Any]:
        value, end, (far, inside) = row
        value = sign * value
        newest = jnp.asarray(end) | (value >= m)
        m = jnp.where(end, value, jnp.maximum(m, value))
        other = jnp.where(inside, _row(ahead, far), -jnp.inf)
        y = sign * jnp.maximum(m, other)
        return m, (y, _code(newest, m >= other)) if keep else (y, None)

    rows = (x, _ends(n, length, reverse), _far(n - 1, length, reverse))
    y, code = lax.scan(finish, lowest, rows, reverse=reverse)[1]
    return y, (code, newest_ahead)


def _code(a: Array, b: Array) -> Array:
    # Two truth values in one byte: what is stored for the way back is what it costs.
    return a.astype(jnp.uint8) + 2 * b.astype(jnp.uint8)


def _windowed_forward(n: int, reverse: bool, sign: int, x: Series) -> tuple[Series, Any]:
    return _windowed(n, reverse, sign, x, keep=True)


def _windowed_backward(
    n: int, reverse: bool, sign: int, residuals: tuple[Array, Array | None], g: Series
) -> tuple[Series]:
    # Towards the greatest sample: what reaches a running maximum goes to its newest sample where
    # that one is the greatest, and on to the maximum before it where not.
    code, newest_ahead = residuals
    length = g.shape[0]
    nothing = jnp.zeros(g.shape[1:], g.dtype)

    def back_near(carry: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        g, code = row
        newest = (code & 1) != 0
        carry = carry + (g if newest_ahead is None else jnp.where(code >= 2, g, 0.0))
        return jnp.where(newest, 0.0, carry), jnp.where(newest, carry, 0.0)

    first = lax.scan(back_near, nothing, (g, code), reverse=not reverse)[1]
    if newest_ahead is None:
        return (first,)

    def back_ahead(
        carry: Array, row: tuple[Array, Array, tuple[Each, Each]]
    ) -> tuple[Array, Array]:
        newest, other, (far, inside) = row
        carry = carry + jnp.where(inside & (_row(code, far) < 2), _row(g, far), 0.0)
        return jnp.where(newest, 0.0, carry), other + jnp.where(newest, carry, 0.0)

    rows = (newest_ahead, first, _far(n - 1, length, not reverse))
    return (lax.scan(back_ahead, nothing, rows, reverse=reverse)[1],)


windowed.defvjp(_windowed_forward, _windowed_backward)


# Smooth windows


def _add(m: Array, s: Array, x: Array, weight: Number, tau: Number) -> Pair:
    """Add one more value, of a `weight`, to the pair; one exponential instead of two."""
    top = jnp.maximum(m, x)
    fade = jnp.exp((jnp.minimum(m, x) - top) / tau)
    grows = x > m
    return top, jnp.where(grows, s * fade + weight, s + weight * fade)


def _pairs(
    n: int, reverse: bool, sign: int, x: Series, weight: Series | None, tau: Number,
    finish: Callable[[Array, Array], Any],
) -> Any:  # fmt: skip
    """Compute `finish(m, s)` of the pairs over windows of `weight * exp(sign * x / tau)`."""
    length = x.shape[0]
    nothing = (jnp.full(x.shape[1:], -NEVER, x.dtype), jnp.zeros(x.shape[1:], x.dtype))

    def begin(pair: Pair, row: tuple[Array, Each, Array | None]) -> tuple[Pair, Pair]:
        value, start, weight = row
        m, s = pair
        m, s = jnp.where(start, -NEVER, m), jnp.where(start, 0.0, s)
        m, s = _add(m, s, sign * value, 1.0 if weight is None else weight, tau)
        return (m, s), (m, s)

    if n < length:
        rows = (x, _starts(n, length, reverse), weight)
        ahead = lax.scan(begin, nothing, rows, reverse=not reverse)[1]
        far, inside = _far(n - 1, length, reverse)
        # A window that is exactly one block would be counted twice.
        far = (far, inside & ~_starts(n, length, reverse))
    else:
        ahead, far = (), None

    def complete(
        pair: Pair, row: tuple[Array, Each, Array | None, tuple[Each, Each] | None]
    ) -> tuple[Pair, Any]:
        value, end, weight, far = row
        m, s = pair
        m, s = jnp.where(end, -NEVER, m), jnp.where(end, 0.0, s)
        m, s = _add(m, s, sign * value, 1.0 if weight is None else weight, tau)
        if far is None:
            return (m, s), finish(m, s)
        more, other = (_row(a, far[0]) for a in ahead)
        both = _add(m, s, more, other, tau)
        total = (jnp.where(far[1], a, b) for a, b in zip(both, (m, s), strict=True))
        return (m, s), finish(*total)

    ends = np.zeros(length, bool) if far is None else _ends(n, length, reverse)
    return lax.scan(complete, nothing, (x, ends, weight, far), reverse=reverse)[1]


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def windowed_smooth(n: int, reverse: bool, sign: int, x: Series, tau: Number) -> Series:
    """Compute `windowed` with `tau log sum exp(x / tau)` for the maximum."""
    return _pairs(n, reverse, sign, x, None, tau, lambda m, s: sign * (m + tau * jnp.log(s)))


def _windowed_smooth_forward(
    n: int, reverse: bool, sign: int, x: Series, tau: Number
) -> tuple[Series, Any]:
    y: Any = windowed_smooth(n, reverse, sign, x, tau)
    return y, (x, y, tau)


def _windowed_smooth_backward(
    n: int, reverse: bool, sign: int, residuals: tuple[Series, Series, Array], g: Series
) -> tuple[Series, Array]:
    # dx[s] = sum over the windows t that contain s of g[t] exp((x[s] - y[t]) / tau): a window the
    # other way over -y with weights g. No exponent is positive, because y is an upper bound of x.
    x, y, tau = residuals
    m, s = _pairs(n, not reverse, -sign, y, g, tau, lambda m, s: (m, s))
    return jnp.exp(jnp.minimum(sign * x + m, 0.0) / tau) * s, jnp.zeros_like(tau)


windowed_smooth.defvjp(_windowed_smooth_forward, _windowed_smooth_backward)


# Until, and since the other way round

Residuals = tuple[Array | None, Array | None, Any, Array | float | None]
"""Both arguments of until (None for hard semantics), what to keep of each step, the temperature."""
SmoothResiduals = tuple[Array, Array, Array, Number]
"""The same at a temperature."""


def _until(
    reverse: bool, f: Series, g: Series, tau: Number | None, keep: Literal["u", "v", "uv", ""]
) -> tuple[Array, Any]:
    """Compute the last value of the recursion, and what to `keep` of each step.

    `"u"` keeps the values, `"v"` what the way back needs: the smaller of `f` and the value before,
    or in the hard case where a value comes from: `g` at once, or else `f`.
    """

    def step(u: Array, row: tuple[Array, Array]) -> tuple[Array, Any]:
        f, g = row
        if tau is None:
            inner = jnp.minimum(f, u)
            v = (g >= inner, f <= u)
        else:
            inner = v = -_greater(-f, -u, tau)
        u = _greater(g, inner, tau)
        return u, {"u": u, "v": v, "uv": (u, v), "": None}[keep]

    nothing = jnp.full(g.shape[1:], -jnp.inf if tau is None else -NEVER, g.dtype)
    return lax.scan(step, nothing, (f, g), reverse=reverse)


def _greater(a: Array, b: Array, tau: Number | None) -> Array:
    m = jnp.maximum(a, b)
    return m if tau is None else m + tau * jnp.log1p(jnp.exp((jnp.minimum(a, b) - m) / tau))


def _until_backward(
    reverse: bool, residuals: Residuals, pull: Float[Array, "*pull"]
) -> tuple[Series, Series]:
    """Pull back the cotangent of every value `[time, *lanes]`, or of the first alone `[*lanes]`."""
    f, g, v, tau = residuals
    lanes = jnp.ndim(v if tau is not None else v[0]) - 1
    whole = pull.ndim > lanes

    def step(
        carry: Array, row: tuple[Array | None, Array | None, Array | None, Any]
    ) -> tuple[Array, tuple[Array, Array]]:
        pull, f, g, v = row
        carry = carry if pull is None else carry + pull
        if tau is None:
            to_g, to_f = v
            down = jnp.where(to_g, 0.0, carry)
            return jnp.where(to_f, 0.0, down), (
                jnp.where(to_f, down, 0.0),
                jnp.where(to_g, carry, 0.0),
            )
        to_g = jax.nn.sigmoid((g - v) / tau) * carry
        down = carry - to_g
        to_f = jnp.exp(jnp.minimum(v - f, 0.0) / tau) * down
        return down - to_f, (to_f, to_g)

    start = jnp.zeros_like(pull[0]) if whole else pull
    rows = (pull if whole else None, f, g, v)
    return lax.scan(step, start, rows, reverse=not reverse)[1]


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def until(reverse: bool, f: Series, g: Series) -> Series:
    """Compute `u[t] = max(g[t], min(f[t], u[t+1]))` (`u[t-1]`, if not `reverse`)."""
    return _until(reverse, f, g, None, "u")[1]


def _until_forward(reverse: bool, f: Series, g: Series) -> tuple[Series, Any]:
    u, v = _until(reverse, f, g, None, "uv")[1]
    return u, (None, None, v, None)


until.defvjp(_until_forward, _until_backward)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def until_smooth(reverse: bool, f: Series, g: Series, tau: Number) -> Series:
    """Compute `until` with smooth maxima and minima."""
    return _until(reverse, f, g, tau, "u")[1]


def _until_smooth_forward(reverse: bool, f: Series, g: Series, tau: Number) -> tuple[Series, Any]:
    u, v = _until(reverse, f, g, tau, "uv")[1]
    return u, (f, g, v, tau)


def _until_smooth_backward(
    reverse: bool, residuals: SmoothResiduals, pull: Series
) -> tuple[Series, Series, Array]:
    return *_until_backward(reverse, residuals, pull), jnp.zeros_like(residuals[3])


until_smooth.defvjp(_until_smooth_forward, _until_smooth_backward)


@jax.custom_vjp
def until_first(f: Series, g: Series) -> Array:
    """Compute only the first value of `until`, without storing the others."""
    return _until(True, f, g, None, "")[0]


def _until_first_forward(f: Series, g: Series) -> tuple[Array, Any]:
    u, v = _until(True, f, g, None, "v")
    return u, (None, None, v, None)


def _until_first_backward(residuals: Residuals, pull: Array) -> tuple[Series, Series]:
    return _until_backward(True, residuals, pull)


until_first.defvjp(_until_first_forward, _until_first_backward)


@jax.custom_vjp
def until_first_smooth(f: Series, g: Series, tau: Number) -> Array:
    """Compute only the first value of `until_smooth`, without storing the others."""
    return _until(True, f, g, tau, "")[0]


def _until_first_smooth_forward(f: Series, g: Series, tau: Number) -> tuple[Array, Any]:
    u, v = _until(True, f, g, tau, "v")
    return u, (f, g, v, tau)


def _until_first_smooth_backward(
    residuals: SmoothResiduals, pull: Array
) -> tuple[Series, Series, Array]:
    return *_until_backward(True, residuals, pull), jnp.zeros_like(residuals[3])


until_first_smooth.defvjp(_until_first_smooth_forward, _until_first_smooth_backward)
