"""Names of modes in words: the few conditions that set a mode's failures apart from the prior.

    name_mode(failures, prior)                      # "speed > 31.2 and gap <= 4"

Each condition is one end of one feature's range, behind which nearly all failures of the mode lie
and as few samples of the prior as possible; conditions are taken one by one while they help.
"""

import numpy as np
import pandas as pd

from verifai_jax.analysis.conditions import Between

KEPT = 0.95
"""Share of the mode's failures that fulfil each condition."""
MOST = 3
"""Conditions of a name, at most."""
HELPS = 0.7
"""Share of the prior's samples that a further condition may keep, at most."""


def name_mode(failures: pd.DataFrame, prior: pd.DataFrame) -> str:
    """Name a mode by conditions on its features.

    **Arguments:**

    - `failures`: features of failures of the mode, one a row.
    - `prior`: features of samples of the prior.

    **Returns:** the conditions, `"anywhere"` without one that tells them apart.
    """
    inside = np.ones(len(prior), bool)
    words: list[str] = []
    left = list(failures.columns)
    while left and len(words) < MOST and inside.sum() > 20:
        kept, name, text, where = min(
            (
                _best(pd.Series(failures[name]), pd.Series(prior[name]), inside, name)
                for name in left
            ),
            key=lambda found: found[0],
        )
        if kept > HELPS:
            break
        words.append(text)
        inside &= where
        left.remove(name)
    return " and ".join(words) or "anywhere"


def _best(
    own: pd.Series, prior: pd.Series, inside: np.ndarray, name: str
) -> tuple[float, str, str, np.ndarray]:
    """Return the share of the prior that the best condition on a feature keeps, and its words."""
    try:
        values, others = own.to_numpy(np.float64), prior.to_numpy(np.float64)
    except (TypeError, ValueError):
        return _choice(own, prior, inside, name)
    values = values[np.isfinite(values)]
    if not len(values):
        return 1.0, name, "", inside
    above, upto = np.quantile(values, [1 - KEPT, KEPT])
    conditions = [Between(name, above=_short(above)), Between(name, upto=_short(upto))]
    masks = [others > conditions[0].above, others <= conditions[1].upto]
    shares = [float(np.mean(mask[inside])) for mask in masks]
    best = int(np.argmin(shares))
    return shares[best], name, str(conditions[best]), masks[best]


def _choice(
    own: pd.Series, prior: pd.Series, inside: np.ndarray, name: str
) -> tuple[float, str, str, np.ndarray]:
    """Return the same for a feature that is no number: its most frequent choice."""
    counts = own.astype(str).value_counts(normalize=True)
    choice = str(counts.index[0])
    mask = (prior.astype(str) == choice).to_numpy()
    if counts.iloc[0] < KEPT:
        return 1.0, name, "", inside
    return float(np.mean(mask[inside])), name, f"{name} is {choice}", mask


def _short(value: float) -> float:
    return float(f"{value:.3g}")
