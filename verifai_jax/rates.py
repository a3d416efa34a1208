"""How often a system fails: a rate with an exact confidence interval.

>>> print(clopper_pearson(38, 1000))
3.80 % (95 % interval 2.70 % to 5.18 %)
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Rate:
    """A failure rate estimated from independent samples of the prior.

    `low` and `high` bound the true rate at the given `confidence`.
    """

    failures: int
    simulations: int
    low: float
    high: float
    confidence: float

    @property
    def estimate(self) -> float:
        """Failures per simulation."""
        return self.failures / self.simulations

    def __str__(self) -> str:
        return (
            f"{_percent(self.estimate)} ({self.confidence * 100:g} % interval "
            f"{_percent(self.low)} to {_percent(self.high)})"
        )


def clopper_pearson(failures: int, simulations: int, confidence: float = 0.95) -> Rate:
    """The exact two-sided binomial interval.

    Source: Clopper and Pearson, The use of confidence or fiducial limits illustrated in the case
    of the binomial, Biometrika 26 (1934).

    **Raises:** `ValueError` unless `0 <= failures <= simulations`, `simulations >= 1` and
    `0 < confidence < 1`.
    """
    if simulations < 1 or not 0 <= failures <= simulations:
        raise ValueError(
            "a rate needs 0 <= failures <= simulations and at least one simulation; "
            f"got (failures={failures}, simulations={simulations})"
        )
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie between 0 and 1; got {confidence}")
    from scipy.special import betaincinv

    tail = (1 - confidence) / 2
    k, n = failures, simulations
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1 - tail))
    return Rate(k, n, low, high, confidence)


def _percent(rate: float) -> str:
    percent = 100 * rate
    if percent == 0 or percent >= 0.995:
        return f"{percent:.2f} %" if percent < 99.995 else "100 %"
    return f"{percent:.2g} %"
