"""Training runs side by side: configurations of one structure share a compiled program.

    training = BatchedTraining([Configuration(task, PPO(learning_rate=r), 50_000) for r in rates])
    for number in training.advance({0: 10_000, 1: 10_000}):
        training.policy(number), training.curve(number)

Hyper-parameters that change no shape are arguments of the program; the others divide the
configurations into groups. On CPUs one training runs on each core, exactly as it would alone; on an
accelerator many run under one `vmap`. The result depends on the configuration and its seed, not on
the other runs: bit for bit on one machine without `vmap`, and up to float32 rounding with it.
"""

import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Integer, Key, PyTree

from verifai_jax.addons.rl.algorithm import Algorithm, AlgorithmState, check_fit
from verifai_jax.addons.rl.policy import Policy
from verifai_jax.addons.rl.task.task import Task
from verifai_jax.core.compute.compilation import KEPT, jit_each, known_options, power_of_two
from verifai_jax.core.compute.devices import (
    Device,
    enable_compile_cache,
    split_sharding,
    spread_over_devices,
)

RUNS_PER_ACCELERATOR = 64
"""Training runs under one `vmap` on an accelerator; a CPU core is busy with one."""
SLICE_SECONDS = 2.0
"""Approximate maximum seconds of a call of compiled code; interrupts act between calls."""
_SEQUENTIAL = {
    "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner",
}
"""Without handing microseconds of work to other threads, which took a third of the processor time;
the cores are busy with other trainings."""
PyTreeDef: TypeAlias = jax.tree_util.PyTreeDef  # pyright: ignore[reportInvalidTypeForm]
"""The structure of a pytree; type checkers take JAX's name of the class for a variable."""
Shapes = tuple[tuple[tuple[int, ...], str], ...]
"""Shape and dtype of each array."""


