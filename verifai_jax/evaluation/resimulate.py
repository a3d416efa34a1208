"""Rows of a table simulated again, many at a time: in a chosen precision and at a finer step.

    features = problem.space.features_of(rows, "float64")   # [n, ...], the values of the table
    again = Replays(problem, "float64", key)
    [verdicts] = again(1, [features], numbers)          # [n] rows, at the system's own step
    finer, moved = again(4, [features, others], numbers)    # twice, at a quarter of it

A system that can be refined has `refined(factor) -> system`: the same sampling and the same control
decisions, with a `factor` times smaller step. With `traced_factor = True` its factor may be traced
by JAX, and one program replays at every step.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree

from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.devices import enable_compile_cache
from verifai_jax.core.compute.keys import as_key, simulation_key
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.display.extensions import verb
from verifai_jax.core.display.progress import count_done
from verifai_jax.core.messages.text import format_error
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.engine import Engine
from verifai_jax.evaluation.row import TableRows
from verifai_jax.evaluation.row_program import RowProgram
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import System

if TYPE_CHECKING:
    from verifai_jax.core.compute.executors import Executor
ONE_BY_ONE = 16
"""Rows up to which they are replayed one after the other: that program is compiled much sooner."""
SEEDS = 32
"""Seeds of a host system's rows that are made in one call, so that one program makes all."""
LANES = (64, 256)
"""Rows that all devices replay together if there are more, and that each does where there are more
than `CALLS` calls of the first would take, and much work."""
CALLS, WORK, ROWS_BEFORE = 6, 10**10, 2**17
"""Calls, operations, and rows of the run up to which the larger program is not compiled. It takes
0.3 to 0.6 s to compile, and saves a fifth to two fifths of the time, which for these operations is
2 s (`benchmarks/RESULTS.md`). Of longer runs thousands of rows are replayed, round by round."""


