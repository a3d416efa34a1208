"""Intervals that hold at any time, together for many policies, and what they decide.

    simultaneous_interval(0, 768, confidence=0.95, among=32)         # one of 32 rates
    verdict(rate, p=0.01)                                            # "safe@0.01"

They are those of `statistics/confidence_sequences.py` with a mixture for each side. The mixture for
upper bounds has an atom at rate 0, which is often the rate of safe policies: without a failure it
needs `ln(1/ATOM) / q` samples more than the exact bound for a fixed number of samples (29 at 0.01);
a mixture without an atom needs hundreds.
"""

import math

import numpy as np
from jaxtyping import Float

from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.statistics.binomial import Rate, check_counts
from verifai_jax.statistics.confidence_sequences import Counts, border_between, log_likelihood

ATOM = 0.75
"""Weight of rate 0 in the mixture for upper bounds."""
UNDECIDED = "undecided"
"""Verdict of a policy whose interval contains the failure rate that is allowed."""
SAFE = "safe"
"""Beginning of the verdict `safe@p`."""
UNSAFE = "unsafe"
"""Verdict of a policy that fails more often than is allowed."""


def simultaneous_interval(
    failures: int, simulations: int, confidence: float = 0.95, among: int = 1
) -> Rate:
    """Compute an interval that is valid at any time, together with those of other rates.

    Each side of each of N intervals has error `(1 - confidence) / (2 N)`, so all of them hold
    together with probability `confidence` (Bonferroni), however the samples depend on each other:
    policies share their features.

    **Arguments:**
    - `failures`: samples that failed.
    - `simulations`: number of all samples, which may depend on their outcomes.
    - `confidence`: the probability that all intervals hold.
    - `among`: number of rates, including this one.
    **Returns:** the `Rate`.
    **Raises:** `ValueError` unless `0 <= failures <= simulations`, `simulations >= 1`,
    `0 < confidence < 1` and `among >= 1`.
    """
    check_counts(failures, simulations)
    limit = required_evidence(confidence, among)
    estimate = failures / simulations
    low = border_between(
        estimate, 0.0, lambda rates: evidence_above(failures, simulations, rates) < limit
    )
    high = border_between(
        estimate, 1.0, lambda rates: evidence_below(failures, simulations, rates) < limit
    )
    return Rate(failures, simulations, low, high, confidence, at_any_time=True)


def required_evidence(confidence: float, among: int) -> float:
    """Compute the logarithm of the likelihood ratio at which a rate is rejected on one side.

    **Raises:** `ValueError` unless `0 < confidence < 1` and `among >= 1`.
    """
    check_fraction("confidence", confidence)
    return math.log(2 * check_count("among", among) / (1 - confidence))


def evidence_below(failures: Counts, simulations: Counts, rate: Counts) -> Float[np.ndarray, "*n"]:
    """Compute the logarithm of the likelihood ratio of the lower rates against `rate`.

    The mixture is an atom at 0 and, above it, a density proportional to `t^(-1/2)`.

    **Arguments:**
    - `failures`, `simulations`: numbers of samples, which broadcast; `failures` may be fractions,
      for expected numbers of future samples.
    - `rate`: rates to reject from above.
    """
    from scipy.special import betainc, betaln

    k, n, q = (np.asarray(value, np.float64) for value in (failures, simulations, rate))
    with np.errstate(divide="ignore", invalid="ignore"):
        null = log_likelihood(k, n, q)
        part = np.log(betainc(k + 0.5, n - k + 1, q)) + betaln(k + 0.5, n - k + 1)
        spread = math.log(1 - ATOM) + part - np.log(2 * np.sqrt(q))
        atom = np.where(k == 0, math.log(ATOM), -np.inf)
        evidence = np.logaddexp(atom, spread) - null
    # Nothing is below 0; a rate of 1 is rejected by a single success.
    evidence = np.where(q <= 0, -np.inf, evidence)
    return np.where((q >= 1) & (k < n), np.inf, np.where((q >= 1) & (k >= n), -np.inf, evidence))


def evidence_above(failures: Counts, simulations: Counts, rate: Counts) -> Float[np.ndarray, "*n"]:
    """Compute the logarithm of the likelihood ratio of the higher rates against `rate`.

    The mixture has a density proportional to `t^(-1/2) (1-t)^(-1/2)` there.

    **Arguments:** those of `evidence_below`, with rates to reject from below.
    """
    from scipy.special import betaincc, betaln

    k, n, q = (np.asarray(value, np.float64) for value in (failures, simulations, rate))
    with np.errstate(divide="ignore", invalid="ignore"):
        null = log_likelihood(k, n, q)
        part = np.log(betaincc(k + 0.5, n - k + 0.5, q)) + betaln(k + 0.5, n - k + 0.5)
        whole = np.log(betaincc(0.5, 0.5, q)) + betaln(0.5, 0.5)
        evidence = part - whole - null
    evidence = np.where(q >= 1, -np.inf, evidence)
    return np.where((q <= 0) & (k > 0), np.inf, np.where((q <= 0) & (k <= 0), -np.inf, evidence))


def verdict(rate: Rate | None, p: float) -> str:
    """Return `"safe@p"`, `"unsafe"` or `"undecided"`, for an interval below, above or around `p`.

    So "unsafe" is a statement about the probability of failure. A single counterexample does not
    make a policy unsafe: a policy that fails once in a million is safe at 0.01.
    """
    if rate is None:
        return UNDECIDED
    if rate.high < p:
        return safe_at(p)
    return UNSAFE if rate.low > p else UNDECIDED


def safe_at(p: float) -> str:
    """Write the verdict on a policy whose failure rate is below `p`."""
    return f"{SAFE}@{p:zg}"


def verdict_kind(verdict: str) -> str:
    """Return the kind of a verdict, `"safe"`, `"unsafe"` or `"undecided"`; empty without one."""
    return SAFE if verdict.split("@")[0] == SAFE else verdict
