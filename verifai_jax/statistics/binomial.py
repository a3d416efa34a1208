"""Failure rates from a fixed number of samples, with exact binomial intervals.

>>> print(clopper_pearson(38, 1000))
3.8 % (95 % interval 2.7 % to 5.18 %)
>>> simulations_without_failure(0.001)
2995

An exact interval for a fixed number of samples is invalid if the outcomes decide when to stop:
checked after every batch, it excludes the true rate sooner or later. Use `confidence_sequences` in
this case.
"""

import math
from dataclasses import dataclass

from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.messages.text import format_percent


@dataclass(frozen=True)
class Rate:
    """A failure rate estimated from independent samples of the prior.

    - `failures`: samples that failed.
    - `simulations`: number of all samples, including those without a verdict.
    - `low`, `high`: bounds of the true rate.
    - `confidence`: the probability that the bounds hold.
    - `at_any_time`: whether they hold however the end of sampling was decided.
    - `undecided`: further samples whose outcome is unknown; they count as safe in the lower bound
      and as failures in the upper one.
    """

    failures: int
    simulations: int
    low: float
    high: float
    confidence: float
    at_any_time: bool = False
    undecided: int = 0

    @property
    def estimate(self) -> float:
        """Failures per simulation."""
        return self.failures / self.simulations

    def __str__(self) -> str:
        maximum = (self.failures + self.undecided) / self.simulations
        range_ = f" to {format_percent(maximum)}" if self.undecided else ""
        return (
            f"{format_percent(self.estimate)}{range_} ({format_percent(self.confidence)} interval "
            f"{format_percent(self.low)} to {format_percent(self.high)}"
            f"{', whenever stopped' if self.at_any_time else ''})"
        )


def clopper_pearson(
    failures: int, simulations: int, confidence: float = 0.95, undecided: int = 0
) -> Rate:
    """Compute the exact two-sided binomial interval.

    **Arguments:**
    - `failures`: samples that failed.
    - `simulations`: number of all samples, fixed beforehand.
    - `confidence`: the probability that the interval holds.
    - `undecided`: further samples that may have failed, for example without a verdict.
    **Returns:** the `Rate`.
    **Raises:** `ValueError` unless `0 <= failures <= failures + undecided <= simulations`,
    `simulations >= 1` and `0 < confidence < 1`.

    Source: Clopper and Pearson, The use of confidence or fiducial limits illustrated in the case
    of the binomial, Biometrika 26 (1934).
    """
    check_counts(failures, simulations, undecided)
    check_fraction("confidence", confidence)
    low, high = exact_interval(failures, failures + undecided, simulations, confidence)
    return Rate(failures, simulations, low, high, confidence, undecided=undecided)


def exact_interval(
    low_count: float, high_count: float, samples: float, confidence: float
) -> tuple[float, float]:
    """Compute the ends of the interval of Clopper and Pearson; counts may be effective ones.

    **Arguments:**
    - `low_count`, `high_count`: the smallest and the largest possible number of failures, used for
      the lower and the upper end.
    - `samples`: number of all samples, or effective number of weighted ones.
    - `confidence`: the probability that the interval holds.
    """
    from scipy.special import betaincinv

    tail = (1 - confidence) / 2
    low = 0.0 if low_count == 0 else float(betaincinv(low_count, samples - low_count + 1, tail))
    if high_count >= samples:
        return low, 1.0
    return low, float(betaincinv(high_count + 1, samples - high_count, 1 - tail))


def simulations_without_failure(rate: float, confidence: float = 0.95) -> int:
    """Count the simulations without a failure that would show a failure rate below `rate`.

    **Arguments:**
    - `rate`: failure rate to exclude.
    - `confidence`: the probability that the statement holds.
    **Returns:** the least `n` with `(1 - rate)^n <= 1 - confidence`: about `3 / rate` at 95 %.
    **Raises:** `ValueError` unless `0 < rate < 1` and `0 < confidence < 1`.
    """
    check_fraction("rate", rate)
    check_fraction("confidence", confidence)
    return math.ceil(math.log1p(-confidence) / math.log1p(-rate) - 1e-9)


def check_counts(failures: int, simulations: int, undecided: int = 0) -> None:
    """Check the counts of a rate.

    **Raises:** `ValueError` unless `0 <= failures <= simulations` and `simulations >= 1`, also if
    undecided samples are counted as failures.
    """
    if undecided and not 0 <= undecided <= simulations - failures:
        raise ValueError(
            "a rate needs undecided >= 0 and failures + undecided <= simulations; "
            f"got (failures={failures}, undecided={undecided}, simulations={simulations})"
        )
    if simulations < 1 or not 0 <= failures <= simulations:
        raise ValueError(
            "a rate needs 0 <= failures <= simulations and at least one simulation; "
            f"got (failures={failures}, simulations={simulations})"
        )
