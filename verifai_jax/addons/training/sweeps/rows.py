"""The rows of a sweep's table as columns, in the order and types that `SweepRecord` promises."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from verifai_jax.addons.estimation.certification.result import Certificate
from verifai_jax.addons.training.sweeps.curves import curve_robustness
from verifai_jax.addons.training.sweeps.record import AFTER, BEFORE, Curve, TrainedPolicy
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.training_runs import RunCheckpoint

_INTEGERS = {"configuration", "seed", "steps", "failures", "simulations"}
_TEXTS = {"status", "verdict"}


@dataclass(frozen=True, eq=False)
class Row:
    """One policy, or one training run without a policy.

    - `configuration`, `seed`, `steps`: number of the configuration, training seed, checkpoint.
    - `values`: the hyper-parameters.
    - `status`: see `record`.
    - `entry`: the number of the training run and that of its checkpoint.
    - `checkpoint`: the run at that checkpoint; None if it did not train.
    - `nominal_return`: mean return on the nominal task; NaN if unknown.
    - `safety`: the safety of the policy; None if it was not certified.
    """

    configuration: int
    seed: int
    steps: int
    values: Mapping[str, object]
    status: str
    entry: tuple[int, int]
    checkpoint: RunCheckpoint | None = None
    nominal_return: float = float("nan")
    safety: Certificate | None = None


class Table(NamedTuple):
    """The parts of a `SweepRecord` that have one entry for each row, and the learning curves."""

    columns: Mapping[str, Shaped[np.ndarray, " rows"]]
    policies: tuple[TrainedPolicy | None, ...]
    worst: tuple[Mapping[str, object] | None, ...]
    curves: Mapping[tuple[int, int], Curve]


def tabulate(rows: Sequence[Row], study: Study) -> Table:
    """Convert rows to columns, policies, worst features and learning curves."""
    names = [n for n in study.space.columns if n not in BEFORE]
    cells = [_cells(row, study) for row in rows]
    columns: dict[str, np.ndarray] = {}
    for name in (*BEFORE, *names, *AFTER):
        entries = [cell[name] for cell in cells]
        if name in _INTEGERS:
            columns[name] = np.array(entries, np.int64)
        elif name in _TEXTS:
            columns[name] = np.array(entries, object)
        elif name in names:
            columns[name] = _hyperparameter_column(entries)
        else:
            columns[name] = np.array(entries, np.float64)
    curves: dict[tuple[int, int], Curve] = {}
    for row in rows:
        # The last checkpoint of a run has the longest curve.
        if row.checkpoint is not None:
            curves[row.configuration, row.seed] = row.checkpoint.curve
    return Table(
        columns=columns,
        policies=tuple(
            row.checkpoint.policy if row.checkpoint is not None and row.checkpoint.finite else None
            for row in rows
        ),
        worst=tuple(None if row.safety is None else row.safety.worst_features for row in rows),
        curves=curves,
    )


def _cells(row: Row, study: Study) -> dict[str, object]:
    nan, checkpoint, safety = float("nan"), row.checkpoint, row.safety
    curve = nan
    if study.curve_formula is not None and checkpoint is not None:
        curve = curve_robustness(study.curve_formula, *checkpoint.curve)
    return {
        **row.values, "configuration": row.configuration, "seed": row.seed, "steps": row.steps,
        "status": row.status,
        "training_return": nan if checkpoint is None else checkpoint.training_return,
        "nominal_return": row.nominal_return, **columns_of(safety), "curve_robustness": curve,
        "training_seconds": nan if checkpoint is None else checkpoint.seconds,
    }  # fmt: skip


def columns_of(certificate: Certificate | None) -> dict[str, Any]:
    """Return the columns of a certificate; `failures` includes samples without a verdict."""
    nan, rate = float("nan"), None if certificate is None else certificate.rate
    if certificate is None or rate is None:
        # An interruption leaves policies without a sample, and so without a verdict.
        worst = nan if certificate is None else certificate.worst_robustness
        columns = {"failures": 0, "simulations": 0, "failure_rate": nan, "failure_low": nan}
        return {**columns, "failure_high": nan, "worst_robustness": worst, "verdict": ""}
    return {
        "failures": certificate.failures + certificate.not_finite,
        "simulations": certificate.simulations, "failure_rate": rate.estimate,
        "failure_low": rate.low, "failure_high": rate.high,
        "worst_robustness": certificate.worst_robustness, "verdict": certificate.verdict,
    }  # fmt: skip


def _hyperparameter_column(entries: Sequence[object]) -> Shaped[np.ndarray, " rows"]:
    """Make a column of hyper-parameters: numbers stay numbers, all else becomes text."""
    kinds = {type(entry) for entry in entries}
    if kinds == {bool}:
        return np.array(entries, bool)
    if kinds == {int}:
        return np.array(entries, np.int64)
    if kinds and kinds <= {int, float}:
        return np.array(entries, np.float64)
    return np.array([str(entry) for entry in entries], object)
