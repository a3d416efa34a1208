"""Whole numbers of periods.

count_periods(4.0, 0.02, "duration")                        # 200
count_periods(4.0, 0.02, "duration", "control_period")      # the same, by another name in errors
"""

import math


def count_periods(seconds: float, period: float, name: str, of: str = "dt") -> int:
    """Return the number of periods in a duration.

    **Arguments:**
    - `seconds`, `period`: both in seconds.
    - `name`, `of`: their names in the error.
    **Raises:** `ValueError` unless it is a whole number of at least 1.
    """
    number = isinstance(seconds, int | float) and math.isfinite(seconds) and period > 0
    count = round(seconds / period) if number else 0
    if count < 1 or abs(count * period - seconds) > 1e-6 * period:
        raise ValueError(
            f"{name} must be a positive multiple of {of}; got ({name}={seconds}, {of}={period})"
        )
    return count
