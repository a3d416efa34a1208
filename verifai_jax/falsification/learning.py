"""The proposals of a run's search, and its learning from simulations.

    learning = Learning(problem, search, key)
    learning.begin(batch=32)                            # once its programs are being compiled
    points = learning.proposals.next(32)
    learning.learn(Batch(points, "search"), objective, verdicts, coverage_ids)

A search minimises the robustness of the worst formula or, for formulas with a priority, the number
of `problem.rulebook.Objective`; a guide adds its term. Some searches also need coverage ids,
traces, or a model of the traces (`TraceProposer`).
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int, Key

from verifai_jax.evaluation.guidance import Guidance
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.rulebook import Objective
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals

if TYPE_CHECKING:
    import pandas as pd

    from verifai_jax.falsification.coverage_counts import CoverageCounts
    from verifai_jax.falsification.likelihood import Likelihood
    from verifai_jax.search.base import TraceProposer
MAX_WARM = 2048
"""Rows of an earlier table that a search starts with at most, the worst ones: a bound on what the
first `tell` costs, whatever the length of that table."""
Source = Literal["search", "first"]
"""The origin of a round's points: the search, or the user before the run."""


class Batch(NamedTuple):
    """The points of a round.

    - `points`: the points of the unit cube, or rows of given features (`given_rows`).
    - `source`: the origin of the points.
    - `cut`: whether the budget cut the round.
    - `verdicts`: verdicts of the points, if workers have simulated them already.
    """

    points: Float[Any, "n row"]
    source: Source
    cut: bool = False
    verdicts: Verdicts | None = None

    @property
    def given(self) -> bool:
        """True if a person gave the points."""
        return self.source != "search"


