"""The compiled simulation of (policy, block of samples) pairs.

    simulator = shared_simulator(problem_of, group, lanes=64, dim=3)
    simulator([0, 0, 1], points, first)         # three blocks: policies 0, 0, 1 of the group

A block simulates one policy on some tens of samples together, so that one matrix product applies
its weights to all. Blocks are spread over the devices and simulated one after another (on an
accelerator all at once), in a program that is compiled once for a structure and any number of
blocks. The result of a block depends only on its policy and samples, bit for bit on one machine.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key, PyTree

from verifai_jax.addons.estimation.certification.policy_groups import PolicyGroup
from verifai_jax.core.compute.devices import Device, enable_compile_cache, spread_over_devices
from verifai_jax.core.compute.keys import IMPLEMENTATION, simulation_key
from verifai_jax.evaluation.engine import Engine, Mode
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.verdicts import Verdicts, violations
from verifai_jax.problem.problem import Problem

MAX_BLOCKS = 64
"""Blocks of a device in one call at most."""
SLICE_SECONDS = 1.0
"""Seconds that a call lasts at most, about: between calls one can stop."""


class Simulator(Protocol):
    """Simulates blocks of a group's policies."""

    lanes: int

    def __call__(
        self, members: Sequence[int], points: Float[np.ndarray, "blocks lanes d"],
        first: Int[np.ndarray, " blocks"], key: Key[Array, ""],
    ) -> list[Verdicts]:  # fmt: skip
        """Return the verdicts of the blocks, in order.

        **Arguments:**
        - `members`: the index in the group of each block's policy.
        - `first`: the number of the first sample of each block, which gives its random keys.
        - `key`: the key of all simulations.
        """
        ...

    def blocks_per_call(self) -> int:
        """Return the number of blocks in one call, chosen so that a call does not take too long."""
        ...


def problem_with(problem_of: Callable[[Any], Problem], policy: PyTree) -> Problem:
    """Return the problem of one policy; JAX may be tracing its weights."""
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
        self._program, self._group = program, group

    def blocks_per_call(self) -> int:
        return self._program.blocks_per_call()

    def __call__(
        self, members: Sequence[int], points: Float[np.ndarray, "blocks lanes d"],
        first: Int[np.ndarray, " blocks"], key: Key[Array, ""],
    ) -> list[Verdicts]:  # fmt: skip
        verdicts: list[Verdicts] = []
        maximum = self._program.capacity * len(self._program.devices)
        for start in range(0, len(members), maximum):
            part = slice(start, start + maximum)
            verdicts += self._call(members[part], points[part], first[part], key)
        return verdicts

    def _call(
        self, members: Sequence[int], points: Float[np.ndarray, "blocks lanes d"],
        first: Int[np.ndarray, " blocks"], key: Key[Array, ""],
    ) -> list[Verdicts]:  # fmt: skip
        policies = [self._group.weights[member] for member in members]
        rho, status = self._program("evaluate", policies, points, first, key)
        flat = rho.reshape(-1, rho.shape[2])

        def holds() -> Bool[np.ndarray, "rows formulas"]:
            indices = np.flatnonzero(np.any(rho == 0, axis=(1, 2)))
            every = np.ones(rho.shape, bool)
            some = [policies[i] for i in indices]
            (every[indices],) = self._program("holds", some, points[indices], first[indices], key)
            return every.reshape(flat.shape)

        violated = violations(flat, status.ravel(), holds).reshape(status.shape)
        return [Verdicts(*block) for block in zip(rho, status, violated, strict=True)]


def shared_simulator(
    problem_of: Callable[[Any], Problem], group: PolicyGroup, lanes: int, dim: int,
    devices: Sequence[Device] | None = None,
) -> SharedSimulator:  # fmt: skip
    """Return the simulator of a group; its programs live as long as `problem_of`."""
    where = tuple(jax.local_devices() if devices is None else devices)
    try:
        program = _known_program(problem_of, group.structure, lanes, dim, where)
    except TypeError:  # It cannot be hashed.
        program = _Program(problem_of, lanes, dim, where)
    return SharedSimulator(program, group)


@lru_cache(maxsize=16)
def _known_program(
    problem_of: Callable[[Any], Problem], structure: str, lanes: int, dim: int,
    devices: tuple[Device, ...],
) -> "_Program":  # fmt: skip
    return _Program(problem_of, lanes, dim, devices)


