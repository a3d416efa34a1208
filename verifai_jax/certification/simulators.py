"""The compiled simulation of (policy, block of samples) pairs.

    simulator = shared_simulator(problem_of, group, lanes=64, dim=3)
    simulator([0, 0, 1], points, first)         # three blocks: policies 0, 0, 1 of the group

A block is one policy in some tens of samples, side by side, so that its weights are shared by one
matrix product. Blocks are worked through one after another (on an accelerator all at once), spread
over the devices, in a program that is compiled once for a structure: how many there are is an
argument. What a block gives depends on its policy and samples alone, bit for bit on one machine,
not on the other blocks or the number of devices.
"""

import time
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.certification.policy_groups import PolicyGroup
from verifai_jax.core.devices import enable_compile_cache, spread_over_devices
from verifai_jax.core.keys import simulation_key
from verifai_jax.core.trace import Status
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.streaming_monitor import streaming_monitor
from verifai_jax.evaluation.verdicts import (
    boolean_semantics,
    trace_verdict,
    violations,
)
from verifai_jax.problem.problem import Problem

MOST_BLOCKS = 64
"""Blocks of a device in one call at most."""
SLICE_SECONDS = 1.0
"""How long a call lasts at most, about: between calls one can stop."""


class Outcome(NamedTuple):
    """The outcome of one block, on the host.

    - `rho`: the least formula's hard robustness; NaN where there is no verdict.
    - `failing`: ended properly and breaks a formula; `proper`: ended properly.
    """

    rho: Float[np.ndarray, " lanes"]
    failing: Bool[np.ndarray, " lanes"]
    proper: Bool[np.ndarray, " lanes"]


class Simulator(Protocol):
    """Simulates blocks of a group's policies."""

    lanes: int

    def __call__(
        self,
        members: Sequence[int],
        points: Float[np.ndarray, "blocks lanes d"],
        first: Int[np.ndarray, " blocks"],
        key: Key[Array, ""],
    ) -> list[Outcome]:
        """Outcomes of the blocks, in order.

        - `members`: of each block the policy, by its place in the group.
        - `first`: of each block the number of its first sample, which its random keys come from.
        """
        ...

    def blocks_per_call(self) -> int:
        """Return the number of blocks of one call, so that it does not last too long."""
        ...


def problem_with(problem_of: Callable[[Any], Problem], policy: Any) -> Problem:
    """Return the problem of one policy, whose weights JAX may be tracing."""
    # What does not depend on the weights is computed now, so that checks of it can be made.
    with jax.ensure_compile_time_eval():
        problem = problem_of(policy)
    if not isinstance(problem, Problem):
        raise TypeError(
            f"problem_of must return a Problem for a policy; it returned {type(problem).__name__}"
        )
    return problem


class SharedSimulator:
    """All policies of a group in one program; see the module's docstring."""

    def __init__(self, program: "_Program", group: PolicyGroup) -> None:
        self.lanes = program.lanes
        self._program, self._family = program, group

    def blocks_per_call(self) -> int:
        return self._program.blocks_per_call()

    def __call__(self, members: Any, points: Any, first: Any, key: Any) -> list[Outcome]:
        outcomes: list[Outcome] = []
        most = self._program.capacity * len(self._program.devices)
        for start in range(0, len(members), most):
            part = slice(start, start + most)
            outcomes += self._call(members[part], points[part], first[part], key)
        return outcomes

    def _call(self, members: Any, points: Any, first: Any, key: Any) -> list[Outcome]:
        policies = [self._family.weights[member] for member in members]
        rho, status = self._program("evaluate", policies, points, first, key)
        flat = rho.reshape(-1, rho.shape[2])

        def holds() -> Bool[np.ndarray, "rows formulas"]:
            places = np.flatnonzero(np.any(rho == 0, axis=(1, 2)))
            every = np.ones(rho.shape, bool)
            some = [policies[i] for i in places]
            (every[places],) = self._program("holds", some, points[places], first[places], key)
            return every.reshape(flat.shape)

        violated = violations(flat, status.ravel(), holds).reshape(status.shape)
        proper = status == Status.OK
        least = np.where(proper, np.min(rho, axis=2), np.nan).astype(np.float32)
        return [Outcome(*block) for block in zip(least, violated, proper, strict=True)]


def shared_simulator(
    problem_of: Callable[[Any], Problem],
    group: PolicyGroup,
    lanes: int,
    dim: int,
    devices: Sequence[Any] | None = None,
) -> SharedSimulator:
    """Return the simulator of a group; its programs live as long as `problem_of` is in use."""
    where = tuple(jax.local_devices() if devices is None else devices)
    try:
        program = _known_program(problem_of, group.structure, lanes, dim, where)
    except TypeError:  # It cannot be hashed.
        program = _Program(problem_of, lanes, dim, where)
    return SharedSimulator(program, group)


@lru_cache(maxsize=16)
def _known_program(
    problem_of: Any, structure: str, lanes: int, dim: int, devices: tuple[Any, ...]
) -> "_Program":
    return _Program(problem_of, lanes, dim, devices)


