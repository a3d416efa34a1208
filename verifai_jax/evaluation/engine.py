"""The compiled evaluation of a batch: inputs of simulations in, verdicts out.

    engine = engine_for(problem, batch=1024)
    engine.compile()
    engine.evaluate(u, key, first=0)                                  # Verdicts
    engine_for(problem, 1024, gradient=True).evaluate(u, key, 0, temperature=0.1)
    engine_for(problem, 16, gradient=True, clauses=True)              # clause by clause

A batch is padded to a fixed shape, split over the devices, and worked through in chunks of lanes
small enough for the cache, so that there is one executable for each (problem, batch, mode).
"""

import time
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Key, PyTree

from verifai_jax.core.compilation import Compilation, XlaOptimization, compile_soon, tracing
from verifai_jax.core.fingerprint import as_traced, fingerprint, identity
from verifai_jax.core.keys import IMPLEMENTATION, as_key
from verifai_jax.core.lifting import CAPACITY, LiftedNumbers
from verifai_jax.core.precision import in_precision
from verifai_jax.core.programs import Slot, pad_rows
from verifai_jax.core.remembered import is_kept, lower_or_recall, remembered_as
from verifai_jax.evaluation.differentiation import Derivative, reverse_refused
from verifai_jax.evaluation.guidance import NOTHING, Guidance
from verifai_jax.evaluation.layout import Layout
from verifai_jax.evaluation.row import CubePoints, Inputs, Packing, Row, RowFunction
from verifai_jax.evaluation.verdicts import Verdicts, violations
from verifai_jax.mtl.clauses import goals_of
from verifai_jax.problem.problem import Problem

Mode = Literal["evaluate", "holds"]
"""Programs of an engine: robustness and derivatives, or the Boolean semantics of the same rows."""
Wanted = Literal["auto", "xla", "native"]
"""What compiles the simulations of a run, as a person asks for it; see `NativeEngine`."""
WANTED: tuple[Wanted, ...] = ("auto", "xla", "native")
_TEMPERATURE = jax.ShapeDtypeStruct((), jnp.float32)
"""Form of the temperature of one row."""


