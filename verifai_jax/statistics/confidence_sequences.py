"""Bounds on many failure rates at once, for samples whose outcomes decide how many there are.

    rate = bounded(failures=0, simulations=768, confidence=0.95, among=32)
    verdict(rate, p=0.01)                               # "safe@0.01"

The allocation looks at every policy again and again, and goes on with those whose decision is open.
A Clopper-Pearson bound of the final number of samples would be wrong then: who looks often enough
sees it exclude the truth. A ladder of sample sizes with the error spent over its rungs would be
right, but pays `ln(rungs)` on each and wastes up to a whole rung between two.

Instead, the rate `q` is rejected once a likelihood ratio against it, mixed over rates on one side
of it, has grown to the reciprocal of the error allowed. For another rate `t`, the factor of one
sample, `t/q` for a failure and `(1-t)/(1-q)` for none, has expectation 1 if `q` is the true rate.
So a mixture over any fixed distribution of `t` is a nonnegative martingale that starts at 1, and by
Ville's inequality it ever reaches `1 / error` with probability `error` at most. The bound holds at
all sample sizes together, whatever decided them, be it other policies' outcomes in the very samples
to come (Robbins, Statistical methods related to the law of the iterated logarithm, Annals of
Mathematical Statistics 41, 1970; Howard, Ramdas, McAuliffe and Sekhon, Time-uniform, nonparametric,
nonasymptotic confidence sequences, Annals of Statistics 49, 2021).

The mixture for upper bounds has an atom at rate 0, which safe policies often have: without a
failure it costs `ln(1/ATOM) / q` samples more than the exact bound of a fixed number of samples,
29 at 0.01. `rates.at_any_time`, with one mixture for all rates and no atom, costs hundreds.

For N policies each side of each interval has error `(1 - confidence) / (2 N)`, so that all of them
hold together with probability `confidence` (Bonferroni), however the samples depend on each other:
policies share their features.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.statistics.binomial import Rate

ATOM = 0.75
"""Weight of rate 0 in the mixture for upper bounds."""

UNDECIDED = "undecided"
UNSAFE = "unsafe"


def bounded(failures: int, simulations: int, confidence: float = 0.95, among: int = 1) -> Rate:
    """A failure rate with an interval that holds at any time, together with `among - 1` others.

    **Raises:** `ValueError` unless `0 <= failures <= simulations`, `simulations >= 1`,
    `0 < confidence < 1` and `among >= 1`.
    """
    if simulations < 1 or not 0 <= failures <= simulations:
        raise ValueError(
            "a rate needs 0 <= failures <= simulations and at least one simulation; "
            f"got (failures={failures}, simulations={simulations})"
        )
    limit = needed(confidence, among)

    def border(outside: float, evidence: Any) -> float:
        """Where the evidence reaches the limit, between the estimate and an end of [0, 1]."""
        within = failures / simulations
        if within == outside or float(evidence(failures, simulations, outside)) < limit:
            return outside
        for _ in range(60):
            middle = (within + outside) / 2
            if float(evidence(failures, simulations, middle)) < limit:
                within = middle
            else:
                outside = middle
        return outside

    low, high = border(0.0, evidence_above), border(1.0, evidence_below)
    return Rate(failures, simulations, low, high, confidence, at_any_time=True)


def needed(confidence: float, among: int) -> float:
    """Logarithm of the likelihood ratio at which a rate is rejected on one side.

    **Raises:** `ValueError` unless `0 < confidence < 1` and `among >= 1`.
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie between 0 and 1; got {confidence}")
    if among < 1:
        raise ValueError(f"among must be at least 1; got {among}")
    return math.log(2 * among / (1 - confidence))


def evidence_below(
    failures: Int[np.ndarray, " n"] | float,
    simulations: Int[np.ndarray, " n"] | int,
    rate: Float[np.ndarray, " n"] | float,
) -> Float[np.ndarray, " n"]:
    """Logarithm of the likelihood ratio against `rate` of the mixture over the rates below it.

    The mixture is an atom at 0 and, above it, a density proportional to `t^(-1/2)`. `failures` may
    be fractions, for what is expected of samples to come.
    """
    from scipy.special import betainc, betaln

    k, n, q = _floats(failures, simulations, rate)
    with np.errstate(divide="ignore", invalid="ignore"):
        null = _likelihood(k, n, q)
        part = np.log(betainc(k + 0.5, n - k + 1, q)) + betaln(k + 0.5, n - k + 1)
        spread = math.log(1 - ATOM) + part - np.log(2 * np.sqrt(q))
        atom = np.where(k == 0, math.log(ATOM), -np.inf)
        found = np.logaddexp(atom, spread) - null
    # Nothing is below 0; a rate of 1 is refuted by a single success.
    found = np.where(q <= 0, -np.inf, found)
    return np.where((q >= 1) & (k < n), np.inf, np.where((q >= 1) & (k >= n), -np.inf, found))


def evidence_above(
    failures: Int[np.ndarray, " n"] | float,
    simulations: Int[np.ndarray, " n"] | int,
    rate: Float[np.ndarray, " n"] | float,
) -> Float[np.ndarray, " n"]:
    """Logarithm of the likelihood ratio against `rate` of the mixture over the rates above it.

    The mixture has a density proportional to `t^(-1/2) (1-t)^(-1/2)` there.
    """
    from scipy.special import betaincc, betaln

    k, n, q = _floats(failures, simulations, rate)
    with np.errstate(divide="ignore", invalid="ignore"):
        null = _likelihood(k, n, q)
        part = np.log(betaincc(k + 0.5, n - k + 0.5, q)) + betaln(k + 0.5, n - k + 0.5)
        whole = np.log(betaincc(0.5, 0.5, q)) + betaln(0.5, 0.5)
        found = part - whole - null
    found = np.where(q >= 1, -np.inf, found)
    return np.where((q <= 0) & (k > 0), np.inf, np.where((q <= 0) & (k <= 0), -np.inf, found))


def verdict(rate: Rate | None, p: float) -> str:
    """`"safe@p"` if the whole interval is below `p`, `"unsafe"` if it is above, or `"undecided"`.

    So "unsafe" is a statement about the probability of failure. A counterexample alone is none: a
    policy that fails once in a million is safe at 0.01.
    """
    if rate is None:
        return UNDECIDED
    if rate.high < p:
        return safe_at(p)
    return UNSAFE if rate.low > p else UNDECIDED


def safe_at(p: float) -> str:
    """The verdict of a policy whose failure rate is below `p`."""
    return f"safe@{p:g}"


def _floats(*values: Any) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(value, np.float64) for value in values)


def _likelihood(k: np.ndarray, n: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Logarithm of the probability of one sequence with `k` failures."""
    from scipy.special import xlog1py, xlogy

    return xlogy(k, q) + xlog1py(n - k, -q)
