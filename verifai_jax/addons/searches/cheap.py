"""Rows of a cheap model, with which a run of a slow model of the same features begins.

check_same_features(slow, cheap)
rows = gravest_rows(run_of_cheap, 16)               # features to simulate first
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem, ProblemError

if TYPE_CHECKING:
    import pandas as pd
TIMES, MAX_CHEAP = 20, 50_000
"""Simulations of a cheap model for each simulation of the slow one, and their maximum."""
MAX_ROWS = 16
"""Maximum number of rows that a cheap model proposes; further failures would be similar."""
MAX_CANDIDATES = 4096
"""Maximum number of candidates: the rows of the cheap run with the lowest robustness."""
LOWEST = 0.02
"""Share of the rows that are candidates if fewer rows fail."""


def check_same_features(slow: Problem, cheap: Problem) -> None:
    """Check that two problems have the same features.

    **Raises:** `TypeError` for an argument that is not a problem; `ProblemError` that names the
    first feature in which they differ.
    """
    if not isinstance(cheap, Problem):
        raise TypeError(f"cheap must be a Problem; got {type(cheap).__name__}")
    ours, theirs = slow.space.domains, cheap.space.domains
    for name in dict.fromkeys((*ours, *theirs)):
        one, other = ours.get(name), theirs.get(name)
        if one != other:
            there = "missing" if other is None else repr(other)
            here = "missing" if one is None else repr(one)
            raise ProblemError(
                f"a cheap model has the same features as the slow one; {name} is {here}, and in "
                f"the cheap one {there}"
            )
    if list(ours) != list(theirs):
        raise ProblemError("a cheap model has its features in the same order as the slow one")


def budget_for(budget: int) -> int:
    """Return the number of simulations of a cheap model from the budget of the slow one."""
    return min(TIMES * budget, MAX_CHEAP)


def gravest_rows(run: Run, cheap: Problem, budget: int) -> "pd.DataFrame":
    """Choose rows of a run: its gravest failure, then failures far from the chosen ones.

    If few rows fail, those with the lowest robustness are used as well.

    **Arguments:**
    - `run`, `cheap`: the run of the cheap model, and the model.
    - `budget`: simulations of the slow model; at most a quarter of them go to these rows.
    """
    count = max(1, min(budget // 4, MAX_ROWS))
    space = cheap.space
    rows: Any = run.table.all.dropna(subset=["rho"]).sort_values("rho", kind="stable")
    failing = int(np.sum(rows["violated"].to_numpy(bool)))
    wanted = max(failing, int(LOWEST * len(rows)), count)
    candidates = rows.iloc[: min(wanted, MAX_CANDIDATES)]
    points: Float[np.ndarray, "n d"] = space.points(candidates)
    chosen = [0]
    gaps = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)) and gaps.max() > 0:
        chosen.append(int(gaps.argmax()))
        gaps = np.minimum(gaps, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return candidates.iloc[chosen][list(space.columns)]
