"""Where a search begins: given features, an earlier run, a cheap model, or a proof.

falsify(problem, Start(rows=worst))                 # simulated before the search proposes any
falsify(problem, Start("cross_entropy", run=earlier))
falsify(slow, Start(cheap=quick)); falsify(problem, Start(proved=result))
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from verifai_jax.core.messages.errors import check_names
from verifai_jax.falsification.proof import Proof
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.features.given import check_columns
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

    from verifai_jax.features.given import Rows


@dataclass(frozen=True, eq=False)
class Start:
    """A search that does not begin from nothing.

    - `search`: the search, as in `falsify`.
    - `rows`: features that are simulated before the search proposes any, in the form that
      `simulate` takes. A search that learns observes them. They count in the budget, and the run
      then has no failure rate.
    - `run`: an earlier run or table with the same features; a search that learns starts from its
      rows. They are not copied.
    - `cheap`: a cheap model of the same features. It is searched first, with 20 times the budget;
      at most a quarter of the budget is spent on its failures. Only the problem decides what fails.
    - `proved`: the result of `verify` for this problem, or its file. The run searches only the part
      that is not proved, `proved.rest(problem)`, and is resumed with that problem. A search that
      learns first simulates the points where the bounds of the robustness are lowest, with at most
      an eighth of the budget, unless `rows` are given.

    **Raises:** `ValueError` for both rows and a cheap model.
    """

    search: "str | Search" = "auto"
    rows: "Rows | np.ndarray | None" = None
    run: "Run | ErrorTable | pd.DataFrame | None" = None
    cheap: Problem | None = None
    proved: "Proof | str | Path | None" = None

    def __post_init__(self) -> None:
        if self.cheap is not None and self.rows is not None:
            raise ValueError("give either rows, or a cheap model that finds what comes first")

    def earlier(self, problem: Problem) -> "pd.DataFrame | None":
        """Return the rows of the earlier run as a DataFrame with the columns needed here.

        **Raises:** `TypeError` for anything else than a run or a table; `ValueError` for a table of
        another space.
        """
        if self.run is None:
            return None
        table = self.run.table if isinstance(self.run, Run) else self.run
        frame = table.all if isinstance(table, ErrorTable) else table
        columns = getattr(frame, "columns", None)
        if columns is None:
            raise TypeError(
                f"run of vj.Start must be a run, an error table or a DataFrame; got {frame!r}"
            )
        check_names("column of the earlier run", (*problem.space.columns, "rho"), map(str, columns))
        try:
            rows = cast("pd.DataFrame", frame)
            check_columns(problem.space, {str(name): rows[name] for name in columns}, held=False)
        except ValueError as error:
            raise ValueError(f"the earlier run does not fit this space: {error}") from error
        return cast("pd.DataFrame", frame)
