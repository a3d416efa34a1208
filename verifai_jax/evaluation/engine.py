"""The compiled evaluation of a batch: inputs of simulations in, verdicts out.

    engine = engine_for(problem, batch=1024)
    engine.compile()
    engine.evaluate(u, key, first=0)                                  # Verdicts
    engine_for(problem, 1024, gradient=True).evaluate(u, key, 0, temperature=0.1)
    engine_for(problem, 16, gradient=True, clauses=True)              # clause by clause

A batch is padded to a fixed shape, split over the devices, and processed in chunks of lanes that
fit into the cache. So there is one executable for each (problem, batch, mode).
"""

import time
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Key, PyTree

from verifai_jax.core.compute.compilation import (
    Compilation,
    Slot,
    XlaOptimization,
    compile_soon,
    pad_rows,
    tracing,
)
from verifai_jax.core.compute.fingerprint import as_traced, fingerprint
from verifai_jax.core.compute.keys import as_key
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.compute.remembered import lower_or_recall, remembered_as
from verifai_jax.evaluation.guidance import NOTHING, Guidance
from verifai_jax.evaluation.layout import Layout
from verifai_jax.evaluation.row import CubePoints, Inputs
from verifai_jax.evaluation.row_program import Mode, RowProgram
from verifai_jax.evaluation.verdicts import Verdicts, violations
from verifai_jax.problem.problem import Problem

Wanted = Literal["auto", "xla", "native"]
"""What compiles the simulations of a run, as a person asks for it; see `NativeEngine`."""
WANTED: tuple[Wanted, ...] = ("auto", "xla", "native")
FIRST = 512
"""Rows of a run that XLA simulates in any case, so that the first result waits for no second
compiler; and rows that it simulates at a time where it only decides what is near to zero."""


