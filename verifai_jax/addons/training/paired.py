"""The mean of paired differences, with Student's t interval.

>>> print(paired_difference([8.1, 7.9, 8.4], [11.0, 10.5, 12.4]))
-3.17 (95 % t interval of 3 paired differences -5.17 to -1.16)

Differences are paired if both values of a pair use the same data, initial weights or disturbances:
common effects cancel, and far fewer pairs distinguish two treatments.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from verifai_jax.core.messages.checks import check_fraction


@dataclass(frozen=True)
class PairedDifference:
    """The mean difference of pairs, with an interval.

    - `mean`: the mean of the differences; NaN without a pair.
    - `low`, `high`: bounds of the expected difference; NaN for fewer than two pairs, which do not
      show how much differences vary.
    - `pairs`: number of differences.
    - `confidence`: the probability that the bounds hold.
    """

    mean: float
    low: float
    high: float
    pairs: int
    confidence: float

    @property
    def negative(self) -> bool:
        """True where the whole interval lies below zero."""
        return self.high < 0

    @property
    def positive(self) -> bool:
        """True where the whole interval lies above zero."""
        return self.low > 0

    def __str__(self) -> str:
        if not self.pairs:
            return "unknown (no pair)"
        if self.pairs == 1:
            return f"{self.mean:z.3g} (one pair gives no interval)"
        return (
            f"{self.mean:z.3g} ({100 * self.confidence:zg} % t interval of {self.pairs} paired "
            f"differences {self.low:z.3g} to {self.high:z.3g})"
        )


def paired_difference(
    values: Sequence[float] | Float[np.ndarray, " n"],
    reference: Sequence[float] | Float[np.ndarray, " n"], confidence: float = 0.95,
) -> PairedDifference:  # fmt: skip
    """Compute the mean of `values - reference` and its Student's t interval.

    **Arguments:**
    - `values`, `reference`: the two values of each pair; pairs without finite values are left out.
    - `confidence`: probability that the interval holds, if differences are independent and normal.
    **Returns:** the `PairedDifference`.
    **Raises:** `ValueError` for lists of different lengths, or a confidence out of range.

    Source: Student, The probable error of a mean, Biometrika 6 (1908).
    """
    check_fraction("confidence", confidence)
    one, other = np.asarray(values, np.float64), np.asarray(reference, np.float64)
    if one.shape != other.shape or one.ndim != 1:
        raise ValueError(
            f"paired values must be two lists of the same length; got shapes {list(one.shape)} and "
            f"{list(other.shape)}"
        )
    differences = one - other
    differences = differences[np.isfinite(differences)]
    pairs = len(differences)
    if not pairs:
        return PairedDifference(math.nan, math.nan, math.nan, 0, confidence)
    mean = float(differences.mean())
    if pairs == 1:
        return PairedDifference(mean, math.nan, math.nan, 1, confidence)
    from scipy.special import stdtrit

    reach = float(
        stdtrit(pairs - 1, (1 + confidence) / 2) * differences.std(ddof=1) / math.sqrt(pairs)
    )
    return PairedDifference(mean, mean - reach, mean + reach, pairs, confidence)
