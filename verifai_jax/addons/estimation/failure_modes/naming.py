"""Names of modes: conditions on features that nearly all failures of a mode satisfy.

    name_mode(failures, prior)                      # "speed > 31.2 and gap <= 4"

Each condition bounds one feature at one side, so that nearly all failures of the mode satisfy it
and as few samples of the prior as possible. Conditions are added as long as they help. All are
necessary for a failure of the mode, but together they may not be sufficient.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from jaxtyping import Bool

from verifai_jax.addons.analysis.conditions import Between

KEPT = 0.95
"""Share of the mode's failures that fulfil each condition."""
MAX_WORDS = 6
"""Conditions of a name, at most."""
HELPS = 0.7
"""Share of the prior's samples that a further condition may keep, at most."""
FEW = 20
"""Samples of the prior that fulfil all conditions so far, below which they tell nothing: then a
further condition is judged by all samples, as one of independent features."""


@dataclass(frozen=True)
class _Choice:
    """A choice that nearly all failures of a mode have."""

    feature: str
    choice: str

    def matches(self, frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
        return (frame[self.feature].astype(str) == self.choice).to_numpy()

    def __str__(self) -> str:
        return f"{self.feature} is {self.choice}"


def name_mode(failures: pd.DataFrame, prior: pd.DataFrame) -> str:
    """Name a mode by conditions on the features that vary.

    **Arguments:**
    - `failures`: features of failures of the mode, one a row.
    - `prior`: features of samples of the prior.
    **Returns:** the conditions, those that the fewest samples of the prior satisfy first;
    `"anywhere"` if no condition separates the failures.
    """
    varying = [name for name in failures.columns if len(set(prior[name].astype(str))) > 1]
    left = [each for name in varying for each in _conditions(failures, prior, name)]
    inside = np.ones(len(prior), bool)
    taken: list[Between | _Choice] = []
    while left and len(taken) < MAX_WORDS:
        judged = inside if inside.sum() > FEW else np.ones(len(prior), bool)
        shares = [float(np.mean(each.matches(prior)[judged])) for each in left]
        best = int(np.argmin(shares))
        if shares[best] > HELPS:
            break
        taken.append(left.pop(best))
        inside &= taken[-1].matches(prior)
    return " and ".join(map(str, _joined(taken))) or "anywhere"


def _conditions(
    failures: pd.DataFrame, prior: pd.DataFrame, name: str
) -> list[Between] | list[_Choice]:
    """Return the conditions on a feature that nearly all failures fulfil."""
    try:
        own, others = failures[name].to_numpy(np.float64), prior[name].to_numpy(np.float64)
    except (TypeError, ValueError):
        counts = failures[name].astype(str).value_counts(normalize=True)
        often = len(counts) and counts.iloc[0] >= KEPT
        return [_Choice(name, str(counts.index[0]))] if often else []
    if np.mean(np.isfinite(own)) < KEPT:
        return []
    own = own[np.isfinite(own)]
    low, high = (float(np.quantile(own, q, method="nearest")) for q in (1 - KEPT, KEPT))
    values = np.concatenate([own, others[np.isfinite(others)]])
    if np.all(values == np.round(values)):
        # The lower end is not included: it is the next smaller number.
        return [Between(name, above=low - 1, integer=True), Between(name, upto=high, integer=True)]
    return [Between(name, above=_short(low, -1)), Between(name, upto=_short(high, 1))]


def _joined(taken: list[Between | _Choice]) -> list[Between | _Choice]:
    """Return the conditions with the two ends of one feature as one."""
    joined: dict[str, Between | _Choice] = {}
    for each in taken:
        other = joined.get(each.feature)
        if isinstance(each, Between) and isinstance(other, Between):
            each = replace(
                each, above=max(each.above, other.above), upto=min(each.upto, other.upto)
            )
        joined[each.feature] = each
    return list(joined.values())


def _short(value: float, outwards: int) -> float:
    """Round to three digits, away from the failures where the nearest number would leave some out.

    Failures lie above the value where `outwards` is -1, and below it where it is 1.
    """
    rounded = float(f"{value:z.3g}")
    if value and (rounded - value) * outwards < 0:
        unit = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
        rounded = float(f"{rounded + outwards * unit:z.3g}")
    return rounded
