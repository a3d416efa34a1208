"""Starting and resuming runs: the checks and choices before the first simulation.

run = falsify(problem, search="cross_entropy", budget=20_000, seed=0)
run = resume(run, budget=50_000)
"""

import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from verifai_jax import search as searches
from verifai_jax.core.compute.compilation import tracing
from verifai_jax.core.compute.precision import in_precision, reproducible_settings
from verifai_jax.core.display.extensions import verb
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_options, options_of
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.store.locks import write_lock, writing
from verifai_jax.core.user_code.callbacks import Callback, check_callbacks
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.engine import Wanted
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification import cheap as cheaply
from verifai_jax.falsification.derived import as_simulated
from verifai_jax.falsification.loop import COMPILE, CONFIRM, REST, SEARCH, SIMULATE, Rounds
from verifai_jax.falsification.model_changes import continued_with
from verifai_jax.falsification.proof import Proof
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.run_folder import RECORD, as_made, check_not_continued, load
from verifai_jax.falsification.running import Ending, Running
from verifai_jax.falsification.silent_mistakes import notes_before
from verifai_jax.falsification.start import Start
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.falsification.validation import (
    AUTO,
    adapt_search,
    can_be_slow,
    check_first,
    check_gradient,
    check_guide,
    check_objective,
    check_rule,
    check_same_guide,
    check_same_space,
    check_search,
    new_folder,
    points_of,
    recorded_search,
    rows_of_first,
    slow_search,
    usual_batch,
)
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.statistics.stopping import Stop

if TYPE_CHECKING:
    from verifai_jax.features.given import Rows


