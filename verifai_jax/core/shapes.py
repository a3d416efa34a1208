"""Few shapes: each shape compiles a program of its own, so numbers of rows become powers of two."""

from typing import Any

import numpy as np


def power_of_two(count: int) -> int:
    """Return the least power of two that is at least `count`, and at least 1."""
    return 1 << max(count - 1, 0).bit_length()


def pad_rows(rows: Any, count: int | None = None) -> np.ndarray:
    """Return rows followed by copies of the last one.

    **Arguments:**

    - `rows`: an array `[n, ...]`; an empty one stays as it is.
    - `count`: rows of the result, at least `n`; the next power of two when left out.
    """
    rows = np.asarray(rows)
    missing = (power_of_two(len(rows)) if count is None else count) - len(rows)
    if not missing:
        return rows
    return np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)])