class Engine:
    """Evaluates batches of one problem; see the module's docstring.

    **Arguments:**
    - `problem`: a checked `Problem`.
    - `batch`: maximum number of rows in a call; fewer rows are padded.
    - `gradient`: whether `evaluate` also differentiates the smooth robustness.
    - `devices`: JAX devices over which the batch is split; all of this process when left out.
    - `precision`: the precision of simulation, monitor and gradient, `"float32"` or `"float64"`.
    - `clauses`: whether it evaluates and differentiates each clause instead.
    - `inputs`: how rows become features and a system; by default they are points of the unit cube.
    - `own_keys`: whether each row has its own random key, instead of one derived from the run's key
      and the row number.
    - `alone`: whether it simulates the rows of a call one after the other, without `jax.vmap` and
      padding, which compiles faster; only with `own_keys` and without a gradient.
    - `lanes`: number of rows that a device processes together; by default that of the system.
    - `effort`: XLA's optimisation effort; by default that of the system, and for derivatives, which
      have few rows, at most little.
    - `guidance`: additional results for a search.

    `program` is the program of one row.
    """

    def __init__(
        self,
        problem: Problem,
        batch: int,
        gradient: bool = False,
        devices: Sequence[Any] | None = None,
        precision: str = "float32",
        clauses: bool = False,
        inputs: Inputs | None = None,
        own_keys: bool = False,
        alone: bool = False,
        lanes: int | None = None,
        effort: XlaOptimization | None = None,
        guidance: Guidance = NOTHING,
    ) -> None:
        self.guidance = guidance
        self.problem, self.batch, self.gradient = problem, batch, gradient
        self.inputs = CubePoints(problem) if inputs is None else inputs
        self.precision, self.own_keys, self.alone = precision, own_keys, alone
        if effort is None:
            effort = problem.system.effort
            effort = "little" if gradient and effort == "most" else effort
        self.effort: XlaOptimization = effort
        devices = jax.local_devices() if devices is None else devices
        self.layout = Layout.of(problem, batch, devices[:1] if alone else devices, lanes)
        self.compile_seconds = 0.0
        self.program = RowProgram(problem, self.inputs, precision, gradient, clauses, guidance)
        self._compiling: dict[Mode, Compilation] = {}
        self._vectors: dict[Mode, Array] = {}
        self._executables: dict[Mode, jax.stages.Compiled] = {}

    def begin_compiling(self) -> None:
        """Trace now, and compile in the background."""
        with in_precision(self.precision):
            self._begin("evaluate")

    def compile(self) -> None:
        """Compile now, so that `evaluate` only runs; `compile_seconds` counts the time."""
        with in_precision(self.precision):
            self._executable("evaluate")

    def evaluate(
        self, rows: PyTree, key: Key[Array, ""] | Key[Array, " lanes"], first: int = 0,
        temperature: Float[np.ndarray, " n"] | Float[Array, ""] | float = 1.0, shared: PyTree = (),
    ) -> Verdicts:  # fmt: skip
        """Simulate `n <= batch` rows and decide which violate the property.

        **Arguments:**
        - `rows`: `[n, ...]`, points of the unit cube, or the rows of the engine's inputs.
        - `key`: the run's key; row `first + i` is simulated with `simulation_key(key, first + i)`.
          With `own_keys` the simulations' keys `[n]`.
        - `first`: number of the first row.
        - `temperature`: the temperature of the smooth robustness that is differentiated, one for
          all rows or one for each; unused without a gradient. For clauses it is dimensionless.
        - `shared`: values shared by all rows, for inputs that have some.
        """
        rho, status, features, more = self._run("evaluate", rows, key, first, temperature, shared)
        if "traces" in more:
            each = [
                jax.tree.map(lambda leaf, i=i: leaf[i], more["traces"]) for i in range(len(rho))
            ]
            more = {**more, "traces": each}
        holds = partial(self.holds, rows, key, first, shared)
        return Verdicts(rho, status, violations(rho, status, holds), features, **more)

    def holds(
        self, rows: PyTree, key: Key[Array, ""] | Key[Array, " lanes"], first: int = 0,
        shared: PyTree = (),
    ) -> Bool[np.ndarray, "n formulas"]:  # fmt: skip
        """Simulate the rows again and return the Boolean semantics of each formula."""
        return self._run("holds", rows, key, first, 1.0, shared)

    def with_batch(self, batch: int) -> "Engine":
        """Return an engine with another batch size that reuses what was traced here."""
        other = Engine(
            self.problem, batch, self.gradient, self.layout.devices, self.precision,
            self.program.goals is not None, self.inputs, self.own_keys, self.alone,
            guidance=self.guidance,
        )  # fmt: skip
        other.program = self.program
        return other

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions that may surprise a user, once the program is compiled."""
        return self.program.notes

    @property
    def padded(self) -> int:
        """Number of rows of the program for a batch."""
        return self.layout.padded

    def _run(
        self, mode: Mode, rows: PyTree, key: Key[Array, ""] | Key[Array, " lanes"], first: int,
        temperature: ArrayLike, shared: PyTree,
    ) -> Any:  # fmt: skip
        # What is compiled already needs nothing else of the precision, and a batch can take less
        # than a millisecond.
        compiled = mode in self._executables
        x64 = self.precision == "float64"
        with jax.enable_x64(x64) if compiled else in_precision(self.precision):
            count = len(jax.tree.leaves(rows)[0])
            temperatures = np.asarray(temperature, np.float32)
            if temperatures.ndim:
                temperatures = pad_rows(temperatures, self.padded)
            else:
                temperatures = np.full(self.padded, temperatures)
            # In NumPy: of an array of JAX each first use of this kind compiles a program.
            rows = jax.tree.map(lambda leaf: pad_rows(leaf, self.padded), rows)
            program = self._executable(mode)
            numbers = self._vectors[mode]
            number = _pad_keys(key, self.padded) if self.own_keys else (key, np.int32(first))
            if self.alone:
                number = (number, np.int32(count))
            packed = program(rows, number, temperatures, shared, numbers)
            return self.program.unpack(mode, packed, count)

    def _executable(self, mode: Mode) -> jax.stages.Compiled:
        if mode not in self._executables:
            self._begin(mode)
            started = time.perf_counter()
            program = self._executables[mode] = self._compiling.pop(mode).result()
            # Once where the program reads it, and not with every batch.
            vector = self.program.numbers(mode)
            self._vectors[mode] = jax.device_put(vector, program.input_shardings[0][-1])
            self.compile_seconds += time.perf_counter() - started
        return self._executables[mode]

    def _begin(self, mode: Mode) -> None:
        if mode in self._executables or mode in self._compiling:
            return
        started = time.perf_counter()
        differentiates = self.gradient and mode == "evaluate"
        name = "gradients" if differentiates else self.inputs.purpose
        with tracing(name):
            layout = self.layout
            if differentiates:
                lowered = self._lower_gradient()
            else:
                single = self.precision == "float32"
                layout = layout.for_program(self.program.trace(mode).jaxpr.jaxpr, single)
                lowered = self._lower(mode, layout)
            splits = not layout.fills_machine
            compiling = compile_soon(name, lowered, self.effort, splits=splits, wide=layout.wide)
            self._compiling[mode] = compiling
        self.compile_seconds += time.perf_counter() - started

    def _lower(self, mode: Mode, layout: Layout) -> jax.stages.Lowered:
        """Lower a program without derivatives, or recall it; see `core.compute.remembered`."""
        traced = self.program.trace(mode)
        if self.alone:
            one_row = self.program.functions[mode]
            return jax.jit(partial(_one_by_one, one_row, traced.out_info)).lower(*self._arguments)
        name = self._kept_as("simulations", fingerprint(traced.jaxpr, derivatives=False))
        program = layout.spread(as_traced(traced), self.own_keys)
        return lower_or_recall(name, program, self._arguments)

    def _kept_as(self, kind: str, computes: str | None, *values: object) -> str | None:
        """Return the name under which a program of batches is kept on disk, if it can be."""
        if list(self.layout.devices) != jax.local_devices()[: len(self.layout.devices)]:
            return None  # A program from a file runs on the first ones.
        rows = (self.padded, self.layout.chunks, self.own_keys, len(self.layout.devices))
        shape = (*rows, self.precision, type(self.inputs).__qualname__)
        return remembered_as(kind, computes, shape, *values)

    def _lower_gradient(self) -> jax.stages.Lowered:
        """Lower the program of derivatives, or recall it; see `core.compute.remembered`."""
        computes, one_row, _ = self.program.derivatives
        program = self.layout.spread(one_row, self.own_keys)

        def lower() -> jax.stages.Lowered:
            name = self._kept_as("gradients", computes, self.program.derivative)
            return lower_or_recall(name, partial(program), self._arguments)

        return self.program.differentiable(lower)

    @cached_property
    def _arguments(self) -> tuple[Any, ...]:
        """Shapes and types of the arguments of the programs of batches."""
        row, key, _, shared, numbers = self.program.forms
        first = jax.ShapeDtypeStruct((), jnp.int32)
        count = (self.padded,)
        number: Any = jax.ShapeDtypeStruct(count, key.dtype) if self.own_keys else (key, first)
        return (
            jax.tree.map(lambda form: jax.ShapeDtypeStruct(count + form.shape, form.dtype), row),
            (number, first) if self.alone else number,
            jax.ShapeDtypeStruct(count, jnp.float32),
            shared,
            numbers,
        )


def _pad_keys(keys: Key[Array, " lanes"], count: int) -> Key[Array, " count"]:
    if len(keys) == count:
        return keys
    return as_key(pad_rows(np.asarray(jax.random.key_data(keys)), count))


def _one_by_one(
    one_row: Callable[..., PyTree], form: PyTree, rows: PyTree, number: tuple[Array, Array],
    temperature: Array, shared: PyTree, vector: Array,
) -> PyTree:  # fmt: skip
    """Compute the first rows one after the other.

    - `one_row`: the function of one row; `form` is the form of its result.
    - `number`: the random keys of the rows, and how many rows to compute.
    """
    keys, count = number

    def compute(i: Array, found: PyTree) -> PyTree:
        # Indices are known to be inside, for which these need no other operations.
        at = partial(jax.lax.dynamic_index_in_dim, index=i, keepdims=False)
        row, key, tau = jax.tree.map(at, (rows, keys, temperature))
        result = one_row(row, key, tau, shared, vector)
        put = partial(jax.lax.dynamic_update_index_in_dim, index=i, axis=0)
        return jax.tree.map(put, found, result)

    blank = jax.tree.map(lambda leaf: jax.lax.full((len(keys), *leaf.shape), 0, leaf.dtype), form)
    return jax.lax.fori_loop(jnp.int32(0), count, compute, blank)


class EngineMode(NamedTuple):
    """The options of a problem's engine; see `Engine`, and `CubePoints` for `given`."""

    batch: int
    gradient: bool
    precision: str
    clauses: bool
    guidance: Guidance
    given: bool


ENGINES: Slot[EngineMode, Engine] = Slot("engines")
"""Engines over points of the unit cube."""


def engine_for(
    problem: Problem, batch: int, gradient: bool = False, precision: str = "float32",
    clauses: bool = False, guidance: Guidance = NOTHING, given: bool = False,
) -> Engine:  # fmt: skip
    """Return the engine for this (problem, batch, mode), made once and cached with the problem."""
    mode = EngineMode(batch, gradient, precision, clauses, guidance, given)
    make = partial(
        Engine, problem, batch, gradient, precision=precision, clauses=clauses, guidance=guidance
    )
    return problem.programs.get(
        ENGINES, mode, lambda: make(inputs=CubePoints(problem, given, precision))
    )
