"""The state of a run between its rounds, and one round: propose, simulate, evaluate, tell, store.

A round leaves everything in step: the table, the search and the counts. The `checkpoint` after a
round is enough to go on from there, whatever happened since.
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from verifai_jax.core.compilation import while_compiling
from verifai_jax.core.executors import Executor
from verifai_jax.core.keys import run_keys
from verifai_jax.core.stopwatch import Stopwatch
from verifai_jax.evaluation.confirmer import Confirmer
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.journal import Journal
from verifai_jax.evaluation.raising import Raising
from verifai_jax.evaluation.steering import Steering
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.falsification.ahead import Ahead
from verifai_jax.falsification.checkpoint import write_checkpoint
from verifai_jax.falsification.columns import import_tables
from verifai_jax.falsification.marks import MarkBook
from verifai_jax.falsification.question import describe_run
from verifai_jax.falsification.rows import rows_of, without_failure
from verifai_jax.falsification.simulations import MEASURED, Simulations
from verifai_jax.falsification.suggestions import Suggestions
from verifai_jax.falsification.surrogates import Surrogate
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.rulebook import Objective
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals, compiled_search

if TYPE_CHECKING:
    import pandas as pd

COMPILE, SEARCH, SIMULATE, CONFIRM, REST = "compile", "search", "simulate", "confirm", "rest"
"""What the seconds of a run are spent on."""
MOST_WARM = 2048
"""Rows of an earlier table at most that a search starts with; the worst of a longer one."""


class Rounds:
    """The rounds of one run; `compile` first, then `advance` as often as wanted.

    `found` counts the counterexamples that are claimed, `violating` the simulations that violate
    the property, and `without_verdict` those that have none; `best` is the least robustness.
    `first` are rows of given features (`given_rows`) that are simulated before the search proposes
    any, and `suggestions` those that somebody gives on the way, None where nobody is asked.
    `record_checksum` is that of the run's record, for the checkpoints.
    `checks` names the closer replays that were made. `watch` has the seconds of all: to
    `COMPILE`; to `SEARCH`, which the search took for its proposals and to learn, and whoever
    suggests points to think of them; to `SIMULATE`, and to put the rows into the table; to
    `CONFIRM`. The rest is whoever advances the rounds.
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
        executor: Executor | None = None,
        target: str | None = None,
        first: Float[np.ndarray, "n row"] | None = None,
        suggests: bool = False,
    ) -> None:
        self.first = np.zeros((0, problem.space.dim), np.float32) if first is None else first
        self.problem, self.search, self.batch, self.table = problem, search, batch, table
        guided = problem.guide is not None and search.learns
        self.steering = Steering(guide=guided, outcome=search.wants.outcomes)
        self.precision, self.folder = precision, folder
        self.search_key = run_keys(seed)[0]
        self._surrogate: Surrogate | None = None
        self._journal = Journal(folder) if folder is not None and problem.black_box else None
        self._learn_traces(search)
        self._simulations = Simulations(
            problem,
            search,
            batch,
            seed,
            precision=precision,
            journal=self._journal,
            executor=executor,
            target=target,
            steering=self.steering,
            keep_traces=self._surrogate is not None,
            given=suggests or self.first.shape[1] > problem.space.dim,
        )
        self._marks = MarkBook(problem) if search.wants.marks else None
        self.found = self.violating = self.without_verdict = 0
        self.best = float("nan")
        self.watch = Stopwatch(COMPILE)
        self.checks: tuple[str, ...] = ()
        self.checkpoint: dict[str, Any] = {}
        self.record_checksum = 0
        self.suggestions: Suggestions | None = None
        self._confirmer = None
        if confirm:
            self._confirmer = Confirmer(problem, precision, seed, executor=executor, target=target)
        self._objective = None if problem.rulebook is None else Objective(problem.rulebook)
        self._proposals: Any = None
        self._pending: Any = None  # Points of the first round that are proposed already.
        self.chosen: tuple[str, ...] = ()
        self._sends_ahead = executor is not None and not search.learns
        self._ahead: Ahead | None = None
        self._saved = time.perf_counter()
        self._raising = Raising()

    def compile(self, resumed: bool = False) -> None:
        """Compile the engine and the search, side by side.

        - `resumed`: whether the first round is one of any kind; a new run begins with gradients
          where the first stage of the search wants those of clauses.
        """
        space, marks = self.problem.space, 0 if self._marks is None else self._marks.width
        while_compiling(import_tables, after=0.0)
        stage = self.search.stage(None, space.cube, self.batch)
        differentiates = stage.wants.clause_gradients and not resumed
        if differentiates:
            # They take longest to load: first, where nothing of them is to be traced.
            self._simulations.begin_if_recalled()
        compiled_search(stage, space.cube, self.batch, marks)
        self.evaluate.begin_compiling()
        if differentiates:
            self._simulations.begin_derivatives()
        if self._confirmer is not None:
            # Meanwhile; whatever fails will be replayed.
            self._confirmer.prepare()
        self.evaluate.compile()
        self._propose()

    def _propose(self) -> None:
        """Begin the proposals of the search."""
        space = self.problem.space
        self._proposals = Proposals(
            self.search,
            space.cube,
            self.batch,
            self.search_key,
            space.constraint,
            0 if self._marks is None else self._marks.width,
            None if self._surrogate is None else self._surrogate.improve,
        )
        self._keep()

    def _learn_traces(self, search: Search) -> None:
        """Model the traces for a search that wants it."""
        if search.wants.traces is None:
            return
        self._surrogate = Surrogate(self.problem, search.wants.traces, self.search_key)
        # Rows of a journal have no traces; those of a batch that is cut off are simulated again.
        if self._journal is not None:
            self._journal.settle(len(self.table) + MEASURED)
            self._journal = None

    def measure(self, most: int, timed: bool) -> float:
        """Simulate the first rows, and return the least seconds that one took.

        They are rows of the run. One by one, a first one that is quick is the only one, unless it
        raises.

        - `most`: of the first round.
        - `timed`: whether the seconds are wanted, for which they are simulated one by one.
        """
        if not len(self.first):
            with self._searching():
                self._pending = self._proposals.next(most)
        points = np.asarray(self.first if len(self.first) else self._pending)
        with self.watch.on(SIMULATE):
            return self._simulations.measure(points[:most], timed)

    def take_in_measured(self) -> None:
        """Store the rows that were simulated one by one, without the rest of their round.

        The checkpoint stays before them: a run that goes on simulates their whole round.
        """
        rows = self.first if len(self.first) else self._pending
        points = np.asarray(rows)[: self._simulations.measured]
        with self.watch.on(SIMULATE):
            verdicts = self._verdicts(points, 0, given=len(self.first) > 0)
            points = np.asarray(points[:, : self.problem.space.dim], np.float32)
            self._take_in(points, verdicts, 0, points[:0], learns=False)

    @property
    def hopeless(self) -> str | None:
        """The message of all simulations, where more of them would only say it again; else None."""
        measured = self._simulations.hopeless
        return self._raising.reason if measured is None else measured

    def switch(self, search: Search, note: str, batch: int) -> None:
        """Go on with another search, for which the rows that are measured are given ones."""
        if not len(self.first) and self._simulations.measured:
            self.first = np.asarray(self._pending)[: self._simulations.measured]
        self._pending = None
        self.search, self.batch, self.chosen = search, batch, (note,)
        self._learn_traces(search)
        self._simulations.regroup(batch, keep_traces=self._surrogate is not None)
        self._propose()

    @property
    def evaluate(self) -> Evaluator:
        """The evaluator of rounds without derivatives."""
        return self._simulations.evaluate

    @property
    def confirms(self) -> bool:
        """True where only what closer replays confirm is claimed."""
        return self._confirmer is not None

    @property
    def distinct(self) -> int:
        """Counterexamples found, of a search for diverse ones those far from each other."""
        distinct = self._proposals.distinct
        return self.found if distinct is None else distinct

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions of the engines that a user may not expect."""
        raised = () if self._confirmer is None else self._confirmer.raised
        suggested = () if self.suggestions is None else self.suggestions.notes
        return (*self._simulations.notes, *raised, *suggested)

    @property
    def numbers(self) -> dict[str, float]:
        """Plain numbers of the run so far, for callbacks."""
        return {
            "simulations": len(self.table),
            "violating": self.violating,
            "counterexamples": self.found,
            "without_verdict": self.without_verdict,
            "least_robustness": self.best,
        }

    @property
    def exhausted(self) -> bool:
        """True where a finite search has come to its end."""
        waiting = self._pending is not None or (self._ahead is not None and not self._ahead.empty)
        return self._proposals is not None and self._proposals.exhausted and not waiting

    @property
    def acceptance(self) -> float | None:
        """Share of proposed points that the constraint let through; None without one."""
        if self.problem.space.where is None or self._proposals is None:
            return None
        return self._proposals.accepted / max(self._proposals.proposed, 1)

    def advance(self, most: int, limit: int | None = None) -> None:
        """Ask, evaluate, tell and store at most `most` simulations.

        - `limit`: simulations of the whole run, up to which points may be sent ahead to workers.
        """
        with self.watch.on(SIMULATE):
            self._advance(most, limit)

    def _advance(self, most: int, limit: int | None) -> None:
        first = len(self.table)
        verdicts: Verdicts | None = None
        # The number of rows alone says how many of them are still to come, so resuming goes on.
        given = self.first[first : first + most]
        cut = most < self.batch and len(self.first) > first + most
        suggested = False
        if not len(given) and self.suggestions is not None:
            with self._searching():
                given = self._suggested(self.suggestions, first)
            cut = limit is not None and len(given) > limit - first
            given = given[: most if limit is None else max(limit - first, 0)]
            suggested = len(given) > 0
        if len(given):
            points = given
        elif self._sends_ahead:
            if self._ahead is None:
                limit = first + most if limit is None else limit
                self._ahead = Ahead(self._proposals, self.evaluate, self.batch, limit, first)
            points, verdicts = self._ahead.next()
        else:
            points, self._pending = self._pending, None
            if points is None:
                self._begin_stage()
                with self._searching():
                    points = self._proposals.next(most)
                cut = self._proposals.cut
        if not len(points):
            self._proposals.tell_refused()
            self._keep()
            return
        if verdicts is None:
            verdicts = self._verdicts(points, first, given=len(given) > 0)
        # What follows knows points alone: the nearest ones.
        given = np.asarray(given[:, : self.problem.space.dim], np.float32)
        if len(given):
            points = given
        self._take_in(points, verdicts, first, given, suggested)
        if not (cut and self.search.learns):
            # A larger budget goes on before a round that this one cut, with all of its points.
            self._keep()

    def _take_in(
        self,
        points: Float[Any, "n d"],
        verdicts: Verdicts,
        first: int,
        given: Float[Any, "given row"],
        suggested: bool = False,
        *,
        learns: bool = True,
    ) -> None:
        """Confirm, tell the search, store and count the simulations of these points.

        - `learns`: whether the search is told; not of rows after which the run ends.
        """
        self._raising.add(verdicts.status, verdicts.messages)
        columns = rows_of(self.problem, verdicts, self._simulations.differentiates)
        if self.suggestions is not None:
            columns["suggested"] = np.full(len(points), suggested)
        marks = None
        if self._marks is not None:
            marks = self._marks.of(points, verdicts)
            columns["new_marks"] = self._marks.add(marks)
            marks = self._marks.of_kinds(marks)
        objective = verdicts.least
        if self._objective is not None:
            objective = self._objective(verdicts.rho, verdicts.rho < 0)
        claimed = verdicts.violated
        if self._confirmer is not None:
            with self.watch.on(CONFIRM):
                compiled = self._confirmer.compile_seconds
                found = self._confirmer.check_round(columns, first)
                self.watch.move(self._confirmer.compile_seconds - compiled, COMPILE)
            columns["verdict"] = found.verdict
            if self.problem.black_box:
                columns["rho_again"] = found.rho.get("again", np.full(len(points), np.nan))
            self.checks = self._confirmer.check_names or self.checks
            refused, greatest = found.refuse()
            claimed = verdicts.violated & ~refused
            # A search that took them for failures would stay with them.
            objective = np.where(refused, greatest, objective)
            verdicts = without_failure(verdicts, refused)
        if self.steering.guide and verdicts.steering is not None:
            objective = self._guided(objective, verdicts.steering[:, 0])
        outcomes = self._outcomes(verdicts)
        if learns:
            with self._searching():
                self._learn(given, suggested, objective, verdicts, marks, outcomes)
                if self._surrogate is not None:
                    self._surrogate.learn(points, verdicts)
        self.table.append(columns)
        self.found += int(np.sum(claimed))
        self.violating += int(np.sum(verdicts.violated))
        self.without_verdict += int(np.sum(~verdicts.proper))
        self.best = float(np.fmin(self.best, np.fmin.reduce(verdicts.least)))

    @contextmanager
    def _searching(self) -> Iterator[None]:
        """Count the time as the search's, but for that in which its programs compile."""
        with self.watch.on(SEARCH), self.watch.waiting_for_programs_is(COMPILE):
            yield

    def _learn(
        self,
        given: Float[Any, "given d"],
        suggested: bool,
        objective: Float[np.ndarray, " n"],
        verdicts: Verdicts,
        marks: Int[np.ndarray, "n marks"] | None,
        outcomes: Float[np.ndarray, "n outcome"] | None,
    ) -> None:
        """Let the search learn from a round, of its own points or of `given` ones."""
        if len(given):
            self._proposals.remember(given)
            told = objective[verdicts.proper].astype(np.float32)
            happened = None if outcomes is None else outcomes[verdicts.proper]
            if suggested:
                # The best ones last, so that none of a small batch takes their place.
                order = np.argsort(-told, kind="stable")
                happened = None if happened is None else happened[order]
                self._proposals.start_from(given[verdicts.proper][order], told[order], happened)
            else:
                self._proposals.warm_start(given[verdicts.proper], told, happened)
        else:
            self._tell(objective, verdicts, marks, outcomes)

    def _begin_stage(self) -> None:
        """Compile what the next round needs for the first time, search and derivatives together."""
        with self.watch.on(COMPILE):
            if not self._proposals.begin_stage():
                return
            if self._proposals.stage.wants.clause_gradients:
                self._simulations.begin_derivatives()
            self._proposals.wait()

    def _suggested(self, suggestions: Suggestions, rows: int) -> Float[np.ndarray, "n d"]:
        """Return the suggested points that come next, after a question where it is time for one."""
        waiting = suggestions.waiting(rows)
        if len(waiting) or not suggestions.due(rows):
            return waiting
        question = describe_run(
            self.problem,
            self.table.all,
            suggestions.search,
            self.evaluate.key,
            self.precision,
            suggestions.last_refused,
        )
        suggestions.ask(question, rows)
        # On disk before anything is simulated: nobody is asked twice for it.
        self._keep()
        self.save()
        return suggestions.waiting(rows)

    def close(self) -> None:
        """Cancel what workers have been sent ahead and have not begun."""
        if self._ahead is not None:
            self._ahead.close()

    def _tell(
        self,
        objective: Float[np.ndarray, " n"],
        verdicts: Verdicts,
        marks: Int[np.ndarray, "n marks"] | None,
        outcomes: Float[np.ndarray, "n outcome"] | None,
    ) -> None:
        """Tell the search what came of its points, in float32 whatever the simulations do."""

        def single(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else values.astype(np.float32)

        self._proposals.tell(
            objective.astype(np.float32),
            verdicts.proper,
            single(verdicts.gradient),
            single(verdicts.clauses),
            single(verdicts.clause_gradients),
            marks,
            outcomes,
        )

    def _guided(
        self, told: Float[np.ndarray, " n"], value: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Return what the search is told with the guide's term, where there is one."""
        guide = self.problem.guide
        return told if guide is None or not self.steering.guide else guide.steer(told, value)

    def _outcomes(self, verdicts: Verdicts) -> Float[np.ndarray, "n outcome"] | None:
        if not self.steering.outcome or verdicts.steering is None:
            return None
        return verdicts.steering[:, int(self.steering.guide) :]

    def _verdicts(self, points: Float[Any, "n d"], first: int, given: bool) -> Verdicts:
        """Simulate the points of a round, proposed ones or `given` ones."""
        compiled = self._simulations.compile_seconds
        verdicts = self._simulations(
            points,
            first,
            differentiate=not given and self._proposals.differentiate,
            temperature=1.0 if given else self._proposals.temperature,
        )
        # A robustness of exactly zero compiles a program of its own.
        self.watch.move(self._simulations.compile_seconds - compiled, COMPILE)
        return verdicts

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
        # What the guide says of these rows is not known: the least good.
        rho = self._guided(rho, np.full(len(rho), np.nan, np.float32))
        self._proposals.warm_start(self.problem.space.points(proper), rho)
        self._keep()

    def save(self, seldom: bool = False) -> None:
        """Write the checkpoint to the folder; if `seldom`, only when the last one is a second old.

        **Raises:** `OSError` where it cannot be written.
        """
        now = time.perf_counter()
        if self.folder is None or (seldom and now - self._saved < 1.0):
            return
        if not self.checkpoint:
            return  # Interrupted before there was a search: it begins where it would have.
        self._saved = now
        rows = self.table.digest(int(self.checkpoint.get("rows", 0)))
        write_checkpoint(self.checkpoint, self.folder, rows, self.record_checksum)
        if self._journal is not None:
            # Only now: rows of the table that the checkpoint does not know are simulated again.
            self._journal.settle(int(self.checkpoint.get("rows", 0)))

    def resume(self, checkpoint: Mapping[str, Any]) -> None:
        """Go on where `checkpoint` was taken; the table must hold its rows already.

        **Raises:** `ValueError` for a checkpoint of another search, space or batch size.
        """
        self._proposals.restore(checkpoint)
        if self._objective is not None:
            names = self._objective.state
            self._objective.state = {name: checkpoint[f"objective.{name}"] for name in names}
        for part in self._parts:
            part.restore(checkpoint)
        counts = self.table.counts
        self._raising.always = counts.without_verdict == len(self.table)
        self.without_verdict, self.violating = counts.without_verdict, counts.violating
        self.found = counts.claimed
        self.best = counts.least
        self._keep()

    def _keep(self) -> None:
        """Take the checkpoint: nothing is copied, as nothing in it is ever written to."""
        objective = {} if self._objective is None else self._objective.state
        ahead = self._ahead
        self.checkpoint = {
            **(self._proposals.checkpoint() if ahead is None else ahead.checkpoint),
            **{f"objective.{name}": value for name, value in objective.items()},
            "rows": np.array(len(self.table)),
        }
        for part in self._parts:
            self.checkpoint |= part.checkpoint()

    @property
    def _parts(self) -> list[Surrogate | MarkBook | Suggestions | Confirmer]:
        """What has entries of its own in a checkpoint."""
        each = (self._surrogate, self._marks, self.suggestions, self._confirmer)
        return [part for part in each if part is not None]
