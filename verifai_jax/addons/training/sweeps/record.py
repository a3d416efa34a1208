"""The record of a sweep as plain data: the sweep writes it, its result shows it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int, Shaped

from verifai_jax.addons.rl.policies import Policy as LoadedPolicy
from verifai_jax.addons.rl.policy import Policy

if TYPE_CHECKING:
    from verifai_jax.addons.estimation.certification.result import Certificates
TrainedPolicy: TypeAlias = Policy | LoadedPolicy
"""A policy of an algorithm of `rl`, or of anybody's function."""
TRAINED, NONFINITE, STOPPED = "trained", "nonfinite", "stopped"
"""Statuses of a row: trained, with a number that is not finite, and stopped here by halving.

A configuration that cannot train has `error: ...` instead."""
BEFORE = ("configuration", "seed", "steps")
"""Columns of the table before those of the hyper-parameters."""
AFTER = (
    "status", "training_return", "nominal_return", "failures", "simulations", "failure_rate",
    "failure_low", "failure_high", "worst_robustness", "verdict", "curve_robustness",
    "training_seconds",
)  # fmt: skip
"""Columns of the table after those of the hyper-parameters."""


def error_status(message: str) -> str:
    """Return the status of a training that raised."""
    return f"error: {message}"


def error_message(status: str) -> str | None:
    """Return the error of a training with this status; None if it did not raise."""
    kind, colon, message = status.partition(": ")
    return message if kind == "error" and colon else None


class Curve(NamedTuple):
    """A learning curve: environment steps by the end of each update, and the mean return of the
    episodes that ended in it; NaN if none did.
    """

    steps: Int[np.ndarray, " updates"]
    mean_return: Float[np.ndarray, " updates"]


@dataclass(frozen=True, eq=False)
class SweepRecord:
    """The table of a sweep with all data of its rows. A row is one policy.

    - `study`: name of the study.
    - `seed`: the seed of the sweep.
    - `columns`: the table, name -> column `[rows]`, in order: `BEFORE`, the hyper-parameters,
      `AFTER`. Unknown numbers are NaN, unknown texts empty. `steps` are the requested ones.
    - `hyperparameters`: columns from the space of the study; `steps` is the column of `BEFORE`.
    - `policies`: the policy of each row, on the host; None without policies.
    - `worst`: features with the least robustness for each row, in the form of `space.rows`; None if
      nothing was simulated.
    - `curves`: learning curve of each training run, by `(configuration, seed)`.
    - `certificates`: result of the certification; None if nothing was certified.
    - `certified`: indices of the certified policies, in the order of the certification.
    - `options`: options of the sweep, plain data.
    - `version`: the version of verifai_jax.
    - `seconds`: wall-clock time of each stage, such as `training` and `certifying`.
    - `complete`: False if the sweep was interrupted or out of time.
    - `sources`: the files of the study when the sweep began, and again when it continued with
      changed ones, as a run records them; empty if not recorded.
    """

    study: str
    seed: int
    columns: Mapping[str, Shaped[np.ndarray, " _"]]
    hyperparameters: tuple[str, ...]
    policies: tuple[TrainedPolicy | None, ...]
    worst: tuple[Mapping[str, Any] | None, ...]
    curves: Mapping[tuple[int, int], Curve]
    certificates: "Certificates | None"
    certified: tuple[int, ...]
    options: Mapping[str, Any]
    version: str
    seconds: Mapping[str, float] = field(default_factory=dict)
    complete: bool = True
    sources: Sequence[Mapping[str, Any]] = ()

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.policies)


def algorithm_uses(used: Mapping[str, Sequence[str]], algorithm: object, name: str) -> bool:
    """Return whether an algorithm has a hyper-parameter.

    - `used`: those of each algorithm; one that is missing, and None, have all.
    """
    return name in used.get(str(algorithm), (name,))