class _Program:
    """What is compiled for one structure: blocks in, robustness and status out."""

    def __init__(
        self,
        problem_of: Callable[[Any], Problem],
        lanes: int,
        dim: int,
        devices: tuple[Any, ...],
    ) -> None:
        self.problem_of, self.lanes, self.dim, self.devices = problem_of, lanes, dim, devices
        self.capacity = MOST_BLOCKS
        self._seconds: float | None = None  # Of a block, on one device.
        self._executables: dict[str, Any] = {}

    def blocks_per_call(self) -> int:
        """Blocks in a call that lasts about `SLICE_SECONDS`; few at first."""
        if not _one_by_one(self.devices):
            return self.capacity * len(self.devices)
        if self._seconds is None:
            return len(self.devices)
        each = max(1, min(self.capacity, int(SLICE_SECONDS / max(self._seconds, 1e-9))))
        return each * len(self.devices)

    def __call__(
        self, mode: str, policies: Sequence[Any], points: Any, first: Any, key: Any
    ) -> list[np.ndarray]:
        """Results `[blocks, lanes, ...]` of as many blocks as there are policies."""
        count, devices = len(policies), len(self.devices)
        share = -(-count // devices)
        # Device i works on blocks i * share and following, which lie at the start of its part.
        place = np.arange(count)
        place = place // share * self.capacity + place % share
        whole = devices * self.capacity
        # Weights are stacked block by block: the program does not know how many policies there are.
        weights = jax.tree.map(lambda *leaves: _spread(leaves, place, whole), *policies)
        u = _spread(points, place, whole)
        numbers = _spread(first, place, whole)
        counts = np.clip(count - np.arange(devices) * share, 0, share).astype(np.int32)
        executable = self._executable(mode, policies[0])
        began = time.perf_counter()
        results = executable(weights, u, numbers, counts, key)
        results = [np.asarray(result)[place] for result in results]
        self._seconds = (time.perf_counter() - began) / share
        return results

    def _executable(self, mode: str, policy: Any) -> Any:
        if mode not in self._executables:
            enable_compile_cache()
            whole = len(self.devices) * self.capacity
            arguments = (
                jax.tree.map(
                    lambda leaf: jax.ShapeDtypeStruct((whole, *leaf.shape), leaf.dtype), policy
                ),
                jax.ShapeDtypeStruct((whole, self.lanes, self.dim), jnp.float32),
                jax.ShapeDtypeStruct((whole,), jnp.int32),
                jax.ShapeDtypeStruct((len(self.devices),), jnp.int32),
                jax.eval_shape(lambda: jax.random.key(0, impl="threefry2x32")),
            )
            self._executables[mode] = jax.jit(self._traced(mode)).lower(*arguments).compile()
        return self._executables[mode]

    def _traced(self, mode: str) -> Any:
        def row(problem: Problem) -> Any:
            monitor = streaming_monitor(problem) if mode == "evaluate" else None

            def one(u: Array, key: Array) -> Any:
                features = problem.space.unflatten(u)
                if monitor is not None:
                    return monitor(features, key)
                trace = problem.system(features, key)
                if mode == "holds":
                    return (boolean_semantics(problem, trace),)
                return trace_verdict(problem, trace)

            return one

        def on_device(weights: Any, u: Array, first: Array, count: Array, key: Array) -> Any:
            def block(i: Any) -> Any:
                policy = jax.tree.map(lambda leaf: leaf[i], weights)
                numbers = first[i] + jnp.arange(self.lanes, dtype=jnp.int32)
                keys = jax.vmap(partial(simulation_key, key))(numbers)
                return jax.vmap(row(problem_with(self.problem_of, policy)))(u[i], keys)

            if not _one_by_one(self.devices):
                return jax.vmap(block)(jnp.arange(self.capacity))
            form = jax.eval_shape(block, jnp.int32(0))
            results = jax.tree.map(
                lambda leaf: jnp.zeros((self.capacity, *leaf.shape), leaf.dtype), form
            )

            def step(i: Any, results: Any) -> Any:
                return jax.tree.map(lambda all_, one: all_.at[i].set(one), results, block(i))

            return jax.lax.fori_loop(0, count[0], step, results)

        return spread_over_devices(on_device, (True, True, True, True, False), self.devices)


def _one_by_one(devices: Sequence[Any]) -> bool:
    """Whether a block keeps a device busy. An accelerator works on all blocks of a call at once."""
    return devices[0].platform == "cpu"


def _spread(rows: Any, places: Int[np.ndarray, " n"], whole: int) -> np.ndarray:
    """Return `whole` rows: the given ones at these places, the first of them elsewhere."""
    given = np.asarray(rows)
    spread = np.empty((whole, *given.shape[1:]), given.dtype)
    spread[:] = given[0]
    spread[places] = given
    return spread


class SeparateSimulators:
    """Each policy by itself: for systems out of JAX's sight, and code that needs the numbers."""

    def __init__(self, problems: Sequence[Problem], lanes: int) -> None:
        self.lanes = lanes
        self.messages: dict[int, str] = {}  # Of each policy the first that a simulation left.
        self._problems = problems
        self._evaluators: dict[int, Evaluator] = {}

    def blocks_per_call(self) -> int:
        return 1

    def __call__(self, members: Any, points: Any, first: Any, key: Any) -> list[Outcome]:
        outcomes = []
        for member, u, number in zip(members, points, first, strict=True):
            if member not in self._evaluators:
                self._evaluators[member] = Evaluator(self._problems[member], self.lanes)
            engine = self._evaluators[member].engine
            verdicts = engine.evaluate(u, key, int(number))
            told = next((message for message in verdicts.messages or () if message), None)
            if told is not None:
                self.messages.setdefault(member, told)
            least = np.where(verdicts.proper, verdicts.least, np.nan).astype(np.float32)
            outcomes.append(Outcome(least, verdicts.violated, verdicts.proper))
        return outcomes
