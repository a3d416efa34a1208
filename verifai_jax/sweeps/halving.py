"""Successive halving: at each snapshot only the best go on, so that most training goes to them.

    sweep(study, configurations=64, halving=Halving(reduction=3))

Source: Jamieson and Talwalkar, Non-stochastic best arm identification and hyperparameter
optimization (2016), figure 1; Li et al., A system for massively parallel hyperparameter tuning
(2020), section 3.1, whose asynchronous form buys nothing where all trainings run on one machine.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from verifai_jax.core.errors import check_names

RETURN, SAFETY = "return", "safety"


@dataclass(frozen=True)
class Halving:
    """Who goes on.

    **Arguments:**

    - `reduction`: of so many configurations one goes on, rounded up; greater than 1.
    - `by`: `"return"`, the nominal return of the snapshot, or `"safety"`: how often its closed loop
      fails in a few simulations, then how nearly, then the return.

    **Raises:** `ValueError` for a reduction of 1 or less; `UnknownNameError` for another `by`.
    """

    reduction: float = 3.0
    by: str = RETURN

    def __post_init__(self) -> None:
        number = isinstance(self.reduction, int | float) and not isinstance(self.reduction, bool)
        if not (number and 1 < self.reduction < math.inf):
            raise ValueError(f"reduction must be greater than 1; got {self.reduction!r}")
        check_names("criterion of halving", [self.by], (RETURN, SAFETY))

    def count(self, configurations: int) -> int:
        """How many of so many go on."""
        return math.ceil(configurations / self.reduction)

    def kept(self, badness: Mapping[int, float]) -> list[int]:
        """The configurations that go on, in the order of their numbers; ties go to the first.

        - `badness`: of each configuration, the less the better; NaN is worse than anything.
        """
        count = self.count(len(badness))
        bad = {n: math.inf if math.isnan(b) else b for n, b in badness.items()}
        return sorted(sorted(bad, key=lambda n: (bad[n], n))[:count])
