"""Transport delays: what a quantity was some time ago.

line = delay_line(14.7, longest=0.8, period=0.01)    # in initial(): 14.7 until time 0
line.at(time - 0.3)                                  # in dynamics(): 0.3 s ago
line.push(time, state["lambda"])                     # in update(): once a period
"""

import math
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from verifai_jax.core.messages.checks import is_number


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DelayLine:
    """The last samples of a quantity, newest first, interpolated linearly.

    It is part of a state, or of a controller's memory; made by `delay_line`.

    **Fields:** `values` `[n, ...]`; `latest`, the time in seconds of the newest value; `period`
    between two values, in seconds.
    """

    # JAX rebuilds the class with placeholders and with batches, which have other shapes.
    __no_type_check__ = True
    values: Float[Array | np.ndarray, "n *shape"]
    latest: Float[Array | np.ndarray, ""]
    period: float = field(metadata={"static": True})

    def push(self, time: Any, value: Any) -> "DelayLine":
        """Return the line with the value at this time, one period after the last one."""
        values, latest = jnp.asarray(self.values), jnp.asarray(self.latest)
        newest = jnp.asarray(value, values.dtype)[None]
        values = jnp.concatenate([newest, values[:-1]])
        return DelayLine(values, jnp.asarray(time, latest.dtype), self.period)

    def at(self, time: Any) -> Any:
        """Return the value at a time in seconds; beyond the ends, the value at the nearest end."""
        values, latest = jnp.asarray(self.values), jnp.asarray(self.latest)
        count = values.shape[0]
        position = (latest - jnp.asarray(time, latest.dtype)) / self.period
        # Unlike jnp.clip, whose derivative at an end is halved.
        position = jnp.where(position < 0, 0, jnp.where(position > count - 1, count - 1, position))
        left = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, count - 2)
        share = (position - left).astype(values.dtype)
        return values[left] * (1 - share) + values[left + 1] * share

    @property
    def still(self) -> "DelayLine":
        """The derivative of a line between two samples: zeros in the form of the line."""
        return jax.tree.map(jnp.zeros_like, self)


def delay_line(value: Any, *, longest: float, period: float) -> DelayLine:
    """Make a delay line whose quantity has been constant until time 0.

    **Arguments:**
    - `value`: a number or an array.
    - `longest`: maximum delay in seconds; longer delays read the oldest value.
    - `period`: seconds between two samples: `dt` for a line that `update` pushes, the control
      period for one in a controller's memory. A shorter delay reads the newest sample.
    **Raises:** `ValueError` for seconds that are not positive, and a value that is not a number.
    """
    for name, seconds in (("longest", longest), ("period", period)):
        if not is_number(seconds) or not 0 < seconds < math.inf:
            raise ValueError(f"{name} must be a positive number of seconds; got {seconds!r}")
    # One sample more than the delay is long: a stage of a step asks up to a period earlier.
    count = math.ceil(longest / period - 1e-6) + 2
    if isinstance(value, str | None) or (is_number(value) and not math.isfinite(value)):
        raise ValueError(f"value must be a finite number or an array; got {value!r}")
    if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value)):
        # In NumPy, whose arrays JAX takes in the precision that it computes in when it meets them:
        # a line may be made before anything is simulated.
        values = np.asarray(value, float)
        return DelayLine(
            np.broadcast_to(values, (count, *values.shape)), np.zeros(()), float(period)
        )
    value = jnp.asarray(value)
    real = value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(float)
    values = jnp.broadcast_to(real, (count, *np.shape(real)))
    return DelayLine(values, jnp.zeros((), real.dtype), float(period))
