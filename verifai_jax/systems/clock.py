"""Whole numbers of periods.

count_periods(4.0, 0.02, "duration")                        # 200
count_periods(4.0, 0.02, "duration", "control_period")      # the same, by another name in errors
"""

import math

from verifai_jax.core.messages.checks import is_number


def count_periods(seconds: float, period: float, name: str, of: str = "dt") -> int:
    """Return the number of periods in a duration.

    **Arguments:**
    - `seconds`, `period`: both in seconds.
    - `name`, `of`: their names in the error.
    **Raises:** `ValueError` unless it is a whole number of at least 1, with the nearest durations
    and the nearest periods.
    """
    number = is_number(seconds) and math.isfinite(seconds) and period > 0
    ratio = seconds / period if number else 0.0
    count = round(ratio)
    # As far as float32 numbers and products of decimals are from the numbers that were meant.
    if count < 1 or abs(ratio - count) > 1e-6 * max(1.0, count):
        near = ""
        if number and seconds > 0:
            counts = [n for n in (math.floor(ratio), math.floor(ratio) + 1) if n]
            times = " or ".join(f"{name}={n * period:z.6g}" for n in counts)
            steps = " or ".join(f"{of}={seconds / n:z.6g}" for n in reversed(counts))
            near = f"; nearest are {times}, or {steps}"
        raise ValueError(
            f"{name} must be a positive multiple of {of}; got ({name}={seconds}, {of}={period})"
            f"{near}"
        )
    return count
