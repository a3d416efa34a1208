"""The rows of a sweep's table as columns, in the order and types that `SweepRecord` promises."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from verifai_jax.addons.estimation.certification.result import Certificate
from verifai_jax.addons.training.sweeps.curves import curve_robustness
from verifai_jax.addons.training.sweeps.record import AFTER, BEFORE
from verifai_jax.addons.training.sweeps.study import Study
from verifai_jax.addons.training.sweeps.training_runs import RunCheckpoint

_INTEGERS = {"configuration", "seed", "steps", "failures", "simulations"}
_TEXTS = {"status", "verdict"}


class Row(NamedTuple):
    """One policy, or a training run without one: its cells by column, but those of training and
    certificate; its `entry`, the numbers of run and checkpoint; the run there, None if it did not
    train; the certificate, None without one.
    """

    cells: Mapping[str, Any]
    entry: tuple[int, int]
    checkpoint: RunCheckpoint | None = None
    safety: Certificate | None = None


def columns_and_policies(rows: Sequence[Row], study: Study) -> dict[str, Any]:
    """Return the fields of a `SweepRecord` that its rows say."""
    names = [n for n in study.space.columns if n not in BEFORE]
    cells = [_cells(row, study) for row in rows]
    columns: dict[str, np.ndarray] = {}
    for name in (*BEFORE, *names, *AFTER):
        entries = [cell[name] for cell in cells]
        if name in names:
            columns[name] = _hyperparameter_column(entries)
        else:
            kind = np.int64 if name in _INTEGERS else object if name in _TEXTS else np.float64
            columns[name] = np.array(entries, kind)
    return {
        "columns": columns,
        "policies": tuple(
            row.checkpoint.policy if row.checkpoint is not None and row.checkpoint.finite else None
            for row in rows
        ),
        "worst": tuple(None if row.safety is None else row.safety.worst_features for row in rows),
        # The last checkpoint of a run has the longest curve.
        "curves": {
            (row.cells["configuration"], row.cells["seed"]): row.checkpoint.curve
            for row in rows
            if row.checkpoint is not None
        },
    }


def _cells(row: Row, study: Study) -> dict[str, Any]:
    trained, curve = row.checkpoint, float("nan")
    if study.curve_formula is not None and trained is not None:
        curve = curve_robustness(study.curve_formula, *trained.curve)
    return {
        **row.cells, **columns_of(row.safety), "curve_robustness": curve,
        "training_return": np.nan if trained is None else trained.training_return,
        "training_seconds": np.nan if trained is None else trained.seconds,
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