class _Program:
    """The compiled programs of one structure: blocks in, robustness and status out."""

    def __init__(
        self, problem_of: Callable[[Any], Problem], lanes: int, dim: int,
        devices: tuple[Device, ...],
    ) -> None:  # fmt: skip
        self.problem_of, self.lanes, self.dim, self.devices = problem_of, lanes, dim, devices
        self.capacity = MAX_BLOCKS
        self._seconds: float | None = None  # Of a block, on one device.
        self._executables: dict[Mode, jax.stages.Compiled] = {}

    def blocks_per_call(self) -> int:
        """Return the blocks of a call that lasts about `SLICE_SECONDS`; only some at first."""
        if not _one_by_one(self.devices):
            return self.capacity * len(self.devices)
        if self._seconds is None:
            return len(self.devices)
        each = max(1, min(self.capacity, int(SLICE_SECONDS / max(self._seconds, 1e-9))))
        return each * len(self.devices)

    def __call__(
        self, mode: Mode, policies: Sequence[PyTree], points: Float[np.ndarray, "blocks lanes d"],
        first: Int[np.ndarray, " blocks"], key: Key[Array, ""],
    ) -> list[np.ndarray]:  # fmt: skip
        """Return results `[blocks, lanes, ...]` of as many blocks as there are policies."""
        count, devices = len(policies), len(self.devices)
        share = -(-count // devices)
        # Device i works on blocks i * share and following, which lie at the start of its part.
        index = np.arange(count)
        index = index // share * self.capacity + index % share
        whole = devices * self.capacity
        # Weights are stacked block by block: the program does not know how many policies there are.
        weights = jax.tree.map(lambda *leaves: _spread(leaves, index, whole), *policies)
        u = _spread(points, index, whole)
        numbers = _spread(first, index, whole)
        counts = np.clip(count - np.arange(devices) * share, 0, share).astype(np.int32)
        executable = self._executable(mode, policies[0])
        began = time.perf_counter()
        results = executable(weights, u, numbers, counts, key)
        results = [np.asarray(result)[index] for result in results]
        self._seconds = (time.perf_counter() - began) / share
        return results

    def _executable(self, mode: Mode, policy: PyTree) -> jax.stages.Compiled:
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
                jax.eval_shape(lambda: jax.random.key(0, impl=IMPLEMENTATION)),
            )
            self._executables[mode] = jax.jit(self._traced(mode)).lower(*arguments).compile()
        return self._executables[mode]

    def _traced(self, mode: Mode) -> Callable[..., PyTree]:
        def on_device(weights: PyTree, u: Array, first: Array, count: Array, key: Array) -> PyTree:
            def block(i: Array) -> PyTree:
                policy = jax.tree.map(lambda leaf: leaf[i], weights)
                numbers = first[i] + jnp.arange(self.lanes, dtype=jnp.int32)
                keys = jax.vmap(partial(simulation_key, key))(numbers)
                engine = Engine(problem_with(self.problem_of, policy), self.lanes)
                if mode == "holds":
                    return (jax.vmap(engine.program.row_holds)(u[i], keys),)
                rows = jax.vmap(engine.program.row, in_axes=(0, 0, None))(
                    u[i], keys, jnp.float32(1.0)
                )
                return rows.rho, rows.status

            if not _one_by_one(self.devices):
                return jax.vmap(block)(jnp.arange(self.capacity))
            form = jax.eval_shape(block, jnp.int32(0))
            results = jax.tree.map(
                lambda leaf: jnp.zeros((self.capacity, *leaf.shape), leaf.dtype), form
            )

            def step(i: Array, results: PyTree) -> PyTree:
                return jax.tree.map(lambda all_, one: all_.at[i].set(one), results, block(i))

            return jax.lax.fori_loop(0, count[0], step, results)

        return spread_over_devices(on_device, (True, True, True, True, False), self.devices)


def _one_by_one(devices: Sequence[Device]) -> bool:
    """Return whether a block keeps a device busy; an accelerator works on all blocks at once."""
    return devices[0].platform == "cpu"


def _spread(
    rows: ArrayLike | Sequence[ArrayLike], indices: Int[np.ndarray, " n"], whole: int
) -> np.ndarray:
    """Return an array of `whole` rows with these at their indices, and the first one elsewhere."""
    given = np.asarray(rows)
    spread = np.empty((whole, *given.shape[1:]), given.dtype)
    spread[:] = given[0]
    spread[indices] = given
    return spread


class SeparateSimulators:
    """A simulator for each policy, for host systems and code that needs concrete numbers."""

    def __init__(self, problems: Sequence[Problem] | Mapping[int, Problem], lanes: int) -> None:
        self.lanes = lanes
        self.messages: dict[int, str] = {}  # Of each policy the first that a simulation left.
        self._problems = problems
        self._evaluators: dict[int, Evaluator] = {}

    def blocks_per_call(self) -> int:
        return 1

    def __call__(
        self, members: Sequence[int], points: Float[np.ndarray, "blocks lanes d"],
        first: Int[np.ndarray, " blocks"], key: Key[Array, ""],
    ) -> list[Verdicts]:  # fmt: skip
        verdicts = []
        for member, u, number in zip(members, points, first, strict=True):
            if member not in self._evaluators:
                self._evaluators[member] = Evaluator(self._problems[member], self.lanes)
            evaluated = self._evaluators[member].engine.evaluate(u, key, int(number))
            message = next((message for message in evaluated.messages or () if message), None)
            if message is not None:
                self.messages.setdefault(member, message)
            verdicts.append(evaluated)
        return verdicts
