"""Successive halving: at each checkpoint only the best configurations continue to train.

    sweep(study, configurations=64, halving=Halving(reduction=3))

Sources: Jamieson and Talwalkar, Non-stochastic best arm identification and hyperparameter
optimization (2016), figure 1; Li et al., A system for massively parallel hyperparameter tuning
(2020), section 3.1, whose asynchronous form gains nothing where all trainings run on one machine.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.messages.errors import check_names

RETURN, SAFETY = "return", "safety"
"""Criteria of halving."""


@dataclass(frozen=True)
class Halving:
    """Successive halving: keep the best 1/reduction of the configurations at each checkpoint.

    **Arguments:**
    - `reduction`: greater than 1; the share 1/reduction of the configurations continues, rounded
      up. It may be 1 with `p` or `until_safe`.
    - `by`: the criterion. `"return"` is the nominal return at the checkpoint; `"safety"` is the
      failure rate of the closed loop in a few simulations, then the worst robustness, then the
      return.
    - `p`: a configuration also ends at a checkpoint if a certificate shows that the policies of all
      its seeds fail there with a greater probability than this. The intervals hold whenever
      sampling stops, for all policies and checkpoints together, with the confidence of the sweep's
      `Certification`. A policy that fails now may be safe after more training, so choose what no
      training overcomes in the steps that are left.
    - `until_safe`: a configuration also ends at a checkpoint where the policies of all its seeds
      pass a test: at most half of the study's `p` of 256 samples fail, which no certificate uses.
      Only the last policy of a training is certified then, since no earlier one passed.
    **Raises:** `ValueError` for a reduction of 1 or less, and for a `p` that is no probability;
    `UnknownNameError` for another criterion.
    """

    reduction: float = 3.0
    by: str = RETURN
    p: float | None = None
    until_safe: bool = False

    def __post_init__(self) -> None:
        number = isinstance(self.reduction, int | float) and not isinstance(self.reduction, bool)
        ends = (self.p is not None or self.until_safe) and self.reduction == 1
        if not (number and (ends or 1 < self.reduction < math.inf)):
            raise ValueError(f"reduction must be greater than 1; got {self.reduction!r}")
        if self.p is not None:
            check_fraction("p", self.p)
        check_names("criterion of halving", [self.by], (RETURN, SAFETY))

    def survivors(self, configurations: int) -> int:
        """Return the number of configurations that continue."""
        return math.ceil(configurations / self.reduction)

    def select(self, objective: Mapping[int, float]) -> list[int]:
        """Choose the configurations that continue, by their objectives.

        The smallest objective is best, and NaN worst; among equal ones the first continue.
        """
        count = self.survivors(len(objective))
        values = {n: math.inf if math.isnan(value) else value for n, value in objective.items()}
        return sorted(sorted(values, key=lambda n: (values[n], n))[:count])
