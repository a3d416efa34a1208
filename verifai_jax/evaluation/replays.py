"""Rows of a table simulated again, many at a time: in a chosen precision and at a finer step.

    features = problem.space.features_of(rows, "float64")   # [n, ...], the values of the table
    again = Replays(problem, "float64", key)
    again(1, features, numbers).rho                     # [n], at the system's own step
    again(4, features, numbers).failing                 # at a quarter of it

A system that can be refined has `refined(factor) -> system`: the same sampling and the same control
decisions, with a `factor` times smaller step. With `traced_factor = True` its factor may be traced
by JAX, and one program replays at every step.
"""

import copy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.core.devices import enable_compile_cache, spread_over_devices
from verifai_jax.core.keys import simulation_key
from verifai_jax.core.precision import in_precision
from verifai_jax.core.text import format_error
from verifai_jax.core.trace import Status
from verifai_jax.evaluation.engine import judge, verdict
from verifai_jax.evaluation.host_engine import HostEngine, _Rows
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import System

FEW = 16
"""Rows up to which they are replayed one by one: that program is compiled much sooner."""
IMPL = "threefry2x32"  # As of the keys of a run.
LANES = 64
"""Rows that a device replays together, where there are more."""


class Replayed(NamedTuple):
    """What came of replays, one row each; as `evaluator.Judged`, and what was raised."""

    rho: Float[np.ndarray, " n"]
    failing: Bool[np.ndarray, " n"]
    proper: Bool[np.ndarray, " n"]
    messages: list[str]

    @classmethod
    def of(cls, parts: "list[Replayed]") -> "Replayed":
        """The rows of all parts."""
        rho, failing, proper = (np.concatenate([part[i] for part in parts]) for i in range(3))
        return cls(rho, failing, proper, [message for part in parts for message in part.messages])


