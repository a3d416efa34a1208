"""The two precisions of simulations, verdicts and gradients."""

from contextlib import AbstractContextManager

import jax

PRECISIONS = ("float32", "float64")


def in_precision(precision: str) -> AbstractContextManager[None]:
    """Return a context in which JAX computes in `"float32"` or `"float64"`.

    **Raises:** `ValueError` for another precision.
    """
    if precision not in PRECISIONS:
        raise ValueError(
            f"precision must be {' or '.join(map(repr, PRECISIONS))}; got {precision!r}"
        )
    return jax.enable_x64(precision == "float64")  # pyright: ignore[reportReturnType]
