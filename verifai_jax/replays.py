"""Rows of a table simulated again, many at a time: in a chosen precision and at a finer step.

    features = stored(problem.space, rows, "float64")   # [n, ...], the values of the table
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
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.devices import enable_compile_cache
from verifai_jax.engine import in_precision, judge, simulation_key, verdict
from verifai_jax.errors import unknown_name
from verifai_jax.features import Box, FeatureSpace, Signal
from verifai_jax.features.compound import Struct
from verifai_jax.features.distributions import Continuous
from verifai_jax.features.domain import as_numbers, dotted, indexed
from verifai_jax.host import HostEngine, _Rows
from verifai_jax.problem import Problem
from verifai_jax.systems.simulations import Batched
from verifai_jax.trace import Status
from verifai_jax.waveform import Waveform

FEW = 16
"""Rows up to which they are replayed one by one: that program is compiled much sooner."""
ROUNDING = 2.0**-23
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


def stored(space: FeatureSpace, rows: Mapping[str, Any], precision: str) -> dict[str, Any]:
    """The features `[n, ...]` that rows of a table hold: `space.from_row` of each, stacked.

    - `rows`: columns `[n]` by name; others than those of features are ignored.

    **Raises:** as `space.from_row`.
    """
    for name in space.columns:
        if name not in rows:
            raise unknown_name("column", name, rows)
    columns = {name: np.asarray(rows[name]) for name in space.columns}
    with in_precision(precision):
        batch = {name: _batch(domain, columns, name) for name, domain in space.domains.items()}
        return jax.tree.map(lambda leaf: _cast(leaf, precision), batch)


def _cast(leaf: np.ndarray, precision: str) -> np.ndarray:
    return leaf.astype(precision) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf


def _batch(domain: Any, columns: Mapping[str, np.ndarray], name: str) -> Any:
    names = domain.columns(name)
    if isinstance(domain, Struct):
        return {part: _batch(inner, columns, dotted(name, part)) for part, inner in domain.fields}
    if isinstance(domain, Box | Continuous):
        # In NumPy: a first use of JAX takes longer than the simulation.
        values = [as_numbers(columns[column], column) for column in names]
        return values[0] if np.ndim(getattr(domain, "low", 0.0)) == 0 else np.stack(values, axis=1)
    if isinstance(domain, Signal):
        knots = [_batch(domain.domain, columns, knot) for knot in indexed(name, domain.knots)]
        return Waveform(np.stack(knots, axis=1), domain.hold, domain.duration)  # pyright: ignore[reportArgumentType]
    # One row at a time, but equal ones once.
    rows = list(zip(*(columns[column].tolist() for column in names), strict=True))
    count = len(next(iter(columns.values())))
    known: dict[Any, Any] = {}
    for row in rows or [()]:
        if row not in known:
            entries = dict(zip(names, row, strict=True))
            known[row] = jax.tree.map(np.asarray, domain.from_columns(entries, name))
    each = [known[row] for row in rows] if rows else [known[()]] * count
    return jax.tree.map(lambda *leaves: np.stack(leaves), *each)


def nudged(space: FeatureSpace, features: Mapping[str, Any]) -> dict[str, Any]:
    """The same features `[n, ...]`, their real numbers one rounding of float32 away.

    Not out of their domains, and not numbers of which there are only some (choices, constants).
    """
    return {name: _nudged(domain, features[name]) for name, domain in space.domains.items()}


def _nudged(domain: Any, value: Any) -> Any:
    if isinstance(domain, Struct):
        return {name: _nudged(part, value[name]) for name, part in domain.fields}
    if isinstance(domain, Signal):
        return replace(value, knots=_nudged(domain.domain, value.knots))
    if isinstance(domain, Box | Continuous):
        low, high = domain.support if isinstance(domain, Continuous) else (domain.low, domain.high)
        away = (value * (1 + ROUNDING)).astype(value.dtype)
        inside = (away >= np.asarray(low)) & (away <= np.asarray(high))
        return np.where(inside, away, (value * (1 - ROUNDING)).astype(value.dtype))
    return value


class Refiner:
    """A system at its own step and at finer ones; each is made once."""

    def __init__(self, system: Any) -> None:
        self.system = system
        refine = getattr(system, "refined", None)
        self.refine: Callable[[Any], Any] | None = refine if callable(refine) else None
        self.traced = self.refine is not None and bool(getattr(system, "traced_factor", False))
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
                return f"refined({factor}) raised {told(error)}"
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
            return Replayed(nothing, no, no, [told(error)] * count)
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

        program = one if lanes is None else _spread(one)
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


def _spread(one: Callable[..., Any]) -> Callable[..., Any]:
    """`one` over rows, a part of them on each device."""
    many, devices = jax.vmap(one, in_axes=(0, 0, None)), jax.local_devices()
    if len(devices) == 1:
        return many
    split, whole = PartitionSpec("batch"), PartitionSpec()
    return jax.shard_map(
        many,
        mesh=Mesh(np.array(devices), ("batch",)),
        in_specs=(split, split, whole),
        out_specs=split,
        check_vma=False,
    )


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
            if isinstance(engine.problem.system, Batched):
                engine._together(features, keys, rows)
            else:
                seeds = np.asarray(jax.vmap(jax.random.bits)(keys))
                engine._one_by_one(features, seeds, np.zeros((n, 0)), 0, rows)
        rho = np.min(rows.rho, axis=1)
        proper = rows.status == Status.OK
        broken = np.any(rows.rho < 0, axis=1)
        broken |= np.any(rows.rho == 0, axis=1) & ~np.all(rows.holds, axis=1)
        return Replayed(rho, broken & proper, proper, rows.messages)


def told(error: Exception) -> str:
    """An exception in one line."""
    first = (str(error).splitlines() or [""])[0]
    return f"{type(error).__name__}: {first}" if first else type(error).__name__
