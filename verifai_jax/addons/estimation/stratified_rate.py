"""A failure rate from few trials in two strata whose shares are known.

>>> print(stratified_rate((1, 38), (9, 12), share=0.25))
0.223 (95 % interval 0.132 to 0.328): 50 trials, as good as 93 without strata

A simulation predicts for each trial whether it fails. The rate of predicted failures (`share`) is
known from many simulations; unknown are the failure rates `q0` of trials predicted to succeed and
`q1` of those predicted to fail. The total rate is `(1 - share) q0 + share q1`, for any quality of
the simulation. Its estimate is that of prediction-powered inference, with the power that suits the
data (Angelopoulos, Duchi, Zrnic, PPI++: efficient prediction-powered inference, 2023; for
predictions of two values it is post-stratification).

The interval is exact for few trials: outcomes are ordered by their signed likelihood ratio, and a
rate is rejected if, for every pair `q0`, `q1` that gives this rate, the probability of an outcome
as extreme is at most `(1 - confidence) / 2` (Berger, Boos, P values maximized over a confidence set
for the nuisance parameter, JASA 89, 1994).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.statistics.binomial import exact_interval
from verifai_jax.statistics.confidence_sequences import (
    anytime_interval,
    log_likelihood,
    log_mixture,
)

MAX_OUTCOMES = 50_000
"""Outcomes up to which all are enumerated, which takes about a second; where there are more, the
number of trials in each stratum is large, and is taken as given."""
LEFT_OUT = 1e-5
"""Probability of the numbers of trials in a stratum that are not enumerated, at each end."""
OUTSIDE = 1e-4
"""Error that is spent on confining `q0`, and on confining `q1`, at each end of the interval."""
PAIRS = 41
"""Pairs `q0`, `q1` that make a rate among which the most compatible one is sought."""
STEPS = 12
"""Halvings until an end of the interval is found."""
SHARE_ERROR = 0.02
"""Part of the error that is spent on the share, where it is estimated as well."""


@dataclass(frozen=True)
class StratifiedRate:
    """A failure rate from two strata.

    - `estimate`: the estimate of the rate; `low`, `high`: bounds of it.
    - `confidence`: the probability that the bounds hold.
    - `trials`: number of trials in both strata.
    - `pooled`: the Clopper-Pearson interval of the same trials, without strata.
    - `at_any_time`: whether the bounds hold however the trials were chosen.
    """

    estimate: float
    low: float
    high: float
    confidence: float
    trials: int
    pooled: tuple[float, float]
    at_any_time: bool = False

    @property
    def worth(self) -> float:
        """Approximate number of trials without strata that give an interval of the same length."""
        return self.trials * ((self.pooled[1] - self.pooled[0]) / (self.high - self.low)) ** 2

    def __str__(self) -> str:
        whenever = ", whenever stopped" if self.at_any_time else ""
        return (
            f"{self.estimate:z.3g} ({100 * self.confidence:zg} % interval {self.low:z.3g} to "
            f"{self.high:z.3g}{whenever}): {self.trials:,} trials, as good as {self.worth:z,.0f} "
            "without strata"
        )


def stratified_rate(
    first: tuple[int, int],
    second: tuple[int, int],
    share: float | tuple[int, int],
    confidence: float = 0.95,
    *,
    undecided: tuple[int, int] = (0, 0),
    allocated: bool = False,
    at_any_time: bool = False,
) -> StratifiedRate:
    """Compute a failure rate and its interval from the trials of two strata.

    **Arguments:**
    - `first`, `second`: failures and trials of each stratum.
    - `share`: probability of the second stratum: a number, or counts of independent samples, in it
      and in all.
    - `confidence`: the probability that the interval holds.
    - `undecided`: further trials of each stratum that may have failed.
    - `allocated`: whether the number of trials in each stratum was chosen beforehand; otherwise
      trials are samples of the whole.
    - `at_any_time`: whether verdicts influenced which trials were made, or when to stop.
    **Returns:** the `StratifiedRate`.
    **Raises:** `ValueError` for counts below zero or failures above trials, if there are no trials,
    and for a share or a confidence out of range.
    """
    check_fraction("confidence", confidence)
    counts = [first, second]
    for (failed, trials), open_ones in zip(counts, undecided, strict=True):
        if not 0 <= failed <= failed + open_ones <= trials:
            raise ValueError(
                "a stratum needs 0 <= failures, and failures and undecided trials together at most "
                f"its trials; got {failed}, {open_ones} and {trials}"
            )
    trials = first[1] + second[1]
    if not trials:
        raise ValueError("a rate needs at least one trial; got none")
    worst = [(k + open_ones, n) for (k, n), open_ones in zip(counts, undecided, strict=True)]
    failures, maximum = (sum(k for k, _ in some) for some in (counts, worst))
    pooled = exact_interval(failures, maximum, trials, confidence)
    if at_any_time:
        rate = anytime_interval(failures, trials, confidence, maximum - failures)
        pooled = rate.low, rate.high
    shares, error, middle = _shares(share, 1 - confidence)
    if not 0 < shares[0] <= shares[-1] < 1:
        ends = pooled  # There is one stratum only.
    else:
        ends = (
            _end([_Test(counts, s, error, allocated, at_any_time) for s in shares], -1),
            _end([_Test(worst, s, error, allocated, at_any_time) for s in shares], 1),
        )
    known = [k / max(n - open_, 1) for (k, n), open_ in zip(counts, undecided, strict=True)]
    estimate = (1 - middle) * known[0] + middle * known[1]
    if not (first[1] and second[1]):
        estimate = failures / trials
    estimate = min(max(estimate, ends[0]), ends[1])
    return StratifiedRate(estimate, *ends, confidence, trials, pooled, at_any_time)


def _shares(share: float | tuple[int, int], error: float) -> tuple[list[float], float, float]:
    """Return shares to allow for, the error that is left, and the share itself."""
    if not isinstance(share, tuple):
        if not 0 <= share <= 1:
            raise ValueError(f"share must be a probability; got {share}")
        return [float(share)], error, float(share)
    inside, samples = share
    low, high = exact_interval(inside, inside, samples, 1 - SHARE_ERROR * error)
    return [low, high], (1 - SHARE_ERROR) * error, inside / samples


def _end(tests: Sequence["_Test"], side: int) -> float:
    """Return the lower (-1) or the upper (1) end of an interval that holds for every share."""
    found = tests[0].end(side)
    for test in tests[1:]:
        # Most often the other share allows nothing beyond it, which one question tells.
        beyond = min(max(found + side * 1e-3, 1e-9), 1 - 1e-9)
        if test.keeps(beyond, side):
            found = test.end(side)
    return found


class _Test:
    """Which rates the trials of two strata reject, at one end with half of the error each."""

    def __init__(
        self, observed: Sequence[tuple[int, int]], share: float, error: float, allocated: bool,
        at_any_time: bool,
    ) -> None:  # fmt: skip
        self.observed, self.share, self.error = tuple(observed), share, error
        self.at_any_time = at_any_time
        self.n = sum(trials for _, trials in observed)
        if at_any_time:
            return
        self.seconds = self._numbers(allocated)
        strata = [np.mgrid[0 : self.n - n1 + 1, 0 : n1 + 1].reshape(2, -1) for n1 in self.seconds]
        n1 = np.repeat(self.seconds, [grid.shape[1] for grid in strata])
        k0, k1 = np.concatenate(strata, axis=1)
        self.outcomes = (k0, self.n - n1, k1, n1)

    def _numbers(self, allocated: bool) -> Int[np.ndarray, " numbers"]:
        """Return the numbers of trials in the second stratum that might have come about."""
        from scipy.stats import binom

        own = np.array([self.observed[1][1]])
        self.chance = np.ones(1)
        ends = binom.ppf(LEFT_OUT, self.n, self.share), binom.isf(LEFT_OUT, self.n, self.share)
        numbers = np.arange(int(ends[0]), int(ends[1]) + 1)
        many = np.sum((numbers + 1) * (self.n - numbers + 1)) > MAX_OUTCOMES
        if allocated or many or own[0] not in numbers:
            return own
        self.chance = binom.pmf(numbers, self.n, self.share)
        return numbers

    def end(self, side: int) -> float:
        """Return the lower (-1) or the upper (1) end of the interval."""
        (k0, n0), (k1, n1) = self.observed
        inside = (1 - self.share) * k0 / max(n0, 1) + self.share * k1 / max(n1, 1)
        if not n0 or not n1:
            inside = (k0 + k1) / self.n
        outside = 1.0 if side > 0 else 0.0
        if (side < 0 and k0 == k1 == 0) or (side > 0 and (k0, k1) == (n0, n1)):
            return outside
        for _ in range(3 * STEPS if self.at_any_time else STEPS):
            middle = (inside + outside) / 2
            if self.keeps(middle, side):
                inside = middle
            else:
                outside = middle
        return outside

    def keeps(self, rate: float, side: int) -> bool:
        """Return whether the trials are compatible with a rate."""
        if self.at_any_time:
            return self._min_evidence(rate) < math.log(1 / self.error)
        return self._probability(rate, side) > self.error / 2

    def _range(self, rate: float) -> tuple[float, float]:
        """Return the least and the greatest `q1` that make a rate with some `q0`."""
        share = self.share
        return max(0.0, (rate - (1 - share)) / share), min(1.0, rate / share)

    def _other(self, rate: float, q1: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        return np.clip((rate - self.share * q1) / (1 - self.share), 0.0, 1.0)

    def _min_evidence(self, rate: float) -> float:
        """Return the evidence against a rate by mixtures over the rates of each stratum.

        Their product is a martingale whatever trial is made next, so that this holds at any time.
        """
        q1 = np.linspace(*self._range(rate), 4001)
        q0 = self._other(rate, q1)
        evidence = sum(
            log_mixture(*stratum) - log_likelihood(*stratum, q)
            for stratum, q in zip(self.observed, (q0, q1), strict=True)
        )
        return float(np.min(evidence))

    def _probability(self, rate: float, side: int) -> float:
        """Return how probable outcomes as extreme as this one are, at most, under a rate."""
        (k0, n0), (k1, n1) = self.observed
        own = self._signed(tuple(np.array([x]) for x in (k0, n0, k1, n1)), rate)[0]
        signed = self._signed(self.outcomes, rate)
        extreme: Bool[np.ndarray, " outcomes"] = side * (signed - own) <= 1e-7
        low, high = self._range(rate)
        (low0, high0), (low1, high1) = (
            exact_interval(k, k, n, 1 - OUTSIDE) if n else (0.0, 1.0) for k, n in self.observed
        )
        low = max(low, low1, (rate - (1 - self.share) * high0) / self.share)
        high = min(high, high1, (rate - (1 - self.share) * low0) / self.share)
        if low > high:
            return 0.0
        q1 = np.linspace(low, high, PAIRS)
        q0 = self._other(rate, q1)
        total, begin = np.zeros(PAIRS), 0
        for n1, chance in zip(self.seconds, self.chance, strict=True):
            n0 = self.n - int(n1)
            size = (n0 + 1) * (int(n1) + 1)
            block = extreme[begin : begin + size].reshape(n0 + 1, -1).astype(float)
            total += chance * np.sum((block.T @ _binomial(n0, q0)) * _binomial(int(n1), q1), axis=0)
            begin += size
        left_out = 2 * LEFT_OUT if len(self.seconds) > 1 else 0.0
        return float(total.max()) + 2 * OUTSIDE + left_out

    def _signed(
        self, outcomes: tuple[Int[np.ndarray, " outcomes"], ...], rate: float
    ) -> Float[np.ndarray, " outcomes"]:
        """Return signed roots of the likelihood ratios of a rate, which order the outcomes."""
        k0, n0, k1, n1 = outcomes
        low, high = (np.full(k0.shape, end) for end in self._range(rate))
        odds = self.share / (1 - self.share)
        for _ in range(20):
            q1 = np.clip((low + high) / 2, 1e-300, 1 - 1e-16)
            q0 = np.clip(self._other(rate, q1), 1e-300, 1 - 1e-16)
            rising = k1 / q1 - (n1 - k1) / (1 - q1) > odds * (k0 / q0 - (n0 - k0) / (1 - q0))
            low, high = np.where(rising, q1, low), np.where(rising, high, q1)
        q1 = (low + high) / 2
        q0 = self._other(rate, q1)
        f0, f1 = k0 / np.maximum(n0, 1), k1 / np.maximum(n1, 1)
        free = log_likelihood(k0, n0, f0) + log_likelihood(k1, n1, f1)
        bound = log_likelihood(k0, n0, q0) + log_likelihood(k1, n1, q1)
        root = np.sqrt(np.clip(2 * (free - bound), 0.0, 1e12))
        return np.sign((1 - self.share) * f0 + self.share * f1 - rate) * root


def _binomial(n: int, q: Float[np.ndarray, " m"]) -> Float[np.ndarray, "n m"]:
    """Return the probabilities of 0 to `n` failures, one column for each rate."""
    from scipy.special import gammaln

    k = np.arange(n + 1)[:, None]
    ways = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
    return np.exp(ways + log_likelihood(k, n, q))
