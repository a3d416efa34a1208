"""The rows of a sweep's table as columns, in the order and types that `SweepRecord` promises."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from verifai_jax.sweeps.curves import judge_curve
from verifai_jax.sweeps.record import AFTER, BEFORE, Curve
from verifai_jax.sweeps.safety import Judged
from verifai_jax.sweeps.study import Study
from verifai_jax.sweeps.training_runs import Reached


@dataclass(frozen=True, eq=False)
class Row:
    """One policy, or what became of it. `place` is its training and snapshot."""

    configuration: int
    seed: int
    steps: int
    values: Mapping[str, Any]
    status: str
    place: tuple[int, int]
    reached: Reached | None = None
    nominal_return: float = float("nan")
    judged: Judged | None = None


def tabulated(rows: Sequence[Row], study: Study) -> dict[str, Any]:
    """The parts of a `SweepRecord` that go row by row: columns, policies, worst, curves."""
    names = [n for n in study.space.columns if n not in BEFORE]
    whole = {"configuration", "seed", "steps", "failures", "simulations"}
    texts = {"status", "verdict"}
    cells = [_cells(row, study) for row in rows]
    columns: dict[str, np.ndarray] = {}
    for name in (*BEFORE, *names, *AFTER):
        entries = [cell[name] for cell in cells]
        if name in whole:
            columns[name] = np.array(entries, np.int64)
        elif name in texts:
            columns[name] = np.array(entries, object)
        elif name in names:
            columns[name] = _values(entries)
        else:
            columns[name] = np.array(entries, np.float64)
    curves: dict[tuple[int, int], Curve] = {}
    for row in rows:
        # The longest comes last.
        if row.reached is not None:
            curves[row.configuration, row.seed] = row.reached.curve
    return {
        "columns": columns,
        "policies": tuple(
            row.reached.policy if row.reached is not None and row.reached.finite else None
            for row in rows
        ),
        "worst": tuple(None if row.judged is None else row.judged.features for row in rows),
        "curves": curves,
    }


def _cells(row: Row, study: Study) -> dict[str, Any]:
    nan, reached, judged = float("nan"), row.reached, row.judged
    curve = nan
    if study.curve_formula is not None and reached is not None:
        curve = judge_curve(study.curve_formula, *reached.curve)
    return {
        **row.values,
        "configuration": row.configuration,
        "seed": row.seed,
        "steps": row.steps,
        "status": row.status,
        "training_return": nan if reached is None else reached.training_return,
        "nominal_return": row.nominal_return,
        "failures": 0 if judged is None else judged.failures,
        "simulations": 0 if judged is None else judged.simulations,
        "failure_rate": nan if judged is None else judged.rate,
        "failure_low": nan if judged is None else judged.low,
        "failure_high": nan if judged is None else judged.high,
        "worst_robustness": nan if judged is None else judged.worst,
        "verdict": "" if judged is None else judged.verdict,
        "curve_robustness": curve,
        "training_seconds": nan if reached is None else reached.seconds,
    }


def _values(entries: list[Any]) -> np.ndarray:
    """A column of hyper-parameters: numbers as numbers, all else as text."""
    kinds = {type(entry) for entry in entries}
    if kinds == {bool}:
        return np.array(entries, bool)
    if kinds == {int}:
        return np.array(entries, np.int64)
    if kinds and kinds <= {int, float}:
        return np.array(entries, np.float64)
    return np.array([str(entry) for entry in entries], object)
