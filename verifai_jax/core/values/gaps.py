"""Masked and missing samples as gaps: NaN, which gets no verdict.

with_gaps("x", np.ma.masked_array([0.0, 9e9], mask=[False, True]))      # [0, nan]
"""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from verifai_jax.core.messages.checks import is_number


def with_gaps(name: str, signal: Any) -> Any:
    """Return a signal with NaN for masked and missing samples; other signals are unchanged.

    NumPy's own conversions would expose masked values. A list becomes an array.

    **Raises:** `TypeError` for values that are not real numbers, such as texts and dates;
    `ValueError` for rows of different lengths.
    """
    plain = isinstance(signal, jax.Array | jax.ShapeDtypeStruct) or type(signal) is np.ndarray
    if plain and getattr(signal.dtype, "kind", "") != "O":
        return signal if isinstance(signal, jax.Array) else _real(name, signal)
    if isinstance(signal, list | tuple):
        signal = _listed(name, signal)
    if isinstance(signal, np.ma.MaskedArray):
        if not np.ma.getmaskarray(signal).any():
            return np.asarray(signal.data)
        return np.where(np.ma.getmaskarray(signal), np.nan, np.asarray(signal.data).astype(float))
    if getattr(signal, "dtype", None) is None:
        return signal
    if np.asarray(signal).dtype != object:
        return _real(name, signal)
    return _numbers_of_objects(name, np.asarray(signal))


def has_truths(signal: Any) -> bool:
    """Return whether the samples of a signal that are not missing are truth values."""
    kind = getattr(getattr(signal, "dtype", None), "kind", "")
    if kind != "O" and not isinstance(signal, list | tuple):
        return kind == "b"
    entries = np.ravel(np.array(signal, object)).tolist()
    known = [entry for entry in entries if not _is_missing(entry)]
    return bool(known) and all(isinstance(entry, bool | np.bool_) for entry in known)


def _listed(name: str, rows: list[Any] | tuple[Any, ...]) -> Any:
    """Return a list of samples as an array; one of values that JAX traces as it is."""
    if any(np.ma.getmaskarray(row).any() for row in rows if isinstance(row, np.ma.MaskedArray)):
        return np.ma.array(rows)
    if any(isinstance(row, Tracer) for row in jax.tree.leaves(rows)):
        return rows
    try:
        return np.asarray(rows)
    except ValueError as error:
        raise ValueError(
            f"signal {name!r} must be an array [time] or [time, k]; its rows have several lengths"
        ) from error


def _real(name: str, signal: Any) -> Any:
    """Return a signal of real numbers or truth values. **Raises:** `TypeError` for any other."""
    dtype = signal.dtype
    kind = getattr(dtype, "kind", "f")
    # Types of half precision that NumPy does not know, such as bfloat16, are without a kind.
    if kind not in "biuf" and not (kind == "V" and "float" in getattr(dtype, "name", "")):
        hint = ": give seconds or other numbers in place of dates" if kind in "mM" else ""
        raise TypeError(f"signal {name!r} must hold real numbers; got {dtype}{hint}")
    # NumPy's long doubles are no numbers for JAX.
    return signal.astype(np.float64) if dtype == np.longdouble else signal


def _numbers_of_objects(name: str, values: np.ndarray) -> np.ndarray:
    """Return objects as numbers, a missing one as NaN."""
    numbers = np.full(values.shape, np.nan)
    for index, value in np.ndenumerate(values):
        if _is_missing(value):
            continue
        if not isinstance(value, bool | np.bool_ | int | float | np.number):
            raise TypeError(
                f"signal {name!r} must hold real numbers; sample {index[0]} is {value!r}"
            )
        numbers[index] = value
    return numbers


def known_times(times: Any) -> Any:
    """Return sample times as numbers, none of which may be masked or missing.

    Integers of 8 and 16 bits become floats, since their differences could overflow.

    **Raises:** `ValueError` that names the first time that is masked or missing; `TypeError` for
    anything but an array of numbers.
    """
    if isinstance(times, jax.Array | jax.ShapeDtypeStruct):
        return times
    if not isinstance(times, np.ma.MaskedArray):
        times = np.asarray(times)
    masked = np.ma.getmaskarray(times)
    if times.dtype == object:
        masked = masked | np.array([_is_missing(value) for value in np.ravel(times)])
    if masked.any():
        raise ValueError(
            f"sample times must be known; that of sample {int(np.argmax(masked))} is masked or "
            "missing: leave out the samples without a time"
        )
    known = np.asarray(times.data if isinstance(times, np.ma.MaskedArray) else times)
    if known.dtype == object:
        known = known.astype(float) if all(map(is_number, np.ravel(known))) else known
    if known.dtype.kind not in "iuf":
        hint = ": give seconds since the first, (times - times[0]) / np.timedelta64(1, 's')"
        hint = hint if known.dtype.kind == "M" else ""
        raise TypeError(f"sample times must be numbers of seconds; got {known.dtype}{hint}")
    return known.astype(float) if known.dtype.itemsize < 4 and known.dtype.kind != "f" else known


def _is_missing(value: object) -> bool:
    # pandas.NA by its name: pandas need not be imported for it.
    return value is None or value is np.ma.masked or type(value).__name__ == "NAType"