@suggests_options
@reproducible_settings()
@shows_progress("falsifying")
def falsify(
    problem: Problem,
    search: str | Search | Start = "auto",
    budget: int = 10_000,
    *,
    batch: int | None = None,
    seed: int = 0,
    stop: Stop | None = None,
    folder: str | Path | None = None,
    confirm: bool = True,
    precision: str = "float32",
    run_on: RunOn | None = None,
    callbacks: Iterable[Callback] = (),
    progress: bool | None = None,
) -> Run:
    """Search the feature space for inputs under which the system breaks its property.

    **Arguments:**
    - `problem`: what to break.
    - `search`: a name (`verifai_jax.search.names()`), a search with its options, or a `Start`, with
      what the search begins from. `"auto"` is `portfolio`, or `trace_surrogate`, which saves
      simulations, if the first two simulations of a black box take half a second or longer. Name a
      search to get the same table on machines of any speed. `"diverse"` looks for failures of kinds
      not found yet, `"likeliest"` for probable ones; `search.Diverse` and `search.Likeliest` do so
      around any search that learns.
    - `budget`: maximum number of simulations; the last batch is cut to fit.
    - `batch`: simulations in a round. A search that learns does so once a round: small batches need
      fewer simulations, large ones less time. The default is 1024, but at most a twentieth of the
      budget for a search that learns (16 for `bayes` and `diverse`). For a search that does not
      learn it is an eighth of any budget over 8192, if only the budget can end the run.
    - `seed`: the same seed gives the same table, bit for bit, on the same machine.
    - `stop`: what ends the run before its budget: counterexamples, seconds, a known failure rate.
    - `folder`: the folder in which rows are stored during the run; it must not hold another run.
    - `confirm`: replay violations in double precision and, if the system has finer steps, at a
      third and a quarter of its step. Only violations that every replay confirms are claimed; the
      others stay in the table as `unconfirmed`. At most 1024 rows are replayed, or one for every
      128 simulations if that is more; the others are `unexamined` (`vj.confirm` replays them). A
      host system without finer steps only repeats violations: 32 rows, or one for every 25
      simulations, and up to 1024 if a repetition gave another result.
    - `precision`: of simulations and verdicts, `"float32"` or `"float64"`.
    - `run_on`: engine, backend and workers of the simulations.
    - `callbacks`: functions called after each round with the number of simulations and plain
      numbers by name, such as `vj.CSVLogger` and `vj.TensorBoardLogger`.
    - `progress`: whether to show a progress bar; by default on a terminal or in a notebook.

    Ctrl-C ends the run and returns what is finished. Likely mistakes of the problem are in `notes`.

    **Returns:** the run: its table, its statistics, and replays of its rows.
    **Raises:** `ValueError` before anything compiles for options out of range, unknown names, a
    problem whose parts do not fit, a constraint that refuses every sample, a search that cannot
    work on the space, a folder that cannot be written or that another process writes; `RunError`
    with the finished part of the run if a round raises, and if all of the first simulations raise.
    """
    started = time.perf_counter()
    check_options(budget, 1 if batch is None else batch, seed)
    ends = Ending(started, budget, options_of("falsify", Stop, stop))
    stop, where = ends.stop, options_of("falsify", RunOn, run_on)
    start = search if isinstance(search, Start) else Start(search)
    of_rest: tuple[str, ...] = ()
    proof: Proof | None = None if start.proved is None else verb("proof")(start.proved)
    if proof is not None:
        problem, of_rest = proof.rest(problem, precision), (proof.note,)
    chooses = start.search == AUTO
    search = check_search(problem, "portfolio" if chooses else start.search)
    search = search.counting(stop.after or 0)
    check_objective(problem, search)
    check_rule(search, stop.when)
    check_guide(problem, search)
    first = start.rows
    if start.cheap is not None:
        cheaply.check_same_features(problem, start.cheap)
        options = {"seed": seed, "precision": precision, "confirm": False, "progress": False}
        found = falsify(start.cheap, budget=cheaply.budget_for(budget), **options)
        first = cheaply.gravest_rows(found, start.cheap, budget)
    elif proof is not None and first is None and search.learns and stop.when is None:
        first = proof.loosest(problem, budget)
    given = check_first(problem, first, stop.when, precision)
    callbacks = check_callbacks(callbacks)
    earlier = start.earlier(problem)
    in_precision(precision)

    def batch_for(search: Search) -> int:
        alone = ends.only_budget and not problem.black_box
        usual = usual_batch(search, budget, stop.after, alone) if batch is None else batch
        return min(usual, budget)

    size = batch_for(search)
    choice = resolved(
        problem, gradient=search.needs_derivatives, batch=size, budget=budget, precision=precision,
        wanted=where.backend,
    )  # fmt: skip
    problem = choice.problem
    check_gradient(problem, search)
    with tracing():
        problem.check()
        search, lasting = adapt_search(problem, search, where.executor)
        notes = notes_before(problem, search)
    with new_folder(folder) as path:
        table = ErrorTable(tuple(problem.space.columns), path)
        engine = where.engine or "auto"
        if engine == "auto" and (ends.may_be_early or search.learns):
            engine = "xla"  # Rounding may change the next proposals, and few rows may end the run.
        rounds = Rounds(
            problem, search, size, seed, table, precision, path, confirm, where.executor, given,
            budget=budget, engine=engine,
        )  # fmt: skip

        def prepare() -> None:
            if earlier is not None:
                rounds.warm(earlier)
            if not can_be_slow(problem, where.executor) or (stop.keep_going and not chooses):
                return
            seconds = rounds.measure(size, timed=chooses)
            if not chooses or (rounds.hopeless is not None and not stop.keep_going):
                return
            slow = slow_search(problem, seconds)
            if slow is not None:
                rounds.switch(*slow, batch_for(slow[0]))
                if earlier is not None:
                    rounds.warm(earlier)

        running = Running(
            rounds, ends, choice, seed, notes, (*lasting, *of_rest), warm=earlier is not None
        )
        return running.play(progress, prepare, callbacks)


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
    run_on: RunOn | None = None,
    progress: bool | None = None,
) -> Run:
    """Simulate given features in their order, without a search; each is a row of the table.

    **Arguments:**
    - `rows`: a DataFrame with the feature columns of a table (from an analysis, another run, a
      file), one row of it, or one or several dictionaries of features.
    - all other arguments: as in `falsify`; the default engine is `"xla"`.

    All rows are checked before the first is simulated, and simulated with exactly these numbers in
    the run's precision; rows of a table give the same results again, bit for bit.

    **Returns:** the run, with one row in its table for each given one.
    **Raises:** `ValueError` for features that are missing or outside the space, and if there are no
    rows; the errors of `falsify`.
    """
    in_precision(precision)
    where = options_of("simulate", RunOn, run_on)
    given = points_of(problem, rows, precision)
    if not len(given):
        raise ValueError("simulate needs features of at least one simulation; got no rows")
    points = np.asarray(given[:, : problem.space.dim], np.float32)
    return falsify(
        problem, Start(searches.PointList(points), rows=given), len(points), batch=batch, seed=seed,
        stop=Stop(keep_going=True), folder=folder, confirm=False, precision=precision,
        run_on=replace(where, engine=where.engine or "xla"), progress=progress,
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
    stop: Stop | None = None,
    run_on: RunOn | None = None,
    callbacks: Iterable[Callback] = (),
    progress: bool | None = None,
    even_if_changed: bool = False,
) -> Run:
    """Continue a run that stopped or was interrupted, as if it had never stopped.

    **Arguments:**
    - `run`: a run, or its folder; new rows are added to a folder.
    - `problem`: needed for a folder, because a record names no code to run.
    - `search`: needed only if the search is not one of `verifai_jax.search`.
    - `budget`: simulations in all, including those already done; the run's own when left out.
    - `run_on`: the executor alone, as the run has the engine and the backend.
    - `even_if_changed`: whether to go on although files of the model have changed since the run
      began. Its rows then come from two models: it has no failure rate, and its notes and its
      record say so.
    - all other arguments: as in `falsify`.

    The table is that of an uninterrupted run with this budget and the same batch and engine, bit
    for bit: if the earlier budget cut the last round of a search that learns, that round is
    simulated again. The defaults of the engine and of the batch of such a search depend on the
    budget; a note says if a run from the start would have another default batch.

    **Returns:** the run with the earlier rows and the new ones.
    **Raises:** `ValueError` for a run without its problem or its state, a model that has changed, a
    budget that is spent, or a folder that another process writes; the errors of `falsify`.
    """
    ends = Ending(time.perf_counter(), 0, options_of("resume", Stop, stop))
    executor = options_of("resume", RunOn, run_on, "executor").executor
    folder = Path(run) if isinstance(run, str | Path) else run.folder
    if not isinstance(run, Run) and not (Path(run) / RECORD).exists():
        load(run)  # Says what is missing; a lock would be written to what is no run.
    # The rows are read under the lock, so that nobody adds to them meanwhile.
    with write_lock(folder):
        if isinstance(run, str | Path):
            run = load(run, problem)
            problem = run.problem  # As the run simulated it.
        elif run.folder is not None:
            check_not_continued(run, run.folder)
        called = check_callbacks(callbacks)
        made = {"derived": run.derived, "space_data": run.space_data}
        problem = run.problem if problem is None else as_simulated(problem, made)
        if problem is None:
            raise ValueError(f"resuming {run.name!r} needs its problem: resume(folder, problem)")
        if search is None:
            if run.search_data is None:
                raise ValueError(
                    f"search {run.search} is not one of verifai_jax.search; give it: resume(..., "
                    "search=)"
                )
            search = recorded_search(run)
        search = check_search(problem, search)
        check_same_space(run, problem)
        check_same_guide(run, problem)
        check_rule(search, ends.stop.when)
        budget = run.budget if budget is None else budget
        check_options(budget, run.batch, run.seed)
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
        if run.target not in (None, problem.target):
            problem = replace(problem, target=run.target)
        check_gradient(problem, search)
        problem.check()
        with writing(run.folder):
            table = run.table.resumed(rows, run.folder)
        rounds = Rounds(
            problem, search, run.batch, run.seed, table, run.precision, run.folder, run.confirm,
            executor, rows_of_first(run.first, problem),
            engine=cast(Wanted, "xla" if run.engine == "host" else run.engine), budget=run.budget,
        )  # fmt: skip
        rounds.checks = tuple(run.checks)

        def prepare() -> None:
            if checkpoint:
                rounds.resume(checkpoint)

        ends = ends._replace(budget=budget, earlier=_seconds_of(run))
        lasting = (*run.lasting_notes, *([changed] if changed else []))
        notes = [*notes_before(problem, search)]
        usual = min(usual_batch(search, budget, ends.stop.after), budget)
        if search.learns and usual != run.batch:
            notes.append(
                f"resumed in batches of {run.batch}: a run of {budget} simulations from the start "
                f"would use batches of {usual} by default, and so simulate other points"
            )
        running = Running(rounds, ends, choice, run.seed, notes, lasting, sources, resumed=True)
        return as_made(running.play(progress, prepare, called))


def _seconds_of(run: Run) -> dict[str, float]:
    """Return the seconds of a run by activity."""
    rest = max(run.run_seconds - run.search_seconds - run.simulate_seconds, 0.0)
    return {
        COMPILE: run.compile_seconds,
        SEARCH: run.search_seconds,
        SIMULATE: run.simulate_seconds,
        CONFIRM: run.confirm_seconds,
        REST: rest,
    }