@dataclass(frozen=True, eq=False)
class Configuration:
    """One training run.

    - `task`: the task to learn.
    - `algorithm`: the algorithm with its hyper-parameters.
    - `steps`: number of environment steps, rounded up to whole updates; schedules end there.
    - `seed`: the seed of all random numbers in the run.
    """

    task: Task
    algorithm: Algorithm
    steps: int
    seed: int = 0

    @property
    def updates(self) -> int:
        """Number of updates for `steps`."""
        return self.updates_for(self.steps)

    def updates_for(self, steps: int) -> int:
        """Return the smallest number of updates with at least this many environment steps."""
        return -(-steps // self.algorithm.steps_per_update)

    def check(self) -> None:
        """Refuse a configuration that cannot be trained.

        **Raises:** `ValueError`, naming the hyper-parameter, or the action that does not fit.
        """
        self.algorithm.check()
        check_fit(self.algorithm, self.task)
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1; got {self.steps}")


class _Batch(NamedTuple):
    """States and learning curves of runs that advanced together, as stacked arrays."""

    states: AlgorithmState
    curves: Float[Array, "lanes capacity"]


@dataclass(eq=False)
class _Lane:
    """An unfinished run: the last batch that it was part of, and its index there."""

    batch: _Batch
    index: int
    done: int
    seconds: float


class _Structure(NamedTuple):
    """Properties common to all runs that share a program."""

    task: Hashable
    algorithm: Hashable
    shapes: Shapes
    capacity: int


class BatchedTraining:
    """Training runs that advance in parallel, each to any step.

    **Arguments:**
    - `configurations`: the runs; methods refer to them by index.
    - `devices`: JAX devices to spread them over; all of this process when left out.
    - `per_device`: number of runs under one `vmap` on a device; by default 1 on CPUs, else 64.
    - `watch`: a function called every few seconds with each run's number and learning curve so far.
    **Raises:** `ValueError` for a configuration that cannot be trained.
    """

    def __init__(
        self, configurations: Sequence[Configuration], *, devices: Sequence[Device] | None = None,
        per_device: int | None = None,
        watch: Callable[[int, Float[np.ndarray, " updates"]], None] | None = None,
    ) -> None:  # fmt: skip
        self._watch = watch
        for configuration in configurations:
            configuration.check()
        self.configurations = list(configurations)
        self.devices = tuple(jax.local_devices() if devices is None else devices)
        on_cpu = self.devices[0].platform == "cpu"
        usual = 1 if on_cpu else RUNS_PER_ACCELERATOR
        self.per_device = usual if per_device is None else per_device
        self._lanes: dict[int, _Lane] = {}
        self._structures = [_structure_of(c) for c in self.configurations]
        self._rates: dict[_Structure, float] = {}

    def advance(self, targets: Mapping[int, int]) -> Iterator[int]:
        """Advance runs until each has made its target number of environment steps.

        **Arguments:**
        - `targets`: environment steps to reach, by number of the run. **Yields:** each number when
          it gets there, grouped by structure. It can be interrupted between updates, every few
          seconds; numbers not yielded yet may be requested again.
        """
        groups: dict[tuple[_Structure, int, int], list[int]] = {}
        for number, steps in targets.items():
            configuration = self.configurations[number]
            until = min(configuration.updates_for(steps), configuration.updates)
            lane = self._lanes.get(number)
            key = (self._structures[number], lane.done if lane else 0, until)
            groups.setdefault(key, []).append(number)
        maximum = len(self.devices) * self.per_device
        for (structure, done, until), numbers in groups.items():
            for start in range(0, len(numbers), maximum):
                part = numbers[start : start + maximum]
                self._advance(structure, part, done, until)
                yield from part

    def change(self, number: int, changed: Configuration) -> None:
        """Continue a run with other numbers in its task and algorithm; nothing is compiled again.

        **Raises:** `ValueError` for a task or an algorithm of another structure.
        """
        if _structure_of(changed) != self._structures[number]:
            raise ValueError("a run can go on only with numbers of the same structure and shapes")
        self.configurations[number] = changed

    def fork(self, number: int) -> int:
        """Add a run that goes on where this one is; return its number."""
        self.configurations.append(self.configurations[number])
        self._structures.append(self._structures[number])
        if number in self._lanes:
            self._lanes[len(self._structures) - 1] = replace(self._lanes[number])
        return len(self._structures) - 1

    def policy(self, number: int) -> Policy:
        """Return the present policy of a run, on the host, without exploration."""
        configuration, lane = self.configurations[number], self._lanes[number]
        task, index = StaticTask(configuration.task), np.int32(lane.index)
        return jax.device_get(_policy(task, configuration.algorithm, lane.batch.states, index))

    def curve(
        self, number: int
    ) -> tuple[Int[np.ndarray, " updates"], Float[np.ndarray, " updates"]]:
        """Return the learning curve of a run so far.

        **Returns:** environment steps by the end of each update; mean return of the episodes that
        ended in it, with exploration, NaN if none did.
        """
        lane = self._lanes[number]
        per_update = self.configurations[number].algorithm.steps_per_update
        steps = np.arange(1, lane.done + 1) * per_update
        return steps, np.asarray(lane.batch.curves)[lane.index, : lane.done]

    def seconds(self, number: int) -> float:
        """Return the processor time of a run so far in core seconds, without compilation."""
        return self._lanes[number].seconds

    def discard(self, number: int) -> None:
        """Free the state of a run, which starts again from the beginning if it is advanced."""
        self._lanes.pop(number, None)

    def _advance(self, structure: _Structure, numbers: list[int], done: int, until: int) -> None:
        enable_compile_cache()
        # As many devices for the last few as for all others: fewer would compile another program.
        same_structure = self._structures.count(structure)
        devices = self.devices[: max(1, min(len(self.devices), same_structure))]
        lanes = len(devices) * self.per_device
        filled = numbers + [numbers[-1]] * (lanes - len(numbers))
        layout = _Layout(structure, devices, self.per_device)
        first = self.configurations[numbers[0]]
        task = StaticTask(first.task)
        algorithms = _stack([numbers_of(self.configurations[n].algorithm)[0] for n in filled])
        tasks = _stack([numbers_of(self.configurations[n].task)[0] for n in filled])
        arguments = (layout, task, jax.tree.structure(first.algorithm), tasks, algorithms)
        if all(n in self._lanes for n in numbers):
            states, curves = self._gather(filled, devices)
        else:
            seeds = np.array([self.configurations[n].seed for n in filled], np.uint32)
            updates = np.array([self.configurations[n].updates for n in filled], np.int32)
            states, curves = _start(*arguments, seeds, updates)
        program = _advance_updates(*arguments[:3])
        seconds = 0.0
        while done < until:
            # Short at first, until it is known how long an update takes.
            rate = self._rates.get(structure)
            if rate is None:  # No update compiles the program, which is not timed.
                program(tasks, algorithms, states, curves, np.int32(0), np.int32(0))
            updates = 1 if rate is None else max(1, int(SLICE_SECONDS / rate))
            updates = min(updates, until - done)
            began = time.perf_counter()
            states, curves = program(
                tasks, algorithms, states, curves, np.int32(done), np.int32(done + updates)
            )
            jax.block_until_ready(curves)
            took = time.perf_counter() - began
            self._rates[structure] = took / updates
            seconds += took
            done += updates
            if self._watch is not None:
                so_far = np.asarray(curves)
                for index, number in enumerate(numbers):
                    self._watch(number, so_far[index, :done])
        share = seconds / max(1, -(-len(numbers) // len(devices)))
        for index, number in enumerate(numbers):
            before = self._lanes.get(number)
            earlier = before.seconds if before else 0.0
            batch = _Batch(states, curves)
            self._lanes[number] = _Lane(batch, index, done, share + earlier)

    def _gather(self, numbers: list[int], devices: tuple[Device, ...]) -> _Batch:
        """Stack the states of runs that advance together from now on."""
        lanes = [self._lanes[n] for n in numbers]
        first = lanes[0].batch
        width = len(first.curves)
        if len(lanes) == width and all(
            lane.batch.curves is first.curves and lane.index == index
            for index, lane in enumerate(lanes)
        ):
            return first
        indices = np.array([lane.index for lane in lanes], np.int32)
        selected = _Batch(*_select_lanes(tuple(tuple(lane.batch) for lane in lanes), indices))
        if len(devices) > 1:
            # Where the program expects them; it would be compiled again for another place.
            return jax.device_put(selected, split_sharding(devices))
        return selected


class StaticTask:
    """A task as a static argument: compared by structure if it is a pytree, else by identity."""

    def __init__(self, task: Task) -> None:
        leaves, self.structure = jax.tree.flatten(task)
        self.opaque = len(leaves) == 1 and leaves[0] is task
        self.task = task if self.opaque else None

    def __hash__(self) -> int:
        return hash((self.structure, self.task))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StaticTask) and (self.structure, self.task) == (
            other.structure,
            other.task,
        )

    def with_numbers(self, leaves: Sequence[ArrayLike]) -> Task:
        """Return the task with these numbers."""
        if self.task is not None:
            return self.task
        return jax.tree.unflatten(self.structure, leaves)


class _Layout(NamedTuple):
    """The arrangement of lanes on the devices, a static argument."""

    structure: _Structure
    devices: tuple[Device, ...]
    per_device: int


def numbers_of(value: PyTree) -> tuple[list[np.ndarray], PyTreeDef]:
    """Return the numbers of a task or algorithm, as float32 or int32 arrays, and its structure."""
    leaves, structure = jax.tree.flatten(value)
    if len(leaves) == 1 and leaves[0] is value:
        return [], structure
    return [_number(leaf) for leaf in leaves], structure


def _number(leaf: ArrayLike) -> np.ndarray:
    array = np.asarray(leaf)
    return array.astype(np.float32 if array.dtype.kind == "f" else np.int32)


def policy_structure(configuration: Configuration) -> tuple[Hashable, Hashable, Shapes]:
    """Return task, algorithm and shapes: equal for runs with policies of one structure."""
    task, algorithm = numbers_of(configuration.task), numbers_of(configuration.algorithm)
    shapes = tuple((leaf.shape, leaf.dtype.str) for leaf in task[0] + algorithm[0])
    return StaticTask(configuration.task), algorithm[1], shapes


def untrained_policy(algorithm: Algorithm, task: Task) -> Policy:
    """Return the shapes and dtypes of the policies that an algorithm learns; nothing compiles."""

    def initial(key: Key[Array, ""]) -> Policy:
        return algorithm.policy(task, algorithm.init(task, key, 1))

    return jax.eval_shape(initial, jax.eval_shape(lambda: jax.random.key(0)))


def _structure_of(configuration: Configuration) -> _Structure:
    # A power of two: runs of other lengths share the program.
    capacity = max(64, power_of_two(configuration.updates))
    return _Structure(*policy_structure(configuration), capacity)


def _stack(trees: Sequence[list[np.ndarray]]) -> list[np.ndarray]:
    return [np.stack(leaves) for leaves in zip(*trees, strict=True)]


def _over_lanes(layout: _Layout, one: Callable[..., PyTree], shared: int) -> Callable[..., PyTree]:
    """Map `one` over lanes on devices; the last `shared` arguments are the same for all."""

    def on_device(*arguments: PyTree) -> PyTree:
        split = len(arguments) - shared
        if layout.per_device > 1:
            axes = (0,) * split + (None,) * shared
            return jax.vmap(one, in_axes=axes)(*arguments)
        # Not a `vmap` of width one: the program of a run by itself.
        alone = [jax.tree.map(lambda leaf: leaf[0], a) for a in arguments[:split]]
        return jax.tree.map(lambda leaf: leaf[None], one(*alone, *arguments[split:]))

    def spread(*arguments: PyTree) -> PyTree:
        split = (True,) * (len(arguments) - shared) + (False,) * shared
        return spread_over_devices(on_device, split, layout.devices)(*arguments)

    return spread


@lru_cache(1)
def _sequential() -> dict[str, Any]:
    return known_options(_SEQUENTIAL)


@jit_each(3)
def _start(
    layout: _Layout, static_task: StaticTask, structure: PyTreeDef, tasks: list[Array],
    algorithms: list[Array], seeds: Integer[Array, " lanes"], updates: Int[Array, " lanes"],
) -> tuple[AlgorithmState, Float[Array, "lanes capacity"]]:  # fmt: skip
    def one(
        task: list[Array], numbers: list[Array], seed: Integer[Array, ""], updates: Int[Array, ""]
    ) -> tuple[AlgorithmState, Float[Array, " capacity"]]:
        algorithm = jax.tree.unflatten(structure, numbers)
        state = algorithm.init(static_task.with_numbers(task), jax.random.key(seed), updates)
        return state, jnp.full(layout.structure.capacity, jnp.nan)

    return _over_lanes(layout, one, shared=0)(tasks, algorithms, seeds, updates)


@lru_cache(KEPT)
def _advance_updates(
    layout: _Layout, static_task: StaticTask, structure: PyTreeDef
) -> jax.stages.Wrapped:
    """Return the program of further updates."""

    def one(
        task_numbers: list[Array], numbers: list[Array], state: AlgorithmState,
        curve: Float[Array, " capacity"], done: Int[Array, ""], until: Int[Array, ""],
    ) -> tuple[AlgorithmState, Float[Array, " capacity"]]:  # fmt: skip
        task = static_task.with_numbers(task_numbers)
        algorithm = jax.tree.unflatten(structure, numbers)

        def update(
            index: Int[Array, ""], carry: tuple[AlgorithmState, Float[Array, " capacity"]]
        ) -> tuple[AlgorithmState, Float[Array, " capacity"]]:
            state, curve = carry
            state, progress = algorithm.step(task, state)
            return state, curve.at[index].set(progress.mean_return)

        return jax.lax.fori_loop(done, until, update, (state, curve))

    further = _over_lanes(layout, one, shared=2)
    further.__name__ = "_advance_updates"
    on_cpu = layout.devices[0].platform == "cpu"
    return jax.jit(further, compiler_options=_sequential() if on_cpu else None)


@jax.jit
def _select_lanes(
    batches: tuple[tuple[AlgorithmState, Float[Array, "lanes capacity"]], ...],
    indices: Int[Array, " selected"],
) -> tuple[AlgorithmState, Float[Array, "selected capacity"]]:
    """Stack one lane of each batch. In one program, not one for each shape."""
    lanes = [jax.tree.map(lambda leaf, i=i: leaf[indices[i]], one) for i, one in enumerate(batches)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *lanes)


@jit_each()
def _policy(
    static_task: StaticTask, algorithm: Algorithm, states: AlgorithmState, index: Int[Array, ""]
) -> Policy:
    # A policy is made of the state alone, so any numbers of the task will do.
    numbers = [0.0] * static_task.structure.num_leaves
    state = jax.tree.map(lambda leaf: leaf[index], states)
    return algorithm.policy(static_task.with_numbers(numbers), state)
