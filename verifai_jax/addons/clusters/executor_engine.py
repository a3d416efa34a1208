"""Verdicts from the workers of an executor: rows are sent in blocks, and verdicts joined in order.

    engine = ExecutorEngine(problem, batch=1024, executor=client.get_executor())
    engine.evaluate(u, key, first=0)                    # Verdicts, as of `engine.Engine`
    pending = engine.submit(u, key, first=0)            # the same in two steps
    pending.result()

The verdict of a row depends only on its point and its number, so the number and order of workers do
not matter, nor whether some died and the executor repeated their blocks. The size of blocks is
chosen by measurement to take about a second.
"""

from collections import deque
from itertools import pairwise
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Key, UInt32

from verifai_jax.addons.clusters import executors
from verifai_jax.addons.clusters.worker import ARRAYS, BlockMode, evaluate_block, question_of
from verifai_jax.core.compute.compilation import Slot, power_of_two
from verifai_jax.core.compute.devices import describe_processor
from verifai_jax.evaluation.guidance import NOTHING, Guidance
from verifai_jax.evaluation.host_engine import HostEngine
from verifai_jax.evaluation.journal import Journal
from verifai_jax.evaluation.layout import chunks_and_lanes
from verifai_jax.evaluation.remarks import Remarks
from verifai_jax.evaluation.verdicts import RowVerdict, Verdicts
from verifai_jax.problem.problem import Problem

AT_FIRST = 8
"""Units of a compiled block, before it is known how long one takes: few enough to learn it soon."""
TOGETHER = 128
"""Rows of a host system that simulates batches, of which a block is a multiple: fixed, since its
numbers may depend on how many rows are simulated together."""
WORTH_KEEPING = 0.01
"""Seconds of a simulation from which on finished rows are journalled before their batch is: what
is quicker is simulated again instead."""
IN_FLIGHT = 3
"""Blocks on their way for each worker, so that none waits for the next one."""
MAX_DROPPED = 100
"""Answers to other calls after which an executor is given up: a bound, so that no run waits for
ever for one that mixes up its answers."""
MAX_AHEAD = 1 << 22
"""Rows at most that are on their way at a time: a bound on the memory that they take."""
SHIPMENTS: Slot[str, Any] = Slot("shipments")
"""The problem as it is sent, by kind of executor."""


