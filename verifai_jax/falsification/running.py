"""A run from its first compilation to its result: rounds until something ends them.

    running = Running(rounds, Ending(started, budget, Stop()), choice, seed)
    run = running.play(progress=True)

The finished part is always returned, or available as the `run` of the error. A run in a folder can
be resumed.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from verifai_jax import search as searches
from verifai_jax._version import __version__
from verifai_jax.core.compute.compilation import tracing
from verifai_jax.core.compute.stopwatch import Stopwatch
from verifai_jax.core.display.progress import SimulationProgress, write_line
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.locks import writing
from verifai_jax.core.user_code.callbacks import Callback, notify
from verifai_jax.core.user_code.user_errors import explain_user_error, format_user_error
from verifai_jax.evaluation.backends import Choice
from verifai_jax.falsification.loop import COMPILE, CONFIRM, REST, SEARCH, SIMULATE, Rounds
from verifai_jax.falsification.model_changes import SourcesWhenAsked
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.run_folder import write_record
from verifai_jax.falsification.silent_mistakes import (
    cut_short_note,
    nominal_note,
    note_on_time_0,
    notes_after,
)
from verifai_jax.falsification.summary import first_message
from verifai_jax.falsification.validation import space_as_data
from verifai_jax.problem.model_digest import digest_of_model
from verifai_jax.problem.silent_mistakes import is_quick
from verifai_jax.search import Search
from verifai_jax.statistics.stopping import Stop

Origin = Literal["prior", "first", "given", "sequence", "coverage", "learned"]
"""Where rows come from: as the points of a search (`search/base.py`), and `"first"` for samples of
the prior after rows that were given."""


def origin_of(search: Search, first: int) -> Origin:
    """Return the origin of a run's rows; see `Run.origin`.

    **Arguments:**
    - `search`: the search of the run.
    - `first`: number of rows that were given before the first proposal.
    """
    return "first" if first and search.samples_prior else search.origin


RAISES = "an error of every simulation"
"""The value of `stopped` for a run whose first simulations all raise."""


class RunError(RuntimeError):
    """An error that ends a run; its `run` holds the finished part."""

    def __init__(self, message: str, run: Run) -> None:
        super().__init__(message)
        self.run = run


class Ending(NamedTuple):
    """The conditions that end a run."""

    started: float
    budget: int
    stop: Stop
    earlier: Mapping[str, float] = MappingProxyType({})
    """Seconds that earlier parts of the run have taken, by activity."""

    @property
    def only_budget(self) -> bool:
        """True if only the budget can end the run."""
        return not self.may_be_early and self.stop.seconds is None

    @property
    def may_be_early(self) -> bool:
        """True if results of simulations can end the run before its budget."""
        return self.stop.after is not None or self.stop.when is not None

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.started

    def reached(self, rounds: Rounds) -> str | None:
        """Return the condition that ends the run after this round; None if it goes on."""
        stop = self.stop
        if stop.after is not None and rounds.distinct >= stop.after:
            return "stop_after"
        if stop.when is not None and stop.when.done(
            rounds.tally.violating, len(rounds.table), rounds.tally.without_verdict
        ):
            return "stop_when"
        if len(rounds.table) >= self.budget:
            return "budget"
        if rounds.exhausted:
            return "exhausted"
        if stop.seconds is not None and self.seconds >= stop.seconds:
            return "max_seconds"
        return None


@dataclass
class Running:
    """A run in progress.

    **Fields:**
    - `rounds`: its rounds, not compiled yet.
    - `ends`: the conditions that end it.
    - `choice`: the choice of its backend.
    - `seed`: the seed of its search and its simulations.
    - `notes`: notes on likely mistakes.
    - `lasting`: notes that stay true when the run is resumed.
    - `sources`: the files of the model for each part of the run; read now when left out.
    - `resumed`: whether it goes on from a checkpoint.
    - `warm`: whether the search starts from the rows of an earlier run.
    """

    rounds: Rounds
    ends: Ending
    choice: Choice
    seed: int
    notes: Sequence[str] = ()
    lasting: Sequence[str] = ()
    sources: Sequence[Mapping[str, Any]] | None = None
    resumed: bool = False
    warm: bool = False
    _models: Sequence[Mapping[str, Any]] = field(default=(), init=False)
    _model: str = field(default="", init=False)

    def play(
        self, progress: bool | None, prepare: Callable[[], None], callbacks: Sequence[Callback] = ()
    ) -> Run:
        """Compile, call `prepare`, and run rounds until a condition ends them.

        **Raises:** `RunError` with the finished part.
        """
        rounds = self.rounds
        rounds.only_budget_ends = self.ends.only_budget
        if self.sources is not None:
            self._models = self.sources
        elif rounds.folder is None:
            self._models = SourcesWhenAsked(rounds.problem)
        else:
            self._models = (rounds.problem.sources().to_json(),)
        # Tracing once more is for those who ask which claims a change concerns.
        self._model = digest_of_model(rounds.problem) if rounds.problem.requirements else ""
        # Checking and tracing are part of what a second run of the problem does not repeat.
        rounds.watch = Stopwatch(COMPILE, self.ends.started, self.ends.earlier)
        self._write_record()
        stopped, cause = None, None
        try:
            with SimulationProgress(rounds.problem.name, self.ends.budget, progress) as bar:
                self._begin(bar, progress, prepare)
                stopped = self._play_rounds(bar, callbacks)
        except KeyboardInterrupt:
            stopped = "interrupted"
        except Exception as error:
            stopped, cause = format_user_error(error), error
        rounds.close()
        result = self._with_notes_after(self.result(stopped))
        try:
            rounds.table.close()
            rounds.save()
            if rounds.folder is not None:
                write_record(result, rounds.folder)
        except OSError as error:
            cause = cause or error
        if cause is not None:
            message = _failure_message(result.name, len(rounds.table), rounds.folder, cause)
            raise RunError(message, result) from cause
        if stopped == RAISES:
            said = rounds.hopeless or ""
            raise RunError(_hopeless_message(result, said, self.ends.budget), result)
        return result

    def _begin(
        self, bar: SimulationProgress, progress: bool | None, prepare: Callable[[], None]
    ) -> None:
        """Compile, and note the decisions; `prepare` may choose another search."""
        rounds, search = self.rounds, self.rounds.search
        slow = rounds.problem.system.why_slow_to_compile(search.wants.derivatives)
        if slow and bar.show:
            bar.note(slow)
        elif slow and progress is not False:
            write_line(f"note: {slow}")
        with tracing():
            rounds.compile(self.resumed)
        if not self.resumed:
            nominal = nominal_note(rounds.problem, rounds.evaluate, search)
            self.lasting = (*self.lasting, *nominal)
        for note in (*self.lasting, *self.notes):
            bar.note(note)
        prepare()
        if rounds.search is not search:
            # Before any row, so that whoever resumes it does not choose again.
            self._write_record()
            for note in (*rounds.chosen, *rounds.notes):
                bar.note(note)

    def _play_rounds(self, bar: SimulationProgress, callbacks: Sequence[Callback]) -> str:
        """Run rounds; return the condition that ended them."""
        rounds, budget = self.rounds, self.ends.budget
        rounds.stop_after = self.ends.stop.after or 0
        stopped = "exhausted" if rounds.exhausted else None
        if self._is_hopeless:
            rounds.take_in_measured()
            return RAISES
        with rounds.watch.on(REST):
            while stopped is None:
                rounds.advance(min(rounds.batch, budget - len(rounds.table)), budget)
                bar.update(len(rounds.table), rounds.tally.claimed, rounds.tally.lowest)
                notify(callbacks, len(rounds.table), rounds.tally.numbers(len(rounds.table)))
                stopped = self.ends.reached(rounds)
                if stopped is None and self._is_hopeless:
                    stopped = RAISES
                if stopped is None:
                    rounds.save(seldom=True)
        return stopped

    @property
    def _is_hopeless(self) -> bool:
        """Whether more simulations would only raise the same, and nobody wants them."""
        return self.rounds.hopeless is not None and not self.ends.stop.keep_going

    def _write_record(self) -> None:
        """Write the current record of the run, so that it can be resumed."""
        folder = self.rounds.folder
        if folder is not None:
            with writing(folder):
                self.rounds.record_checksum = write_record(self.result("running"), folder)

    def _with_notes_after(self, result: Run) -> Run:
        """Return the result with notes on common properties of all its simulations."""
        rounds, search = self.rounds, self.rounds.search
        after = notes_after(rounds.table, rounds.tally, result.formulas, search, self.warm)
        if after and rounds.tally.violating and is_quick(rounds.problem):
            row = int(rounds.table.violating.index[0])
            after += note_on_time_0(rounds.problem.formulas, result.replay(row).trace)
        if not rounds.exhausted:
            simulated = len(rounds.table) - len(rounds.first)
            total = search.total(rounds.problem.space.cube)
            after += cut_short_note(search, total, max(simulated, 0))
        return replace(result, notes=(*result.notes, *after))

    def result(self, stopped: str) -> Run:
        """Return the run as it is now.

        - `stopped`: the condition that ended it.
        """
        rounds, problem, search = self.rounds, self.rounds.problem, self.rounds.search
        spent = dict(rounds.watch.seconds)
        origin = origin_of(search, len(rounds.first))
        why = self.choice.why
        chosen = (f"backend {self.choice.backend}: {why}",) if why else ()
        return Run(
            name=problem.name,
            formulas={name: str(formula) for name, formula in problem.formulas.items()},
            table=rounds.table,
            search=repr(search),
            seed=int(self.seed),
            batch=rounds.batch,
            stopped=stopped,
            compile_seconds=spent.get(COMPILE, 0.0),
            run_seconds=sum(spent.get(name, 0.0) for name in (SEARCH, SIMULATE, REST)),
            confirm_seconds=spent.get(CONFIRM, 0.0),
            search_seconds=spent.get(SEARCH, 0.0),
            simulate_seconds=spent.get(SIMULATE, 0.0),
            checks=rounds.checks,
            version=__version__,
            prior=origin == "prior",
            origin=origin,
            first=rounds.first.tolist(),
            folder=rounds.folder,
            target=problem.target,
            problem=problem,
            budget=int(self.ends.budget),
            search_data=searches.to_json(search),
            space_data=space_as_data(problem),
            acceptance=rounds.learning.acceptance,
            checkpoint=rounds.checkpoint,
            precision=rounds.precision,
            backend=self.choice.backend,
            engine=rounds.simulated_by,
            confirm=rounds.confirms,
            guide=None if problem.guide is None else problem.guide.to_json(),
            sources=self._models,
            derived=problem.system.derived,
            requirements=problem.requirement_entries(),
            model=self._model,
            notes=(*chosen, *self.lasting, *self.notes, *rounds.chosen, *rounds.notes),
            lasting_notes=(*self.lasting, *rounds.chosen),
        )


def _hopeless_message(run: Run, said: str, budget: int) -> str:
    """Write the error that all simulations of a run raised, and how to go on regardless."""
    first = first_message(run)
    said = one_line(said or ("" if first is None else first[1])).rstrip(".")
    where = "" if run.folder is None else f" and in {run.folder}, which can be resumed"
    return (
        f"the run of {run.name!r} ended after {run.simulations:,} of {budget:,} simulations, since "
        f"none succeeds: each raised{f' {said}' if said else ' an error'}. They are in the .run of "
        f"this error{where}. Stop(keep_going=True), or --keep-going, simulates all"
    )


def _failure_message(name: str, simulations: int, folder: Path | None, cause: Exception) -> str:
    why = str(cause) if isinstance(cause, OSError) else explain_user_error(cause)
    message = f"the run of {name!r} broke down after {simulations} simulations: {why}. "
    if folder is None:
        return f"{message}They are in the .run of this error"
    if isinstance(cause, OSError) and not folder.is_dir():
        return (
            f"{message}{folder} does not exist any more: save the .run of this error, which has all"
        )
    if isinstance(cause, OSError):
        return (
            f"{message}All of them are in the .run of this error, and in {folder} those up to the "
            "last whole batch that could be written: make room there and resume it, or save the "
            "run elsewhere"
        )
    return f"{message}They are in the .run of this error and in {folder}, which can be resumed"
