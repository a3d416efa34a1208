"""The function of one row of an engine, traced once, and the programs derived from it.

program = RowProgram(problem, CubePoints(problem), "float32")
program.trace("evaluate")                           # robustness and status, packed
program.traced_row()                                # the same as a function, not traced again
program.unpack("evaluate", packed, count)
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from verifai_jax.core.compute.compilation import tracing
from verifai_jax.core.compute.fingerprint import as_traced, fingerprint, identity
from verifai_jax.core.compute.jaxprs import work_of
from verifai_jax.core.compute.keys import IMPLEMENTATION
from verifai_jax.core.compute.lifting import CAPACITY, LiftedNumbers
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.evaluation.differentiation import Derivative, reverse_refused
from verifai_jax.evaluation.guidance import NOTHING, Guidance
from verifai_jax.evaluation.row import Inputs, Packing, Row, RowFunction
from verifai_jax.mtl.clauses import goals_of
from verifai_jax.problem.problem import Problem

Mode = Literal["evaluate", "holds"]
"""Programs of an engine: robustness and derivatives, or the Boolean semantics of the same rows."""
_TEMPERATURE = jax.ShapeDtypeStruct((), jnp.float32)
"""Form of the temperature of one row."""
GRADIENT_WORK = 6
"""Work of a simulation with its reverse sweep, in simulations: 5 to 10 as measured on eight
problems."""


class RowProgram:
    """The traced function of one row; see the module's docstring.

    **Arguments:**
    - `problem`: a checked `Problem`.
    - `inputs`: how rows are converted to features and a system.
    - `precision`: the precision of simulation, monitor and gradient, `"float32"` or `"float64"`.
    - `gradient`: whether to differentiate the smooth robustness.
    - `clauses`: whether to evaluate and differentiate clauses instead.
    - `guidance`: additional results for a search.

    After tracing, `notes` lists decisions that may surprise a user; `derivative` is the chosen mode
    of differentiation, and `functions` are those that `trace` has traced: a larger program may call
    them, and they are not traced again.
    """

    def __init__(
        self, problem: Problem, inputs: Inputs, precision: str, gradient: bool = False,
        clauses: bool = False, guidance: Guidance = NOTHING,
    ) -> None:  # fmt: skip
        self.problem, self.inputs, self.precision = problem, inputs, precision
        self.gradient = gradient
        self.goals = goals_of(problem.formulas.values()) if clauses else None
        self.notes: tuple[str, ...] = ()
        self.derivative = Derivative(inputs.dim, problem.system.forward_up_to)
        self._function = RowFunction(problem, inputs, precision, gradient, self.goals, guidance)
        self._packing: dict[Mode, Packing] = {}
        self._traced: dict[Mode, jax.stages.Traced] = {}
        self.functions: dict[Mode, Callable[..., Any]] = {}
        self._numbers: dict[Mode, LiftedNumbers] = {}

    def row(
        self, row: PyTree, key: Key[Array, ""], temperature: Float[Array, ""], shared: PyTree = ()
    ) -> Row:
        """Evaluate one row under `jax.vmap`, in a program that the caller compiles."""
        return self._function(row, key, temperature, shared, self.derivative)

    def row_holds(
        self, row: PyTree, key: Key[Array, ""], temperature: Float[Array, ""] | float = 1.0,
        shared: PyTree = (),
    ) -> Bool[Array, " formulas"]:  # fmt: skip
        """Return the Boolean semantics of one row under `jax.vmap`, in a caller's program."""
        return self._function.holds(row, key, shared)

    @cached_property
    def forms(self) -> tuple[Any, ...]:
        """Shapes and types of the arguments for one row.

        They are the row, its random key, a temperature, the shared values, and the numbers.
        """
        numbers = jax.ShapeDtypeStruct((CAPACITY,), self.precision)
        key = jax.eval_shape(lambda: jax.random.key(0, impl=IMPLEMENTATION))
        return self.inputs.row_form, key, _TEMPERATURE, self.inputs.shared_form, numbers

    def trace(self, mode: Mode) -> jax.stages.Traced:
        """Trace a row without derivatives; the program of a batch is built from that."""
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

        # A new function object each time: JAX remembers what it traced by the function.
        self.functions[mode] = function = jax.jit(packed_row)
        traced = self._traced[mode] = function.trace(*self.forms)
        return traced

    @cached_property
    def derivatives(self) -> tuple[str | None, Callable[..., Any], Any]:
        """Fingerprint of simulation and monitor, derivatives of one row, and the program.

        Only these are traced here; everything else follows from them.
        """
        function, shared = self._function, self.inputs.shared_form
        numbers = self._numbers["evaluate"] = LiftedNumbers()
        row, *others = self.forms
        coordinates = jax.eval_shape(function.coordinates, row, shared)

        def objective(coordinates: Array, *others: Any) -> Any:
            vector, rest = others[-1], others[:-1]
            return numbers.read_from(vector, lambda: function.objective(coordinates, *rest))

        traced = jax.jit(objective).trace(coordinates, row, *others)
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
            derivative = self.derivative if self.goals is None else self.derivative.of_several
            return packed(*derivative(objective, function.coordinates(row, shared)))

        return fingerprint(traced.jaxpr), packed_row, traced.jaxpr.jaxpr

    def traced_row(self) -> Callable[..., Any]:
        """Return the function of one row, already traced.

        It takes arguments of `forms`; `unpack` splits its result.
        """
        with tracing(self.inputs.purpose), in_precision(self.precision):
            return self.derivatives[1] if self.gradient else as_traced(self.trace("evaluate"))

    @property
    def identity(self) -> str | None:
        """A hash of all that the function of one row computes; None if there is no such hash."""
        if not self.gradient:
            return fingerprint(self.trace("evaluate").jaxpr, derivatives=False)
        computes, *_ = self.derivatives
        return None if computes is None else identity(computes, self.derivative)

    @cached_property
    def work(self) -> int:
        """Approximate number of scalar operations in a simulation with its derivative."""
        with tracing(self.inputs.purpose), in_precision(self.precision):
            if not self.gradient:
                return work_of(self.trace("evaluate").jaxpr.jaxpr)
            return GRADIENT_WORK * work_of(self.derivatives[2])

    def numbers(self, mode: Mode = "evaluate") -> Float[np.ndarray, " numbers"]:
        """Return the numbers that a program reads, after it is traced."""
        return self._numbers[mode].vector(self.precision)

    def unpack(self, mode: Mode, packed: dict[str, Any], count: int) -> Any:
        """Return the first rows of a program's result."""
        return self._packing[mode].unpack(packed, count)

    def draws(self) -> bool:
        """Return whether the system uses its random key, in a program without derivatives.

        This traces the program, and raises its errors.
        """
        with tracing(self.inputs.purpose), in_precision(self.precision):
            program = self.trace("evaluate").jaxpr.jaxpr
        used = program.invars[len(jax.tree.leaves(self.inputs.row_form))]
        return any(used is value for step in program.eqns for value in step.invars)

    def differentiable(self, trace: Callable[[], Any]) -> Any:
        """Return the result of `trace`, which traces rows of this program, in a mode that works.

        If the system refuses reverse mode, it is traced again in forward mode.
        """
        try:
            return trace()
        except TypeError as error:
            if not self.gradient or self.derivative.reverse or "custom_vjp" not in str(error):
                raise
            # A function that brings a derivative for reverse mode alone.
            self.derivative = self.derivative.by("reverse")
            return trace()
        except ValueError as error:
            if not (self.gradient and self.derivative.reverse and reverse_refused(error)):
                raise
        self.derivative = self.derivative.by("forward")
        hint = self.problem.system.reverse_hint
        self.notes = (f"{self.derivative.describe()}{f': {hint}' if hint else ''}",)
        return trace()

    def _packed(self, packing: Packing, result: Row | Array) -> dict[str, Array]:
        """Pack the result of one row, without its features where the inputs have them already."""
        if isinstance(result, Row) and not self.inputs.keeps_features:
            result = result._replace(features=None)
        return packing.pack(result)
