"""The state of a run between its rounds, and one round: propose, simulate, judge, tell, store.

A round leaves everything in step: the table, the search and the counts. What `snapshot` gives after
a round is enough to go on from there, whatever happened since.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from verifai_jax.core.keys import run_keys
from verifai_jax.core.trace import Status
from verifai_jax.evaluation.confirmation import Confirmer
from verifai_jax.evaluation.engine import Evaluation, engine_for
from verifai_jax.evaluation.evaluator import violated
from verifai_jax.evaluation.host_engine import HostEngine
from verifai_jax.evaluation.journal import Journal
from verifai_jax.falsification.checkpoint import write_snapshot
from verifai_jax.falsification.table import NOT_CLAIMED, ErrorTable
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.rulebook import Objective
from verifai_jax.search import Diverse, Search
from verifai_jax.search.proposals import Proposals

if TYPE_CHECKING:
    import pandas as pd

STATUS_NAMES = np.array([status.name.lower() for status in Status], dtype=object)
MOST_SLOPES = 16
"""Rows with slopes in one call of the engine."""
MOST_WARM = 2048
"""Rows of an earlier table at most that a search starts with; the worst of a longer one."""


class Rounds:
    """The rounds of one run; `compile` first, then `advance` as often as wanted.

    `found` counts the counterexamples and `judged` the simulations with a verdict; `best` is the
    least robustness.
    """

    def __init__(
        self,
        problem: Problem,
        search: Search,
        batch: int,
        seed: int,
        table: ErrorTable,
        precision: str = "float32",
        folder: Path | None = None,
        confirm: bool = False,
    ) -> None:
        self.problem, self.search, self.batch, self.table = problem, search, batch, table
        self.precision, self.folder = precision, folder
        self._journal = Journal(folder) if folder is not None and problem.black_box else None
        self.engine = (
            HostEngine(problem, precision, self._journal)
            if problem.black_box
            else engine_for(
                problem, batch, search.wants_gradient, precision, clauses=search.wants_clauses
            )
        )
        # Slopes are wanted of few points at a time, and now and then: compiled when they are.
        self._slopes_engine = (
            engine_for(problem, min(batch, MOST_SLOPES), True, precision, clauses=True)
            if search.wants_clauses
            else None
        )
        self.search_key, self.simulation_key = run_keys(seed)
        self.found = self.judged = 0
        self.best = float("nan")
        self.compile_seconds = 0.0
        self.snapshot: dict[str, Any] = {}
        self._confirmer = Confirmer(problem, precision, seed) if confirm else None
        self._objective = None if problem.rulebook is None else Objective(problem.rulebook)
        self._proposals: Any = None
        self._saved = time.perf_counter()

    def compile(self) -> None:
        """Compile the engine and the search."""
        self.engine.compile()
        self._proposals = Proposals(
            self.search,
            self.problem.space.cube,
            self.batch,
            self.search_key,
            self.problem.space.constraint,
        )
        self._keep()

    @property
    def confirms(self) -> bool:
        """Whether only what closer replays confirm is claimed."""
        return self._confirmer is not None

    @property
    def distinct(self) -> int:
        """Counterexamples found, of a search for diverse ones those far from each other."""
        if isinstance(self.search, Diverse):
            return self._proposals.distinct
        return self.found

    @property
    def notes(self) -> tuple[str, ...]:
        """What the engines decided by themselves and would surprise."""
        slopes = () if self._slopes_engine is None else self._slopes_engine.notes
        return (*self.engine.notes, *slopes)

    @property
    def exhausted(self) -> bool:
        """Whether a finite search has come to its end."""
        return self._proposals.exhausted

    @property
    def acceptance(self) -> float | None:
        """Share of proposed points that the constraint let through; None without one."""
        if self.problem.space.where is None or self._proposals is None:
            return None
        return self._proposals.accepted / max(self._proposals.asked, 1)

    def advance(self, most: int) -> None:
        """Ask, evaluate, tell and store at most `most` simulations."""
        first = len(self.table)
        points = self._proposals.next(most)
        if not len(points):
            self._proposals.tell_refused()
            self._keep()
            return
        evaluation = self._evaluated(points, first)
        violated = self._violated(evaluation, points, first)
        rho = np.min(evaluation.rho, axis=1)
        proper = evaluation.status == Status.OK
        columns = self._columns(evaluation, rho, violated)
        told = rho
        if self._objective is not None:
            told = self._objective(evaluation.rho, evaluation.rho < 0)
        claimed = violated
        if self._confirmer is not None:
            verdict, held = self._confirmed(self._confirmer, columns, first)
            columns["verdict"] = verdict
            claimed = violated & ~np.isin(verdict, NOT_CLAIMED)
            # A search that took them for failures would stay with them.
            told = np.where(violated & ~claimed, held, told)
            evaluation = _raised(evaluation, violated & ~claimed)
        gradient = evaluation.gradient
        self._proposals.tell(
            told.astype(np.float32),  # Searches compute in float32, whatever the simulations do.
            proper,
            None if gradient is None else gradient.astype(np.float32),
            None if evaluation.clauses is None else evaluation.clauses.astype(np.float32),
            None if evaluation.slopes is None else evaluation.slopes.astype(np.float32),
        )
        self.table.append(columns)
        self.found += int(np.sum(claimed))
        self.judged += int(np.sum(proper))
        self.best = float(np.fmin(self.best, np.fmin.reduce(rho)))
        self._keep()

    def _confirmed(
        self, confirmer: Confirmer, columns: dict[str, Any], first: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """The verdict of each row, empty where nothing is violated, and what speaks against it.

        That is the greatest robustness of the replays, and no less than next to nothing.
        """
        rows = np.flatnonzero(columns["violated"])
        verdict = np.full(len(columns["rho"]), "", object)
        held = np.full(len(verdict), np.nan)
        if not len(rows):
            return verdict, held
        if not confirmer.finer:
            # To simulate it again may take as long as the run, and would say little.
            verdict[rows] = "unchecked"
            return verdict, held
        own = {name: column[rows] for name, column in columns.items()}
        checked = confirmer(own, first + rows)
        verdict[rows] = checked.verdict
        if checked.rho:
            greatest = np.nanmax(np.stack([*checked.rho.values(), own["rho"]]), axis=0)
            held[rows] = np.maximum(greatest, 1e-6)
        return verdict, held

    def _evaluated(self, points: Any, first: int) -> Evaluation:
        temperature = self._proposals.temperature
        if self._slopes_engine is None or not self._proposals.differentiate:
            if self._slopes_engine is not None:
                temperature = 1.0  # Nothing is differentiated.
            return self.engine.evaluate(points, self.simulation_key, first, temperature)
        engine = self._slopes_engine
        compiled = engine.compile_seconds
        parts = [
            engine.evaluate(
                points[start : start + engine.batch],
                self.simulation_key,
                first + start,
                temperature[start : start + engine.batch],
            )
            for start in range(0, len(points), engine.batch)
        ]
        self.compile_seconds += engine.compile_seconds - compiled
        if len(parts) == 1:
            return parts[0]
        # Messages and Boolean verdicts are those of black boxes, which have no slopes.
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    def warm(self, table: "pd.DataFrame") -> None:
        """Let the search learn from the rows of an earlier table."""
        proper = table.loc[table["status"] == "ok"] if "status" in table else table
        proper = proper.loc[np.isfinite(proper["rho"].to_numpy(np.float64))]
        if len(proper) > MOST_WARM:
            proper = proper.loc[proper["rho"].nsmallest(MOST_WARM).index.sort_values()]
        if not len(proper):
            return
        rho = proper["rho"].to_numpy(np.float32)
        names = [f"rho.{name}" for name in self.problem.formulas]
        if self._objective is not None and all(name in proper for name in names):
            each = proper[names].to_numpy(np.float64)
            rho = self._objective(each, each < 0).astype(np.float32)
        self._proposals.warm_start(self.problem.space.points(proper), rho)
        self._keep()

    def save(self, seldom: bool = False) -> None:
        """Write the snapshot to the folder; if `seldom`, only when the last one is a second old.

        **Raises:** `OSError` where it cannot be written.
        """
        now = time.perf_counter()
        if self.folder is None or (seldom and now - self._saved < 1.0):
            return
        self._saved = now
        write_snapshot(self.snapshot, self.folder)
        if self._journal is not None:
            # Only now: rows of the table that the snapshot does not know are simulated again.
            self._journal.settle(int(self.snapshot.get("rows", 0)))

    def _restore_confirmer(self, snapshot: Mapping[str, Any]) -> None:
        if self._confirmer is not None and "confirmer" in snapshot:
            examined, band = snapshot["confirmer"]
            self._confirmer.examined, self._confirmer.band = int(examined), float(band)

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on where `snapshot` was taken; the table must hold its rows already.

        **Raises:** `ValueError` for a snapshot of another search, space or batch size.
        """
        self._proposals.restore(snapshot)
        self._restore_confirmer(snapshot)
        if self._objective is not None:
            names = self._objective.state
            self._objective.state = {name: snapshot[f"objective.{name}"] for name in names}
        table = self.table.all
        self.judged = len(table) - len(self.table.failed)
        self.found = len(self.table.counterexamples)
        self.best = float(np.fmin.reduce(table["rho"].to_numpy(), initial=np.nan))
        self._keep()

    def _keep(self) -> None:
        """Take the snapshot: nothing is copied, as nothing in it is ever written to."""
        objective = {} if self._objective is None else self._objective.state
        self.snapshot = {
            **self._proposals.snapshot(),
            **{f"objective.{name}": value for name, value in objective.items()},
            "rows": np.array(len(self.table)),
        }
        if self._confirmer is not None:
            seen = self._confirmer
            self.snapshot["confirmer"] = np.array([seen.examined, seen.band], np.float64)

    def _violated(self, evaluation: Evaluation, points: Any, first: int) -> np.ndarray:
        compiled = getattr(self.engine, "compile_seconds", 0.0)
        found = violated(self.engine, evaluation, points, self.simulation_key, first)
        self.compile_seconds += getattr(self.engine, "compile_seconds", 0.0) - compiled
        return found

    def _columns(self, evaluation: Evaluation, rho: Any, violated: Any) -> dict[str, Any]:
        columns: dict[str, Any] = {**self.problem.space.rows(evaluation.features), "rho": rho}
        if len(self.problem.formulas) > 1:
            for i, name in enumerate(self.problem.formulas):
                columns[f"rho.{name}"] = evaluation.rho[:, i]
        columns |= {"violated": violated, "status": STATUS_NAMES[evaluation.status]}
        if evaluation.gradient is not None:
            columns["gradient_finite"] = np.all(np.isfinite(evaluation.gradient), axis=1)
        if self._slopes_engine is not None:
            slopes, count = evaluation.slopes, len(rho)
            columns["differentiated"] = np.full(count, slopes is not None)
            columns["gradient_finite"] = (
                np.ones(count, bool) if slopes is None else np.all(np.isfinite(slopes), axis=(1, 2))
            )
        if evaluation.messages is not None:
            columns["message"] = np.array(evaluation.messages, dtype=object)
        return columns


def _raised(evaluation: Evaluation, rows: np.ndarray) -> Evaluation:
    """The same with clauses that are not broken in these rows."""
    if evaluation.clauses is None or not rows.any():
        return evaluation
    lift = np.where(rows, 1e-6 - np.max(evaluation.clauses, axis=1), 0.0)
    return evaluation._replace(clauses=evaluation.clauses + lift[:, None])
