"""Running maxima by doubling and by associative scans: the form for a GPU.

A window of `n` samples is joined from windows of 1, 2, 4, ... samples, in `log n` steps over all of
time at once. Until is a product of maps `x -> max(R, min(L, x))`, which compose associatively; the
smooth one is a product of Moebius maps in `exp(x / tau)`, kept as logarithms of their matrices.
Derivatives are left to JAX, because nothing here is sequential.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Series = Float[Array, "time *lanes"]
Maps = tuple[Array, ...]
"""Maps of a product, by the arrays that hold their entries."""


def _shift(x: Series, by: int, reverse: bool, fill: float) -> Series:
    if by == 0:
        return x
    pad = jnp.full((min(by, x.shape[0]), *x.shape[1:]), fill, x.dtype)
    return jnp.concatenate([x[by:], pad] if reverse else [pad, x[: x.shape[0] - by]])


def windowed(n: int, reverse: bool, sign: int, x: Series) -> Series:
    """Compute the maximum (minimum, for `sign` -1) of `n` samples from (or up to) each instant."""
    x, size = sign * x, 1
    while size < n:
        by = min(size, n - size)  # Windows may overlap: a maximum counts nothing twice.
        x = jnp.maximum(x, _shift(x, by, reverse, -jnp.inf))
        size += by
    return sign * x


def windowed_smooth(n: int, reverse: bool, sign: int, x: Series, tau: Array | float) -> Series:
    """Compute `windowed` with `tau log sum exp(x / tau)` for the maximum."""
    # An overlap would count samples twice, so windows are joined by the binary digits of n.
    never = 1e30
    pair = (sign * x, jnp.ones_like(x))
    total, offset, size, rest = None, 0, 1, n
    while True:
        if rest & 1:
            part = (_shift(pair[0], offset, reverse, -never), _shift(pair[1], offset, reverse, 0.0))
            total = part if total is None else _join(total, part, tau)
            offset += size
        rest >>= 1
        if not rest:
            break
        later = (_shift(pair[0], size, reverse, -never), _shift(pair[1], size, reverse, 0.0))
        pair = _join(pair, later, tau)
        size *= 2
    m, s = total if total is not None else pair
    return sign * (m + tau * jnp.log(s))


def _join(
    a: tuple[Series, Series], b: tuple[Series, Series], tau: Array | float
) -> tuple[Series, Series]:
    top = lax.stop_gradient(jnp.maximum(a[0], b[0]))
    return top, a[1] * jnp.exp((a[0] - top) / tau) + b[1] * jnp.exp((b[0] - top) / tau)


def until(reverse: bool, f: Series, g: Series) -> Series:
    """Compute `u[t] = max(g[t], min(f[t], u[t+1]))` (`u[t-1]`, if not `reverse`)."""

    # x -> max(R, min(L, x)): (L1, R1) after (L2, R2) is (min(L1, L2), max(R1, min(L1, R2))).
    def after(b: Maps, a: Maps) -> Maps:
        return jnp.minimum(a[0], b[0]), jnp.maximum(a[1], jnp.minimum(a[0], b[1]))

    edge = -1 if reverse else 0
    f = f.at[edge].set(-jnp.inf)
    return lax.associative_scan(after, (f, g), reverse=reverse)[1]


def until_smooth(reverse: bool, f: Series, g: Series, tau: Array | float) -> Series:
    """Compute `until` with smooth maxima and minima."""

    # With X = exp(x / tau), smin(L, x) is LX / (X + L) and smax adds: a matrix
    # [[R + L, R L], [1, L]], all of whose entries are positive, so their logarithms exist.
    def add(a: Array, b: Array) -> Array:
        top = lax.stop_gradient(jnp.maximum(a, b))
        return top + jnp.log(jnp.exp(a - top) + jnp.exp(b - top))

    def after(b: Maps, a: Maps) -> Maps:
        return (
            add(a[0] + b[0], a[1] + b[2]),
            add(a[0] + b[1], a[1] + b[3]),
            add(a[2] + b[0], a[3] + b[2]),
            add(a[2] + b[1], a[3] + b[3]),
        )

    left, right = f / tau, g / tau
    edge = -1 if reverse else 0
    # The last map is the constant g: [[0, R], [0, 1]], with a finite stand-in for log 0.
    matrix = (
        add(right, left).at[edge].set(-1e20),
        (right + left).at[edge].set(right[edge]),
        jnp.zeros_like(left).at[edge].set(-1e20),
        left.at[edge].set(0.0),
    )
    _, top, _, bottom = lax.associative_scan(after, matrix, reverse=reverse)
    return tau * (top - bottom)
