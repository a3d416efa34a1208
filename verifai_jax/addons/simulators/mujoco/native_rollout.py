"""MuJoCo in C: a batch in lock-step, the policy in JAX between its control periods.

The physics runs on all cores through `mujoco.batch.Batch`, which was measured to be as fast as
`mujoco.rollout` and keeps its states for the next period. Parameters that differ between rows are
written into its arrays, so a batch of any size needs only one model. A batch is processed in two
halves: while one is stepped, the policy of the other is evaluated.
"""

import contextlib
import copy
import ctypes
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from verifai_jax.addons.simulators.mujoco.loop import Loop, Progress, Sample
from verifai_jax.addons.simulators.mujoco.part_paths import MjModel
from verifai_jax.core.compute.compilation import power_of_two
from verifai_jax.core.messages.errors import require
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.systems.base import Features

BLOCK = 64
"""Rows whose policy is evaluated together."""
HALVED = 64
"""Rows from which two halves are worth their overhead."""


@dataclass(eq=False)
class Native:
    """Batches of one loop with the programs that they need; made once for a system.

    - `make`: makes a batch of a model and a number of rows; by default MuJoCo's own, in C.
    """

    loop: Loop
    batches: dict[Any, Any] = field(default_factory=dict)
    programs: dict[Any, Any] = field(default_factory=dict)
    make: Callable[[MjModel, int], Any] | None = None

    def simulate(self, features: Features, keys: Key[Array, " n"]) -> Trace:
        """Simulate a batch: all leaves of `features` and `keys` have a leading axis `[n]`."""
        count = len(keys)
        # Few sizes, for which programs are compiled; the rows that fill one up are never stepped.
        size = power_of_two(count)
        filled = np.minimum(np.arange(size), count - 1)
        program = self._program(features)
        features = jax.tree.map(lambda leaf: np.asarray(leaf)[filled], features)
        with _no_warnings():
            parts = [
                _Part(
                    self,
                    program,
                    number,
                    jax.tree.map(lambda leaf, part=part: leaf[part], features),
                    keys[filled[part]],
                    alive=np.arange(size)[part] < count,
                )
                for number, part in enumerate(_split(size))
            ]
            first, others = parts[0], parts[1:]
            first.observe(0)
            for k in range(self.loop.periods + 1):
                for part in others:
                    part.observe(k)
                first.advance()
                if k < self.loop.periods:
                    first.observe(k + 1)
                for part in others:
                    part.advance()
        trace = self._trace([part.results() for part in parts])
        return jax.tree.map(lambda leaf: leaf[:count], trace)

    def _program(self, features: Features) -> "_Program":
        leaves, form = jax.tree.flatten(features)
        key = (form, tuple((np.shape(leaf)[1:], np.result_type(leaf)) for leaf in leaves))
        key = (*key, bool(jax.config.read("jax_enable_x64")))
        if key not in self.programs:
            one = jax.tree.map(
                lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf)[1:], _kind(leaf)), features
            )
            self.loop.check(one)
            self.programs[key] = _Program(self.loop, self.loop.arrays_read(one))
        return self.programs[key]

    def batch(self, size: int, number: int) -> Any:
        """Return a `mujoco.batch.Batch` with this many rows, or one like it, made once."""
        if (size, number) not in self.batches:
            make = self.make or require("mujoco.batch", extra="mujoco").Batch
            # Batches of other sizes are not needed again, or not soon.
            self.batches = {key: b for key, b in self.batches.items() if key[0] == size}
            compiled = self.loop.compiled
            if self.loop.finer != 1:
                compiled = copy.copy(compiled)
                compiled.opt.timestep /= self.loop.finer
            self.batches[size, number] = make(compiled, size)
        return self.batches[size, number]

    def _trace(self, results: list["_Results"]) -> Trace:
        signals = {
            name: np.concatenate([result.signals[name] for result in results])
            for name in results[0].signals
        }
        age = np.concatenate([result.age for result in results])
        finite = np.concatenate([result.finite for result in results])
        failed = np.concatenate([result.failed for result in results])
        status = np.where(finite, Status.OK, Status.NONFINITE)
        status = np.where(failed, Status.ERROR, status).astype(np.int32)
        ends = self.loop.terminate is not None
        form = Trace(
            {name: signal[0] for name, signal in signals.items()}, dt=self.loop.control_period,
            valid=1 if ends else None, status=0, held=ends, finite=self.loop.finite_signals(),
        )  # fmt: skip
        leaves = [*signals.values(), *([(age + 1).astype(np.int32)] if ends else []), status]
        return jax.tree.unflatten(jax.tree.structure(form), leaves)


class _Program:
    """The compiled functions for features of one form."""

    def __init__(self, loop: Loop, reads: frozenset[str]) -> None:
        self.loop = loop
        # The state always, so that what is not finite is seen.
        self.names = ("qpos", "qvel", "act", *sorted(reads - {"qpos", "qvel", "act"}))
        self.sizes = [int(np.prod(loop.shapes[name])) for name in self.names]
        self.stage = self._stage()
        self.start = jax.jit(_in_blocks(loop.start))
        self.begin = jax.jit(_in_blocks(loop.initial_progress))
        self.leaves = jax.jit(_in_blocks(loop.bindings.leaves))
        self.sample = jax.jit(
            lambda k, *rows: _in_blocks(lambda *row: self._sample(k, *row))(*rows)
        )

    def _stage(self) -> int:
        """Return the stage up to which MuJoCo computes at each sample, in addition to the steps."""
        derived = set(self.names) - {"qpos", "qvel", "act"}
        if not derived:
            return 0
        needed = 1
        if "sensordata" in derived and np.any(self.loop.compiled.sensor_needstage > 1):
            needed = 2
        return needed

    def _sample(
        self, k: Int[Array, ""], packed: Float[Array, " packed"], progress: Progress,
        features: Features,
    ) -> tuple[Sample, Progress]:  # fmt: skip
        parts = jnp.split(packed, np.cumsum(self.sizes)[:-1])
        arrays = {
            name: part.reshape(self.loop.shapes[name])
            for name, part in zip(self.names, parts, strict=True)
        }
        if "sensordata" in arrays:
            # Before the first step there is no acceleration yet.
            unknown = (k == 0) & self.loop.delayed_sensors
            arrays["sensordata"] = jnp.where(unknown, 0.0, arrays["sensordata"])
        return self.loop.sample(k, arrays, progress, features)


