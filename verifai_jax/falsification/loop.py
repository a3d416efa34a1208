"""The state of a run between its rounds, and one round: propose, simulate, confirm, learn, store.

    rounds = Rounds(problem, search, batch, seed, table, confirm=True)
    rounds.compile()
    while ...:
        rounds.advance(batch)

After a round the table, the search and the counts are consistent. The `checkpoint` after a round is
enough to continue from there.
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from verifai_jax.core.compute.compilation import while_compiling
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.stopwatch import Stopwatch
from verifai_jax.evaluation.confirmations import Standing
from verifai_jax.evaluation.confirmer import Confirmer
from verifai_jax.evaluation.engine import Wanted
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.kept_work import present
from verifai_jax.evaluation.raising import Raising
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.falsification.columns import import_tables, rows_of, without_failure
from verifai_jax.falsification.counts import Tally
from verifai_jax.falsification.learning import Batch, Learning
from verifai_jax.falsification.run_folder import write_checkpoint
from verifai_jax.falsification.simulations import MEASURED, Simulations
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.search.search_program import compiled_search, compiled_start

if TYPE_CHECKING:
    import pandas as pd

    from verifai_jax.core.compute.executors import Executor
    from verifai_jax.falsification.prefetch import Prefetch
COMPILE, SEARCH, SIMULATE, CONFIRM, REST = "compile", "search", "simulate", "confirm", "rest"
"""Activities by which the seconds of a run are counted."""


class Rounds:
    """The rounds of one run; call `compile` first, then `advance` as often as wanted.

    `first` are rows of given features (`given_rows`) that are simulated before the search proposes
    any. `record_checksum` is the checksum of the run's record, for the checkpoints.
    `only_budget_ends` is true if nothing but the budget can end the run. `checks` names the closer
    replays that were made. `watch` measures seconds: `COMPILE`; `SEARCH`, for proposals and
    learning; `SIMULATE`, including adding rows to the table; `CONFIRM`. Other time is not counted
    here.
    """

    def __init__(
        self, problem: Problem, search: Search, batch: int, seed: int, table: ErrorTable,
        precision: str = "float32", folder: Path | None = None, confirm: bool = False,
        executor: "Executor | None" = None, first: Float[np.ndarray, "n row"] | None = None,
        engine: Wanted = "xla", budget: int = 0,
    ) -> None:  # fmt: skip
        self.problem, self.batch, self.table = problem, batch, table
        self.precision, self.folder = precision, folder
        self.first = np.zeros((0, problem.space.dim), np.float32) if first is None else first
        self.learning = Learning(problem, search, run_keys(seed)[0])
        self._journal = None
        if folder is not None and problem.black_box:
            from verifai_jax.evaluation.journal import Journal

            self._journal = Journal(folder)
        self._journal_without_traces()
        self._simulations = Simulations(
            problem, search, batch, seed, precision=precision, journal=self._journal,
            executor=executor, guidance=self.learning.guidance,
            keep_traces=self.learning.surrogate is not None,
            given=self.first.shape[1] > problem.space.dim,
            engine=engine, budget=budget,
        )  # fmt: skip
        self._confirmer = None
        if confirm:
            self._confirmer = Confirmer(problem, precision, seed, executor=executor)
        self.tally = Tally()
        self.stop_after = 0
        self.watch = Stopwatch(COMPILE)
        self.checks: tuple[str, ...] = ()
        self.chosen: tuple[str, ...] = ()
        self.checkpoint: dict[str, Any] = {}
        self.record_checksum = 0
        self._pending: Any = None  # Points of the first round that are proposed already.
        self._has_workers, self.only_budget_ends = executor is not None, False
        self._prefetch: Prefetch | None = None
        self._saved = time.perf_counter()
        self._raising = Raising()

    def compile(self, resumed: bool = False) -> None:
        """Compile the engine and the search, concurrently.

        - `resumed`: whether the run is resumed, so that its first round may be of any kind. A new
          run begins with gradients if the first stage of the search wants gradients of clauses.
        """
        cube = self.problem.space.cube
        while_compiling(import_tables, after=0.0)
        stage = self.search.stage(None, cube, self.batch)
        if stage.wants.clause_gradients and not resumed:
            # They take longest to compile.
            self._simulations.begin_derivatives()
        compiled_search(stage, cube, self.batch, self.learning.coverage_id_count)
        compiled_start(stage, cube, self.batch)
        self.evaluate.begin_compiling()
        if self._confirmer is not None:
            # Meanwhile; whatever fails will be replayed.
            self._confirmer.prepare()
        self.evaluate.compile()
        self.learning.begin(self.batch)
        self._keep()

    def advance(self, maximum: int, limit: int | None = None) -> None:
        """Propose, simulate, confirm, learn and store at most `maximum` simulations.

        - `limit`: simulations of the whole run; points up to there may be sent ahead to workers.
        """
        with self.watch.on(SIMULATE):
            batch = self._next_points(maximum, limit)
            if not len(batch.points):
                self.learning.proposals.tell_refused()
                self._keep()
                return
            verdicts = batch.verdicts
            if verdicts is None:
                verdicts = self._simulate(batch, len(self.table))
            self._take_in(batch, verdicts)
            if not (batch.cut and self.search.learns):
                # A larger budget goes on before a round that this one cut, with all of its points.
                self._keep()

    def _next_points(self, maximum: int, limit: int | None) -> Batch:
        """Return the points of the next round: given ones, then proposals."""
        # The number of rows alone says how many of them are still to come, so resuming goes on.
        done = len(self.table)
        given = self.first[done : done + maximum]
        if len(given):
            return Batch(given, "first", maximum < self.batch and len(self.first) > done + maximum)
        if self._prefetch is None:
            self._prefetch = self._begin_prefetching(done + maximum if limit is None else limit)
        if self._prefetch is not None:
            compiled = self._simulations.compile_seconds
            points, verdicts = self._prefetch.next()
            self.watch.move(self._simulations.compile_seconds - compiled, COMPILE)
            return Batch(points, "search", verdicts=verdicts)
        points, self._pending = self._pending, None
        if points is not None:
            return Batch(points, "search")
        self._begin_stage()
        with self._searching():
            points = self.learning.proposals.next(maximum)
        return Batch(points, "search", self.learning.proposals.cut)

    def _begin_prefetching(self, limit: int) -> "Prefetch | None":
        """Begin to simulate rounds ahead, up to so many rows, or return None to simulate in turn.

        In this process rounds are simulated in turn if the run may end before its budget, and if
        the thread that began keeps simulations for another process.
        """
        done, proposals = len(self.table), self.learning.proposals
        here = self.only_budget_ends and limit > done + self.batch and present() is None
        here = here and not self.problem.black_box
        if self.search.learns or not (self._has_workers or here):
            return None
        from verifai_jax.falsification.prefetch import Prefetch

        return Prefetch(proposals, self.evaluate, self.batch, limit, done, self._searching)

    def _simulate(self, batch: Batch, first: int) -> Verdicts:
        """Simulate the points of a round; `first` is the number of its first row in the run."""
        compiled, proposals = self._simulations.compile_seconds, self.learning.proposals
        verdicts = self._simulations(
            batch.points, first, differentiate=not batch.given and proposals.differentiate,
            temperature=1.0 if batch.given else proposals.temperature,
        )  # fmt: skip
        # A robustness of exactly zero compiles a program of its own.
        self.watch.move(self._simulations.compile_seconds - compiled, COMPILE)
        return verdicts

    def _take_in(self, batch: Batch, verdicts: Verdicts, *, learns: bool = True) -> None:
        """Confirm, learn from, store and count the simulations of a round.

        - `learns`: whether the search learns from them, which it need not after the last round.
        """
        self._raising.add(verdicts.status, verdicts.messages)
        if batch.given:
            # What follows knows points alone: the nearest ones.
            points = np.asarray(batch.points[:, : self.problem.space.dim], np.float32)
            batch = batch._replace(points=points)
        columns = rows_of(self.problem, verdicts, self._simulations.differentiates)
        coverage_ids, book = None, self.learning.coverage_ids
        if book is not None:
            coverage_ids = book.of(batch.points, verdicts)
            columns["new_coverage"] = book.add(coverage_ids)
            coverage_ids = book.of_kinds(coverage_ids)
        objective = self.learning.objective(verdicts)
        if self._confirmer is not None:
            objective = self._confirm(self._confirmer, columns, objective)
        stands = Standing.of(verdicts.violated, columns.get("verdict"))
        verdicts = without_failure(verdicts, stands.refused)
        if learns:
            with self._searching():
                self.learning.learn(batch, objective, verdicts, coverage_ids)
        self.table.append(columns)
        self.tally.add(verdicts, stands.claimed)

    def _confirm(
        self, confirmer: Confirmer, columns: dict[str, np.ndarray],
        objective: Float[np.ndarray, " n"],
    ) -> Float[np.ndarray, " n"]:  # fmt: skip
        """Replay violations, and write the verdicts into the columns.

        **Returns:** the objective, in which refused rows count as safe, so that a search does not
        stay with them.
        """
        with self.watch.on(CONFIRM):
            compiled = confirmer.compile_seconds
            wanted = max(self.stop_after - self.distinct, 0)
            rows, found = confirmer.check_round(columns, len(self.table), wanted)
            self.watch.move(confirmer.compile_seconds - compiled, COMPILE)
        count = len(columns["violated"])
        columns["verdict"] = np.full(count, "", object)
        columns["verdict"][rows] = found.verdict
        if self.problem.black_box:
            columns["rho_again"] = np.full(count, np.nan)
            columns["rho_again"][rows] = found.rho.get("again", np.nan)
        self.checks = confirmer.check_names or self.checks
        refused, greatest = found.refuse()
        if refused.any():
            objective = objective.copy()
            objective[rows[refused]] = greatest[refused]
        return objective

    @contextmanager
    def _searching(self) -> Iterator[None]:
        """Count the time as the search's, except the time of compiling its programs."""
        with self.watch.on(SEARCH), self.watch.waiting_for_programs_is(COMPILE):
            yield

    def _begin_stage(self) -> None:
        """Compile what the next round needs for the first time, search and derivatives together."""
        proposals = self.learning.proposals
        with self.watch.on(COMPILE):
            if not proposals.begin_stage():
                return
            if proposals.stage.wants.clause_gradients:
                self._simulations.begin_derivatives()
            proposals.wait()

    def measure(self, maximum: int, timed: bool) -> float:
        """Simulate the first rows, and return the shortest time of a row in seconds.

        These rows belong to the run. They are simulated one by one; if the first is quick and does
        not raise, it is the only one.

        - `maximum`: maximum size of the first round.
        - `timed`: whether to measure the time, for which rows are simulated one by one.
        """
        if not len(self.first):
            with self._searching():
                self._pending = self.learning.proposals.next(maximum)
        points = np.asarray(self.first if len(self.first) else self._pending)
        with self.watch.on(SIMULATE):
            return self._simulations.measure(points[:maximum], timed)

    def take_in_measured(self) -> None:
        """Store the rows that were simulated one by one, without the rest of their round.

        The checkpoint stays that before these rows: a resumed run repeats their whole round.
        """
        given = len(self.first) > 0
        points = np.asarray(self.first if given else self._pending)[: self._simulations.measured]
        with self.watch.on(SIMULATE):
            batch = Batch(points, "first" if given else "search")
            self._take_in(batch, self._simulate(batch, 0), learns=False)

    @property
    def hopeless(self) -> str | None:
        """The message that all simulations raised, which makes more pointless; else None."""
        measured = self._simulations.hopeless
        return self._raising.reason if measured is None else measured

    def switch(self, search: Search, note: str, batch: int) -> None:
        """Continue with another search; the rows simulated so far are given rows for it."""
        if not len(self.first) and self._simulations.measured:
            self.first = np.asarray(self._pending)[: self._simulations.measured]
        self._pending = None
        self.batch, self.chosen = batch, (note,)
        self.learning.take(search)
        self._journal_without_traces()
        self._simulations.regroup(batch, keep_traces=self.learning.surrogate is not None)
        self.learning.begin(batch)
        self._keep()

    def _journal_without_traces(self) -> None:
        """Leave the journal if traces are wanted: its rows have none.

        Rows of an interrupted batch are simulated again.
        """
        if self.learning.surrogate is not None and self._journal is not None:
            self._journal.settle(len(self.table) + MEASURED)
            self._journal = None

    def warm(self, table: "pd.DataFrame") -> None:
        """Let the search learn from the rows of an earlier table."""
        self.learning.warm(table)
        self._keep()

    @property
    def search(self) -> Search:
        """The search of the run."""
        return self.learning.search

    @property
    def evaluate(self) -> Evaluator:
        """The evaluator of rounds without derivatives."""
        return self._simulations.evaluate

    @property
    def simulated_by(self) -> str:
        """The engine that simulates the rows, as far as it is decided."""
        return self.evaluate.simulated_by

    @property
    def confirms(self) -> bool:
        """True if only violations that closer replays confirm are claimed."""
        return self._confirmer is not None

    @property
    def distinct(self) -> int:
        """Counterexamples found; with a search for diverse ones, those far from each other."""
        distinct = self.learning.distinct
        return self.tally.claimed if distinct is None else distinct

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions of the engines that a user may not expect."""
        raised = () if self._confirmer is None else self._confirmer.raised
        return (*self._simulations.notes, *raised)

    @property
    def exhausted(self) -> bool:
        """True if a finite search has come to its end."""
        ahead, proposals = self._prefetch, self.learning.proposals
        waiting = self._pending is not None or (ahead is not None and not ahead.empty)
        return proposals is not None and proposals.exhausted and not waiting

    def close(self) -> None:
        """Cancel work that was sent ahead to workers and has not begun."""
        if self._prefetch is not None:
            self._prefetch.close()

    def save(self, seldom: bool = False) -> None:
        """Write the checkpoint to the folder; if `seldom`, at most once a second.

        **Raises:** `OSError` where it cannot be written.
        """
        now = time.perf_counter()
        # Without a checkpoint it was interrupted before there was a search, and begins anew.
        if self.folder is None or not self.checkpoint or (seldom and now - self._saved < 1.0):
            return
        self._saved = now
        rows = self.table.digest(int(self.checkpoint.get("rows", 0)))
        write_checkpoint(self.checkpoint, self.folder, rows, self.record_checksum)
        if self._journal is not None:
            # Only now: rows of the table that the checkpoint does not know are simulated again.
            self._journal.settle(int(self.checkpoint.get("rows", 0)))

    def resume(self, checkpoint: Mapping[str, Any]) -> None:
        """Continue from `checkpoint`; the table must hold its rows already.

        **Raises:** `ValueError` for a checkpoint of another search, space or batch size.
        """
        for part in self._parts:
            part.restore(checkpoint)
        counts = self.table.counts
        self._raising.always = counts.without_verdict == len(self.table)
        self.tally = Tally(counts.claimed, counts.violating, counts.without_verdict, counts.lowest)
        self._keep()

    def _keep(self) -> None:
        """Take the checkpoint, without copies, because none of its arrays is ever modified."""
        ahead, proposals = self._prefetch, self.learning.proposals
        state = proposals.checkpoint() if ahead is None else ahead.checkpoint
        self.checkpoint = {**state, "rows": np.array(len(self.table))}
        for part in self._parts:
            self.checkpoint |= part.checkpoint()

    @property
    def _parts(self) -> list[Learning | Confirmer]:
        """The objects with their own entries in a checkpoint."""
        return [self.learning, *([] if self._confirmer is None else [self._confirmer])]
