"""Ends of intervals in the precision of a simulation: no value lies outside, whatever is rounded.

    first, last = ends_within(0.0, 61.2, np.float32)        # 0.0 and 61.199997
    clip_to_ends(x, first, last)                            # jax.grad sees x itself
    round_inwards(np.float32(61.2), 0.0, 61.2)              # 61.199997

The single-precision number nearest to 61.2 is 61.20000076. With it a model that switches at 61.2
would be in the wrong mode, also in a double-precision replay, which uses the table's values.
"""

from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from verifai_jax.core.messages.errors import unknown_name

CLOSED = ("both", "left", "right", "neither")
"""Which ends of an interval belong to it, as in pandas."""
End: TypeAlias = float | tuple[float, ...]
"""An end of an interval, or of several; infinite for an open range."""
Reals = TypeVar("Reals", jax.Array, np.ndarray)
"""Real numbers, of JAX or of NumPy."""


def check_closed(closed: object) -> None:
    """Refuse a value that does not say which ends belong to an interval.

    **Raises:** `UnknownNameError` for a word that is not in `CLOSED`.
    """
    if closed not in CLOSED:
        raise unknown_name("value of closed", str(closed), CLOSED)


def ends_within(
    low: End, high: End, dtype: DTypeLike, closed: str = "both"
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest number of a precision inside intervals.

    They are zero or normal numbers, because XLA treats subnormal numbers as zero.

    **Arguments:**
    - `low`, `high`: the ends.
    - `closed`: which ends belong to the intervals, one of `CLOSED`.
    """
    ends = _ends(low, high, np.dtype(dtype), closed)
    return ends.first, ends.last


def clip_to_ends(
    x: Float[Array, "*shape"], first: np.ndarray | Array, last: np.ndarray | Array
) -> Float[Array, "*shape"]:
    """Return numbers clipped to the ends, but with the derivative of `x`.

    So a search that stands at an end can leave it.
    """
    return replace_where(replace_where(x, x < first, first), x > last, last)


def replace_where(
    x: Float[Array, "*shape"], condition: Any, value: float | np.floating | np.ndarray | Array
) -> Float[Array, "*shape"]:
    """Return `value` where the condition holds, and `x` elsewhere, with the derivative of `x`."""
    return jnp.where(condition, value + (x - jax.lax.stop_gradient(x)), x)


def is_inside(
    numbers: Float[np.ndarray, "*shape"], low: End, high: End, closed: str = "both"
) -> Bool[np.ndarray, "*shape"]:
    """Return which numbers of double precision lie inside intervals, up to rounding.

    A number that rounds to an end in single precision counts as that end, if the end belongs to the
    interval.
    """
    first, last, under, over, _ = _ends(low, high, np.dtype(np.float64), closed)
    single = _single(numbers, np)
    at_low = (single == under) & (closed in ("both", "left"))
    at_high = (single == over) & (closed in ("both", "right"))
    return np.asarray(((numbers >= first) & (numbers <= last)) | at_low | at_high)


def round_inwards(value: Reals, low: End, high: End, closed: str = "both") -> Reals:
    """Return numbers in which those rounded just past an end become the last number inside.

    Other numbers are unchanged, including those farther outside.

    **Arguments:**
    - `value`: numbers in single or double precision.
    - `low`, `high`, `closed`: as in `ends_within`.
    """
    first, last, under, over, inside = _ends(low, high, np.dtype(value.dtype), closed)
    if inside:
        return value
    xp: Any = np if isinstance(value, np.ndarray) else jnp
    single = _single(value, xp)
    value = xp.where((value < first) & (single == under), first, value)
    return xp.where((value > last) & (single == over), last, value)


class _Ends(NamedTuple):
    """The ends of intervals in a precision.

    - `first`, `last`: the least and the greatest number within.
    - `under`, `over`: the ends rounded to single precision.
    - `inside`: True where rounding cannot lead outside.
    """

    first: np.ndarray
    last: np.ndarray
    under: np.ndarray
    over: np.ndarray
    inside: bool


@lru_cache(maxsize=4096)
def _ends(low: End, high: End, dtype: np.dtype, closed: str) -> _Ends:
    lowest, highest = np.asarray(low, np.float64), np.asarray(high, np.float64)
    first = _at_least(lowest, dtype, closed in ("both", "left"))
    last = np.asarray(-_at_least(np.asarray(-highest), dtype, closed in ("both", "right")))
    under, over = (end.astype(np.float32).astype(dtype) for end in (lowest, highest))
    # In double precision a number may be an end but for rounding: 0.1 + 0.2 is more than 0.3.
    inside = dtype == np.float32 and bool(np.all(under >= first) and np.all(over <= last))
    inside |= bool(np.all(np.isinf(lowest)) and np.all(np.isinf(highest)))
    return _Ends(first, last, under, over, inside)


def _single(value: Any, xp: Any) -> Any:
    """Return numbers rounded to single precision, in their own precision."""
    with np.errstate(over="ignore"):
        return xp.asarray(value).astype(np.float32).astype(value.dtype)


def _at_least(bound: Float[np.ndarray, "*shape"], dtype: DTypeLike, included: bool) -> np.ndarray:
    """Return the least number of a precision that is not below a bound, or that is above it."""
    x = bound.astype(dtype)
    back = x.astype(np.float64)
    outside = back < bound if included else back <= bound
    x = np.where(outside, np.nextafter(x, np.asarray(np.inf, dtype)), x)
    tiny = np.asarray(jnp.finfo(dtype).tiny, dtype)
    x = np.where((x > 0) & (x < tiny), tiny, x)
    return np.where((x < 0) & (x > -tiny), np.zeros_like(x), x)
