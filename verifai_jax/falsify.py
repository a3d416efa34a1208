"""The falsification loop: rounds, budgets, stopping, progress, storing.

run = falsify(problem, search="cross_entropy", budget=20_000, seed=0)
run = falsify(problem, search=search.Gradient(learning_rate=0.2), stop_after=10)
"""

import time
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import verifai_jax
from verifai_jax import search as searches
from verifai_jax.engine import Engine, Evaluation, engine_for
from verifai_jax.errors import suggests_options
from verifai_jax.host import HostEngine
from verifai_jax.problem import Problem
from verifai_jax.progress import Progress
from verifai_jax.run import Run, run_keys, write_record
from verifai_jax.search import Cube, Evaluated, Search
from verifai_jax.table import ErrorTable
from verifai_jax.trace import Status

STATUS_NAMES = np.array([status.name.lower() for status in Status], dtype=object)


class RunError(RuntimeError):
    """The loop broke down; `run` holds every batch finished before."""

    def __init__(self, message: str, run: Run) -> None:
        super().__init__(message)
        self.run = run


@suggests_options
def falsify(
    problem: Problem,
    search: str | Search = "cross_entropy",
    budget: int = 10_000,
    *,
    batch: int = 1024,
    seed: int = 0,
    max_seconds: float | None = None,
    stop_after: int | None = None,
    folder: str | Path | None = None,
    progress: bool | None = None,
    target: str | None = None,
) -> Run:
    """Search the feature space for inputs under which the system breaks its property.

    **Arguments:**

    - `problem`: what to break.
    - `search`: a name (`verifai_jax.search.names()`), or a search with its options.
    - `budget`: simulations at most; the last batch is cut to fit.
    - `batch`: simulations a round. Active searches learn once a round: a small batch spends
      fewer simulations, a large one less time.
    - `seed`: the same seed gives the same table, bit for bit, on the same machine.
    - `max_seconds`: wall-clock seconds, compilation included, after which no round begins.
    - `stop_after`: stop after the round in which that many counterexamples are reached.
    - `folder`: where rows are kept on disk as they come; must not hold another run.
    - `progress`: show a progress bar; by default on a terminal or in a notebook.
    - `target`: how the command line names the problem, for the record.

    Ctrl-C ends the run and returns what is finished.

    **Raises:** `ValueError` before anything compiles for options out of range, unknown names, a
    problem whose parts do not fit, a search that cannot work on the space; `RunError` with the
    finished part of the run when the loop breaks down.
    """
    started = time.perf_counter()
    _check_options(budget, batch, seed, max_seconds, stop_after)
    search = _check_search(problem, search)
    problem.check()
    batch = min(batch, budget)
    place = _new_folder(folder)
    rounds = _Rounds(problem, search, batch, seed, ErrorTable(tuple(problem.space.columns), place))

    def run(stopped: str) -> Run:
        return Run(
            name=problem.name,
            formulas={name: str(formula) for name, formula in problem.formulas.items()},
            table=rounds.table,
            search=repr(search),
            seed=int(seed),
            batch=batch,
            stopped=stopped,
            compile_seconds=rounds.compile_seconds,
            run_seconds=time.perf_counter() - started - rounds.compile_seconds,
            version=verifai_jax.__version__,
            prior=search.samples_prior,
            folder=place,
            target=target,
            problem=problem,
        )

    if place is not None:
        write_record(run("running"), place)
    stopped, cause = "budget", None
    try:
        with Progress(problem.name, budget, progress) as bar:
            rounds.compile()
            # Checking and tracing are part of what a second run of the problem does not repeat.
            rounds.compile_seconds = time.perf_counter() - started
            while len(rounds.table) < budget:
                rounds.advance(min(batch, budget - len(rounds.table)))
                bar.update(len(rounds.table), rounds.found, rounds.best)
                if stop_after is not None and rounds.found >= stop_after:
                    stopped = "stop_after"
                    break
                overtime = max_seconds is not None and time.perf_counter() - started >= max_seconds
                if overtime and len(rounds.table) < budget:
                    stopped = "max_seconds"
                    break
    except KeyboardInterrupt:
        stopped = "interrupted"
    except Exception as error:
        stopped, cause = f"{type(error).__name__}: {error}", error
    result = run(stopped)
    rounds.table.close()
    if place is not None:
        write_record(result, place)
    if cause is not None:
        raise RunError(
            f"the run of {problem.name!r} broke down after {len(rounds.table)} simulations, which "
            f"are in the .run of this error{f' and in {place}' if place else ''}: {cause}",
            result,
        ) from cause
    return result


