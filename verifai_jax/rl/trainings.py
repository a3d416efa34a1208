"""Many trainings with few programs: configurations of one structure share what is compiled.

    trainings = Trainings([Configuration(task, PPO(learning_rate=r), steps=50_000) for r in rates])
    for number in trainings.advance({0: 10_000, 1: 10_000}):
        trainings.policy(number), trainings.curve(number)

Hyper-parameters that change no shape are arguments of the program; those that do group the
configurations. On CPUs one training runs on each core, each exactly as it would alone; on an
accelerator many of them run under one `vmap`. What comes out depends on the configuration and its
seed, not on its company: bit for bit on one machine where trainings are not vmapped, and to the
rounding of float32 in each update where they are.
"""

import time
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from verifai_jax.core.devices import enable_compile_cache, spread_over_devices
from verifai_jax.rl.algorithm import Algorithm, check_fit
from verifai_jax.rl.policy import Policy
from verifai_jax.rl.task.task import Task

# Under one `vmap` on an accelerator. On a CPU it gains nothing: the cores are busy with one each.
TOGETHER = 64
# How long a call into compiled code lasts at most, about: between calls one can stop it.
SLICE_SECONDS = 2.0


@dataclass(frozen=True, eq=False)
class Configuration:
    """One training: the task, the algorithm with its hyper-parameters, how long, which seed.

    - `steps`: environment steps, rounded up to whole updates; schedules end there.
    """

    task: Task
    algorithm: Algorithm
    steps: int
    seed: int = 0

    @property
    def updates(self) -> int:
        """Updates that take `steps`."""
        return self.updates_for(self.steps)

    def updates_for(self, steps: int) -> int:
        """The least number of updates that take as many environment steps."""
        return -(-steps // self.algorithm.steps_per_update)

    def check(self) -> None:
        """Refuse what cannot train.

        **Raises:** `ValueError`, naming the hyper-parameter, or the action that does not fit.
        """
        self.algorithm.check()
        check_fit(self.algorithm, self.task)
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1; got {self.steps}")


class _Together(NamedTuple):
    """Trainings that went on side by side, still in one piece."""

    states: Any
    curves: Float[Array, "lanes capacity"]


@dataclass(eq=False)
class _Lane:
    """Where one training stands: its place among those that it went on with."""

    together: _Together
    place: int
    done: int
    seconds: float


class _Structure(NamedTuple):
    """What has to be equal for trainings to share a program."""

    task: Hashable
    algorithm: Hashable
    shapes: tuple[Any, ...]
    capacity: int


class Trainings:
    """Trainings that go on step by step; see the module's docstring.

    **Arguments:**

    - `configurations`: what to train; numbers below are places in this sequence.
    - `devices`: JAX devices to spread them over; all of this process when left out.
    - `together`: trainings under one `vmap` on a device; 1 on CPUs when left out.

    **Raises:** `ValueError` for a configuration that cannot train.
    """

    def __init__(
        self,
        configurations: Sequence[Configuration],
        *,
        devices: Sequence[Any] | None = None,
        together: int | None = None,
    ) -> None:
        for configuration in configurations:
            configuration.check()
        self.configurations = list(configurations)
        self.devices = tuple(jax.local_devices() if devices is None else devices)
        on_cpu = self.devices[0].platform == "cpu"
        self.together = (1 if on_cpu else TOGETHER) if together is None else together
        self._lanes: dict[int, _Lane] = {}
        self._structures = [_structure(c) for c in self.configurations]
        self._rates: dict[_Structure, float] = {}

    def advance(self, targets: Mapping[int, int]) -> Iterator[int]:
        """Take trainings on until each has used its target of environment steps.

        Yields each number as it gets there, those of one structure after another. Between updates,
        every few seconds, it can be interrupted; what was not yielded yet may be asked for again.
        """
        groups: dict[Any, list[int]] = {}
        for number, steps in targets.items():
            configuration = self.configurations[number]
            until = min(configuration.updates_for(steps), configuration.updates)
            lane = self._lanes.get(number)
            place = (self._structures[number], lane.done if lane else 0, until)
            groups.setdefault(place, []).append(number)
        most = len(self.devices) * self.together
        for (structure, done, until), numbers in groups.items():
            for start in range(0, len(numbers), most):
                part = numbers[start : start + most]
                self._advance(structure, part, done, until)
                yield from part

    def policy(self, number: int) -> Policy:
        """The policy that a training has reached, on the host, without exploration."""
        configuration, lane = self.configurations[number], self._lanes[number]
        known, place = Known(configuration.task), np.int32(lane.place)
        return jax.device_get(_policy(configuration.algorithm, known, lane.together.states, place))

    def curve(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Environment steps taken by the end of each update so far, and the mean return in it.

        NaN where no episode ended in the update. Exploration included.
        """
        lane = self._lanes[number]
        per_update = self.configurations[number].algorithm.steps_per_update
        steps = np.arange(1, lane.done + 1) * per_update
        return steps, np.asarray(lane.together.curves)[lane.place, : lane.done]

    def seconds(self, number: int) -> float:
        """Seconds of a core that a training has taken so far, compilation not counted."""
        return self._lanes[number].seconds

    def forget(self, number: int) -> None:
        """Let go of a training's state: it cannot go on, and starts anew if asked to."""
        self._lanes.pop(number, None)

    def _advance(self, structure: _Structure, numbers: list[int], done: int, until: int) -> None:
        enable_compile_cache()
        # As many devices for the last few as for all others: they would compile anew for fewer.
        alike = self._structures.count(structure)
        devices = self.devices[: max(1, min(len(self.devices), alike))]
        lanes = len(devices) * self.together
        filled = numbers + [numbers[-1]] * (lanes - len(numbers))
        layout = _Layout(structure, devices, self.together)
        first = self.configurations[numbers[0]]
        known = Known(first.task)
        algorithms = _stacked([leaves_of(self.configurations[n].algorithm)[0] for n in filled])
        tasks = _stacked([leaves_of(self.configurations[n].task)[0] for n in filled])
        arguments = (layout, known, jax.tree.structure(first.algorithm), tasks, algorithms)
        if all(n in self._lanes for n in numbers):
            states, curves = self._gathered(filled, devices)
        else:
            seeds = np.array([self.configurations[n].seed for n in filled], np.uint32)
            updates = np.array([self.configurations[n].updates for n in filled], np.int32)
            states, curves = _start(*arguments, seeds, updates)
        compiled = _reach.lower(*arguments, states, curves, np.int32(0), np.int32(0)).compile()
        seconds = 0.0
        while done < until:
            # Short at first, until it is known how long an update takes.
            rate = self._rates.get(structure)
            some = 1 if rate is None else max(1, int(SLICE_SECONDS / rate))
            some = min(some, until - done)
            began = time.perf_counter()
            states, curves = compiled(
                tasks, algorithms, states, curves, np.int32(done), np.int32(done + some)
            )
            jax.block_until_ready(curves)
            took = time.perf_counter() - began
            self._rates[structure] = took / some
            seconds += took
            done += some
        share = seconds / max(1, -(-len(numbers) // len(devices)))
        for place, number in enumerate(numbers):
            before = self._lanes.get(number)
            earlier = before.seconds if before else 0.0
            together = _Together(states, curves)
            self._lanes[number] = _Lane(together, place, done, share + earlier)

    def _gathered(self, numbers: list[int], devices: tuple[Any, ...]) -> _Together:
        """The states of trainings that go on side by side from now on."""
        lanes = [self._lanes[n] for n in numbers]
        first = lanes[0].together
        width = len(first.curves)
        if len(lanes) == width and all(
            lane.together.curves is first.curves and lane.place == place
            for place, lane in enumerate(lanes)
        ):
            return first
        picked = _Together(
            *_picked(
                tuple(tuple(lane.together) for lane in lanes),
                np.array([lane.place for lane in lanes], np.int32),
            )
        )
        if len(devices) > 1:
            # Where the program expects them; it would be compiled again for another place.
            spread = NamedSharding(Mesh(np.array(devices), ("lane",)), PartitionSpec("lane"))
            return jax.device_put(picked, spread)
        return picked


class Known:
    """A task as a static argument: by its structure if it is a pytree, else by itself."""

    def __init__(self, task: Task) -> None:
        leaves, self.structure = jax.tree.flatten(task)
        self.opaque = len(leaves) == 1 and leaves[0] is task
        self.task = task if self.opaque else None

    def __hash__(self) -> int:
        return hash((self.structure, self.task))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Known) and (self.structure, self.task) == (
            other.structure,
            other.task,
        )

    def with_leaves(self, leaves: Sequence[Any]) -> Any:
        """The task with these numbers in it."""
        return self.task if self.opaque else jax.tree.unflatten(self.structure, leaves)


class _Layout(NamedTuple):
    """How lanes lie on the devices: static."""

    structure: _Structure
    devices: tuple[Any, ...]
    together: int


def leaves_of(value: Any) -> tuple[list[Any], Any]:
    """The numbers of a task or an algorithm, as float32 or int32 arrays, and its structure."""
    leaves, structure = jax.tree.flatten(value)
    if len(leaves) == 1 and leaves[0] is value:
        return [], structure
    return [_number(leaf) for leaf in leaves], structure


def _number(leaf: Any) -> np.ndarray:
    array = np.asarray(leaf)
    return array.astype(np.float32 if array.dtype.kind == "f" else np.int32)


def form_of(configuration: Configuration) -> tuple[Hashable, Hashable, tuple[Any, ...]]:
    """What is equal for trainings whose policies have one form: task, algorithm, and shapes."""
    task, algorithm = leaves_of(configuration.task), leaves_of(configuration.algorithm)
    shapes = tuple((leaf.shape, leaf.dtype.str) for leaf in task[0] + algorithm[0])
    return Known(configuration.task), algorithm[1], shapes


def _structure(configuration: Configuration) -> _Structure:
    # A power of two: trainings of other lengths share the program.
    capacity = 1 << max(6, (configuration.updates - 1).bit_length())
    return _Structure(*form_of(configuration), capacity)


def _stacked(trees: Sequence[list[np.ndarray]]) -> list[np.ndarray]:
    return [np.stack(leaves) for leaves in zip(*trees, strict=True)]


def _over_lanes(layout: _Layout, one: Any, shared: int) -> Any:
    """`one` for each lane, on its device; the last `shared` arguments are the same for all."""

    def on_device(*arguments: Any) -> Any:
        split = len(arguments) - shared
        if layout.together > 1:
            axes = (0,) * split + (None,) * shared
            return jax.vmap(one, in_axes=axes)(*arguments)
        # Not a `vmap` of width one: the program of a training that runs alone.
        alone = [jax.tree.map(lambda leaf: leaf[0], a) for a in arguments[:split]]
        return jax.tree.map(lambda leaf: leaf[None], one(*alone, *arguments[split:]))

    def spread(*arguments: Any) -> Any:
        split = (True,) * (len(arguments) - shared) + (False,) * shared
        return spread_over_devices(on_device, split, layout.devices)(*arguments)

    return spread


@partial(jax.jit, static_argnums=(0, 1, 2))
def _start(
    layout: _Layout,
    known: Known,
    algorithm: Any,
    tasks: Any,
    algorithms: Any,
    seeds: Int[Array, " lanes"],
    updates: Int[Array, " lanes"],
) -> Any:
    def one(task: Any, leaves: Any, seed: Any, updates: Any) -> Any:
        made = jax.tree.unflatten(algorithm, leaves)
        state = made.init(known.with_leaves(task), jax.random.key(seed), updates)
        return state, jnp.full(layout.structure.capacity, jnp.nan)

    return _over_lanes(layout, one, shared=0)(tasks, algorithms, seeds, updates)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _reach(
    layout: _Layout,
    known: Known,
    algorithm: Any,
    tasks: Any,
    algorithms: Any,
    states: Any,
    curves: Float[Array, "lanes capacity"],
    done: Int[Array, ""],
    until: Int[Array, ""],
) -> Any:
    def one(task: Any, leaves: Any, state: Any, curve: Any, done: Any, until: Any) -> Any:
        task, made = known.with_leaves(task), jax.tree.unflatten(algorithm, leaves)

        def update(place: Any, carry: Any) -> Any:
            state, curve = carry
            state, progress = made.step(task, state)
            return state, curve.at[place].set(progress.mean_return)

        return jax.lax.fori_loop(done, until, update, (state, curve))

    spread = _over_lanes(layout, one, shared=2)
    return spread(tasks, algorithms, states, curves, done, until)


@jax.jit
def _picked(together: Any, places: Int[Array, " lanes"]) -> Any:
    """One lane of each of these, side by side. In one program, not one for each shape."""
    lanes = [jax.tree.map(lambda leaf, i=i: leaf[places[i]], one) for i, one in enumerate(together)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *lanes)


@partial(jax.jit, static_argnums=1)
def _policy(algorithm: Any, known: Known, states: Any, place: Int[Array, ""]) -> Policy:
    # What a policy is made of does not depend on the task's numbers.
    numbers = [0.0] * known.structure.num_leaves
    state = jax.tree.map(lambda leaf: leaf[place], states)
    return algorithm.policy(known.with_leaves(numbers), state)
