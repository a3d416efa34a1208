"""Derivatives of the robustness, forward or reverse, by dimension and by model.

    derivative = Derivative(dim)
    gradient, auxiliary = derivative(objective, u)      # objective(u) -> (value, auxiliary)
    derivatives, auxiliary = derivative.of_several(objective, u)         # values [k]: [k, d]

Forward mode takes a sweep for each coordinate, several at a time, and works for every model.
Reverse mode takes one sweep for any number of coordinates, but stores intermediate results, and JAX
does not support it for a loop that ends by its own condition, such as a constraint solver's.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

FORWARD_UP_TO = 1
"""Coordinates up to which forward sweeps are no slower than one reverse, in a small model."""
SWEEPS = 8
"""Forward sweeps at a time: more fill the cache, fewer repeat the simulation more often."""


@dataclass(frozen=True)
class Derivative:
    """The derivative of an objective with respect to `dim` coordinates; `reverse` names the mode.

    - `forward_up_to`: number of coordinates up to which forward sweeps are faster.
    """

    dim: int
    forward_up_to: int = FORWARD_UP_TO
    mode: str | None = None

    @property
    def reverse(self) -> bool:
        """True if one reverse sweep is used."""
        return self.mode == "reverse" or (self.mode is None and self.dim > self.forward_up_to)

    def by(self, mode: str) -> "Derivative":
        """Return the same derivative by `"forward"` sweeps or one `"reverse"` sweep."""
        return replace(self, mode=mode)

    def describe(self) -> str:
        """Describe the cost of forward mode."""
        return (
            f"gradient by {self.dim} forward sweeps for each simulation, because reverse mode does "
            "not work through a loop of this system"
        )

    def __call__(
        self, objective: Callable[..., tuple[Array, Any]], u: Float[Array, " d"]
    ) -> tuple[Float[Array, " d"], Any]:
        """Return gradient and auxiliary output at `u`."""
        if self.reverse:
            return jax.grad(objective, has_aux=True)(u)
        return _forward(objective, u)

    def of_several(
        self, objective: Callable[..., tuple[Float[Array, " k"], Any]], u: Float[Array, " d"]
    ) -> tuple[Float[Array, "k d"], Any]:
        """Differentiate an objective of several values: a reverse sweep each, or forward sweeps."""
        if self.reverse:
            values, sweep, auxiliary = jax.vjp(objective, u, has_aux=True)
            if len(values) == 1:
                # Without an axis for it, which takes longer to trace and to compile.
                return sweep(jnp.ones_like(values))[0][None], auxiliary
            each = jnp.eye(len(values), dtype=values.dtype)
            return jax.vmap(lambda weight: sweep(weight)[0])(each), auxiliary
        by_coordinate, auxiliary = _forward(objective, u)
        return by_coordinate.T, auxiliary


def reverse_refused(error: Exception) -> bool:
    """Return whether JAX refuses to differentiate a loop of unknown length in reverse."""
    return "Reverse-mode differentiation does not work" in str(error)


def _forward(
    objective: Callable[..., tuple[Array, Any]], u: Float[Array, " d"]
) -> tuple[Float[Array, "d *k"], Any]:
    def sweep(direction: Array) -> Any:
        return jax.jvp(objective, (u,), (direction,), has_aux=True)

    # Only the tangents depend on the direction: the simulation itself is done once for each block.
    sweeps = jax.vmap(sweep, out_axes=(None, 0, None))
    d = u.shape[0]
    directions = jnp.eye(d, dtype=u.dtype)
    if d <= SWEEPS:
        _, derivative, auxiliary = sweeps(directions)
        return derivative, auxiliary
    missing = -d % SWEEPS
    blocks = jnp.pad(directions, ((0, missing), (0, 0))).reshape(-1, SWEEPS, d)
    _, derivative, auxiliary = sweeps(blocks[0])
    rest = jax.lax.map(lambda block: sweeps(block)[1], blocks[1:])
    rest = rest.reshape(-1, *derivative.shape[1:])
    return jnp.concatenate([derivative, rest])[:d], auxiliary
