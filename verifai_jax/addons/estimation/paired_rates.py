"""The difference of two failure rates on the same samples, with an interval that holds at any time.

>>> print(paired_rates(only_first=2, only_second=31, pairs=5_000))
0.58 points more (95 % interval 0.123 to 1.23, whenever stopped)

Both systems are simulated with the same features and random numbers. Only discordant pairs, in
which exactly one fails, distinguish them. Let `q` be the probability of a discordant pair, and `s`
the share of them in which the second fails: the difference is `q (2 s - 1)`. Both `q` and `s` have
a confidence sequence (`confidence_sequences`) with half of the allowed error, and the interval is
the range of the product. Its sign is that of `s - 1/2`, which depends only on the discordant pairs,
however rare they are: eight of eight suffice (McNemar, Note on the sampling error of the difference
between correlated proportions or percentages, Psychometrika 12, 1947, with a test that may be
looked at after every pair).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.statistics.binomial import Rate, clopper_pearson
from verifai_jax.statistics.confidence_sequences import anytime_interval


@dataclass(frozen=True)
class PairedRates:
    """The difference of two failure rates, second minus first, from paired samples.

    - `only_first`, `only_second`: pairs in which only one of the two fails.
    - `pairs`: number of all pairs.
    - `low`, `high`: bounds of the difference.
    - `at_any_time`: whether they hold however the end of sampling was decided.
    - `confidence`: the probability that they hold.
    - `undecided`: pairs, included in `pairs`, without both verdicts; they count as failures of the
      first only in the lower bound, of the second only in the upper bound.
    """

    only_first: int
    only_second: int
    pairs: int
    low: float
    high: float
    confidence: float
    undecided: int = 0
    at_any_time: bool = True

    @property
    def estimate(self) -> float:
        """Difference per pair, without pairs that lack a verdict."""
        known = self.pairs - self.undecided
        return (self.only_second - self.only_first) / known if known else math.nan

    def __str__(self) -> str:
        points = 100 * self.estimate
        more = "more" if points >= 0 else "fewer"
        ends = sorted(100 * end if points >= 0 else -100 * end for end in (self.low, self.high))
        shown = f"{abs(points):z.3g} points {more}" if self.pairs > self.undecided else "unknown"
        return (
            f"{shown} ({100 * self.confidence:zg} % interval "
            f"{ends[0]:z.3g} to {ends[1]:z.3g}{', whenever stopped' if self.at_any_time else ''})"
        )


def paired_rates(
    only_first: int, only_second: int, pairs: int, confidence: float = 0.95, undecided: int = 0,
    at_any_time: bool = True,
) -> PairedRates:  # fmt: skip
    """Compute the interval of a difference of failure rates on paired samples.

    **Arguments:**
    - `only_first`, `only_second`: pairs in which only the first, only the second fails.
    - `pairs`: number of all pairs, which may depend on their outcomes.
    - `confidence`: the probability that the interval holds at all times.
    - `undecided`: further pairs that lack a verdict.
    - `at_any_time`: False for a number of pairs fixed beforehand, which gives a narrower interval.
    **Returns:** the `PairedRates`.
    **Raises:** `ValueError` for counts below zero or above `pairs`, and unless `pairs >= 1` and
    `0 < confidence < 1`.
    """
    counts = (only_first, only_second, undecided)
    if pairs < 1 or min(counts) < 0 or sum(counts) > pairs:
        raise ValueError(
            "counts of pairs must be at least 0 and add up to at most the number of pairs, which "
            f"must be at least 1; got {only_first}, {only_second} and {undecided} of {pairs}"
        )
    check_fraction("confidence", confidence)
    interval = anytime_interval if at_any_time else clopper_pearson
    low = _bound(interval, only_first + undecided, only_second, pairs, confidence, -1)
    high = _bound(interval, only_first, only_second + undecided, pairs, confidence, 1)
    return PairedRates(
        only_first, only_second, pairs, low, high, confidence, undecided, at_any_time
    )


def _bound(
    interval: Callable[[int, int, float], Rate], first: int, second: int, pairs: int,
    confidence: float, side: int,
) -> float:  # fmt: skip
    """Return the least (-1) or greatest (1) difference that is not rejected."""
    each = 1 - (1 - confidence) / 2
    discordant = first + second
    often = interval(discordant, pairs, each)
    share = float(side > 0)
    if discordant:
        part = interval(second, discordant, each)
        share = part.high if side > 0 else part.low
    lean = 2 * share - 1
    return lean * (often.high if lean * side > 0 else often.low)
