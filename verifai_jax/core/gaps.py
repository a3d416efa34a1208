"""Masked and missing samples as gaps: NaN, of which no verdict is made.

with_gaps("x", np.ma.masked_array([0.0, 9e9], mask=[False, True]))      # [0, nan]
"""

from typing import Any

import jax
import numpy as np


def with_gaps(name: str, signal: Any) -> Any:
    """Return a signal whose masked and missing samples are NaN; any other one as it is.

    NumPy's own conversions show what lies under a mask.

    **Raises:** `TypeError` for objects that are no real numbers, such as texts.
    """
    plain = isinstance(signal, jax.Array | jax.ShapeDtypeStruct) or type(signal) is np.ndarray
    if plain and getattr(signal.dtype, "kind", "") != "O":
        return signal
    if isinstance(signal, list | tuple) and any(_is_masked(row) for row in signal):
        signal = np.ma.array(signal)
    if isinstance(signal, np.ma.MaskedArray):
        if not np.ma.getmaskarray(signal).any():
            return np.asarray(signal.data)
        numbers = np.asarray(signal.data)
        numbers = np.where(numbers, 1.0, -1.0) if numbers.dtype == bool else numbers.astype(float)
        return np.where(np.ma.getmaskarray(signal), np.nan, numbers)
    if getattr(signal, "dtype", None) is None or np.asarray(signal).dtype != object:
        return signal
    return _numbers_of_objects(name, np.asarray(signal))


def _is_masked(value: object) -> bool:
    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.getmaskarray(value).any())


def _numbers_of_objects(name: str, values: np.ndarray) -> np.ndarray:
    """Return objects as numbers, a missing one as NaN."""
    numbers = np.full(values.shape, np.nan)
    for index, value in np.ndenumerate(values):
        # pandas.NA by its name: pandas need not be imported for it.
        if value is None or value is np.ma.masked or type(value).__name__ == "NAType":
            continue
        if isinstance(value, bool | np.bool_):
            numbers[index] = 1.0 if value else -1.0
        elif isinstance(value, int | float | np.number):
            numbers[index] = value
        else:
            raise TypeError(
                f"signal {name!r} must hold real numbers; sample {index[0]} is {value!r}"
            )
    return numbers


def known_times(times: np.ma.MaskedArray) -> np.ndarray:
    """Return sample times of which none is masked.

    **Raises:** `ValueError` that names the first masked one.
    """
    masked = np.ma.getmaskarray(times)
    if masked.any():
        raise ValueError(
            f"sample times must be known; that of sample {int(np.argmax(masked))} is masked: "
            "leave out the samples without a time"
        )
    return np.asarray(times.data)
