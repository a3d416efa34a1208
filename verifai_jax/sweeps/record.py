"""What a sweep leaves behind, as plain data: the driver writes it, `Sweep` shows it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.rl.policy import Policy

TRAINED, NONFINITE, STOPPED = "trained", "nonfinite", "stopped"
"""Of a row: a policy that trained on, one with a number that is not finite, one that halving
stopped here. A configuration that cannot train has `error: ...` instead."""

BEFORE = ("configuration", "seed", "steps")
AFTER = (
    "status",
    "training_return",
    "nominal_return",
    "failures",
    "simulations",
    "failure_rate",
    "failure_low",
    "failure_high",
    "worst_robustness",
    "verdict",
    "curve_robustness",
    "training_seconds",
)
"""Columns of the table; those of the hyper-parameters stand between the two."""


class Curve(NamedTuple):
    """A learning curve: environment steps by the end of each update, and the mean return in it."""

    steps: Int[np.ndarray, " updates"]
    mean_return: Float[np.ndarray, " updates"]


@dataclass(frozen=True, eq=False)
class SweepRecord:
    """The table of a sweep and all that belongs to its rows. A row is one policy.

    - `study`: its name; `seed`: of the sweep.
    - `columns`: the table, name -> column `[rows]`, in order: `BEFORE`, the hyper-parameters,
      `AFTER`. Numbers that are not known are NaN, texts `""`. `steps` are those asked for.
    - `hyperparameters`: the columns that the space of the study gave; `steps` is `BEFORE`'s own.
    - `policies`: of each row, on the host; None where there is none.
    - `worst`: of each row the features with the least robustness met, as `space.rows` shows them
      (the problem's table columns); None where nothing was simulated.
    - `curves`: of each training, by `(configuration, seed)`.
    - `certificates`: what the certification said, and `certified`: the rows that its policies are,
      in its order. None and empty where nothing was certified.
    - `options`: what the sweep was asked for, plain data.
    - `version`: of verifai_jax.
    - `seconds`: of the whole, by what they were spent on ("training", "certification", ...).
    - `complete`: False where it was interrupted or out of time.
    """

    study: str
    seed: int
    columns: Mapping[str, np.ndarray]
    hyperparameters: tuple[str, ...]
    policies: tuple[Policy | None, ...]
    worst: tuple[Mapping[str, Any] | None, ...]
    curves: Mapping[tuple[int, int], Curve]
    certificates: Any | None
    certified: tuple[int, ...]
    options: Mapping[str, Any]
    version: str
    seconds: Mapping[str, float] = field(default_factory=dict)
    complete: bool = True

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.policies)
