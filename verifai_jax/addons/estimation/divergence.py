"""The worst mean of a bounded number over all distributions near a given one.

>>> f"{worst_probability(0.01, 0.1):.4f}"       # of an event of 1 %, within 0.1 nats
'0.0805'
>>> f"{radius_of(0.001, 0.01):.4f}"             # nats that make 1 % of 0.1 %
'0.0141'

Near means a Kullback-Leibler divergence `KL(Q || P)` of at most `radius` nats. For a number with
finitely many values, the worst `Q` reweights `P` by `exp(value / t)` with one temperature `t`, so
the bound has one dual variable: `inf_t t radius + t log E_P exp(value / t)` (Hu and Hong,
Kullback-Leibler divergence constrained distributionally robust optimization, 2013, theorem 1). For
an event, whose value is 0 or 1, the bound is the greater root `q` of `KL(q || p) = radius`.
"""

import math
from collections.abc import Sequence

import numpy as np

EXTREME = 700.0
"""Greatest exponent of a reweighting: beyond, all weight is on the greatest value."""


def binary_divergence(q: float, p: float) -> float:
    """Return the divergence in nats of an event's probability `q` from its probability `p`."""
    parts = [(q, p), (1 - q, 1 - p)]
    if any(new > 0 and old <= 0 for new, old in parts):
        return math.inf
    return max(0.0, sum(new * math.log(new / old) for new, old in parts if new > 0))


def worst_probability(p: float, radius: float) -> float:
    """Return the greatest probability of an event over all priors within a divergence.

    **Arguments:**
    - `p`: its probability under the prior.
    - `radius`: the divergence in nats, at least 0.
    """
    _check(p, radius)
    return worst_mean((0.0, 1.0), (1 - p, p), radius)


def radius_of(p: float, limit: float) -> float:
    """Return the smallest divergence in nats at which a prior gives an event probability `limit`.

    **Arguments:**
    - `p`: its probability under the prior.
    - `limit`: a greater probability; the result is 0 if it is not greater.
    """
    _check(p, 0.0)
    return 0.0 if limit <= p else binary_divergence(limit, p)


def worst_mean(values: Sequence[float], weights: Sequence[float], radius: float) -> float:
    """Return the greatest mean of a number over all distributions within a divergence.

    **Arguments:**
    - `values`: the possible values of the number.
    - `weights`: their probabilities, which sum to 1.
    - `radius`: the divergence in nats, at least 0.
    """
    _check(0.0, radius)
    low, high = 0.0, EXTREME
    for _ in range(200):
        middle = (low + high) / 2
        near = _tilted(values, weights, middle)[1] <= radius
        low, high = (middle, high) if near else (low, middle)
    return _tilted(values, weights, low)[0]


def radius_of_mean(values: Sequence[float], weights: Sequence[float], limit: float) -> float:
    """Return the smallest divergence in nats at which the mean of a number reaches `limit`.

    **Arguments:** those of `worst_mean`, and `limit`; the result is 0 if the mean already reaches
    it.
    """
    if limit <= _tilted(values, weights, 0.0)[0]:
        return 0.0
    low, high = 0.0, EXTREME
    if _tilted(values, weights, high)[0] < limit:
        return math.inf
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if _tilted(values, weights, middle)[0] < limit else (low, middle)
    return _tilted(values, weights, high)[1]


def _tilted(values: Sequence[float], weights: Sequence[float], slope: float) -> tuple[float, float]:
    """Return the mean under weights times `exp(slope * value)`, and their divergence."""
    value, old = np.asarray(values, float), np.asarray(weights, float)
    value, old = value[old > 0], old[old > 0]
    new = old * np.exp(slope * (value - value.max()))
    total = float(new.sum())
    mean = float(new @ value) / total
    log_total = math.log(total) + slope * float(value.max())
    return mean, max(0.0, slope * mean - log_total)


def _check(p: float, radius: float) -> None:
    if not 0 <= p <= 1:
        raise ValueError(f"a probability lies between 0 and 1; got {p}")
    if not radius >= 0:
        raise ValueError(f"a divergence is at least 0 nats; got {radius}")