class _Rounds:
    """The state of a run between rounds, and one round of it."""

    def __init__(
        self, problem: Problem, search: Search, batch: int, seed: int, table: ErrorTable
    ) -> None:
        self.problem, self.search, self.batch, self.table = problem, search, batch, table
        self.engine = (
            HostEngine(problem)
            if problem.black_box
            else engine_for(problem, batch, gradient=search.wants_gradient)
        )
        self.search_key, self.simulation_key = run_keys(seed)
        self.found, self.best = 0, float("nan")
        self.compile_seconds = 0.0
        self.program: Any = None
        self.state: Any = None

    def compile(self) -> None:
        self.engine.compile()
        cube = Cube(tuple(self.problem.space.levels))
        self.program = _search_program(self.search, cube, self.batch)
        self.state = self.program.init(self.search_key)

    def advance(self, n: int) -> None:
        """Ask, evaluate, tell and store `n` simulations."""
        first = len(self.table)
        u, self.state = self.program.ask(self.state)
        temperature = self.program.temperature(self.state)
        evaluation = self.engine.evaluate(u[:n], self.simulation_key, first, temperature)
        rho = np.min(evaluation.rho, axis=1)
        proper = evaluation.status == Status.OK
        violated = np.any(evaluation.rho < 0, axis=1)
        undecided = proper & ~violated & np.any(evaluation.rho == 0, axis=1)
        if undecided.any():
            # At exactly zero the comparator decides: x >= 0 holds there, x > 0 does not.
            holds = evaluation.holds
            if holds is None:
                assert isinstance(self.engine, Engine)
                compiled = self.engine.compile_seconds
                holds = self.engine.verdicts(u[:n], self.simulation_key, first)
                self.compile_seconds += self.engine.compile_seconds - compiled
            violated |= undecided & ~np.all(holds, axis=1)
        self.state = self.program.tell(
            self.state,
            Evaluated(
                u=u,
                rho=_fill(rho, self.batch, np.nan),
                counted=_fill(proper, self.batch, False),
                gradient=None
                if evaluation.gradient is None
                else _fill(evaluation.gradient, self.batch, 0.0),
            ),
        )
        self.table.append(self._columns(evaluation, rho, violated))
        self.found += int(np.sum(violated))
        self.best = float(np.fmin(self.best, np.fmin.reduce(rho)))

    def _columns(self, evaluation: Evaluation, rho: Any, violated: Any) -> dict[str, Any]:
        columns: dict[str, Any] = {**self.problem.space.rows(evaluation.features), "rho": rho}
        if len(self.problem.formulas) > 1:
            for i, name in enumerate(self.problem.formulas):
                columns[f"rho.{name}"] = evaluation.rho[:, i]
        columns |= {"violated": violated, "status": STATUS_NAMES[evaluation.status]}
        if evaluation.messages is not None:
            columns["message"] = np.array(evaluation.messages, dtype=object)
        return columns


def _fill(rows: Any, batch: int, value: Any) -> Any:
    if len(rows) == batch:
        return rows
    return np.concatenate([rows, np.full((batch - len(rows), *rows.shape[1:]), value, rows.dtype)])


class _SearchProgram(NamedTuple):
    init: Any
    ask: Any
    tell: Any
    temperature: Any


@lru_cache(maxsize=64)
def _search_program(search: Search, cube: Cube, batch: int) -> _SearchProgram:
    """The compiled `init / ask / tell` of one search on one cube."""
    key = jax.eval_shape(lambda: jax.random.key(0, impl="threefry2x32"))
    init = jax.jit(lambda key: search.init(key, cube, batch)).lower(key).compile()
    state = jax.eval_shape(lambda key: search.init(key, cube, batch), key)
    ask = jax.jit(lambda state: search.ask(state, cube, batch)).lower(state).compile()
    points: Any = jax.ShapeDtypeStruct((batch, cube.dim), jnp.float32)
    rho: Any = jax.ShapeDtypeStruct((batch,), jnp.float32)
    counted: Any = jax.ShapeDtypeStruct((batch,), jnp.bool_)
    evaluated = Evaluated(points, rho, counted, points if search.wants_gradient else None)
    tell = jax.jit(lambda state, told: search.tell(state, cube, told))
    tell = tell.lower(state, evaluated).compile()
    temperature: Any = lambda state: 1.0  # noqa: E731
    if search.wants_gradient:
        temperature = jax.jit(search.temperature).lower(state).compile()
    return _SearchProgram(init, ask, tell, temperature)


def _is_integer(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _check_options(budget: Any, batch: Any, seed: Any, max_seconds: Any, stop_after: Any) -> None:
    for name, value in (("budget", budget), ("batch", batch), ("stop_after", stop_after)):
        if name == "stop_after" and value is None:
            continue
        if not _is_integer(value) or value < 1:
            raise ValueError(f"{name} must be an integer of at least 1; got {value!r}")
    if not _is_integer(seed) or not 0 <= seed < 2**63:
        raise ValueError(f"seed must be an integer from 0 to 2**63 - 1; got {seed!r}")
    if max_seconds is not None and not max_seconds > 0:
        raise ValueError(f"max_seconds must be positive; got {max_seconds!r}")


def _check_search(problem: Any, search: Any) -> Search:
    if not isinstance(problem, Problem):
        raise TypeError(f"falsify needs a Problem; got {type(problem).__name__}")
    if isinstance(search, str):
        search = searches.named(search)
    if isinstance(search, type) or not hasattr(search, "ask"):
        raise TypeError(f"search must be a name or a search like CrossEntropy(); got {search!r}")
    if problem.black_box and search.wants_gradient:
        raise ValueError(
            f"the system of problem {problem.name!r} is a black box, which has no gradient, and "
            f"search {search!r} needs one; use one that does not, such as 'cross_entropy'"
        )
    search.check(Cube(tuple(problem.space.levels)))
    return search


def _new_folder(folder: str | Path | None) -> Path | None:
    if folder is None:
        return None
    place = Path(folder)
    if place.exists() and (not place.is_dir() or any(place.iterdir())):
        raise ValueError(f"folder {str(place)!r} exists and is not empty; a run needs a new one")
    place.mkdir(parents=True, exist_ok=True)
    return place