class Learning:
    """The search of a run with all that it has learned; see the module's docstring.

    **Arguments:**
    - `problem`: the problem of the run.
    - `search`: the search of the run.
    - `key`: the key of the search.

    `surrogate` models the traces if the search wants that; `coverage_ids` counts covered items.
    """

    def __init__(self, problem: Problem, search: Search, key: Key[Array, ""]) -> None:
        self.problem, self.search, self._key = problem, search, key
        guided = problem.guide is not None and search.learns
        self.guidance = Guidance(guide=guided, outcome=search.wants.outcomes)
        self.coverage_ids: CoverageCounts | None = None
        if search.wants.coverage_ids:
            from verifai_jax.falsification import coverage_counts

            self.coverage_ids = coverage_counts.CoverageCounts(problem)
        self.surrogate: TraceProposer | None = None
        self._objective: Objective | None = None
        self._likelihood: Likelihood | None = None
        if search.wants.likelihood:
            from verifai_jax.falsification import likelihood

            self._likelihood = likelihood.Likelihood(problem.space)
        elif problem.rulebook is not None:
            self._objective = Objective(problem.rulebook)
        self.proposals: Any = None
        self.take(search)

    def take(self, search: Search) -> None:
        """Use this search from now on."""
        self.search = search
        if search.wants.traces is not None:
            self.surrogate = search.wants.traces.trace_model(self.problem, self._key)

    @property
    def coverage_id_count(self) -> int:
        """Maximum number of coverage ids of a row; 0 if none are counted."""
        return 0 if self.coverage_ids is None else self.coverage_ids.width

    def begin(self, batch: int) -> None:
        """Start the search."""
        space = self.problem.space
        improve = None if self.surrogate is None else self.surrogate.improve
        self.proposals = Proposals(
            self.search, space.cube, batch, self._key, space.constraint, self.coverage_id_count,
            improve,
        )  # fmt: skip

    @property
    def distinct(self) -> int | None:
        """Failures that are far from each other, for a search for diverse failures; else None."""
        return self.proposals.distinct

    @property
    def acceptance(self) -> float | None:
        """Share of proposed points that satisfy the constraint; None without one."""
        if self.problem.space.where is None or self.proposals is None:
            return None
        return self.proposals.accepted / max(self.proposals.proposed, 1)

    def objective(self, verdicts: Verdicts) -> Float[np.ndarray, " n"]:
        """Return what the search minimises; with a priority it depends on earlier rows."""
        if self._objective is None:
            return verdicts.lowest
        return self._objective(verdicts.rho, verdicts.rho < 0)

    def learn(
        self, batch: Batch, objective: Float[np.ndarray, " n"], verdicts: Verdicts,
        coverage_ids: Int[np.ndarray, "n ids"] | None,
    ) -> None:  # fmt: skip
        """Let the search learn from a round.

        **Arguments:**
        - `batch`: the points of the round, in the unit cube.
        - `objective`: the number at each point that the search minimises.
        - `verdicts`: the verdicts of its simulations.
        - `coverage_ids`: the coverage of its simulations, for a search that wants them.
        """
        outcomes = None
        if verdicts.guidance is not None:
            if self.guidance.guide:
                objective = self._with_guide(objective, verdicts.guidance[:, 0])
            if self.guidance.outcome:
                outcomes = verdicts.guidance[:, int(self.guidance.guide) :]
        if self._likelihood is not None:
            points = np.asarray(batch.points)
            objective, verdicts = self._likelihood.learned(points, objective, verdicts)
        if batch.given:
            self._learn_given(batch, objective, verdicts, outcomes)
        else:
            self._tell(objective, verdicts, coverage_ids, outcomes)
        if self.surrogate is not None:
            self.surrogate.learn(batch.points, verdicts)

    def _learn_given(
        self, batch: Batch, objective: Float[np.ndarray, " n"], verdicts: Verdicts,
        outcomes: Float[np.ndarray, "n outcome"] | None,
    ) -> None:  # fmt: skip
        """Let the search learn from points that a person gave."""
        self.proposals.remember(batch.points)
        proper = verdicts.proper
        points, rho = batch.points[proper], objective[proper].astype(np.float32)
        self.proposals.warm_start(points, rho, None if outcomes is None else outcomes[proper])

    def _tell(
        self, objective: Float[np.ndarray, " n"], verdicts: Verdicts,
        coverage_ids: Int[np.ndarray, "n ids"] | None,
        outcomes: Float[np.ndarray, "n outcome"] | None,
    ) -> None:  # fmt: skip
        """Pass the results of its points to the search, always in float32."""

        def single(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else values.astype(np.float32)

        self.proposals.tell(
            objective.astype(np.float32), verdicts.proper, single(verdicts.gradient),
            single(verdicts.clauses), single(verdicts.clause_gradients), coverage_ids, outcomes,
        )  # fmt: skip

    def _with_guide(
        self, rho: Float[np.ndarray, " n"], value: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Return the objective with the term of the guide, if there is one."""
        guide = self.problem.guide
        return rho if guide is None or not self.guidance.guide else guide.steer(rho, value)

    def warm(self, table: "pd.DataFrame") -> None:
        """Let the search learn from the rows of an earlier table."""
        proper = table.loc[table["status"] == "ok"] if "status" in table else table
        proper = proper.loc[np.isfinite(proper["rho"].to_numpy(np.float64))]
        if len(proper) > MAX_WARM:
            proper = proper.loc[proper["rho"].nsmallest(MAX_WARM).index.sort_values()]
        if not len(proper):
            return
        rho = proper["rho"].to_numpy(np.float32)
        names = [f"rho.{name}" for name in self.problem.formulas]
        points = self.problem.space.points(proper)
        if self._likelihood is not None:
            rho = self._likelihood(points, rho, proper["rho"].to_numpy() < 0).astype(np.float32)
        elif self._objective is not None and all(name in proper for name in names):
            each = proper[names].to_numpy(np.float64)
            rho = self._objective(each, each < 0).astype(np.float32)
        # What the guide says of these rows is unknown; it counts as the least good.
        rho = self._with_guide(rho, np.full(len(rho), np.nan, np.float32))
        self.proposals.warm_start(points, rho)

    def checkpoint(self) -> dict[str, Any]:
        """Return what was learned as entries of a checkpoint, without the search's state."""
        weighed = self._likelihood or self._objective
        state = {} if weighed is None else weighed.state
        entries: dict[str, Any] = {f"objective.{name}": value for name, value in state.items()}
        for part in (self.surrogate, self.coverage_ids):
            entries |= {} if part is None else part.checkpoint()
        return entries

    def restore(self, checkpoint: Mapping[str, Any]) -> None:
        """Continue from a checkpoint.

        **Raises:** `ValueError` for a checkpoint of another search, space or batch size.
        """
        self.proposals.restore(checkpoint)
        weighed = self._likelihood or self._objective
        if weighed is not None:
            weighed.state = {name: checkpoint[f"objective.{name}"] for name in weighed.state}
        for part in (self.surrogate, self.coverage_ids):
            if part is not None:
                part.restore(checkpoint)
