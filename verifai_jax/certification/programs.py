"""The compiled simulation of (policy, block of samples) pairs.

    simulator = simulator_for(problem_of, family, lanes=64)
    simulator([0, 0, 1], points, first)         # three blocks: policies 0, 0, 1 of the family

A block is one policy in some tens of samples, side by side, so that its weights are shared by one
matrix product. Blocks are worked through one after another, spread over the devices, in a program
that is compiled once for a structure: how many there are is an argument. What a block gives depends
on its policy and samples alone, bit for bit, not on the other blocks or the number of devices.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.carried import carried_monitor
from verifai_jax.certification.families import Family
from verifai_jax.devices import enable_compile_cache
from verifai_jax.engine import judge, simulation_key, verdict
from verifai_jax.evaluator import Evaluator, violated
from verifai_jax.problem import Problem
from verifai_jax.trace import Status

MOST_BLOCKS = 64
"""Blocks of a device in one call at most."""
SLICE_SECONDS = 1.0
"""How long a call lasts at most, about: between calls one can stop."""

# What JAX raises where code needs the numbers that it traces.
NEEDS_NUMBERS = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerBoolConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)


class Outcome(NamedTuple):
    """What came of one block, on the host.

    - `rho`: the least formula's hard robustness; NaN where there is no verdict.
    - `failing`: ended properly and breaks a formula; `proper`: ended properly.
    """

    rho: Float[np.ndarray, " lanes"]
    failing: Bool[np.ndarray, " lanes"]
    proper: Bool[np.ndarray, " lanes"]


class Simulator(Protocol):
    """Simulates blocks of a family's policies."""

    lanes: int

    def __call__(
        self,
        members: Sequence[int],
        points: Float[np.ndarray, "blocks lanes d"],
        first: Int[np.ndarray, " blocks"],
        key: Key[Array, ""],
    ) -> list[Outcome]:
        """Outcomes of the blocks, in order.

        - `members`: of each block the policy, by its place in the family.
        - `first`: of each block the number of its first sample, which its random keys come from.
        """
        ...

    def together(self) -> int:
        """How many blocks one call should have, so that it does not last too long."""
        ...


def problem_with(problem_of: Callable[[Any], Problem], policy: Any) -> Problem:
    """The problem of one policy, whose weights JAX may be tracing."""
    # What does not depend on the weights is computed now, so that checks of it can be made.
    with jax.ensure_compile_time_eval():
        problem = problem_of(policy)
    if not isinstance(problem, Problem):
        raise TypeError(
            f"problem_of must return a Problem for a policy; it returned {type(problem).__name__}"
        )
    return problem