class ExecutorEngine:
    """Evaluates any number of rows on an executor's workers; see the module's docstring.

    **Arguments:**
    - `problem`: a checked problem, on the backend on which it should run.
    - `batch`: number of rows of a batch on one machine, for the number of parallel lanes.
    - `executor`: an executor with `submit`.
    - `gradient`, `clauses`, `precision`, `guidance`: as in `engine.Engine`.
    - `given`: whether points are rows of given features, as in `CubePoints`.
    - `journal`: the journal of rows in progress, for a problem on the host.
    **Raises:** `TypeError` for anything that is not an executor; `ValueError` for an executor that
    cannot work here, or to which the problem cannot be sent.
    """

    def __init__(
        self, problem: Problem, batch: int, executor: executors.Executor, *, gradient: bool = False,
        clauses: bool = False, precision: str = "float32", journal: Journal | None = None, guidance:
        Guidance = NOTHING, given: bool = False,
    ) -> None:  # fmt: skip
        self.problem, self.executor, self.precision = problem, executor, precision
        self.compile_seconds = 0.0
        self._journal = journal if problem.black_box else None
        self._shipment = shipped(problem, executor)
        form = problem.space.feature_form
        self._features: Any = jax.tree.structure(form)
        _, lanes = chunks_and_lanes(problem, batch, len(jax.local_devices()))
        smallest = power_of_two(batch)
        backend = problem.system.backend if problem.system.backends else None
        self.mode = BlockMode(
            lanes, gradient, clauses, precision, smallest, backend, guidance, given
        )
        self._dtype = np.dtype(precision if given else "float32")
        self.unit = lanes
        if problem.black_box:
            self.unit = TOGETHER if problem.system.can_simulate_batch else 1
        self.padded = lanes
        self._seconds: float | None = None  # Of a row, once one is known.
        self._notes: dict[str, None] = {}
        self._remarks = Remarks()
        self._dropped = 0  # Answers that belonged to other calls.
        self._recalling: HostEngine | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions of the workers' engines that may surprise a user, and other processors."""
        dropped = f"{self._dropped} answers of workers belonged to other calls and were dropped"
        return (*self._notes, *self._remarks.texts, *([dropped] if self._dropped else []))

    @property
    def block(self) -> int:
        """Number of rows in a block that takes about `seconds_per_block`."""
        if self._seconds is None:
            return self.unit * (1 if self.problem.black_box else AT_FIRST)
        wanted = executors.seconds_per_block(self.executor)
        rows = int(min(wanted / max(self._seconds, 1e-9), MAX_AHEAD // 8))
        return max(self.unit, rows - rows % self.unit)

    @property
    def ahead(self) -> int:
        """Number of rows to send ahead so that all workers stay busy."""
        return min(MAX_AHEAD, IN_FLIGHT * executors.count_workers(self.executor) * self.block)

    def begin_compiling(self) -> None:
        """Do nothing, because workers compile with their first block."""

    def compile(self) -> None:
        """Do nothing, because workers compile with their first block."""

    def evaluate(
        self, rows: Float[Any, "n d"], key: Key[Array, ""], first: int = 0,
        temperature: Float[np.ndarray, " n"] | Float[Array, ""] | float = 1.0,
    ) -> Verdicts:  # fmt: skip
        """Simulate and evaluate rows on the workers; arguments as in `engine.Engine.evaluate`."""
        return self.submit(rows, key, first, temperature).result()

    def submit(
        self, rows: Float[Any, "n d"], key: Key[Array, ""], first: int = 0,
        temperature: Float[np.ndarray, " n"] | Float[Array, ""] | float = 1.0,
    ) -> "Pending":  # fmt: skip
        """Send rows to the workers, and return an object that waits for their verdicts."""
        u = np.ascontiguousarray(rows, self._dtype)
        pending = Pending(self, u, key, first, np.asarray(temperature, np.float32))
        pending.send()
        return pending

    def send(self, *arguments: Any) -> executors.Future:
        """Send a block to a worker: words of the key, first number, points, temperatures.

        **Raises:** `ValueError` if it cannot be sent.
        """
        try:
            return self.executor.submit(evaluate_block, self._shipment, self.mode, *arguments)
        except (TypeError, AttributeError, OSError) as error:
            raise ValueError(
                f"the problem {self.problem.name!r} cannot be sent to the workers: {error}"
            ) from error

    def is_answer(
        self, result: dict[str, Any], words: UInt32[np.ndarray, "2"], first: int, u: Any
    ) -> bool:
        """Return whether a result belongs to this call; count results that do not.

        **Raises:** `WorkerError` if there are too many of those.
        """
        question = question_of(self._shipment, words, first, u)
        if result.get("question", question) == question:
            return True
        self._dropped += 1
        if self._dropped > MAX_DROPPED:
            raise executors.WorkerError(
                f"{self._dropped} answers of the executor belonged to other calls than their "
                "futures; finished work is kept: resume with another executor"
            )
        return False

    def step(self, count: int) -> int:
        """Return the number of rows in the next block: enough for all workers, but not too long."""
        share = -(-count // executors.count_workers(self.executor))
        rows = min(self.block, max(share, self.block // 8))
        return -(-rows // self.unit) * self.unit

    def runs(self, u: Float[np.ndarray, "n d"], first: int) -> list[tuple[int, int, bool]]:
        """Split rows into those already in the journal and others, in their order."""
        known = set() if self._journal is None else set(self._journal.recall(first, u))
        if not known:
            return [(0, len(u), False)] if len(u) else []
        flags = np.array([i in known for i in range(len(u))])
        ends = [0, *(np.flatnonzero(flags[1:] != flags[:-1]) + 1).tolist(), len(u)]
        return [(a, b, bool(flags[a])) for a, b in pairwise(ends)]

    def recall(self, u: Float[np.ndarray, "n d"], key: Key[Array, ""], first: int) -> Verdicts:
        """Return the verdicts of rows in the journal."""
        if self._recalling is None:
            self._recalling = HostEngine(
                self.problem, self.precision, self._journal,
                guidance=self.mode.guidance, given=self.mode.given,
            )  # fmt: skip
        return self._recalling.evaluate(u, key, first, padded_to=self.mode.padded_to)

    def receive(self, result: dict[str, Any], u: Float[np.ndarray, "n d"], first: int) -> Verdicts:
        """Return the verdicts of one block, and record the information on its worker."""
        verdicts = Verdicts(
            **{name: result[name] for name in ARRAYS if name in result},
            features=jax.tree.unflatten(self._features, result["leaves"]),
            messages=result["messages"],
        )
        count = len(verdicts.status)
        if count >= self.unit or self._seconds is None:
            self._seconds = result["seconds"] / count
        here = describe_processor()
        if result["processor"] != here:
            self._notes[
                f"some rows were simulated on {result['processor']}, which is not the kind of "
                f"processor here ({here}): their last digits may differ from those of a run here"
            ] = None
        self._notes.update(dict.fromkeys(result["notes"]))
        if "remarks" in result:
            self._remarks.join(result["remarks"])
        if self._journal is not None and result["seconds"] > WORTH_KEEPING * count:
            for i in range(count):
                coverage_ids = None if verdicts.coverage_ids is None else verdicts.coverage_ids[i]
                message = "" if verdicts.messages is None else verdicts.messages[i]
                holds = np.array(not verdicts.violated[i])
                guidance = None if verdicts.guidance is None else verdicts.guidance[i]
                rho, status = verdicts.rho[i], int(verdicts.status[i])
                row = RowVerdict(rho, status, holds, message, coverage_ids, guidance)
                self._journal.add(first + i, u[i], row)
        return verdicts


class Pending:
    """Rows sent to workers; call `result` once to wait for them.

    Only a few blocks for each worker are sent at a time, so that the size of later ones can follow
    from the time of the first.

    **Arguments:**
    - `engine`: the engine that sends them.
    - `u`: the points of the rows.
    - `key`, `first`: as in `ExecutorEngine.submit`.
    - `temperature`: one temperature for all rows, or one for each.
    """

    def __init__(
        self, engine: ExecutorEngine, u: Float[np.ndarray, "n d"], key: Key[Array, ""], first: int,
        temperature: Float[np.ndarray, "*n"],
    ) -> None:  # fmt: skip
        self._engine, self._u, self._key, self._first = engine, u, key, first
        self._temperature, self._words = temperature, np.asarray(jax.random.key_data(key))
        runs = engine.runs(u, first)
        self._known = [(begin, end) for begin, end, known in runs if known]
        self._unsent = deque((begin, end) for begin, end, known in runs if not known)
        self._sent: list[tuple[int, int, executors.Future]] = []
        self._ended = 0
        self._verdicts: Verdicts | None = None

    def send(self) -> list[executors.Future]:
        """Send blocks until each worker has a few, and return the new ones."""
        maximum = self._ended + IN_FLIGHT * executors.count_workers(self._engine.executor)
        already = len(self._sent)
        while self._unsent and len(self._sent) < maximum:
            begin, end = self._unsent.popleft()
            left = end - begin + sum(b - a for a, b in self._unsent)
            stop = min(begin + self._engine.step(left), end)
            if stop < end:
                self._unsent.appendleft((stop, end))
            some = self._temperature
            some = some[begin:stop] if some.ndim else float(some)
            future = self._engine.send(self._words, self._first + begin, self._u[begin:stop], some)
            self._sent.append((begin, stop, future))
        return [future for _, _, future in self._sent[already:]]

    def result(self) -> Verdicts:
        """Return the verdicts in the order of the rows.

        **Raises:** `WorkerError` if a worker died and its block was not run again; otherwise the
        error of an evaluation. Queued blocks are then cancelled.
        """
        if self._verdicts is None:
            found: dict[int, Verdicts] = {}
            for begin, stop in self._known:
                u = self._u[begin:stop]
                found[begin] = self._engine.recall(u, self._key, self._first + begin)

            def ended(index: int, result: dict[str, Any]) -> None:
                begin, stop, _ = self._sent[index]
                u, first = self._u[begin:stop], self._first + begin
                self._ended += 1
                if not self._engine.is_answer(result, self._words, first, u):
                    self._unsent.appendleft((begin, stop))  # It is asked again.
                    return
                found[begin] = self._engine.receive(result, u, first)

            executors.gather([future for _, _, future in self._sent], ended, self.send)
            self._verdicts = Verdicts.concatenate([found[begin] for begin in sorted(found)])
        return self._verdicts

    def cancel(self) -> None:
        """Remove blocks that have not started from the queue."""
        self._unsent.clear()
        for _, _, future in self._sent:
            future.cancel()


def shipped(problem: Problem, executor: executors.Executor) -> executors.Shipment[Problem]:
    """Return the problem as it is sent through this kind of executor, kept with its programs."""
    return problem.programs.get(
        SHIPMENTS,
        type(executor).__module__ + type(executor).__name__,
        lambda: executors.ship(problem, executor, problem.target, identity),
    )


def identity(problem: Problem) -> dict[str, str]:
    """Return texts that identify a problem: name, formulas and features."""
    return {
        "name": problem.name,
        "formulas": str({name: str(formula) for name, formula in problem.formulas.items()}),
        "features": str(tuple(problem.space.columns)),
        "levels": str(tuple(problem.space.levels)),
    }
