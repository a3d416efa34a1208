"""The simulations of a run, in rounds; the first rows may be timed one by one.

    simulations = Simulations(problem, search, batch=32, seed=0, precision="float32", ...)
    verdicts = simulations(points, first=0)                      # of a round
    verdicts = simulations(points, first=32, differentiate=True, temperature=temperature)
    seconds = simulations.measure(points)                        # of a black box

Derivatives of clauses are needed for some rounds only, so a second evaluator computes them; it is
compiled on demand.
"""

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from verifai_jax.core.compute.compilation import power_of_two
from verifai_jax.evaluation.engine import Wanted
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.guidance import Guidance
from verifai_jax.evaluation.raising import ALIKE, ALWAYS, Raising
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.falsification.validation import SLOW
from verifai_jax.mtl.clauses import goals_of
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search

if TYPE_CHECKING:
    from verifai_jax.core.compute.executors import Executor
    from verifai_jax.evaluation.journal import Journal
MAX_DIFFERENTIATED = 16
"""Rows whose clauses are differentiated in one call of the engine."""
MEASURED = 2
"""First rows of a black box that are timed; in the first one a simulator may prepare itself. More
follow one by one, up to `ALWAYS`, while all raise."""


class Simulations:
    """Evaluators with and without derivatives of clauses, and the first rows if they are timed.

    **Arguments:**
    - `problem`: the problem, on the backend on which it runs.
    - `search`: the search; it determines what is computed in addition to the robustness.
    - `batch`: maximum number of simulations in a round.
    - `seed`: the seed of the run.
    - `precision`, `journal`, `executor`, `guidance`, `keep_traces`, `given`,
      `engine`, `budget`: as for `Evaluator`.

    `hopeless` is the error that all timed rows raised; None if one of them did not.
    """

    def __init__(
        self, problem: Problem, search: Search, batch: int, seed: int, *, precision: str,
        journal: "Journal | None", executor: "Executor | None", guidance: Guidance,
        keep_traces: bool, given: bool = False, engine: Wanted = "xla", budget: int = 0,
    ) -> None:  # fmt: skip
        self.batch, self.keep_traces, self._journals = batch, keep_traces, True
        evaluator = partial(
            Evaluator, problem, precision=precision, seed=seed, executor=executor,
            guidance=guidance, engine=engine, budget=budget,
        )  # fmt: skip
        self.evaluate = evaluator(
            batch,
            gradient=search.wants.gradient,
            # Of goals that have one each, that is the robustness, which costs less.
            clauses=search.wants.clauses and goals_of(problem.formulas.values()).max_clauses > 1,
            journal=journal,
            keep_traces=keep_traces,
            given=given,
        )
        self._differentiate: Evaluator | None = None
        if search.wants.clauses:
            maximum = min(batch, MAX_DIFFERENTIATED)
            # Of few rows, which are not worth a native program unless it is asked for.
            wanted = "native" if engine == "native" else "xla"
            self._differentiate = evaluator(maximum, gradient=True, clauses=True, engine=wanted)
        self._measured: Verdicts | None = None
        self.hopeless: str | None = None

    @property
    def differentiates(self) -> bool:
        """True if some rounds are differentiated."""
        return self._differentiate is not None

    @property
    def compile_seconds(self) -> float:
        """Seconds that all evaluators have spent compiling."""
        more = 0.0 if self._differentiate is None else self._differentiate.compile_seconds
        return self.evaluate.compile_seconds + more

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions of the engines that a user may not expect."""
        more = () if self._differentiate is None else self._differentiate.notes
        return (*self.evaluate.notes, *more)

    @property
    def measured(self) -> int:
        """Number of rows that are already simulated and wait for their round."""
        return 0 if self._measured is None else len(self._measured.status)

    def begin_derivatives(self) -> None:
        """Trace derivatives now, and compile them in the background."""
        if self._differentiate is not None:
            self._differentiate.begin_compiling()

    def __call__(
        self, points: Float[Any, "n d"], first: int, *, differentiate: bool = False,
        temperature: Float[np.ndarray, " n"] | float = 1.0,
    ) -> Verdicts:  # fmt: skip
        """Simulate and evaluate the points of a round.

        **Arguments:**
        - `points`: the points of the unit cube.
        - `first`: number of the first point in the run.
        - `differentiate`: whether derivatives of their clauses are wanted.
        - `temperature`: the temperature of the smooth robustness, one for all or one each.
        """
        if self._measured is not None:
            return self._after_measured(points, first)
        if self._differentiate is None:
            return self.evaluate(
                points, temperature, first, keep_traces=self.keep_traces, journals=self._journals
            )
        if differentiate:
            return self._differentiate(points, temperature, first)
        return self.evaluate(points, first=first)

    def measure(self, points: Float[np.ndarray, "n d"], timed: bool) -> float:
        """Simulate the first rows of the run, and return the shortest time of one in seconds.

        Rows are simulated one by one; if the first is quick and does not raise, it is the only one.
        If no time is needed, an engine for many rows gets them together. Their round does not
        simulate them again. If all of many raise, `hopeless` is their error, else None.
        """
        from verifai_jax.evaluation.host_engine import HostEngine

        engine = self.evaluate.engine
        assert isinstance(engine, HostEngine)
        points, raising = points[:ALWAYS], Raising()
        together = ALIKE if not timed and engine.system.can_simulate_each else 1
        seconds, parts = float("inf") if len(points) else 0.0, []
        for row in range(0, len(points), together):
            some = points[row : row + together]
            verdicts = self.evaluate(some, first=row, padded_to=self._full_batch, keep_traces=True)
            parts.append(verdicts)
            raising.add(verdicts.status, verdicts.messages)
            # Without the compilation of the monitor.
            seconds = min(seconds, engine.simulation_seconds)
            known = seconds < SLOW or row + 1 >= MEASURED
            if known and (not raising.always or raising.reason is not None):
                break
        self.hopeless = raising.reason
        self._measured = Verdicts.concatenate(parts) if parts else None
        return seconds

    def regroup(self, batch: int, keep_traces: bool) -> None:
        """Use another batch size; with traces, regroup those of rows already simulated too.

        Rows of a journal have no traces, so the journal is not used then.
        """
        self.batch = self.evaluate.batch = batch
        if keep_traces:
            self.keep_traces, self._journals = True, False

    def _after_measured(self, points: Float[Any, "n d"], first: int) -> Verdicts:
        """Return the verdicts of the first round, whose first rows are simulated already."""
        known, self._measured = self._measured, None
        assert known is not None
        count = len(known.status)
        if len(points) <= count:
            return known
        rest = self.evaluate(
            np.asarray(points)[count:], first=first + count, padded_to=self._full_batch,
            keep_traces=self.keep_traces, journals=self._journals,
        )  # fmt: skip
        if not self.keep_traces:
            known = known._replace(traces=None)
        return Verdicts.concatenate([known, rest])

    @property
    def _full_batch(self) -> int:
        """Rows that rows on their own are padded to, to be those of a whole batch bit for bit."""
        return power_of_two(self.batch)
