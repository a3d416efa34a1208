"""Episodes with physics of their own: what the tasks that are trained on share.

    mass = 0.1 * factor(jax.random.uniform(key, minval=-1.0), mass_range)
    check_ranges(task, {"x0_range": 2.4})

Source: Tobin et al., Domain randomization for transferring deep neural networks from simulation to
the real world (2017), section III.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float


def factor(unit: Float[Array, ""], spread: Float[Array, ""] | float) -> Float[Array, ""]:
    """Map `unit` from -1 to 1 to `1 / (1 + spread)` to `1 + spread`, evenly in the logarithm."""
    return jnp.exp(unit * jnp.log1p(spread))


def check_ranges(task: Any, farthest: Mapping[str, float]) -> None:
    """Refuse a number of a task that is negative, or beyond the one in `farthest`.

    **Raises:** `ValueError`: "CartPoleTask's x0_range must be between 0 and 2.4; got 3".
    """
    for field in dataclasses.fields(task):
        name, value = field.name, getattr(task, field.name)
        maximum = farthest.get(name, math.inf)
        # JAX puts tracers and placeholders into a pytree's places too.
        if isinstance(value, int | float) and not 0 <= value <= maximum:
            wanted = "at least 0" if maximum == math.inf else f"between 0 and {maximum:g}"
            raise ValueError(f"{type(task).__name__}'s {name} must be {wanted}; got {value}")
