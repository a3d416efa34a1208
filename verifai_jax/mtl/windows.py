"""Running minima and maxima along time, hard and smooth.

Arrays are time-major `[time, *lanes]`. A smooth maximum is carried as a pair `(m, s)`: the greatest
value seen and the sum of `exp((x - m) / tau)`, which never overflows.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

NEVER = 1e30  # Stands for infinity in smooth arithmetic, where inf - inf would be NaN.

Tau = Any


def maximum(x: Float[Array, "time *lanes"], tau: Tau = None) -> Float[Array, " *lanes"]:
    """Greatest value along time; its log-sum-exp at temperature `tau` if given."""
    m = jnp.max(x, axis=0)
    if tau is None:
        return m
    fixed = lax.stop_gradient(m)
    return fixed + tau * jnp.log(jnp.sum(jnp.exp((x - fixed) / tau), axis=0))


def pairwise(x: Float[Array, " *n"], y: Float[Array, " *n"], tau: Tau = None) -> Array:
    """The greater of two values at every instant; smooth at `tau` if given."""
    return jnp.maximum(x, y) if tau is None else maximum(jnp.stack([x, y]), tau)


def running(
    x: Float[Array, "time *lanes"], tau: Tau = None, reverse: bool = False
) -> Float[Array, "time *lanes"]:
    """Maximum of everything up to each instant (from each instant on, if `reverse`)."""

    def step(carry: Any, row: Array) -> Any:
        carry = _join(carry, _one(row, tau), tau)
        return carry, _value(carry, tau)

    first = jax.tree.map(
        lambda a: jnp.full_like(a, -jnp.inf if tau is None else 0.0), _one(x[0], tau)
    )
    if tau is not None:
        first = (jnp.full_like(x[0], -NEVER), first[1])
    return lax.scan(step, first, x, reverse=reverse)[1]


def windowed(
    x: Float[Array, "time *lanes"], n: int, tau: Tau = None, reverse: bool = False
) -> Float[Array, "time *lanes"]:
    """Maximum of the `n` samples that begin at each instant (end there, if not `reverse`).

    Windows are cut at the ends of the array.
    """
    if n >= x.shape[0]:
        return running(x, tau, reverse)
    value, size = _one(x, tau), 1
    while size < n:
        shift = min(size, n - size)
        if shift != size and tau is not None:
            break
        value = _join(value, _shifted(value, shift, reverse, tau), tau)
        size += shift
    if size < n:  # An overlap would count samples twice, so add the binary digits that are left.
        total, offset = None, 0
        value, size, rest = _one(x, tau), 1, n
        while rest:
            if rest & 1:
                part = _shifted(value, offset, reverse, tau)
                total = part if total is None else _join(total, part, tau)
                offset += size
            rest >>= 1
            if rest:
                value = _join(value, _shifted(value, size, reverse, tau), tau)
                size *= 2
        value = total
    return _value(value, tau)


def until(
    f: Float[Array, "time *lanes"],
    g: Float[Array, "time *lanes"],
    tau: Tau = None,
    reverse: bool = True,
) -> Float[Array, "time *lanes"]:
    """`u[t] = max(g[t], min(f[t], u[t+1]))`, and `u = g` at the last sample (first, for since)."""

    def step(u: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        u = pairwise(row[1], -pairwise(-row[0], -u, tau), tau)
        return u, u

    if g.shape[0] == 1:
        return g
    last = g[-1] if reverse else g[0]
    rows = (f[:-1], g[:-1]) if reverse else (f[1:], g[1:])
    out = lax.scan(step, last, rows, reverse=reverse)[1]
    return jnp.concatenate([out, last[None]] if reverse else [last[None], out])


def _one(x: Array, tau: Tau) -> Any:
    return x if tau is None else (x, jnp.ones_like(x))


def _join(a: Any, b: Any, tau: Tau) -> Any:
    if tau is None:
        return jnp.maximum(a, b)
    (m, s), (n, t) = a, b
    top = lax.stop_gradient(jnp.maximum(m, n))
    return top, s * jnp.exp((m - top) / tau) + t * jnp.exp((n - top) / tau)


def _value(a: Any, tau: Tau) -> Array:
    return a if tau is None else a[0] + tau * jnp.log(jnp.maximum(a[1], 1e-30))


def _shifted(a: Any, by: int, reverse: bool, tau: Tau) -> Any:
    """The element `by` samples later (earlier, if not `reverse`); nothing beyond the array."""

    def shift(x: Array, fill: float) -> Array:
        if by == 0:
            return x
        if by >= x.shape[0]:
            return jnp.full_like(x, fill)
        pad = jnp.full_like(x[:by], fill)
        return jnp.concatenate([x[by:], pad] if reverse else [pad, x[:-by]])

    return shift(a, -jnp.inf) if tau is None else (shift(a[0], -NEVER), shift(a[1], 0.0))
