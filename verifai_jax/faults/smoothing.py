"""Hard values with smooth derivatives: what is switched, and what is rounded to whole periods."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


@jax.custom_jvp
def straight(value: Array, smooth: Array) -> Array:
    """Return `value` with the derivative of `smooth`."""
    return value


straight.defjvp(lambda primals, tangents: (primals[0], tangents[1]))


@jax.custom_jvp
def blend(
    on: Bool[Array, ""],
    live: Bool[Array, ""],
    possible: Bool[Array, ""],
    lead: Float[Array, ""],
    trail: Float[Array, ""],
    bad: Float[Array, " n"],
    good: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Return `bad` where `on` and `good` elsewhere, with derivatives by the edges.

    A fault that begins a little earlier, between two samples, changes no value. The derivative is
    therefore that of the line between the values at both samples: the sum over the samples grows by
    one difference for each period by which the fault is longer.

    **Arguments:**
    - `on`: whether the fault acts; `live`: whether the instant lies in its time, so that it would
      act if it were a little severer; `possible`: whether it happens at all.
    - `lead`, `trail`: periods since its onset, and since its end.
    """
    return jnp.where(on, bad, good)


@blend.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    _, live, possible, lead, trail, bad, good = primals
    *_, dlead, dtrail, dbad, dgood = tangents
    gap = jnp.where(possible, bad - good, 0.0)
    begins = jnp.where(jnp.abs(lead) < 1, gap * (1 - jnp.abs(lead)), 0.0)
    ends = jnp.where(jnp.abs(trail) < 1, gap * (1 - jnp.abs(trail)), 0.0)
    edges = begins * dlead - ends * dtrail
    return blend(*primals), jnp.where(live, dbad, dgood) + edges
