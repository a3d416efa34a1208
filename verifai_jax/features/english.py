"""Values and domains in English, for readers who do not know their notation.

number(0.25)                                        # '0.25'
Box(-1, 1).words()                                  # 'uniform between -1 and 1'
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.core.messages.text import one_line


def number(value: Any) -> str:
    """Format a value of a feature: a number with six digits, anything else in one line."""
    if value is None or value != value:
        return "absent"
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number):
        return one_line(str(value), 80)
    if isinstance(value, int | np.integer):
        return str(int(value))
    return f"{float(value):z.6g}"


def numbers(value: float | Sequence[float] | np.ndarray) -> str:
    """Format a number, or a vector in brackets."""
    if np.ndim(value) == 0:
        return number(value)
    return f"[{', '.join(number(each) for each in np.asarray(value).ravel().tolist())}]"


def quantile_words(domain: Any) -> str:
    """Describe a distribution by its quantiles, including the outermost that are simulated."""
    u = jnp.array([0.0, 0.01, 0.25, 0.5, 0.75, 0.99, 1.0], jnp.float32)
    lowest, low, first, median, third, high, highest = np.asarray(
        jax.vmap(domain.from_unit)(u[:, None])
    )
    return (
        f"with median {number(median)}, half of it from {number(first)} to {number(third)}, 98 % "
        f"from {number(low)} to {number(high)}, and no simulated value beyond {number(lowest)} and "
        f"{number(highest)}"
    )
