"""Intervals of the mean of weighted samples and of products of fractions; one-sided bounds."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from verifai_jax.core.messages.checks import check_fraction


class WeightedMean(NamedTuple):
    """The mean of weighted samples, its relative error, and their tail.

    - `mean`: their arithmetic mean.
    - `cv`: relative standard error of the mean.
    - `skewness`: skewness of the samples.
    - `effective`: effective number of equally weighted samples.
    - `largest`: share of the largest sample in the sum.
    - `tail`: shape of the generalised Pareto distribution fitted to the largest ones (k-hat); the
      variance is infinite from 0.5 on, and the mean is unreliable beyond 0.7.
    """

    mean: float
    cv: float
    skewness: float
    effective: float
    largest: float
    tail: float


def weighted_mean(x: Float[np.ndarray, " n"]) -> WeightedMean:
    """Return the mean and tail of independent `x >= 0`: weights at failures, zero elsewhere."""
    n, total = len(x), float(x.sum())
    if n < 2 or total <= 0:
        return WeightedMean(0.0, math.inf, 0.0, 0.0, 1.0, math.inf)
    mean, std = total / n, float(x.std(ddof=1))
    skewness = float(np.mean((x - mean) ** 3)) / std**3 if std > 0 else 0.0
    effective = total**2 / float(np.sum(x * x))
    return WeightedMean(
        mean, std / math.sqrt(n) / mean, skewness, effective, float(x.max()) / total,
        tail_index(x[x > 0]),
    )  # fmt: skip


def skewed_interval(x: Float[np.ndarray, " n"], confidence: float) -> tuple[float, float]:
    """Return Student's interval of the mean of skewed samples, corrected for skewness.

    Source: Hall, On the removal of skewness by transformation, Journal of the Royal Statistical
    Society B 54 (1992), equation 2.3 (the cubic one, which is monotone).
    """
    mean, n = weighted_mean(x), len(x)
    if not math.isfinite(mean.cv):
        return 0.0, math.inf
    # Few effective samples: as wide as Student's interval of so many.
    quantile = student_quantile(confidence, max(mean.effective - 1, 2.0))
    g = mean.skewness / math.sqrt(n)

    def transformed(t: float) -> float:
        if abs(g) < 1e-6:
            return t
        inner = 1 + g * (t - g / 6)
        return 3 / g * (math.copysign(abs(inner) ** (1 / 3), inner) - 1)

    low = mean.mean * (1 - mean.cv * transformed(quantile))
    high = mean.mean * (1 - mean.cv * transformed(-quantile))
    # Below zero nothing is possible; there the logarithm is symmetric.
    return max(low, mean.mean * math.exp(-quantile * mean.cv * 1.5), 0.0), high


def log_interval(mean: float, cv: float, confidence: float, freedom: float) -> tuple[float, float]:
    """Return an interval symmetric in the logarithm, for a product of fractions."""
    factor = math.exp(student_quantile(confidence, freedom) * math.sqrt(math.log1p(cv * cv)))
    return mean / factor, mean * factor


def student_quantile(confidence: float, freedom: float) -> float:
    """Return the quantile of Student's distribution for a two-sided interval."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, (1 + confidence) / 2))


def tail_index(weights: Float[np.ndarray, " n"]) -> float:
    """Fit a generalised Pareto distribution to the largest weights; return its shape, k-hat.

    Sources: Vehtari, Simpson, Gelman, Yao and Gabry, Pareto smoothed importance sampling, JMLR 25
    (2024); the fit is that of Zhang and Stephens, Technometrics 51 (2009).
    """
    n = len(weights)
    count = int(min(0.2 * n, 3 * math.sqrt(n)))
    if count < 10:
        return math.inf
    ordered = np.sort(weights)
    x = ordered[-count:] - ordered[-count - 1]
    x = x[x > 0]
    if len(x) < 10:
        return -math.inf  # They are all alike.
    count = len(x)
    grid = 30 + int(math.sqrt(count))
    quartile = x[max(0, int(count / 4 + 0.5) - 1)]
    j = np.arange(1, grid + 1)
    b = (1 - np.sqrt(grid / (j - 0.5))) / 3 / quartile + 1 / x[-1]
    k = np.mean(np.log1p(-b[:, None] * x), axis=1)
    likelihood = count * (np.log(-b / k) - k - 1)
    share = np.exp(likelihood - likelihood.max())
    share /= share.sum()
    shape = float(np.mean(np.log1p(-float(b @ share) * x)))
    return (count * shape + 5) / (count + 10)  # Their weak prior at one half.


def upper_bound(failures: int, simulations: int, confidence: float = 0.95) -> float:
    """Compute the one-sided Clopper-Pearson bound: the largest rate that is not excluded.

    **Arguments:** those of `clopper_pearson`; without simulations, or if all fail, the bound is 1.
    **Returns:** the bound; without a failure about `3 / simulations` at a confidence of 95 %.
    """
    from scipy.special import betaincinv

    if simulations < 1 or failures >= simulations:
        return 1.0
    return float(betaincinv(failures + 1, simulations - failures, confidence))


def simulations_until(
    p0: float, failures: int = 0, simulations: int = 0, confidence: float = 0.95
) -> int:
    """Count the further simulations without a failure that would show a rate below `p0`.

    **Arguments:**
    - `p0`: failure rate to exclude.
    - `failures`, `simulations`: samples taken so far.
    - `confidence`: the probability that the statement holds.
    **Returns:** the least `n` for which `upper_bound(failures, simulations + n)` is at most `p0`.
    **Raises:** `ValueError` unless `0 < p0 < 1`.
    """
    check_fraction("p0", p0)
    low, high = 0, 1
    while upper_bound(failures, simulations + high, confidence) > p0:
        low, high = high, 2 * high
        if high > 2**62:
            break
    if upper_bound(failures, max(simulations, 1), confidence) <= p0 and simulations:
        return 0
    while high - low > 1:
        middle = (low + high) // 2
        enough = upper_bound(failures, simulations + middle, confidence) <= p0
        low, high = (low, middle) if enough else (middle, high)
    return high


def format_probability(probability: float) -> str:
    """Format a probability with three digits, or more if needed to differ from 1: `0.99993`."""
    if 0.999 < probability < 1:
        digits = -math.floor(math.log10(1 - probability))
        return f"{probability:z.{digits}f}".rstrip("0")
    return f"{probability:z.3g}"