class _Results(NamedTuple):
    """Signals `[n, time, ...]`, and by row: periods simulated, all finite, refused by MuJoCo."""

    signals: dict[str, np.ndarray]
    age: np.ndarray
    finite: np.ndarray
    failed: np.ndarray


class _Part:
    """A half of the rows, or all of them, on their way through a simulation."""

    def __init__(
        self, native: Native, program: _Program, number: int, features: Features,
        keys: Key[Array, " n"], alive: np.ndarray,
    ) -> None:  # fmt: skip
        self.loop, self.program = native.loop, program
        self.alive = alive
        self.failed = np.broadcast_to(
            ~np.asarray(self.loop.channels(features).valid(), bool), alive.shape
        ).copy()
        count = len(keys)
        self.batch = native.batch(count, number)
        self.features = jax.device_put(features)
        bindings = self.loop.bindings
        if bindings.arrays:
            for name, value in program.leaves(self.features).items():
                self.batch.expand(name)[...] = np.asarray(value).reshape(
                    self.batch.expand(name).shape
                )
            if bindings.moves_constants:
                self.batch.set_const()
        self.batch.reset(stage=0)
        for name, value in program.start(self.features, keys).items():
            self.batch.bind(name)[...] = np.asarray(value)
        self.views = [self.batch.bind(name) for name in program.names]
        if program.stage:
            self.batch.forward(stage=program.stage)
        dtype = np.float64 if jax.config.read("jax_enable_x64") else np.float32
        self.packed = np.zeros((count, sum(program.sizes)), dtype)
        self.progress = program.begin(self.features, keys)
        self.refused = require("mujoco.batch", extra="mujoco").SimulationError
        self.samples: list[dict[str, Any]] = []
        self.sampled: Any = None

    def observe(self, k: int) -> None:
        """Start to evaluate the policy on the state at sample `k`."""
        start = 0
        for view, size in zip(self.views, self.program.sizes, strict=True):
            self.packed[:, start : start + size] = view.reshape(len(view), size)
            start += size
        self.sampled, self.progress = self.program.sample(
            np.int32(k), self.packed, self.progress, self.features
        )

    def advance(self) -> None:
        """Step the rows that have not ended to the next sample, under their new control."""
        self.samples.append(self.sampled.signals)
        ended = np.asarray(self.sampled.frozen) | ~np.asarray(self.progress.finite)
        for name, value in self.sampled.inputs.items():
            self.batch.bind(name)[...] = np.asarray(value).reshape(self.batch.bind(name).shape)
        going = self.alive & ~self.failed & ~ended
        if not going.any():
            return
        try:
            self.batch.step(
                None if going.all() else going,
                nstep=self.loop.substeps * self.loop.finer,
                stage=self.program.stage,
            )
        except self.refused as error:
            # MuJoCo raised in these rows, which keep their state; the others went on.
            self.failed[error.ids] = True

    def results(self) -> "_Results":
        """Return the results of these rows."""
        signals = {
            name: np.stack([np.asarray(sample[name]) for sample in self.samples], axis=1)
            for name in self.samples[0]
        }
        age, finite = np.asarray(self.progress.age), np.asarray(self.progress.finite)
        return _Results(signals, age, finite, self.failed)


def _in_blocks(function: Callable[..., Any]) -> Callable[..., Any]:
    """Apply `jax.vmap` so that a row's results do not depend on the number of other rows.

    XLA sums in another order in products of other sizes, and through contacts a last digit becomes
    another fall: a row that is simulated again must be the same simulation.
    """

    def blocked(*rows: Any) -> Any:
        count = len(jax.tree.leaves(rows)[0])
        number = -(-count // BLOCK)
        filled = np.minimum(np.arange(number * BLOCK), count - 1)
        blocks = jax.tree.map(
            lambda leaf: leaf[filled].reshape(number, BLOCK, *leaf.shape[1:]), rows
        )
        results = jax.lax.map(lambda block: jax.vmap(function)(*block), blocks)
        return jax.tree.map(
            lambda leaf: leaf.reshape(len(filled), *leaf.shape[2:])[:count], results
        )

    return blocked


def _split(size: int) -> list[slice]:
    if size < HALVED:
        return [slice(0, size)]
    return [slice(0, size // 2), slice(size // 2, size)]


def _kind(leaf: np.ndarray | Array) -> Any:
    return jax.dtypes.canonicalize_dtype(np.result_type(leaf))


@contextlib.contextmanager
def _no_warnings() -> Iterator[None]:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT: the status reports what is not finite."""
    mujoco = require("mujoco", extra="mujoco")
    before = mujoco.get_mju_user_warning()
    # The threads that step call it without Python: a C function that takes a text and does nothing.
    c = ctypes.CDLL(None if os.name == "posix" else "msvcrt")
    mujoco.set_mju_user_warning(ctypes.CFUNCTYPE(None, ctypes.c_char_p)(("strlen", c)))
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
