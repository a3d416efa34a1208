"""Split conformal prediction: thresholds that a further score exceeds with a chosen probability.

>>> conformal_threshold([3.0, 1.0, 2.0, 5.0, 4.0], alpha=0.2)
5.0
>>> float(conformal_p_value([1.0, 2.0, 3.0], 2.5))
0.5

They hold for any distribution, if the further score and the given ones are exchangeable, such as
independent runs of one system. The probability is over these scores and the further one together.

Source: V. Vovk, A. Gammerman, G. Shafer, "Algorithmic Learning in a Random World", 2005, ch. 2.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from verifai_jax.core.messages.checks import check_fraction


def conformal_threshold(scores: ArrayLike, alpha: float) -> float:
    """Return a threshold that a further score exceeds with probability at most `alpha`.

    **Raises:** `ValueError` for too few scores.
    """
    check_fraction("alpha", alpha)
    ordered = np.sort(np.asarray(scores, float))
    rank = math.ceil((len(ordered) + 1) * (1 - alpha) - 1e-9)
    if rank > len(ordered):
        raise ValueError(
            f"a guarantee at alpha={alpha} needs {math.ceil(1 / alpha - 1 - 1e-9)} runs or more to "
            f"calibrate; got {len(ordered)}"
        )
    return float(ordered[rank - 1])


def conformal_p_value(scores: ArrayLike, score: ArrayLike) -> np.ndarray:
    """Return the share of all scores, a further one included, not below the further one.

    It is at most `alpha` with probability at most `alpha`.
    """
    ordered = np.sort(np.asarray(scores, float))
    below = np.searchsorted(ordered, np.asarray(score, float), "left")
    return np.asarray((1 + len(ordered) - below) / (1 + len(ordered)))
