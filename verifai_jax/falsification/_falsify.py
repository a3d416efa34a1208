"""The falsification loop: budgets, stopping, progress, storing, resuming.

run = falsify(problem, search="cross_entropy", budget=20_000, seed=0)
run = falsify(problem, search=search.Gradient(patience=8), stop_after=10)
run = resume(run, budget=50_000)
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from verifai_jax import search as searches
from verifai_jax._version import __version__
from verifai_jax.core.callbacks import Callback, check_callbacks, notify
from verifai_jax.core.compilation import tracing
from verifai_jax.core.errors import suggests_options
from verifai_jax.core.executors import Executor
from verifai_jax.core.precision import in_precision, reproducible_settings
from verifai_jax.core.progress import SimulationProgress, shows_progress, write_line
from verifai_jax.core.sources import Sources
from verifai_jax.core.stopwatch import Stopwatch
from verifai_jax.core.text import one_line
from verifai_jax.core.user_errors import explain_user_error, format_user_error
from verifai_jax.evaluation.backends import Choice, resolved
from verifai_jax.falsification.derived import as_simulated
from verifai_jax.falsification.loop import COMPILE, CONFIRM, REST, SEARCH, SIMULATE, Rounds
from verifai_jax.falsification.model_changes import continued_with
from verifai_jax.falsification.origin import origin_of
from verifai_jax.falsification.run import (
    RECORD,
    Run,
    as_made,
    check_not_continued,
    load,
    write_record,
)
from verifai_jax.falsification.silent_mistakes import (
    cut_short_note,
    nominal_note,
    notes_after,
    notes_before,
)
from verifai_jax.falsification.suggestions import Suggestions
from verifai_jax.falsification.summary import first_message
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.falsification.validation import (
    AUTO,
    adapt_search,
    can_be_slow,
    check_first,
    check_gradient,
    check_guide,
    check_options,
    check_rule,
    check_same_guide,
    check_same_space,
    check_search,
    earlier_rows,
    locked,
    new_folder,
    points_of,
    recorded_search,
    rows_of_first,
    slow_search,
    space_as_data,
    usual_batch,
    writing,
)
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.search.suggested import without_suggestions
from verifai_jax.statistics.stopping import StoppingRule

if TYPE_CHECKING:
    import pandas as pd

    from verifai_jax.features.given import Rows


RAISES = "an error of every simulation"
"""What has stopped a run whose first simulations all raise."""


class RunError(RuntimeError):
    """The loop broke down, or nothing can succeed; `run` holds what was finished before."""

    def __init__(self, message: str, run: Run) -> None:
        super().__init__(message)
        self.run = run


@suggests_options
@reproducible_settings()
@shows_progress("falsifying")
def falsify(
    problem: Problem,
    search: str | Search = "auto",
    budget: int = 10_000,
    *,
    batch: int | None = None,
    seed: int = 0,
    max_seconds: float | None = None,
    stop_after: int | None = None,
    stop_when: StoppingRule | None = None,
    warm_start: "Run | ErrorTable | pd.DataFrame | None" = None,
    folder: str | Path | None = None,
    precision: str = "float32",
    backend: str | None = None,
    confirm: bool = True,
    diverse: bool | Literal["inputs", "behaviour"] = False,
    first: "Rows | None" = None,
    callbacks: Iterable[Callback] = (),
    progress: bool | None = None,
    target: str | None = None,
    executor: Executor | None = None,
    keep_going: bool = False,
) -> Run:
    """Search the feature space for inputs under which the system breaks its property.

    **Arguments:**

    - `problem`: what to break.
    - `search`: a name (`verifai_jax.search.names()`), or a search with its options. `"auto"` is
      `portfolio`, unless the system is a black box whose first two simulations take half a second
      or longer: then it is one that spends arithmetic to save simulations, `trace_surrogate`. The
      run's record says which; name it for the same table whatever the machine's speed.
    - `budget`: simulations at most; the last batch is cut to fit.
    - `batch`: simulations a round. Active searches learn once a round: a small batch spends
      fewer simulations, a large one less time. By default 1024, and for a search that learns at
      most a twentieth of the budget, so that it can (16 for `bayes`); for one that does not, and
      that only the budget ends, an eighth of a budget over 8192.
    - `seed`: the same seed gives the same table, bit for bit, on the same machine.
    - `max_seconds`: wall-clock seconds, compilation included, after which no round begins.
    - `stop_after`: stop after the round in which that many counterexamples are reached.
    - `stop_when`: stop when the failure rate is known well enough: `Within(0.005)`,
      `Decided(0.01)`; only for searches that sample the prior.
    - `warm_start`: an earlier run or table with the same features, from which a search that learns
      starts. Its rows are not copied.
    - `folder`: where rows are kept on disk as they come; must not hold another run.
    - `precision`: `"float32"` or `"float64"`, of simulations and verdicts.
    - `backend`: of a system that has several (`"mjx"`, `"native"`); the faster one that the search
      can use when left out, as measured here. Name it for the same table on every machine.
    - `confirm`: replay what violates the property in double precision and, where the system has
      finer steps, at a half and a quarter of its step, and do not claim what no longer does: it
      stays in the table, as `unconfirmed`. At most 1024 rows are replayed, or one for 128
      simulations where that is more; the others are `unexamined` (`vj.confirm` replays them).
      What runs on the host and has no finer steps is simulated once more: 32 rows, or one for 25
      simulations, and up to 1024 once one came again otherwise.
    - `diverse`: look for failures of other kinds than those found: `stop_after` then counts
      failures that are far from each other (`search.Diverse`). True or `"inputs"`: in their
      inputs; `"behaviour"`: in what happens, that is the predicate that decides, when it does, and
      the shape of the trace.
    - `first`: features that are simulated before the search proposes any, and told to it where it
      learns: as in `simulate`. They count in the budget, and the run then has no failure rate.
    - `callbacks`: functions called after each round with the number of simulations and a dictionary
      of plain numbers; `vj.CSVLogger` and `vj.TensorBoardLogger` are ready ones.
    - `progress`: show a progress bar; by default on a terminal or in a notebook.
    - `target`: how the command line names the problem, for the record.
    - `executor`: whose workers simulate: Dask's `client.get_executor()`, `clusters.RayExecutor()`,
      a process pool, or anything else with `concurrent.futures`' `submit`. The table is the one of
      this machine alone, bit for bit, on workers with its kind of processor.
    - `keep_going`: whether to simulate on where all of the first simulations raise. When left out
      the run ends there with an error, after 16 that raise the same, or a first round of a system
      that simulates many at once: an error of the problem would cost the whole budget.

    Ctrl-C ends the run and returns what is finished. What is likely a mistake of the problem is in
    the run's `notes`, and above the progress bar.

    **Returns:** the run: its table, its statistics, and replays of its rows.

    **Raises:** `ValueError` before anything compiles for options out of range, unknown names, a
    problem whose parts do not fit, a constraint that refuses every sample, a search that cannot
    work on the space, a folder that cannot be written or that another process writes; `RunError`
    with the finished part of the run when the loop breaks down, and when all of the first
    simulations raise.
    """
    started = time.perf_counter()
    check_options(budget, 1 if batch is None else batch, seed, max_seconds, stop_after)
    asking, search = without_suggestions(search)
    default = search == AUTO
    search = check_search(problem, "portfolio" if default else search)
    check_rule(search, stop_when)
    check_guide(problem, search)
    given = check_first(problem, first, stop_when, precision)
    callbacks = check_callbacks(callbacks)
    earlier = earlier_rows(warm_start, problem)
    in_precision(precision)
    # Far from what is found already takes rounds, more than many at once.
    whole = stop_after is None and stop_when is None and max_seconds is None
    usual = usual_batch(search, budget, stop_after, whole and not problem.black_box)
    usual = min(16, budget) if diverse else usual
    own_batch, batch = batch, min(usual if batch is None else batch, budget)
    choice = resolved(
        problem, gradient=search.needs_derivatives, batch=batch, budget=budget, precision=precision,
        wanted=backend,
    )  # fmt: skip
    problem = choice.problem
    check_gradient(problem, search)
    with tracing():
        problem.check()
        search, lasting = adapt_search(problem, search, executor)
        notes = notes_before(problem, search)
    if diverse:
        by = "inputs" if diverse is True else diverse
        search = searches.Diverse(search, capacity=max(256, stop_after or 0), by=by)
    ends = _Ending(started, budget, max_seconds, stop_after, stop_when)
    warm = earlier is not None
    with new_folder(folder) as place:
        table = ErrorTable(tuple(problem.space.columns), place)
        rounds = Rounds(
            problem, search, batch, seed, table, precision, place, confirm, executor, target, given,
            suggests=asking is not None,
        )  # fmt: skip
        if asking is not None:
            rounds.suggestions = Suggestions(replace(asking, search=search), problem, precision)

        def prepare() -> None:
            if earlier is not None:
                rounds.warm(earlier)
            chooses = default and not diverse
            if asking is not None or not can_be_slow(problem, executor):
                return
            if keep_going and not chooses:
                return
            seconds = rounds.measure(min(batch, budget), timed=chooses)
            if not chooses or (rounds.hopeless is not None and not keep_going):
                return
            slow = slow_search(problem, seconds)
            if slow is not None:
                usual = usual_batch(slow[0], budget, stop_after)
                rounds.switch(*slow, min(own_batch or usual, budget))
                if earlier is not None:
                    rounds.warm(earlier)

        return _run_rounds(
            rounds, ends, seed, choice, progress, target, prepare, notes, callbacks, warm=warm,
            keep_going=keep_going, lasting=lasting,
        )  # fmt: skip


@suggests_options
@reproducible_settings()
def simulate(
    problem: Problem,
    rows: "Rows",
    *,
    batch: int = 1024,
    seed: int = 0,
    folder: str | Path | None = None,
    precision: str = "float32",
    backend: str | None = None,
    progress: bool | None = None,
    target: str | None = None,
    executor: Executor | None = None,
) -> Run:
    """Simulate given features, in their order: no search, a row of the table for each.

    **Arguments:**

    - `rows`: a DataFrame with the feature columns of a table (from an analysis, another run, a
      file), a row of one, or features as a person writes them, one or several.
    - the others as in `falsify`.

    All are checked before anything is simulated, and simulated with exactly these numbers, in the
    run's precision; those of a table give its bits again.

    **Returns:** the run, with a row of its table for each of these.

    **Raises:** `ValueError` for features that are missing or outside the space, and for no rows; as
    `falsify`.
    """
    in_precision(precision)
    given = points_of(problem, rows, precision)
    if not len(given):
        raise ValueError("simulate needs features of at least one simulation; got no rows")
    points = np.asarray(given[:, : problem.space.dim], np.float32)
    return falsify(
        problem, searches.PointList(points), len(points), first=given,
        batch=batch, seed=seed, folder=folder, precision=precision, backend=backend,
        confirm=False, progress=progress, target=target, executor=executor, keep_going=True,
    )  # fmt: skip


@suggests_options
@reproducible_settings()
@shows_progress("going on with")
def resume(
    run: Run | str | Path,
    problem: Problem | None = None,
    *,
    search: Search | None = None,
    budget: int | None = None,
    max_seconds: float | None = None,
    stop_after: int | None = None,
    stop_when: StoppingRule | None = None,
    callbacks: Iterable[Callback] = (),
    progress: bool | None = None,
    executor: Executor | None = None,
    even_if_changed: bool = False,
    keep_going: bool = False,
) -> Run:
    """Go on with a run where it stopped, or where it was cut off, as if it had never stopped.

    **Arguments:**

    - `run`: a run, or the folder of one; a folder is written on.
    - `problem`: needed for a folder, which names no code to run.
    - `search`: needed only if it is none of `verifai_jax.search`.
    - `budget`: simulations in all, those done included; the run's own when left out.
    - `keep_going`: as in `falsify`.
    - `even_if_changed`: whether to go on where files of the model are others than those that the
      run recorded when it began; its rows are then of two models, it has no failure rate, and its
      notes and its record say so.
    - the others as in `falsify`.

    The table is that of an uninterrupted run with this budget and the same `batch`, bit for bit,
    whatever the search. Where the earlier budget cut the last round of a search that learns, its
    simulations are made again, with the others of the round. The default batch of a search that
    learns depends on the budget: a run from the start has the same points only with the same
    `batch`, and the notes of the resumed run say where the default would be another.

    **Returns:** the run with the earlier rows and the new ones.

    **Raises:** `ValueError` for a run without its problem or its state, a model that has changed, a
    budget that is spent, or a folder that another process writes; as `falsify` otherwise.
    """
    ends = _Ending(time.perf_counter(), 0, max_seconds, stop_after, stop_when)
    folder = Path(run) if isinstance(run, str | Path) else run.folder
    if not isinstance(run, Run) and not (Path(run) / RECORD).exists():
        load(run)  # Says what is missing; a lock would be written to what is no run.
    # The rows are read under the lock, so that nobody adds to them meanwhile.
    with locked(folder):
        if isinstance(run, str | Path):
            run = load(run, problem)
            problem = run.problem  # As the run simulated it.
        elif run.folder is not None:
            check_not_continued(run, run.folder)
        called = check_callbacks(callbacks)
        return as_made(
            _resume(
                run, problem, search, budget, ends, progress, called, executor, even_if_changed,
                keep_going,
            )
        )  # fmt: skip


def _resume(
    run: Run,
    problem: Problem | None,
    search: Search | None,
    budget: int | None,
    ends: "_Ending",
    progress: bool | None,
    callbacks: Sequence[Callback],
    executor: Executor | None,
    even_if_changed: bool,
    keep_going: bool,
) -> Run:
    """Go on with a run whose folder is locked; `ends` is completed from the run."""
    made = {"derived": run.derived, "space_data": run.space_data}
    problem = run.problem if problem is None else as_simulated(problem, made)
    if problem is None:
        raise ValueError(f"resuming {run.name!r} needs its problem: resume(folder, problem)")
    if search is None:
        if run.search_data is None:
            raise ValueError(
                f"search {run.search} is none of verifai_jax.search; give it: resume(..., search=)"
            )
        search = recorded_search(run)
    asking, search = without_suggestions(search)
    search = check_search(problem, search)
    check_same_space(run, problem)
    check_same_guide(run, problem)
    check_rule(search, ends.stop_when)
    budget = run.budget if budget is None else budget
    check_options(budget, run.batch, run.seed, ends.max_seconds, ends.stop_after)
    if run.damage:
        raise ValueError(f"the run of {run.name!r} cannot go on: {run.damage}")
    checkpoint = run.checkpoint or {}
    rows = int(checkpoint.get("rows", 0))
    # Those of a round that the budget cut are simulated again, with the rest of the round.
    done = len(run.table) if run.stopped == "budget" else rows
    if budget <= done:
        raise ValueError(
            f"the run of {run.name!r} has {done} simulations already; resume it with a larger "
            f"budget than {budget}"
        )
    if not checkpoint and len(run.table) and run.stopped != "running":
        raise ValueError(f"the run of {run.name!r} was saved without the state of its search")
    sources, changed = continued_with(run.name, run.sources, problem, rows, even_if_changed)
    choice = resolved(problem, wanted=run.backend)
    problem = choice.problem
    check_gradient(problem, search)
    problem.check()
    with writing(run.folder):
        table = run.table.resumed(rows, run.folder)
    rounds = Rounds(
        problem, search, run.batch, run.seed, table, run.precision, run.folder, run.confirm,
        executor, run.target, rows_of_first(run.first, problem), suggests=asking is not None,
    )  # fmt: skip

    if asking is not None:
        rounds.suggestions = Suggestions(replace(asking, search=search), problem, run.precision)
        rounds.suggestions.restore(checkpoint)
        rounds.suggestions.check_source()

    rounds.checks = tuple(run.checks)

    def prepare() -> None:
        if checkpoint:
            rounds.resume(checkpoint)

    ends = ends._replace(budget=budget, earlier=_seconds_of(run))
    lasting = (*run.lasting_notes, *([changed] if changed else []))
    notes = [*notes_before(problem, search)]
    usual = min(usual_batch(search, budget, ends.stop_after), budget)
    if search.learns and usual != run.batch:
        notes.append(
            f"resumed in batches of {run.batch}: a run of {budget} simulations from the start has "
            f"batches of {usual} by default, and so other points"
        )
    return _run_rounds(
        rounds,
        ends,
        run.seed,
        choice,
        progress,
        run.target,
        prepare,
        notes,
        callbacks,
        resumed=True,
        sources=sources,
        keep_going=keep_going,
        lasting=lasting,
    )


def _seconds_of(run: Run) -> dict[str, float]:
    """Return the seconds of a run by what they were spent on."""
    rest = max(run.run_seconds - run.search_seconds - run.simulate_seconds, 0.0)
    return {
        COMPILE: run.compile_seconds,
        SEARCH: run.search_seconds,
        SIMULATE: run.simulate_seconds,
        CONFIRM: run.confirm_seconds,
        REST: rest,
    }


class _Ending(NamedTuple):
    """The conditions that end a run."""

    started: float
    budget: int
    max_seconds: float | None
    stop_after: int | None
    stop_when: StoppingRule | None
    earlier: Mapping[str, float] = MappingProxyType({})
    """Seconds that an earlier part of the run has taken, by what they were spent on."""

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.started

    def reached(self, rounds: Rounds) -> str | None:
        """Return the condition that ends the run after this round, if any does."""
        if self.stop_after is not None and rounds.distinct >= self.stop_after:
            return "stop_after"
        if self.stop_when is not None and self.stop_when.done(
            rounds.violating, len(rounds.table), rounds.without_verdict
        ):
            return "stop_when"
        if len(rounds.table) >= self.budget:
            return "budget"
        if rounds.exhausted:
            return "exhausted"
        if self.max_seconds is not None and self.seconds >= self.max_seconds:
            return "max_seconds"
        return None


def _run_rounds(
    rounds: Rounds,
    ends: _Ending,
    seed: int,
    choice: Choice,
    progress: bool | None,
    target: str | None,
    prepare: Callable[[], None],
    notes: Sequence[str] = (),
    callbacks: Sequence[Callback] = (),
    *,
    warm: bool = False,
    resumed: bool = False,
    sources: Sequence[Mapping[str, Any]] | None = None,
    keep_going: bool = False,
    lasting: Sequence[str] = (),
) -> Run:
    """Compile, `prepare`, and play rounds until something ends them."""
    problem, search, place = rounds.problem, rounds.search, rounds.folder
    asked = rounds.suggestions
    recorded = search if asked is None else asked.search
    chosen = (f"backend {choice.backend}: {choice.why}",) if choice.why else ()
    begun = time.time()
    models = (problem.sources().to_json(),) if sources is None else tuple(sources)
    # Checking and tracing are part of what a second run of the problem does not repeat.
    watch = rounds.watch = Stopwatch(COMPILE, ends.started, ends.earlier)

    def run(stopped: str) -> Run:
        spent = dict(watch.seconds)
        origin = origin_of(recorded, len(rounds.first))
        return Run(
            name=problem.name,
            formulas={name: str(formula) for name, formula in problem.formulas.items()},
            table=rounds.table,
            search=repr(recorded),
            seed=int(seed),
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
            folder=place,
            target=target,
            problem=problem,
            budget=int(ends.budget),
            search_data=searches.to_json(recorded),
            space_data=space_as_data(problem),
            acceptance=rounds.acceptance,
            checkpoint=rounds.checkpoint,
            precision=rounds.precision,
            backend=choice.backend,
            confirm=rounds.confirms,
            guide=None if problem.guide is None else problem.guide.to_json(),
            sources=models,
            derived=problem.system.derived,
            notes=(*chosen, *lasting, *notes, *rounds.chosen, *rounds.notes),
            lasting_notes=(*lasting, *rounds.chosen),
        )

    def settled() -> Sequence[Mapping[str, Any]]:
        return tuple(
            Sources.from_json(each).settled(begun).to_json() if each is models[-1] else each
            for each in models
        )

    if place is not None:
        with writing(place):
            rounds.record_checksum = write_record(run("running"), place)
    known = False
    stopped, cause = None, None
    try:
        with SimulationProgress(problem.name, ends.budget, progress) as bar:
            slow = problem.system.why_slow_to_compile(search.wants.derivatives)
            if slow and bar.bar.show:
                bar.note(slow)
            elif slow and progress is not False:
                write_line(f"note: {slow}")
            with tracing():
                rounds.compile(resumed)
            if not resumed:
                lasting = (*lasting, *nominal_note(problem, rounds.evaluate, search))
            for note in (*lasting, *notes):
                bar.note(note)
            prepare()
            if rounds.search is not search:
                search = recorded = rounds.search
                if place is not None:
                    # Before any row, so that whoever resumes it does not choose again.
                    with writing(place):
                        rounds.record_checksum = write_record(run("running"), place)
                for note in (*rounds.chosen, *rounds.notes):
                    bar.note(note)
            stopped = "exhausted" if rounds.exhausted else None
            if rounds.hopeless is not None and not keep_going:
                rounds.take_in_measured()
                stopped = RAISES
            with watch.on(REST):
                while stopped is None:
                    rounds.advance(min(rounds.batch, ends.budget - len(rounds.table)), ends.budget)
                    bar.update(len(rounds.table), rounds.found, rounds.best)
                    notify(callbacks, len(rounds.table), rounds.numbers)
                    stopped = ends.reached(rounds)
                    if stopped is None and rounds.hopeless is not None and not keep_going:
                        stopped = RAISES
                    if place is not None and not known:
                        # A run that is killed knows what its first simulations read, too.
                        known, models = True, settled()
                        write_record(run("running"), place)
                    if stopped is None:
                        rounds.save(seldom=True)
    except KeyboardInterrupt:
        stopped = "interrupted"
    except Exception as error:
        stopped, cause = format_user_error(error), error
    rounds.close()
    models = settled()
    result = run(stopped)
    after = notes_after(rounds.table, result.formulas, search, warm)
    if not rounds.exhausted:
        simulated = len(rounds.table) - len(rounds.first)
        after += cut_short_note(search, search.total(problem.space.cube), max(simulated, 0))
    result = replace(result, notes=(*result.notes, *after))
    try:
        rounds.table.close()
        rounds.save()
        if place is not None:
            write_record(result, place)
    except OSError as error:
        cause = cause or error
    if cause is not None:
        raise RunError(
            _failure_message(problem.name, len(rounds.table), place, cause), result
        ) from cause
    if stopped == RAISES:
        raise RunError(_hopeless_message(result, rounds.hopeless or "", ends.budget), result)
    return result


def _hopeless_message(run: Run, said: str, budget: int) -> str:
    """Say what all simulations of a run raised, and how to simulate on."""
    first = first_message(run)
    said = one_line(said or ("" if first is None else first[1])).rstrip(".")
    where = "" if run.folder is None else f" and in {run.folder}, which can be resumed"
    return (
        f"the run of {run.name!r} ended after {run.simulations:,} of {budget:,} simulations, since "
        f"none succeeds: each raised{f' {said}' if said else ' an error'}. They are in the .run of "
        f"this error{where}. keep_going=True, or --keep-going, simulates all"
    )


def _failure_message(name: str, simulations: int, place: Path | None, cause: Exception) -> str:
    why = str(cause) if isinstance(cause, OSError) else explain_user_error(cause)
    message = f"the run of {name!r} broke down after {simulations} simulations: {why}. "
    if place is None:
        return f"{message}They are in the .run of this error"
    if isinstance(cause, OSError) and not place.is_dir():
        return f"{message}{place} is there no more: all are in the .run of this error, to be saved"
    if isinstance(cause, OSError):
        return (
            f"{message}All of them are in the .run of this error, and in {place} those up to the "
            "last whole batch that could be written: make room there and resume it, or save the "
            "run elsewhere"
        )
    return f"{message}They are in the .run of this error and in {place}, which can be resumed"
