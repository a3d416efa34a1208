"""Running maxima along time, hard and smooth, at a cost independent of the window.

    extreme(x)                                        # over everything
    windowed(x, n, tau=0.1)                           # over the n samples from each instant on
    until(f, g)                                       # max over j of min(g[j], f before j)

Arrays are time-major `[time, *lanes]`; sign -1 selects a minimum. With a temperature `tau` a
maximum is `tau log sum exp(x / tau)`. Every function has two forms: `sequential` scans, which are
fastest on a CPU, and `parallel` ones for a GPU, where the depth of the computation matters.
"""

from types import ModuleType

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from verifai_jax.mtl import parallel, sequential
from verifai_jax.mtl.sequential import NEVER as NEVER

Tau = Array | float | None


def _form() -> ModuleType:
    return sequential if jax.default_backend() == "cpu" else parallel


def extreme(
    x: Float[Array, "time *lanes"], sign: int = 1, tau: Tau = None
) -> Float[Array, " *lanes"]:
    """Compute the maximum (minimum, for sign -1) along time; smooth at a temperature `tau`."""
    m = jnp.max(x, axis=0) if sign > 0 else jnp.min(x, axis=0)
    if tau is None or x.shape[0] == 1:
        return m
    fixed = lax.stop_gradient(m)
    return fixed + sign * tau * jnp.log(jnp.sum(jnp.exp(sign * (x - fixed) / tau), axis=0))


def join(values: list[Array], sign: int = 1, tau: Tau = None) -> Array:
    """Compute the maximum (minimum, for sign -1) of several arrays, element by element."""
    m = values[0]
    for value in values[1:]:
        m = jnp.maximum(m, value) if sign > 0 else jnp.minimum(m, value)
    if tau is None or len(values) == 1:
        return m
    fixed = lax.stop_gradient(m)
    total = sum(jnp.exp(sign * (value - fixed) / tau) for value in values)
    return fixed + sign * tau * jnp.log(total)


def windowed(
    x: Float[Array, "time *lanes"], n: int, sign: int = 1, tau: Tau = None, reverse: bool = True,
    form: ModuleType | None = None,
) -> Float[Array, "time *lanes"]:  # fmt: skip
    """Compute the maximum over `n` samples from each instant on, or, if not `reverse`, up to it.

    For sign -1 it is the minimum. Windows are cut at the ends of the array. Time `O(time)` on a
    CPU.

    Source: M. van Herk, Pattern Recognition Letters 13 (1992); J. Gil, M. Werman, IEEE PAMI 15
    (1993).
    """
    form = form or _form()
    n = min(n, x.shape[0])
    if n <= 1:
        return x
    if tau is None:
        return form.windowed(n, reverse, sign, x)
    return form.windowed_smooth(n, reverse, sign, x, tau)


def until(
    f: Float[Array, "time *lanes"], g: Float[Array, "time *lanes"], tau: Tau = None,
    reverse: bool = True, form: ModuleType | None = None,
) -> Float[Array, "time *lanes"]:  # fmt: skip
    """Compute `u[t] = max(g[t], min(f[t], u[t+1]))`, and `u = g` at the last sample.

    If not `reverse`, backwards: `u[t] = max(g[t], min(f[t], u[t-1]))`, which is since.
    """
    form = form or _form()
    if g.shape[0] == 1:
        return g
    return form.until_smooth(reverse, f, g, tau) if tau is not None else form.until(reverse, f, g)


def until_first(
    f: Float[Array, "time *lanes"], g: Float[Array, "time *lanes"], tau: Tau = None,
    form: ModuleType | None = None,
) -> Float[Array, " *lanes"]:  # fmt: skip
    """Compute the first sample of `until(f, g)`."""
    form = form or _form()
    if form is sequential and g.shape[0] > 1:
        if tau is None:
            return sequential.until_first(f, g)
        return sequential.until_first_smooth(f, g, tau)
    return until(f, g, tau, form=form)[0]
