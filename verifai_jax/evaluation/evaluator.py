"""Any number of points of the unit cube, simulated and evaluated in batches of one shape.

    evaluate = Evaluator(problem, batch=512, seed=0)
    verdicts = evaluate(u)                              # u [n, d], any n: Verdicts

Every function that simulates points uses an evaluator, which returns verdicts. It chooses the
engine that suits the problem, compiled or on the host, or sends points to the workers of an
executor. The random key of a simulation follows from its number.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.core.compute.compilation import power_of_two
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.display.extensions import extension, extensions
from verifai_jax.core.display.progress import count_done
from verifai_jax.evaluation.engine import FIRST, Wanted, engine_for
from verifai_jax.evaluation.guidance import NOTHING, Guidance
from verifai_jax.evaluation.kept_work import present_part
from verifai_jax.evaluation.raising import ALIKE, Raising
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    from verifai_jax.core.compute.executors import Executor
    from verifai_jax.evaluation.host_engine import HostEngine
    from verifai_jax.evaluation.journal import Journal
    from verifai_jax.evaluation.unfinished import Part
ENGINES = "verifai_jax.engines"
"""Entry points of engines: one around XLA's, and one that sends rows to an executor's workers."""
NATIVE, EXECUTOR = "native", "executor"
NOT_NATIVE = (
    "simulated without native code, which supports only systems that JAX traces, in single "
    "precision and in this process"
)
"""Note of a run for which requested native code was not possible."""


@runtime_checkable
class Pending(Protocol):
    """Points on their way to the workers of an executor."""

    def result(self) -> Verdicts:
        """Wait for the verdicts, in the order of the points."""
        ...

    def cancel(self) -> None:
        """Remove points that have not started from the workers' queue."""
        ...


