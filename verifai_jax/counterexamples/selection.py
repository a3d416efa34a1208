"""The selection of a counterexample of a run, and of others next to it."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from jaxtyping import Float

from verifai_jax.counterexamples.nominal import Likeliest, Nominal
from verifai_jax.evaluation.backends import resolved
from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem

Row: TypeAlias = int | np.integer | pd.Series | Mapping[str, Any] | None
"""A row of a table by its number, itself, or as a mapping of its columns; None if left out."""


def problem_of(run: Run) -> Problem:
    """Return the problem of a run, on the backend on which it ran.

    **Raises:** `TypeError` for anything but a run; `ValueError` for a run without its problem.
    """
    if not isinstance(run, Run):
        raise TypeError(f"a run of falsify is needed; got {type(run).__name__}")
    if run.problem is None:
        raise ValueError(
            f"the run of {run.name!r} was loaded without its problem; "
            "give it: vj.load(path, problem)"
        )
    return resolved(run.problem, wanted=run.backend).problem


def select_row(run: Run, row: Row) -> tuple[int, dict[str, Any]]:
    """Select a counterexample of a run.

    **Arguments:**
    - `run`: a run with a counterexample.
    - `row`: its number, or a row of the table; the worst if None.
    **Returns:** its number, and the entries of its row by column.
    **Raises:** `ValueError` for a run without a counterexample, or a row that is not one;
    `TypeError` or `IndexError` for anything that is not a row of the table.
    """
    failing = run.table.counterexamples
    if not len(failing) and (row is None or not run.table.counts.violating):
        raise ValueError(
            f"the run of {run.name!r} has no counterexample in {run.simulations} simulations"
            + "; name a row of run.table.unconfirmed" * (run.table.counts.violating > 0)
        )
    number = failing["rho"].idxmin() if row is None else getattr(row, "name", row)
    if isinstance(number, bool) or not isinstance(number, int | np.integer):
        raise TypeError(f"row must be the number of a row of the table; got {row!r}")
    number = int(number)
    entry = {str(name): value for name, value in run.table.row(number).items()}
    # A row that was not confirmed is none that the run claims; it may be asked for all the same.
    if number not in failing.index and not bool(entry.get("violated", False)):
        some = ", ".join(map(str, failing.index[:5]))
        raise ValueError(
            f"row {number} is not a counterexample: status {entry['status']}, robustness "
            f"{entry['rho']:z.4g}; counterexamples are {some}{', ...' * (len(failing) > 5)}"
        )
    return number, entry


def select_others(
    run: Run, nominal: Nominal, number: int, maximum: int
) -> Float[np.ndarray, "n d"]:
    """Return the points of at most `maximum` counterexamples other than row `number`.

    If there are more, half of them are the nearest, and the rest is spread over the others.
    """
    failing = run.table.counterexamples
    failing = failing.loc[failing.index != number]
    if not len(failing):
        return np.zeros((0, nominal.space.dim), np.float32)
    if isinstance(nominal, Likeliest):
        away = -run.improbability(failing)["log_density"].to_numpy()
    else:
        away = _rough_distance(nominal, failing)
    order = np.argsort(away, kind="stable")
    if len(order) > maximum:
        half = maximum // 2
        rest = np.linspace(half, len(order) - 1, maximum - half).astype(int)
        order = np.concatenate([order[:half], order[rest]])
    return nominal.settle(nominal.space.points(failing.iloc[order]))


def _rough_distance(nominal: Nominal, rows: pd.DataFrame) -> Float[np.ndarray, " n"]:
    """Estimate how far rows are from nominal from the table, since points take time to compute."""
    columns = nominal.space.rows(nominal.space.features_at(nominal.u[None]))
    total = np.zeros(len(rows))
    for name, value in columns.items():
        entries = rows[name].to_numpy()
        if entries.dtype.kind in "iuf" and value.dtype.kind in "iuf":
            spread = np.nanstd(entries) or 1.0
            total += np.nan_to_num((entries - value[0]) / spread) ** 2
        else:
            total += entries != value[0]
    return total


def columns_at(problem: Problem, u: Float[np.ndarray, " d"]) -> dict[str, Any]:
    """Return the row of a table with the features at a point."""
    columns = problem.space.rows(problem.space.features_at(u[None]))
    return {name: column[0] for name, column in columns.items()}
