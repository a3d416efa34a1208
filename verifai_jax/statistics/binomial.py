"""How often a system fails: a rate with an exact confidence interval, and when to stop sampling.

>>> print(clopper_pearson(38, 1000))
3.80 % (95 % interval 2.70 % to 5.18 %)
>>> simulations_without_failure(0.001)
2995

An exact interval of a fixed number of samples is wrong once the outcomes decide when to stop: who
looks after every batch sees it exclude the true rate at some time, sooner or later. The stopping
rules `Within` and `Decided` therefore use intervals that hold at all times together.
"""

import math
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class Rate:
    """A failure rate estimated from independent samples of the prior.

    `low` and `high` bound the true rate at the given `confidence`; `at_any_time` if they do so
    whatever decided when sampling ended.
    """

    failures: int
    simulations: int
    low: float
    high: float
    confidence: float
    at_any_time: bool = False

    @property
    def estimate(self) -> float:
        """Failures per simulation."""
        return self.failures / self.simulations

    def __str__(self) -> str:
        return (
            f"{_percent(self.estimate)} ({self.confidence * 100:g} % interval "
            f"{_percent(self.low)} to {_percent(self.high)}"
            f"{', whenever stopped' if self.at_any_time else ''})"
        )


def clopper_pearson(failures: int, simulations: int, confidence: float = 0.95) -> Rate:
    """The exact two-sided binomial interval.

    Source: Clopper and Pearson, The use of confidence or fiducial limits illustrated in the case
    of the binomial, Biometrika 26 (1934).

    **Raises:** `ValueError` unless `0 <= failures <= simulations`, `simulations >= 1` and
    `0 < confidence < 1`.
    """
    _check_counts(failures, simulations, confidence)
    from scipy.special import betaincinv

    tail = (1 - confidence) / 2
    k, n = failures, simulations
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1 - tail))
    return Rate(k, n, low, high, confidence)


def at_any_time(failures: int, simulations: int, confidence: float = 0.95) -> Rate:
    """An interval that holds at all times together, for samples stopped by their own outcomes.

    The rates at which a mixture of binomial likelihoods over a Beta(1/2, 1/2) prior has not grown
    to `1 / (1 - confidence)` times that of the rate itself (Robbins, Statistical methods related
    to the law of the iterated logarithm, Annals of Mathematical Statistics 41, 1970). Wider than
    `clopper_pearson`, by a factor of 1.5 to 2.

    **Raises:** as `clopper_pearson`.
    """
    _check_counts(failures, simulations, confidence)
    k, n = failures, simulations
    mixture = (
        math.lgamma(k + 0.5) + math.lgamma(n - k + 0.5) - math.lgamma(n + 1) - math.log(math.pi)
    )
    limit = mixture + math.log(1 - confidence)

    def inside(rate: float) -> bool:
        return _power(rate, k) + _power(1 - rate, n - k) >= limit

    def border(outside: float) -> float:
        """Between the estimate, which is inside, and an end of [0, 1]."""
        if inside(outside):
            return outside
        within = k / n
        for _ in range(60):
            middle = (outside + within) / 2
            within, outside = (middle, outside) if inside(middle) else (within, middle)
        return outside

    return Rate(k, n, border(0.0), border(1.0), confidence, at_any_time=True)


def _power(base: float, exponent: int) -> float:
    """Logarithm of `base ** exponent`, for a base in [0, 1]."""
    if exponent == 0:
        return 0.0
    return exponent * math.log(base) if base > 0 else -math.inf


def simulations_without_failure(rate: float, confidence: float = 0.95) -> int:
    """How many simulations without a failure show that the failure rate is below `rate`.

    The least `n` with `(1 - rate)^n <= 1 - confidence`: about `3 / rate` at 95 %.

    **Raises:** `ValueError` unless `0 < rate < 1` and `0 < confidence < 1`.
    """
    if not 0 < rate < 1:
        raise ValueError(f"rate must lie between 0 and 1; got {rate}")
    _check_confidence(confidence)
    return math.ceil(math.log1p(-confidence) / math.log1p(-rate) - 1e-9)


class StoppingRule(Protocol):
    """When a run of prior samples has told enough; `falsify(..., stop_when=rule)`."""

    def done(self, failures: int, simulations: int) -> bool:
        """Whether to stop, asked after every batch; `simulations` are those with a verdict."""
        ...


@dataclass(frozen=True)
class Within:
    """Stop when the failure rate is known to within `half_width`, such as 0.005 for half a percent.

    **Raises:** `ValueError` unless `0 < half_width < 0.5` and `0 < confidence < 1`.
    """

    half_width: float
    confidence: float = 0.95

    def __post_init__(self) -> None:
        if not 0 < self.half_width < 0.5:
            raise ValueError(f"half_width must lie between 0 and 0.5; got {self.half_width}")
        _check_confidence(self.confidence)

    def done(self, failures: int, simulations: int) -> bool:
        if simulations < 1:
            return False
        rate = at_any_time(failures, simulations, self.confidence)
        return rate.high - rate.low <= 2 * self.half_width


@dataclass(frozen=True)
class Decided:
    """Stop when it is clear whether the failure rate is above or below `rate`.

    **Raises:** `ValueError` unless `0 < rate < 1` and `0 < confidence < 1`.
    """

    rate: float
    confidence: float = 0.95

    def __post_init__(self) -> None:
        if not 0 < self.rate < 1:
            raise ValueError(f"rate must lie between 0 and 1; got {self.rate}")
        _check_confidence(self.confidence)

    def done(self, failures: int, simulations: int) -> bool:
        if simulations < 1:
            return False
        found = at_any_time(failures, simulations, self.confidence)
        return not found.low <= self.rate <= found.high


def _check_counts(failures: int, simulations: int, confidence: float) -> None:
    if simulations < 1 or not 0 <= failures <= simulations:
        raise ValueError(
            "a rate needs 0 <= failures <= simulations and at least one simulation; "
            f"got (failures={failures}, simulations={simulations})"
        )
    _check_confidence(confidence)


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie between 0 and 1; got {confidence}")


def _percent(rate: float) -> str:
    percent = 100 * rate
    if percent == 0 or percent >= 0.995:
        return f"{percent:.2f} %" if percent < 99.995 else "100 %"
    return f"{percent:.2g} %"