class Evaluator:
    """Simulates and evaluates points of a problem's unit cube; `simulations` counts them.

    `sender` is the engine that sends points to workers; None in this process.

    **Arguments:**
    - `problem`: a checked problem, on the backend on which it should run.
    - `batch`: maximum number of simulations at once; fewer points are padded.
    - `gradient`: whether to differentiate the smooth robustness as well.
    - `clauses`: whether to evaluate and differentiate clauses instead.
    - `precision`: `"float32"` or `"float64"`.
    - `seed`: the seed of the random keys of simulations; as in `falsify`.
    - `journal`: the journal of rows in progress, for a problem on the host.
    - `executor`: an executor with the `submit` of `concurrent.futures`, whose workers simulate;
      this process when left out.
    - `guidance`: additional results for a search.
    - `keep_traces`: whether verdicts include traces, in this process; or names of signals that
      these should have in addition to the monitored ones.
    - `given`: whether points may include rows of user-given features (`given_rows`).
    - `engine`: `"native"` to simulate rows with native code, or `"auto"` to decide by `budget`, the
      number of simulations of the run; see `evaluation.native_engine`.
    - `ends_raising`: whether a call raises `AlwaysRaises` if all of the first simulations raise.
    """

    def __init__(
        self,
        problem: Problem,
        batch: int = 512,
        *,
        gradient: bool = False,
        clauses: bool = False,
        precision: str = "float32",
        seed: int = 0,
        journal: "Journal | None" = None,
        executor: "Executor | None" = None,
        guidance: Guidance = NOTHING,
        keep_traces: bool | tuple[str, ...] = False,
        given: bool = False,
        ends_raising: bool = False,
        engine: Wanted = "xla",
        budget: int = 0,
    ) -> None:
        self._raising = Raising() if ends_raising else None
        self.problem, self.batch = problem, batch
        self.given = given and problem.space.width > 0
        # Points are float32 whatever the precision; what a person gives is not.
        self._dtype = np.dtype(precision if self.given else "float32")
        self.engine: Any
        self._host: HostEngine | None = None
        self.sender: Any = None
        self._native: Any = None
        if executor is not None:
            self.engine = self.sender = extension(ENGINES, EXECUTOR)(
                problem, batch, executor, gradient=gradient, clauses=clauses,
                precision=precision, journal=journal, guidance=guidance, given=self.given,
            )  # fmt: skip
        elif problem.black_box:
            from verifai_jax.evaluation import host_engine

            self.engine = self._host = host_engine.HostEngine(
                problem, precision, journal, guidance=guidance, given=self.given,
                keep_traces=keep_traces is not False,
            )  # fmt: skip
        else:
            others = keep_traces if isinstance(keep_traces, tuple) else ()
            guidance = guidance._replace(trace=keep_traces is not False, signals=others)
            self.engine = compiled = engine_for(
                problem, batch, gradient, precision, clauses, guidance, self.given
            )
            wanted = engine == "native" or (engine == "auto" and budget > FIRST)
            possible = precision == "float32" and keep_traces is False
            if wanted and possible and NATIVE in extensions(ENGINES):
                around = extension(ENGINES, NATIVE)
                self.engine = self._native = around(compiled, engine, budget)
        self._not_native = ()
        if engine == "native" and self._native is None:
            self._not_native = (NOT_NATIVE,)
        # Features of few points are those of a whole batch, bit for bit.
        self._padded_to = power_of_two(batch) if ends_raising else 1
        self.key: Key[Array, ""] = run_keys(seed)[1]
        self.simulations = 0
        self._mode = (precision, gradient, clauses, given, seed)
        self._kept: Part | None = None
        self._keeps_traces = keep_traces is not False

    @property
    def compile_seconds(self) -> float:
        """Seconds that the engine has spent compiling."""
        return self.engine.compile_seconds

    @property
    def simulated_by(self) -> Literal["auto", "xla", "native", "host"]:
        """The engine that simulates rows, `"auto"` until decided; `"host"` for black boxes."""
        if self._native is not None:
            return self._native.chosen
        return "host" if self.problem.black_box else "xla"

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions of the engine that may surprise a user."""
        return (*self.engine.notes, *self._not_native)

    def begin_compiling(self) -> None:
        """Trace now, and compile in the background."""
        self.engine.begin_compiling()

    def compile(self) -> None:
        """Compile now, so that calls only run."""
        self.engine.compile()

    def __call__(
        self, u: Float[Any, "n d"], temperature: Float[np.ndarray, " n"] | float = 1.0,
        first: int | None = None, *, padded_to: int = 1, keep_traces: bool | None = None,
        journals: bool = True,
    ) -> Verdicts:  # fmt: skip
        """Simulate and evaluate these points.

        **Arguments:**
        - `u`: points of the unit cube, or rows of given features.
        - `temperature`: the temperature of the smooth robustness that is differentiated, one for
          all or one each.
        - `first`: number of the first simulation; numbers go on from those before when left out.
        - `padded_to`, `keep_traces`, `journals`: as of `HostEngine.evaluate`, for a black box.
        **Raises:** `AlwaysRaises` where it was asked for.
        """
        start = self.simulations if first is None else first
        u = self.rows_of(u)
        count, parts = len(u), []
        if self.sender is not None and count:
            return self.begin(u, temperature, start).result()
        begin = 0
        while begin < count:
            size = min(self.batch, count - begin)
            if self._looks_often:
                size = min(size, ALIKE)
            block = slice(begin, begin + size)
            some = temperature[block] if isinstance(temperature, np.ndarray) else temperature
            points = u if block.stop - block.start >= count else u[block]
            first_row = start + begin
            if self._host is not None:
                simulate = partial(
                    self._host.evaluate, points, self.key, first_row, some,
                    padded_to=max(padded_to, self._padded_to), keep_traces=keep_traces,
                    journals=journals,
                )  # fmt: skip
            else:
                simulate = partial(self.engine.evaluate, points, self.key, first_row, some)
            parts.append(self._recall_or(points, first_row, some, simulate))
            count_done(len(points))
            self._check_raising(parts[-1])
            begin = block.stop
        self.simulations = start + count
        if not parts:
            return Verdicts.nothing(len(self.problem.formulas), self.problem.space.dim)
        return Verdicts.concatenate(parts)

    def _recall_or(
        self, points: Float[Any, "n d"], first: int, temperature: Float[np.ndarray, " n"] | float,
        simulate: Callable[[], Verdicts],
    ) -> Verdicts:  # fmt: skip
        """Return the verdicts of work that continues after an earlier process was killed."""
        kept = self.part()
        if kept is None:
            return simulate()  # Traces are not stored.
        if self._host is not None and not self._host.system.can_simulate_batch:
            # One by one, which is worth more the longer a simulation takes.
            self._host.journal = kept.journal
            return simulate()
        return kept.recall_or(
            np.asarray(points), np.arange(first, first + len(points)), temperature, simulate
        )

    def part(self) -> "Part | None":
        """Return the stored part of unfinished work for this evaluator, if there is any."""
        if self._keeps_traces:
            return None
        self._kept = present_part(self._kept, self.problem, *self._mode)
        return self._kept

    def begin(
        self, u: Float[Any, "n d"], temperature: Float[np.ndarray, " n"] | float = 1.0,
        first: int | None = None,
    ) -> "Sent":  # fmt: skip
        """Send points to the workers; `result` of the returned object gives the verdicts.

        **Raises:** `TypeError` for an evaluator without an executor.
        """
        start, u = self.simulations if first is None else first, self.rows_of(u)
        self.simulations = start + len(u)
        return Sent(self, u, temperature, start)

    def submit(self, u: Float[Any, "n d"], first: int) -> "Pending":
        """Send points to the executor's workers; `result` of the returned object waits for them.

        **Raises:** `TypeError` for an evaluator without an executor.
        """
        return self._send(self.rows_of(u), first, 1.0)

    def _send(
        self, u: Float[Any, "n row"], first: int, temperature: Float[np.ndarray, " n"] | float
    ) -> "Pending":
        if self.sender is None:
            raise TypeError("points are sent to workers only by an evaluator with an executor")
        return self.sender.submit(u, self.key, first, temperature)

    def rows_of(self, u: Float[Any, "n d"]) -> Float[Any, "n row"]:
        """Return points as rows of the engine, which are longer if features may be given."""
        if self.given and u.shape[1] == self.problem.space.dim:
            u = np.pad(u, ((0, 0), (0, self.problem.space.width)), constant_values=np.nan)
        return u if u.dtype == self._dtype else np.asarray(u, self._dtype)

    @property
    def _looks_often(self) -> bool:
        """Whether few rows are simulated at a time, since all may raise."""
        if self._raising is None or not self._raising.always:
            return False
        return self._host is not None and not self._host.system.can_simulate_batch

    def _check_raising(self, verdicts: Verdicts) -> None:
        if self._raising is not None:
            self._raising.add(verdicts.status, verdicts.messages)
            self._raising.check(self.problem.name)


class Sent:
    """Points sent to workers, unless their verdicts are already stored; see `Evaluator.begin`."""

    def __init__(
        self, evaluator: Evaluator, u: Float[Any, "n row"],
        temperature: Float[np.ndarray, " n"] | float, first: int,
    ) -> None:  # fmt: skip
        self._evaluator, self._asked = evaluator, (u, first, temperature)
        kept, numbers = evaluator.part(), np.arange(first, first + len(u))
        self._known = None if kept is None else kept.recall(np.asarray(u), numbers, temperature)
        self._pending: Pending | None = None
        if self._known is None:
            self._pending = evaluator._send(u, first, temperature)

    def result(self) -> Verdicts:
        """Wait for the verdicts, and count them; call it once."""
        if self._pending is None:
            assert self._known is not None
            verdicts = self._known
        else:
            verdicts = self._evaluator._recall_or(*self._asked, self._pending.result)
        count_done(len(self._asked[0]))
        self._evaluator._check_raising(verdicts)
        return verdicts

    def cancel(self) -> None:
        """Remove points that have not started from the workers' queue."""
        if self._pending is not None:
            self._pending.cancel()