class Refiner:
    """A system with its own step and with finer ones, each made once."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.traced = system.can_refine and system.traced_factor
        self._finer = cache(system.refined)

    def __call__(self, factor: int) -> System:
        """Return the system with a `factor` times smaller step."""
        return self.system if factor == 1 else self._finer(factor)

    def why_not(self, factors: Iterable[int]) -> str | None:
        """Explain why the step cannot be refined; None if it can."""
        if not self.system.can_refine:
            if self.system.exact_step:
                return "the step belongs to the system"
            return "the system has no refined(factor)"
        for factor in factors:
            try:
                self(factor)
            except Exception as error:
                return f"refined({factor}) raised {format_error(error)}"
        return None


class Replays:
    """Replays of a problem that JAX traces.

    **Arguments:**
    - `problem`: the problem on the backend on which it ran.
    - `precision`: the precision of the replays.
    - `key`: the key of the run's simulations, from `run_keys`.

    `draws` tells whether the system uses its random key; `compile_seconds` is the compilation time
    of its programs. The first program is traced here, and its errors are raised here.
    """

    def __init__(self, problem: Problem, precision: str, key: Key[Array, ""]) -> None:
        self.problem, self.precision, self.key = problem, precision, key
        self.refiner = Refiner(problem.system)
        self.compile_seconds = 0.0
        self._make_keys = jax.jit(jax.vmap(partial(simulation_key, key)))
        data = np.asarray(jax.random.key_data(key))
        self._any_keys = cache(lambda count: as_key(np.broadcast_to(data, (count, 2))))
        # Forms alone are traced: no value has to be made up that a user's domain would accept.
        self._form = problem.space.feature_form_in(precision)
        try:
            self.draws = self._engine(1, ONE_BY_ONE).program.draws()
        except Exception:
            if not self.refiner.traced:
                raise
            # It takes integers only, whatever it says of itself.
            self.refiner.traced = False
            self.draws = self._engine(1, ONE_BY_ONE).program.draws()

    def __call__(
        self, factor: int, each: Sequence[PyTree], numbers: Int[np.ndarray, " n"]
    ) -> list[Verdicts]:
        """Simulate the rows of these numbers again, with a `factor` times smaller step.

        **Arguments:**
        - `factor`: by how much the step is smaller; 1 is the system's own step.
        - `each`: features `[n, ...]` of all rows, as `FeatureSpace.features_of` gives them; the
          rows are simulated once with each.
        - `numbers`: the numbers of the rows, which their random keys come from.
        **Returns:** the verdicts of the rows, once for each.
        """
        together = self._together(factor, numbers, len(each))
        features = jax.tree.map(
            lambda form, *leaves: np.concatenate(leaves).astype(form.dtype), self._form, *each
        )
        numbers = np.tile(numbers, len(each))
        engine, parts = self._engine(factor, together), []
        compiled = engine.compile_seconds
        blocks = [slice(i, i + together) for i in range(0, len(numbers), together)]
        while blocks:
            block = blocks.pop(0)
            rows = jax.tree.map(lambda leaf, block=block: leaf[block], features)
            size = len(numbers[block])
            try:
                keys = self._keys(numbers[block], together)
                parts.append(engine.evaluate(rows, keys, shared=np.int32(factor)))
            except Exception as error:
                if engine.alone and size > 1:
                    # Which of them raised is seen one by one.
                    blocks[:0] = [slice(block.start + i, block.start + i + 1) for i in range(size)]
                    continue
                rho = np.full((size, len(self.problem.formulas)), np.nan)
                status, no = np.full(size, Status.ERROR, np.int32), np.zeros(size, bool)
                parts.append(Verdicts(rho, status, no, messages=[format_error(error)] * size))
            count_done(size)
        self.compile_seconds += engine.compile_seconds - compiled
        verdicts = Verdicts.concatenate([part._replace(features=None) for part in parts])
        return verdicts.split(len(each))

    def begin_compiling(self, factor: int, numbers: Int[np.ndarray, " n"], times: int) -> None:
        """Compile in the background the programs that replay these rows this many times."""
        engine = self._engine(factor, self._together(factor, numbers, times))
        compiled = engine.compile_seconds
        # An error in it is reported when rows are replayed.
        with suppress(Exception):
            engine.begin_compiling()
        self.compile_seconds += engine.compile_seconds - compiled

    def _together(self, factor: int, numbers: Int[np.ndarray, " n"], times: int) -> int:
        """Return the number of replays in one call, for numbers of rows and repetitions."""
        if len(numbers) <= ONE_BY_ONE:
            return ONE_BY_ONE
        some, many = LANES[0], LANES[1] * len(jax.local_devices())
        replays, work = len(numbers) * times, factor * self._engine(1, ONE_BY_ONE).program.work
        much = replays * work > WORK or np.max(numbers) > ROWS_BEFORE
        return many if replays > CALLS * some and much else some

    def _keys(self, numbers: Int[np.ndarray, " n"], together: int) -> Key[Array, " together"]:
        if not self.draws:
            # Any keys will do.
            return self._any_keys(together)
        # Always as many, so that one program makes the keys.
        many = numbers[np.minimum(np.arange(together), len(numbers) - 1)]
        return self._make_keys(jnp.asarray(many, jnp.int32))

    def _engine(self, factor: int, together: int) -> Engine:
        traced = self.refiner.traced
        mode = (self.precision, 0 if traced else factor, together)

        def make() -> Engine:
            finer = None if traced else self.refiner(factor)
            refine = self.problem.system.refined if finer is None else lambda _: finer
            engine = Engine(
                self.problem,
                together,
                precision=self.precision,
                inputs=TableRows(self._form, refine),
                own_keys=True,
                alone=together == ONE_BY_ONE,
                # It compiles in a third of the time and runs half again as long.
                effort="least" if together == ONE_BY_ONE else "little",
            )
            # Traced once, however many rows are together.
            engine.program = self.problem.programs.get(ROWS, mode[:2], lambda: engine.program)
            return engine

        return self.problem.programs.get(REPLAYS, mode, make)


REPLAYS: Slot[tuple[str, int, int], Engine] = Slot("replays")
"""Engines by (precision, factor or 0 where it is traced, rows together)."""
ROWS: Slot[tuple[str, int], RowProgram] = Slot("rows of replays")
"""Programs of one row by the first two of these."""


class HostReplays:
    """Replays of a problem on the host, in this process.

    **Arguments:**
    - `problem`, `precision`, `key`: as in `Replays`.

    `draws` is False: a black box gets an integer seed, which is the same in every precision.
    """

    draws = False
    compile_seconds = 0.0

    def __init__(self, problem: Problem, precision: str, key: Key[Any, ""]) -> None:
        from verifai_jax.evaluation.host_engine import HostEngine

        self.problem, self.precision, self.key = problem, precision, key
        self.refiner = Refiner(problem.system)
        enable_compile_cache()
        self._engine = HostEngine(problem, precision)

    def begin_compiling(self, factor: int, numbers: Int[np.ndarray, " n"], times: int) -> None:
        """Do nothing, because a black box is not compiled."""

    def __call__(
        self, factor: int, each: Sequence[PyTree], numbers: Int[np.ndarray, " n"]
    ) -> list[Verdicts]:
        """Simulate the rows of these numbers again, with a `factor` times smaller step."""
        return self._replay(self.refiner(factor), each, numbers)

    def anew(self, features: PyTree, numbers: Int[np.ndarray, " n"]) -> list[Verdicts]:
        """Simulate rows again with a new copy of the system, which has no state from the run.

        If the system cannot be copied, it is used itself.
        """
        return self._replay(self._renewed, [features], numbers)

    @cached_property
    def _renewed(self) -> System:
        return self.problem.system.renewed()

    def _replay(
        self, system: System, each: Sequence[PyTree], numbers: Int[np.ndarray, " n"]
    ) -> list[Verdicts]:
        # One monitor for all steps.
        engine = type(self._engine)(
            self.problem, self.precision, system=system, monitor=self._engine.monitor
        )
        count = len(numbers)
        many = np.pad(np.asarray(numbers, np.int32), (0, -count % SEEDS), mode="edge")
        keys = None
        with in_precision(self.precision):
            each_block = [np.asarray(_seeds(self.key, b)) for b in many.reshape(-1, SEEDS)]
            if system.can_simulate_batch:
                keys = jax.vmap(partial(simulation_key, self.key))(jnp.asarray(numbers, jnp.int32))
        seeds = np.concatenate(each_block)[:count]
        parts = []
        for features in each:
            parts.append(engine.evaluate_features(features, seeds, keys)._replace(features=None))
            count_done(count)
        return parts


def finest_replays(
    problem: Problem, run: str, key: Key[Any, ""], executor: "Executor | None" = None
) -> tuple[Replays | HostReplays | None, list[str], str]:
    """Return replays of a problem's rows in the highest precision in which it can be traced.

    **Arguments:**
    - `run`: precision of the run.
    - `key`: as in `HostReplays`.
    - `executor`: an executor whose workers simulate the rows of a black box.
    **Returns:** the replays, None if they cannot be traced; notes on checks that are left out; the
    error raised in tracing, empty if there was none.
    """
    if problem.black_box:
        if executor is None:
            replays = HostReplays(problem, run, key)
        else:
            replays = verb("replays")(problem, run, key, executor)
        return replays, ["not checked in float64: a black box"], ""
    note = "not checked in float64: in it the system would draw other random numbers"
    if run != "float64" and problem.system.can_refine:
        # It is traced in this precision in any case.
        with suppress(Exception):
            single = Replays(problem, run, key)
            if single.draws:
                return single, [note], ""
    raised = ""
    try:
        replays = Replays(problem, "float64", key)
        if not (replays.draws and run != "float64"):
            return replays, [], ""
    except Exception as error:
        raised = f"the replay in float64 raised: {format_error(error)}"
        note = f"not checked in float64: {format_error(error)}"
        if run == "float64":
            return None, [note], raised
    try:
        return Replays(problem, run, key), [note], raised
    except Exception as error:
        raised = raised or f"the replay raised: {format_error(error)}"
        return None, [note, f"not simulated again: {format_error(error)}"], raised


@jax.jit
def _seeds(key: Key[Array, ""], numbers: Int[Array, " n"]) -> Array:
    """Return the seeds of a host system's simulations, as its engine makes them of their keys."""
    return jax.vmap(lambda number: jax.random.bits(simulation_key(key, number)))(numbers)
