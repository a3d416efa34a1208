"""The compiled evaluation of a batch: unit cube in, robustness and status out.

    engine = engine_for(problem, batch=1024)
    engine.compile()
    engine.evaluate(u, key, first=0)                                  # robustness, status
    engine_for(problem, 1024, gradient=True).evaluate(u, key, 0, temperature=0.1)
    engine_for(problem, 16, gradient=True, clauses=True)              # told clause by clause

A batch is padded to a fixed shape, split over the devices, and worked through in chunks of lanes
small enough for the cache, so that there is one executable for each (problem, batch, mode).
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.core.clauses import CLAUSES
from verifai_jax.core.devices import enable_compile_cache, spread_over_devices
from verifai_jax.core.keys import simulation_key
from verifai_jax.core.precision import in_precision
from verifai_jax.core.trace import Status, Trace
from verifai_jax.evaluation.differentiation import Derivative, reverse_refused
from verifai_jax.evaluation.packing import Packing
from verifai_jax.evaluation.streaming_monitor import carried_monitor, with_status
from verifai_jax.mtl import hard, robustness, satisfied, smooth
from verifai_jax.mtl.clauses import ABSENT, Goals, goals_of
from verifai_jax.problem.problem import Problem


class Evaluation(NamedTuple):
    """What a batch of simulations gave, on the host, one row a simulation.

    `rho` is `[n, formulas]`, hard robustness; NaN where the status is not OK. `gradient` is
    `[n, d]`, of the least smooth robustness with respect to the unit coordinates. `features` are
    the simulated values. `messages` say what a black box raised, one a row, empty where nothing.
    `holds` are its Boolean verdicts where the robustness is exactly zero; None where `verdicts` has
    to be asked. `clauses` are the scaled values of the clauses of the goal that is nearest to being
    broken (`mtl.clauses`), `slopes` their derivatives; None unless told clause by clause.
    """

    rho: Float[np.ndarray, "n formulas"]
    status: Int[np.ndarray, " n"]
    features: dict[str, Any]
    gradient: Float[np.ndarray, "n d"] | None = None
    messages: list[str] | None = None
    holds: Bool[np.ndarray, "n formulas"] | None = None
    clauses: Float[np.ndarray, "n clauses"] | None = None
    slopes: Float[np.ndarray, "n clauses d"] | None = None


class ToldRow(NamedTuple):
    """What a search is told of one row, traced; see `Evaluation`."""

    rho: Float[Array, ""]
    status: Int[Array, ""]
    gradient: Float[Array, " d"] | None
    clauses: Float[Array, " clauses"] | None
    slopes: Float[Array, "clauses d"] | None


def judge(problem: Problem, trace: Trace) -> tuple[Float[Array, " formulas"], Int[Array, ""]]:
    """Hard robustness of each formula, and the status, of one trace.

    A simulation whose monitored signals are not finite has status `NONFINITE` and robustness NaN.
    """
    trace = trace.hold()
    rho = jnp.stack(
        [robustness(formula, trace, end=problem.end) for formula in problem.formulas.values()]
    )
    finite = jnp.array(True)
    for name in problem.monitored:
        signal = jnp.asarray(trace.signals[name])
        if name not in trace.finite and jnp.issubdtype(signal.dtype, jnp.inexact):
            finite &= jnp.all(jnp.isfinite(signal))
    status = jnp.asarray(Status.OK if trace.status is None else trace.status, jnp.int32)
    return with_status(rho, status, finite)


def verdict(problem: Problem, trace: Trace) -> Bool[Array, " formulas"]:
    """Whether each formula holds on one trace: what decides where robustness is exactly zero."""
    trace = trace.hold()
    formulas = problem.formulas.values()
    return jnp.stack([satisfied(formula, trace, end=problem.end) for formula in formulas])


class Engine:
    """Evaluates batches of one problem; see the module's docstring.

    **Arguments:**

    - `problem`: a checked `Problem` whose system JAX can trace.
    - `batch`: rows of a call at most; fewer are padded.
    - `gradient`: whether `evaluate` also differentiates the smooth robustness.
    - `clauses`: whether it tells, and differentiates, clause by clause instead.
    - `devices`: JAX devices to split the batch over; all of this process when left out.
    - `precision`: `"float32"` or `"float64"`, of simulation, monitor and gradient.

    `notes` says, once compiled, what was decided and would surprise.
    """

    def __init__(
        self,
        problem: Problem,
        batch: int,
        gradient: bool = False,
        devices: list[Any] | None = None,
        precision: str = "float32",
        clauses: bool = False,
    ) -> None:
        self.problem = problem
        self.batch = batch
        self.gradient = gradient
        self.goals: Goals | None = goals_of(problem.formulas.values()) if clauses else None
        self.precision = precision
        devices = jax.local_devices() if devices is None else devices
        # A batch smaller than the number of devices is not worth splitting.
        self.devices = devices[: max(1, min(len(devices), batch))]
        per_device = -(-batch // len(self.devices))
        self.together = problem.system.lanes
        self.chunks = -(-per_device // self.together)
        self.lanes = -(-per_device // self.chunks)
        self.padded = self.lanes * self.chunks * len(self.devices)
        self.compile_seconds = 0.0
        self.notes: tuple[str, ...] = ()
        limit = problem.system.forward_up_to
        self._derivative = Derivative(problem.space.dim, limit)
        self._packing: dict[str, Packing] = {}
        self._executables: dict[str, Any] = {}

    def compile(self) -> None:
        """Compile now, so that `evaluate` only runs; the time is in `compile_seconds`."""
        with in_precision(self.precision):
            self._executable("evaluate")

    def evaluate(
        self,
        u: Float[Array, "n d"],
        key: Key[Array, ""],
        first: int,
        temperature: Float[Array, " n"] | Float[Array, ""] | float = 1.0,
    ) -> Evaluation:
        """Simulate and judge `n <= batch` points of the unit cube.

        - `key`: the run's key; row `first + i` is simulated with `simulation_key(key, first + i)`.
        - `temperature`: of the smooth robustness that is differentiated, one for all rows or one
          each; unused without gradient. Clause by clause it has no unit.
        """
        rho, status, features, told = self._run("evaluate", u, key, first, temperature)
        return Evaluation(rho, status, features)._replace(**told)

    def verdicts(self, u: Float[Array, "n d"], key: Key[Array, ""], first: int) -> np.ndarray:
        """Boolean semantics `[n, formulas]`: what decides where the robustness is exactly zero."""
        return self._run("verdicts", u, key, first, 1.0)

    def told_row(
        self, u: Float[Array, " d"], key: Key[Array, ""], temperature: Float[Array, ""]
    ) -> ToldRow:
        """One row under `vmap`: what a search is told of it."""
        rho, status, _, told = self._evaluate_row(u.astype(self.precision), key, temperature)
        told = {name: value.astype(jnp.float32) for name, value in told.items()}
        nothing = dict.fromkeys(("gradient", "clauses", "slopes"))
        return ToldRow(jnp.min(rho), status, **{**nothing, **told})

    def _run(self, mode: str, u: Any, key: Any, first: int, temperature: Any) -> Any:
        with in_precision(self.precision):
            temperatures = np.asarray(temperature, np.float32)
            if temperatures.ndim:
                temperatures = _pad(temperatures, self.padded)
            else:
                temperatures = np.full(self.padded, temperatures)
            arguments = (_pad(u, self.padded), key, np.int32(first), temperatures)
            packed = self._executable(mode)(*arguments)
            return self._packing[mode].unpack(packed, len(u))

    def _executable(self, mode: str) -> Any:
        if mode not in self._executables:
            enable_compile_cache()
            started = time.perf_counter()
            self._executables[mode] = self._compiled(mode)
            self.compile_seconds += time.perf_counter() - started
        return self._executables[mode]

    def _compiled(self, mode: str) -> Any:
        one_row = {"evaluate": self._evaluate_row, "verdicts": self._verdict_row}[mode]
        arguments = (
            jax.ShapeDtypeStruct((self.padded, self.problem.space.dim), jnp.float32),
            jax.eval_shape(lambda: jax.random.key(0)),
            jax.ShapeDtypeStruct((), jnp.int32),
            jax.ShapeDtypeStruct((self.padded,), jnp.float32),
        )
        packing = self._packing[mode] = Packing()

        def packed_row(u: Array, key: Array, temperature: Array) -> Any:
            return packing.pack(one_row(u.astype(self.precision), key, temperature))

        program = self._batched(packed_row)
        # A new function object each time: JAX remembers what it traced by the function.
        return self.differentiable(lambda: jax.jit(partial(program)).lower(*arguments)).compile()

    def differentiable(self, trace: Callable[[], Any]) -> Any:
        """The result of `trace`, which traces rows of this engine, in a mode that works.

        Where the system refuses reverse mode, it is traced again in forward mode.
        """
        try:
            return trace()
        except ValueError as error:
            if not (self.gradient and self._derivative.reverse and reverse_refused(error)):
                raise
        self._derivative = self._derivative.by("forward")
        hint = self.problem.system.reverse_hint
        self.notes = (f"{self._derivative.told()}{f': {hint}' if hint else ''}",)
        return trace()

    def _batched(self, one_row: Any) -> Any:
        """Spread `one_row(u, key, temperature)` over chunks of lanes and over the devices."""

        def on_device(u: Array, rows: Array, key: Array, temperature: Array) -> Any:
            def chunk(block: tuple[Array, Array, Array]) -> Any:
                keys = jax.vmap(partial(simulation_key, key))(block[1])
                return jax.vmap(one_row)(block[0], keys, block[2])

            if self.chunks == 1:
                return chunk((u, rows, temperature))
            blocks = (
                u.reshape(self.chunks, self.lanes, u.shape[-1]),
                rows.reshape(self.chunks, self.lanes),
                temperature.reshape(self.chunks, self.lanes),
            )
            results = jax.lax.map(chunk, blocks)
            return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), results)

        spread = spread_over_devices(on_device, (True, True, False, True), self.devices)

        def program(u: Array, key: Array, first: Array, temperature: Array) -> Any:
            rows = first + jnp.arange(self.padded, dtype=jnp.int32)
            return spread(u, rows, key, temperature)

        return program

    def _evaluate_row(self, u: Array, key: Array, temperature: Array) -> Any:
        if self.goals is not None:
            return self._clauses_row(self.goals, u, key, temperature)
        if not self.gradient:
            features = self.problem.space.unflatten(u)
            carried = carried_monitor(self.problem)
            if carried is not None:
                rho, status = carried(features, key)
            else:
                rho, status = judge(self.problem, self.problem.system(features, key))
            return rho.astype(u.dtype), status, features, {}

        def objective(u: Array) -> tuple[Array, Any]:
            features = self.problem.space.unflatten(u)
            trace = self.problem.system(features, key).hold()
            semantics = smooth(temperature.astype(u.dtype))
            smoothed = [
                robustness(formula, trace, semantics, end=self.problem.end)
                for formula in self.problem.formulas.values()
            ]
            return jnp.min(jnp.stack(smoothed)), (*judge(self.problem, trace), features)

        derivative, (rho, status, features) = self._derivative(objective, u)
        return rho.astype(u.dtype), status, features, {"gradient": derivative.astype(u.dtype)}

    def _clauses_row(self, goals: Goals, u: Array, key: Array, temperature: Array) -> Any:
        """Robustness as ever, and the clauses of the goal that is nearest to being broken."""

        def objective(u: Array) -> tuple[Array, Any]:
            features = self.problem.space.unflatten(u)
            trace = self.problem.system(features, key).hold()
            values = goals.values(trace, hard, self.problem.end)
            nearest = jnp.argmin(jnp.max(values, axis=1))
            results = (*judge(self.problem, trace), features, values[nearest])
            if not self.gradient:
                return values[nearest], results
            semantics = smooth(temperature.astype(u.dtype))
            return goals.values(trace, semantics, self.problem.end)[nearest], results

        if self.gradient:
            slopes, (rho, status, features, values) = self._derivative.slopes(objective, u)
        else:
            _, (rho, status, features, values) = objective(u)
            slopes = jnp.zeros((0, 0))
        missing = CLAUSES - len(values)
        told = {"clauses": jnp.pad(values, (0, missing), constant_values=ABSENT).astype(u.dtype)}
        if self.gradient:
            told["slopes"] = jnp.pad(slopes, ((0, missing), (0, 0))).astype(u.dtype)
        return rho.astype(u.dtype), status, features, told

    def _verdict_row(self, u: Array, key: Array, temperature: Array) -> Any:
        return verdict(self.problem, self.problem.system(self.problem.space.unflatten(u), key))


def _pad(u: Any, rows: int) -> Any:
    if len(u) == rows:
        return u
    # In NumPy: JAX would compile a program for each number of missing rows.
    u = np.asarray(u)
    return np.concatenate([u, np.broadcast_to(u[-1:], (rows - len(u), *u.shape[1:]))])


def engine_for(
    problem: Problem,
    batch: int,
    gradient: bool = False,
    precision: str = "float32",
    clauses: bool = False,
) -> Engine:
    """The engine of this (problem, batch, mode), made once and kept as long as the problem."""
    mode = (batch, gradient, precision, clauses)
    if mode not in problem.engines:
        problem.engines[mode] = Engine(
            problem, batch, gradient, precision=precision, clauses=clauses
        )
    return problem.engines[mode]
