"""Rows of the error table, made of the verdicts of a round."""

import numpy as np
from jaxtyping import Bool

from verifai_jax.core.trace import Status
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem

STATUS_NAMES = np.array([status.name.lower() for status in Status], dtype=object)


def rows_of(
    problem: Problem, verdicts: Verdicts, differentiates: bool = False
) -> dict[str, np.ndarray]:
    """Return the columns of the table, as the rows are before they are confirmed.

    **Arguments:**

    - `problem`: whose features and formulas name columns.
    - `verdicts`: the verdicts of a round, with features.
    - `differentiates`: whether clauses are differentiated in some rounds; the rows then say in
      which.
    """
    count = len(verdicts.status)
    assert verdicts.features is not None
    columns: dict[str, np.ndarray] = {**problem.space.rows(verdicts.features)}
    # Adding 0 makes a robustness of -0 one of 0.
    columns["rho"] = verdicts.lowest + 0.0
    if len(problem.formulas) > 1:
        for i, name in enumerate(problem.formulas):
            columns[f"rho.{name}"] = verdicts.rho[:, i] + 0.0
    columns |= {"violated": verdicts.violated, "status": STATUS_NAMES[verdicts.status]}
    if verdicts.gradient is not None:
        columns["gradient_finite"] = np.all(np.isfinite(verdicts.gradient), axis=1)
    if differentiates:
        clause_gradients = verdicts.clause_gradients
        columns["differentiated"] = np.full(count, clause_gradients is not None)
        columns["gradient_finite"] = (
            np.ones(count, bool)
            if clause_gradients is None
            else np.all(np.isfinite(clause_gradients), axis=(1, 2))
        )
    if verdicts.messages is not None:
        columns["message"] = np.array(verdicts.messages, dtype=object)
    return columns


def without_failure(verdicts: Verdicts, rows: Bool[np.ndarray, " n"]) -> Verdicts:
    """Raise the clauses of these rows until they are not broken."""
    if verdicts.clauses is None or not rows.any():
        return verdicts
    lift = np.where(rows, 1e-6 - np.max(verdicts.clauses, axis=1), 0.0)
    return verdicts._replace(clauses=verdicts.clauses + lift[:, None])