class Engine:
    """Evaluates batches of one problem; see the module's docstring.

    **Arguments:**

    - `problem`: a checked `Problem`.
    - `batch`: rows of a call at most; fewer are padded.
    - `gradient`: whether `evaluate` also differentiates the smooth robustness.
    - `devices`: JAX devices to split the batch over; all of this process when left out.
    - `precision`: `"float32"` or `"float64"`, of simulation, monitor and gradient.
    - `clauses`: whether it evaluates, and differentiates, clause by clause instead.
    - `inputs`: how rows become features and a system; points of the unit cube when left out.
    - `own_keys`: whether each row is given the random key of its simulation, instead of one key of
      the run and the number of the first row.
    - `alone`: whether the engine takes one row at a time, which compiles without `jax.vmap` and so
      takes less time; with `own_keys` only.
    - `lanes`: rows that a device works on together; as the system says when left out.
    - `effort`: how much XLA does to make its programs fast; when left out as the system says, and
      for derivatives, which are of few rows, at most a little.
    - `guidance`: what it computes for a search in addition to the robustness.

    `notes` says, once compiled, what the engine decided that a user may not expect.
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
        self.layout = Layout.of(problem, batch, devices, lanes)
        self.compile_seconds = 0.0
        self.notes: tuple[str, ...] = ()
        self._derivative = Derivative(self.inputs.dim, problem.system.forward_up_to)
        goals = goals_of(problem.formulas.values()) if clauses else None
        self.goals = goals
        self._function = RowFunction(problem, self.inputs, precision, gradient, goals, guidance)
        self._packing: dict[Mode, Packing] = {}
        self._traced: dict[Mode, jax.stages.Traced] = {}
        self._compiling: dict[Mode, Compilation] = {}
        self._numbers: dict[Mode, LiftedNumbers] = {}
        self._vectors: dict[Mode, Array] = {}
        self._executables: dict[Mode, jax.stages.Compiled] = {}

    def begin_compiling(self) -> None:
        """Trace now and compile in the background."""
        with in_precision(self.precision):
            self._begin("evaluate")

    def begin_if_recalled(self) -> None:
        """Begin to compile derivatives if an earlier process had the same: they only have to load.

        Simulation and monitor are traced to know.
        """
        with in_precision(self.precision):
            started = time.perf_counter()
            with tracing("gradients"):
                known = self.gradient and is_kept(self._gradient_kept_as)
            self.compile_seconds += time.perf_counter() - started
            if known:
                self._begin("evaluate")

    def compile(self) -> None:
        """Compile now, so that `evaluate` only runs; the time is in `compile_seconds`."""
        with in_precision(self.precision):
            self._executable("evaluate")

    def evaluate(
        self,
        rows: PyTree,
        key: Key[Array, ""] | Key[Array, " lanes"],
        first: int = 0,
        temperature: Float[np.ndarray, " n"] | Float[Array, ""] | float = 1.0,
        shared: PyTree = (),
    ) -> Verdicts:
        """Simulate `n <= batch` rows and decide which violate the property.

        **Arguments:**

        - `rows`: `[n, ...]`, points of the unit cube or whatever the engine's inputs are.
        - `key`: the run's key; row `first + i` is simulated with `simulation_key(key, first + i)`.
          With `own_keys` the keys `[n]` of the simulations.
        - `first`: number of the first row.
        - `temperature`: the temperature of the smooth robustness that is differentiated, one for
          all rows or one each; unused without gradient. Clause by clause it has no unit.
        - `shared`: what all rows share, for inputs that have such.
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
        self,
        rows: PyTree,
        key: Key[Array, ""] | Key[Array, " lanes"],
        first: int = 0,
        shared: PyTree = (),
    ) -> Bool[np.ndarray, "n formulas"]:
        """Simulate the rows again and return the Boolean semantics of each formula."""
        return self._run("holds", rows, key, first, 1.0, shared)

    def row(
        self, row: PyTree, key: Key[Array, ""], temperature: Float[Array, ""], shared: PyTree = ()
    ) -> Row:
        """Evaluate one row under `jax.vmap`, in a program that a caller compiles."""
        return self._function(row, key, temperature, shared, self._derivative)

    def with_batch(self, batch: int) -> "Engine":
        """Return an engine of other batches, which has traced what this one has."""
        other = Engine(
            self.problem, batch, self.gradient, self.layout.devices, self.precision,
            self.goals is not None, self.inputs, self.own_keys, self.alone, guidance=self.guidance,
        )  # fmt: skip
        other._packing, other._numbers = self._packing, self._numbers
        other._traced, other._derivative = self._traced, self._derivative
        if "_derivatives" in self.__dict__:
            other.__dict__["_derivatives"] = self._derivatives
        return other

    def traced_row(self) -> Callable[..., Any]:
        """Return the function of one row, which is traced already.

        It takes the row, its random key, a temperature, what all rows share, and `numbers`, and
        returns what `unpack` takes apart.
        """
        with tracing(self.inputs.purpose), in_precision(self.precision):
            return self._derivatives[1] if self.gradient else as_traced(self._trace("evaluate"))

    @property
    def padded(self) -> int:
        """Rows of the program of a batch."""
        return self.layout.padded

    @property
    def row_identity(self) -> str | None:
        """A hash of all that the function of one row computes; None if that has no hash."""
        if not self.gradient:
            return fingerprint(self._trace("evaluate").jaxpr, derivatives=False)
        computes, *_ = self._derivatives
        return None if computes is None else identity(computes, self._derivative)

    @property
    def work(self) -> int:
        """Operations on single numbers in a simulation, with its derivative, about."""
        from verifai_jax.native_code.work import work_of

        with tracing(self.inputs.purpose), in_precision(self.precision):
            if not self.gradient:
                return work_of(self._trace("evaluate").jaxpr.jaxpr)
            return GRADIENT_WORK * work_of(self._derivatives[2])

    @property
    def numbers(self) -> Float[np.ndarray, " numbers"]:
        """The numbers that a traced program reads, once it is traced."""
        return self._numbers["evaluate"].vector(self.precision)

    def unpack(self, packed: dict[str, Any], count: int) -> Row:
        """Return the first rows of what a program computed."""
        return self._packing["evaluate"].unpack(packed, count)

    def draws(self) -> bool:
        """Return whether the system uses its random key, in an engine without derivatives.

        Traces the program, and raises what that raises.
        """
        with tracing(self.inputs.purpose), in_precision(self.precision):
            program = self._trace("evaluate").jaxpr.jaxpr
        used = program.invars[len(jax.tree.leaves(self.inputs.row_form))]
        return any(used is value for step in program.eqns for value in step.invars)

    def differentiable(self, trace: Callable[[], Any]) -> Any:
        """Return the result of `trace`, which traces rows of this engine, in a mode that works.

        Where the system refuses reverse mode, it is traced again in forward mode.
        """
        try:
            return trace()
        except TypeError as error:
            if not self.gradient or self._derivative.reverse or "custom_vjp" not in str(error):
                raise
            # A function that brings a derivative for reverse mode alone.
            self._derivative = self._derivative.by("reverse")
            return trace()
        except ValueError as error:
            if not (self.gradient and self._derivative.reverse and reverse_refused(error)):
                raise
        self._derivative = self._derivative.by("forward")
        hint = self.problem.system.reverse_hint
        self.notes = (f"{self._derivative.describe()}{f': {hint}' if hint else ''}",)
        return trace()

    def _run(
        self,
        mode: Mode,
        rows: PyTree,
        key: Key[Array, ""] | Key[Array, " lanes"],
        first: int,
        temperature: ArrayLike,
        shared: PyTree,
    ) -> Any:
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
            if self.alone:
                one = jax.tree.map(lambda leaf: leaf[0], rows)
                packed = program(one, _one_key(key), temperatures[0], shared, numbers)
                packed = jax.tree.map(lambda leaf: np.asarray(leaf)[None], packed)
            else:
                number = _pad_keys(key, self.padded) if self.own_keys else (key, np.int32(first))
                packed = program(rows, number, temperatures, shared, numbers)
            return self._packing[mode].unpack(packed, count)

    def _executable(self, mode: Mode) -> jax.stages.Compiled:
        if mode not in self._executables:
            self._begin(mode)
            started = time.perf_counter()
            program = self._executables[mode] = self._compiling.pop(mode).result()
            # Once where the program reads it, and not with every batch.
            vector = self._numbers[mode].vector(self.precision)
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
                layout = layout.for_program(self._trace(mode).jaxpr.jaxpr)
                lowered = self._lower(mode, layout)
            splits = not layout.fills_machine
            compiling = compile_soon(name, lowered, self.effort, splits=splits, wide=layout.wide)
            self._compiling[mode] = compiling
        self.compile_seconds += time.perf_counter() - started

    def _trace(self, mode: Mode) -> jax.stages.Traced:
        """Trace one row; the program of a batch is made of that."""
        if mode in self._traced:
            return self._traced[mode]
        one_row = {"evaluate": self.row, "holds": self.row_holds}[mode]
        packing = self._packing[mode] = Packing()
        numbers = self._numbers[mode] = LiftedNumbers()

        def packed_row(
            row: PyTree, key: Array, temperature: Array, shared: PyTree, vector: Array
        ) -> Any:
            result = numbers.read_from(vector, lambda: one_row(row, key, temperature, shared))
            return self._packed(packing, result)

        *_, shared, vector = self._arguments
        one = (self.inputs.row_form, _key_form(), _TEMPERATURE, shared, vector)
        # A new function object each time: JAX remembers what it traced by the function.
        traced = self._traced[mode] = jax.jit(packed_row).trace(*one)
        return traced

    def _lower(self, mode: Mode, layout: Layout) -> jax.stages.Lowered:
        """Lower a program without derivatives, or recall it; see `core.remembered`."""
        traced = self._trace(mode)
        if self.alone:
            return traced.lower()
        name = self._kept_as("simulations", fingerprint(traced.jaxpr, derivatives=False))
        program = layout.spread(as_traced(traced), self.own_keys)
        return lower_or_recall(name, program, self._arguments)

    def _packed(self, packing: Packing, result: Row | Array) -> dict[str, Array]:
        """Pack the result of one row, without its features where the inputs have them already."""
        if isinstance(result, Row) and not self.inputs.keeps_features:
            result = result._replace(features=None)
        return packing.pack(result)

    @cached_property
    def _derivatives(self) -> tuple[str | None, Callable[..., Any], Any]:
        """The fingerprint of simulation and monitor, the derivatives of one row, and the program.

        Only these are traced here. All else follows from them.
        """
        function, shared = self._function, self.inputs.shared_form
        numbers = self._numbers["evaluate"] = LiftedNumbers()
        *_, vector = self._arguments
        row = self.inputs.row_form
        coordinates = jax.eval_shape(function.coordinates, row, shared)
        one = (coordinates, row, _key_form(), _TEMPERATURE, shared, vector)

        def objective(coordinates: Array, *others: Any) -> Any:
            vector, rest = others[-1], others[:-1]
            return numbers.read_from(vector, lambda: function.objective(coordinates, *rest))

        traced = jax.jit(objective).trace(*one)
        values, results = traced.out_info
        # Traced once, and all else is made of that: nothing that a user's code may do comes in.
        known = as_traced(traced)
        packing = self._packing["evaluate"] = Packing()

        def packed(derivatives: Array, results: PyTree) -> Any:
            return self._packed(packing, function.finish(derivatives, results))

        derivatives = jax.ShapeDtypeStruct((*values.shape, *coordinates.shape), values.dtype)
        jax.eval_shape(packed, derivatives, results)

        def packed_row(row: PyTree, *others: Any) -> Any:
            def objective(coordinates: Array) -> Any:
                return known(coordinates, row, *others)

            *_, shared, _ = others
            derivative = self._derivative if self.goals is None else self._derivative.of_several
            return packed(*derivative(objective, function.coordinates(row, shared)))

        return fingerprint(traced.jaxpr), packed_row, traced.jaxpr.jaxpr

    def _kept_as(self, kind: str, computes: str | None, *values: object) -> str | None:
        """Return the name under which a program of batches is kept on disk, if it can be."""
        if list(self.layout.devices) != jax.local_devices()[: len(self.layout.devices)]:
            return None  # A program from a file runs on the first ones.
        shape = (
            self.padded,
            self.layout.chunks,
            self.own_keys,
            self.alone,
            len(self.layout.devices),
        )
        shape = (*shape, self.precision, type(self.inputs).__qualname__)
        return remembered_as(kind, computes, shape, *values)

    @property
    def _gradient_kept_as(self) -> str | None:
        return self._kept_as("gradients", self._derivatives[0], self._derivative)

    def _lower_gradient(self) -> jax.stages.Lowered:
        """Lower the program of derivatives, or recall it; see `core.remembered`."""
        one_row = self._derivatives[1]
        program = one_row if self.alone else self.layout.spread(one_row, self.own_keys)
        return self.differentiable(
            lambda: lower_or_recall(self._gradient_kept_as, partial(program), self._arguments)
        )

    @cached_property
    def _arguments(self) -> tuple[Any, ...]:
        """Shapes and types of the arguments of the programs of batches."""
        first = jax.ShapeDtypeStruct((), jnp.int32)
        leading = () if self.alone else (self.padded,)
        key = _key_form()
        return (
            jax.tree.map(
                lambda form: jax.ShapeDtypeStruct((*leading, *form.shape), form.dtype),
                self.inputs.row_form,
            ),
            jax.ShapeDtypeStruct(leading, key.dtype) if self.own_keys else (key, first),
            jax.ShapeDtypeStruct(leading, jnp.float32),
            self.inputs.shared_form,
            jax.ShapeDtypeStruct((CAPACITY,), self.precision),
        )

    def row_holds(
        self,
        row: PyTree,
        key: Key[Array, ""],
        temperature: Float[Array, ""] | float = 1.0,
        shared: PyTree = (),
    ) -> Bool[Array, " formulas"]:
        """Return the Boolean semantics of one row under `jax.vmap`, in a caller's program."""
        return self._function.holds(row, key, shared)


