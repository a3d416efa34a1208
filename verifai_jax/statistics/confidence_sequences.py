"""Failure rates with intervals that hold for all sample sizes simultaneously.

    anytime_interval(failures=3, simulations=512)                    # one rate, stopped at any time

Such intervals are needed if outcomes decide when sampling stops: a Clopper-Pearson bound for the
final number of samples would be invalid, because with enough checks it excludes the truth at some
time.

A rate `q` is rejected once a likelihood ratio against it, mixed over other rates, has grown to the
reciprocal of the error allowed. For another rate `t`, the factor of one sample, `t/q` for a failure
and `(1-t)/(1-q)` for none, has expectation 1 if `q` is the true rate. So a mixture over any fixed
distribution of `t` is a nonnegative martingale that starts at 1, and by Ville's inequality the
probability that it ever reaches `1 / error` is at most `error`. The bound holds for all sample
sizes simultaneously, however they were decided, even by other rates' outcomes on later samples
(Robbins, Statistical methods related to the law of the iterated logarithm, Annals of Mathematical
Statistics 41, 1970; Howard, Ramdas, McAuliffe and Sekhon, Time-uniform, nonparametric,
nonasymptotic confidence sequences, Annals of Statistics 49, 2021).
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Real

from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.statistics.binomial import Rate, check_counts

Counts = Real[np.ndarray, "*#n"] | float
"""Numbers of samples, one or many; fractions where they are expectations."""


def anytime_interval(
    failures: int, simulations: int, confidence: float = 0.95, undecided: int = 0
) -> Rate:
    """Compute an interval that is valid at any time, even if outcomes decide when sampling stops.

    It contains the rates whose likelihood, times `1 / (1 - confidence)`, is at least the mixture of
    binomial likelihoods over a Beta(1/2, 1/2) prior. It is wider than `clopper_pearson`, by a
    factor of 1.5 to 2.

    **Arguments:** those of `clopper_pearson`, but the number of simulations may depend on their
    outcomes.
    **Returns:** the `Rate`.
    **Raises:** `ValueError` unless `0 <= failures <= simulations`, `simulations >= 1` and
    `0 < confidence < 1`.
    """
    check_counts(failures, simulations, undecided)
    check_fraction("confidence", confidence)
    n = simulations

    def border(k: int, end: float) -> float:
        limit = log_mixture(k, n) + math.log(1 - confidence)
        return border_between(k / n, end, lambda rates: log_likelihood(k, n, rates) >= limit)

    low, high = border(failures, 0.0), border(failures + undecided, 1.0)
    return Rate(failures, n, low, high, confidence, at_any_time=True, undecided=undecided)


def border_between(within: float, outside: float, inside: Callable[[np.ndarray], Any]) -> float:
    """Find where an interval ends, between the estimate, which is inside, and an end of [0, 1].

    `inside` says of several rates at once whether they belong to the interval.
    """
    if inside(np.array([outside]))[0]:
        return outside
    for _ in range(7):  # To 2^-35, on the outer side.
        rates = np.linspace(within, outside, 33)
        count = int(np.argmin([*inside(rates[1:-1]), False]))
        within, outside = float(rates[count]), float(rates[count + 1])
    return outside


def log_mixture(k: int, n: int) -> float:
    """Compute the logarithm of the likelihood averaged over a Beta(1/2, 1/2) prior."""
    half = math.lgamma(k + 0.5) + math.lgamma(n - k + 0.5) - math.lgamma(n + 1)
    return half - math.log(math.pi)


def log_likelihood(k: Counts, n: Counts, q: Counts) -> Float[np.ndarray, "*n"] | np.float64:
    """Compute the logarithm of the probability of one sequence with `k` failures."""
    from scipy.special import xlog1py, xlogy

    return xlogy(k, q) + xlog1py(n - k, -q)