class Refiner:
    """A system at its own step and at finer ones; each is made once."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.refine: Callable[[Any], Any] | None = system.refined if system.can_refine else None
        self.traced = system.can_refine and system.traced_factor
        self._made: dict[int, Any] = {1: system}

    def __call__(self, factor: int) -> Any:
        """The system with a `factor` times smaller step."""
        if factor not in self._made:
            assert self.refine is not None
            self._made[factor] = self.refine(factor)
        return self._made[factor]

    def why_not(self, factors: Iterable[int]) -> str | None:
        """Why the step cannot be made smaller; None where it can."""
        if self.refine is None:
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

    - `key`: of the run's simulations, from `run_keys`.
    - `features`: of some rows, whose form all others have.

    `draws` is whether the system uses its random key. One program is traced at once, and what that
    raises is raised here.
    """

    def __init__(
        self, problem: Problem, precision: str, key: Key[Array, ""], features: Mapping[str, Any]
    ) -> None:
        self.problem, self.precision, self.key = problem, precision, key
        self.refiner = Refiner(problem.system)
        self._forms = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), features
        )
        self._kept = problem.engines.setdefault("replays", {})
        try:
            traced = self._traced("rho", 1, None)
        except Exception:
            if not self.refiner.traced:
                raise
            # It takes integers only, whatever it says of itself.
            self.refiner.traced = False
            traced = self._traced("rho", 1, None)
        used = traced.jaxpr.jaxpr.invars[len(jax.tree.leaves(features))]
        self.draws = any(used is v for step in traced.jaxpr.jaxpr.eqns for v in step.invars)

    def __call__(
        self, factor: int, features: Mapping[str, Any], numbers: Int[np.ndarray, " n"]
    ) -> Replayed:
        """Simulate the rows of these numbers again, with a `factor` times smaller step."""
        count = len(numbers)
        lanes = None if count <= FEW else LANES * len(jax.local_devices())
        parts = []
        with in_precision(self.precision):
            for start in range(0, count, lanes or 1):
                block = np.arange(start, min(start + (lanes or 1), count))
                parts.append(self._block(factor, lanes, features, numbers, block))
        return Replayed.of(parts)

    def _block(
        self, factor: int, lanes: int | None, features: Any, numbers: Any, block: np.ndarray
    ) -> Replayed:
        count = len(block)
        if lanes is None:
            place, key = block[0], self.key
            if self.draws:  # Without it any key will do.
                key = simulation_key(self.key, int(numbers[place]))
        else:
            place = block[np.minimum(np.arange(lanes), count - 1)]
            many = jnp.asarray(numbers[place], jnp.int32)
            key = jax.vmap(partial(simulation_key, self.key))(many)
        rows = jax.tree.map(lambda leaf: leaf[place], features)

        def run(mode: str) -> Any:
            result = self._executable(mode, factor, lanes)(rows, key, np.int32(factor))
            result = jax.tree.map(np.asarray, result)
            return jax.tree.map(lambda leaf: leaf[None] if lanes is None else leaf[:count], result)

        try:
            rho, status = run("rho")
            broken, proper = np.any(rho < 0, axis=1), status == Status.OK
            undecided = proper & ~broken & np.any(rho == 0, axis=1)
            if undecided.any():
                # At exactly zero the Boolean semantics decide, as in a run.
                broken |= undecided & ~np.all(run("holds"), axis=1)
        except Exception as error:
            nothing, no = np.full(count, np.nan), np.zeros(count, bool)
            return Replayed(nothing, no, no, [format_error(error)] * count)
        return Replayed(np.min(rho, axis=1), broken & proper, proper, [""] * count)

    def _executable(self, mode: str, factor: int, lanes: int | None) -> Any:
        place = ("run", *self._place(mode, factor, lanes))
        if place not in self._kept:
            enable_compile_cache()
            self._kept[place] = self._traced(mode, factor, lanes).lower().compile()
        return self._kept[place]

    def _place(self, mode: str, factor: int, lanes: int | None) -> tuple[Any, ...]:
        return (self.precision, mode, 0 if self.refiner.traced else factor, lanes)

    def _traced(self, mode: str, factor: int, lanes: int | None) -> Any:
        place = self._place(mode, factor, lanes)
        if place in self._kept:
            return self._kept[place]
        problem, refiner = self.problem, self.refiner
        judged = {"rho": judge, "holds": verdict}[mode]
        finer = None if refiner.traced else refiner(factor)

        def one(features: Any, key: Any, factor: Any) -> Any:
            system = finer
            if system is None:
                assert refiner.refine is not None
                system = refiner.refine(factor)
            return judged(problem, system(features, key))

        program = one
        if lanes is not None:
            many = jax.vmap(one, in_axes=(0, 0, None))
            program = spread_over_devices(many, (True, True, False))
        leading = () if lanes is None else (lanes,)
        features = jax.tree.map(
            lambda form: jax.ShapeDtypeStruct((*leading, *form.shape), form.dtype), self._forms
        )
        key = jax.eval_shape(lambda: jax.random.key(0, impl=IMPL))
        keys = jax.ShapeDtypeStruct(leading, key.dtype)
        with in_precision(self.precision):
            traced = jax.jit(program).trace(features, keys, jax.ShapeDtypeStruct((), jnp.int32))
        self._kept[place] = traced
        return traced


class HostReplays:
    """Replays of a problem that runs on the host; as `Replays`.

    `draws` is False: a black box gets an integer seed, the same in every precision.
    """

    draws = False

    def __init__(self, problem: Problem, precision: str, key: Key[Array, ""]) -> None:
        self.problem, self.precision, self.key = problem, precision, key
        self.refiner = Refiner(problem.system)
        enable_compile_cache()
        self._engine = HostEngine(problem, precision)

    def __call__(
        self, factor: int, features: Mapping[str, Any], numbers: Int[np.ndarray, " n"]
    ) -> Replayed:
        """Simulate the rows of these numbers again, with a `factor` times smaller step."""
        # One monitor for all steps.
        engine, n = copy.copy(self._engine), len(numbers)
        engine.problem = replace(self.problem, system=self.refiner(factor))
        rows = _Rows(n, len(self.problem.formulas), self.precision)
        with in_precision(self.precision):
            keys = jax.vmap(partial(simulation_key, self.key))(jnp.asarray(numbers, jnp.int32))
            # What a run does once it has made features of its points.
            if engine.problem.system.can_simulate_batch:
                engine._together(features, keys, rows)
            else:
                seeds = np.asarray(jax.vmap(jax.random.bits)(keys))
                engine._one_by_one(features, seeds, np.zeros((n, 0)), 0, rows)
        rho = np.min(rows.rho, axis=1)
        proper = rows.status == Status.OK
        broken = np.any(rows.rho < 0, axis=1)
        broken |= np.any(rows.rho == 0, axis=1) & ~np.all(rows.holds, axis=1)
        return Replayed(rho, broken & proper, proper, rows.messages)