def _key_form() -> Any:
    return jax.eval_shape(lambda: jax.random.key(0, impl=IMPLEMENTATION))


GRADIENT_WORK = 6
"""Work of a simulation with its reverse sweep, in simulations: 5 to 10 as measured on eight
problems."""


def _pad_keys(keys: Key[Array, " lanes"], count: int) -> Key[Array, " count"]:
    if len(keys) == count:
        return keys
    return as_key(pad_rows(np.asarray(jax.random.key_data(keys)), count))


def _one_key(keys: Key[Array, "*lanes"]) -> Key[Array, ""]:
    """Return a key, or the only one of several; nothing compiles."""
    return keys if keys.ndim == 0 else as_key(np.asarray(jax.random.key_data(keys))[0])


class EngineMode(NamedTuple):
    """The options of one problem's engine; see `Engine`, and `CubePoints` for `given`."""

    batch: int
    gradient: bool
    precision: str
    clauses: bool
    guidance: Guidance
    given: bool


ENGINES: Slot[EngineMode, Engine] = Slot("engines")
"""Engines over points of the unit cube."""


def engine_for(
    problem: Problem,
    batch: int,
    gradient: bool = False,
    precision: str = "float32",
    clauses: bool = False,
    guidance: Guidance = NOTHING,
    given: bool = False,
) -> Engine:
    """Return the engine of this (problem, batch, mode), made once and kept with the problem."""
    mode = EngineMode(batch, gradient, precision, clauses, guidance, given)
    return problem.programs.get(
        ENGINES,
        mode,
        lambda: Engine(
            problem,
            batch,
            gradient,
            precision=precision,
            clauses=clauses,
            guidance=guidance,
            inputs=CubePoints(problem, given, precision),
        ),
    )