class Traced:
    """All policies of a family in one program; see the module's docstring."""

    def __init__(
        self,
        problem_of: Callable[[Any], Problem],
        family: Family,
        lanes: int,
        dim: int,
        devices: Sequence[Any] | None = None,
    ) -> None:
        self.problem_of, self.family, self.lanes, self.dim = problem_of, family, lanes, dim
        self.devices = tuple(jax.local_devices() if devices is None else devices)
        self.capacity = MOST_BLOCKS
        self._seconds: float | None = None  # Of a block, on one device.
        self._executables: dict[str, Any] = {}

    def together(self) -> int:
        if self._seconds is None:
            return len(self.devices)
        each = max(1, min(self.capacity, int(SLICE_SECONDS / max(self._seconds, 1e-9))))
        return each * len(self.devices)

    def compile(self) -> None:
        """Compile now."""
        self._executable("evaluate")

    def __call__(self, members: Any, points: Any, first: Any, key: Any) -> list[Outcome]:
        outcomes: list[Outcome] = []
        most = self.capacity * len(self.devices)
        for start in range(0, len(members), most):
            part = slice(start, start + most)
            outcomes += self._call(members[part], points[part], first[part], key)
        return outcomes

    def _call(self, members: Any, points: Any, first: Any, key: Any) -> list[Outcome]:
        rho, status = self._run("evaluate", members, points, first, key)
        proper = status == Status.OK
        broken = np.any(rho < 0, axis=2) & proper
        zero = proper & ~broken & np.any(rho == 0, axis=2)
        if zero.any():
            # At exactly zero the comparator decides: x >= 0 holds there, x > 0 does not.
            places = np.flatnonzero(zero.any(axis=1))
            some = [members[i] for i in places]
            (holds,) = self._run("verdicts", some, points[places], first[places], key)
            broken[places] |= zero[places] & ~np.all(holds, axis=2)
        least = np.where(proper, np.min(rho, axis=2), np.nan).astype(np.float32)
        return [Outcome(*block) for block in zip(least, broken, proper, strict=True)]

    def _run(self, mode: str, members: Any, points: Any, first: Any, key: Any) -> list[np.ndarray]:
        count, devices = len(members), len(self.devices)
        executable = self._executable(mode)
        share = -(-count // devices)
        # Device i works on blocks i * share and following, which lie at the start of its part.
        place = np.arange(count)
        place = place // share * self.capacity + place % share
        whole = devices * self.capacity
        spread = np.zeros(whole, np.int32)
        spread[place] = np.asarray(members, np.int32)
        # Weights are stacked block by block: the program does not know how many policies there are.
        weights = jax.tree.map(
            lambda *leaves: np.stack(leaves), *[self.family.weights[m] for m in spread]
        )
        u = np.full((whole, self.lanes, self.dim), 0.5, np.float32)
        u[place] = points
        numbers = np.zeros(whole, np.int32)
        numbers[place] = first
        counts = np.clip(count - np.arange(devices) * share, 0, share).astype(np.int32)
        began = time.perf_counter()
        results = [np.asarray(r)[place] for r in executable(weights, u, numbers, counts, key)]
        self._seconds = (time.perf_counter() - began) / share
        return results

    def _executable(self, mode: str) -> Any:
        if mode not in self._executables:
            enable_compile_cache()
            whole = len(self.devices) * self.capacity
            arguments = (
                jax.tree.map(
                    lambda leaf: jax.ShapeDtypeStruct((whole, *leaf.shape), leaf.dtype),
                    self.family.weights[0],
                ),
                jax.ShapeDtypeStruct((whole, self.lanes, self.dim), jnp.float32),
                jax.ShapeDtypeStruct((whole,), jnp.int32),
                jax.ShapeDtypeStruct((len(self.devices),), jnp.int32),
                jax.eval_shape(lambda: jax.random.key(0, impl="threefry2x32")),
            )
            self._executables[mode] = jax.jit(self._program(mode)).lower(*arguments).compile()
        return self._executables[mode]

    def _program(self, mode: str) -> Any:
        def row(problem: Problem) -> Any:
            carried = carried_monitor(problem) if mode == "evaluate" else None

            def one(u: Array, key: Array) -> Any:
                features = problem.space.unflatten(u)
                if carried is not None:
                    return carried(features, key)
                trace = problem.system(features, key)
                return (verdict(problem, trace),) if mode == "verdicts" else judge(problem, trace)

            return one

        def on_device(weights: Any, u: Array, first: Array, count: Array, key: Array) -> Any:
            def block(i: Any) -> Any:
                policy = jax.tree.map(lambda leaf: leaf[i], weights)
                numbers = first[i] + jnp.arange(self.lanes, dtype=jnp.int32)
                keys = jax.vmap(partial(simulation_key, key))(numbers)
                return jax.vmap(row(problem_with(self.problem_of, policy)))(u[i], keys)

            form = jax.eval_shape(block, jnp.int32(0))
            results = jax.tree.map(
                lambda leaf: jnp.zeros((self.capacity, *leaf.shape), leaf.dtype), form
            )

            def step(i: Any, results: Any) -> Any:
                return jax.tree.map(lambda all_, one: all_.at[i].set(one), results, block(i))

            return jax.lax.fori_loop(0, count[0], step, results)

        if len(self.devices) == 1:
            return on_device
        split, whole = PartitionSpec("block"), PartitionSpec()
        return jax.shard_map(
            on_device,
            mesh=Mesh(np.array(self.devices), ("block",)),
            in_specs=(split, split, split, split, whole),
            out_specs=split,
            # A user's scan need not say that its carry differs between devices.
            check_vma=False,
        )


class Alone:
    """Each policy by itself: for systems out of JAX's sight, and code that needs the numbers."""

    def __init__(self, problems: Sequence[Problem], lanes: int) -> None:
        self.lanes = lanes
        self._problems = problems
        self._evaluators: dict[int, Evaluator] = {}

    def together(self) -> int:
        return 1

    def __call__(self, members: Any, points: Any, first: Any, key: Any) -> list[Outcome]:
        outcomes = []
        for member, u, number in zip(members, points, first, strict=True):
            if member not in self._evaluators:
                self._evaluators[member] = Evaluator(self._problems[member], self.lanes)
            engine = self._evaluators[member].engine
            found = engine.evaluate(u, key, int(number))
            broken = violated(engine, found, u, key, int(number))
            proper = found.status == Status.OK
            least = np.where(proper, np.min(found.rho, axis=1), np.nan).astype(np.float32)
            outcomes.append(Outcome(least, broken & proper, proper))
        return outcomes
