"""The rows of a batch laid out over devices, and in chunks of lanes small enough for the cache.

layout = Layout.of(problem, batch=16_384, devices=jax.local_devices())
layout.padded                                       # rows of its program, at least the batch
layout.spread(one_row, own_keys=False)              # a program (rows, number, ...) of a batch
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from verifai_jax.core.compute.devices import Device, spread_over_devices
from verifai_jax.core.compute.jaxprs import programs_in
from verifai_jax.core.compute.keys import simulation_key
from verifai_jax.problem.problem import Problem

ACCELERATOR_FACTOR = 128
"""How many times as many rows a chunk has on an accelerator as on a core, whose cache traces fit.
On an H200 chunks of 65,536 rows were 9 to 91 times as fast as those of 512 (RESULTS.md)."""
TOGETHER = ("reduce_", "arg", "cum", "dot_", "conv_", "sort", "gather", "scatter")
"""Beginnings of the names of operations that bring several numbers of a row together."""
PLAIN = frozenset((
    "abs", "add", "add_any", "and", "bitcast_convert_type", "broadcast_in_dim", "ceil", "clamp",
    "concatenate", "convert_element_type", "copy", "copy_p", "div", "dot_general", "dynamic_slice",
    "dynamic_update_slice", "eq", "expand_dims", "floor", "gather", "ge", "gt", "integer_pow",
    "iota", "is_finite", "le", "lt", "max", "min", "mul", "ne", "neg", "not", "one_minus_square",
    "optimization_barrier", "or", "pad", "reduce_and", "reduce_max", "reduce_min", "reduce_or",
    "reduce_sum", "rem", "reshape", "rev", "round", "scatter", "select_n", "shift_left",
    "shift_right_arithmetic", "shift_right_logical", "sign", "slice", "split", "sqrt", "square",
    "squeeze", "stack", "stop_gradient", "sub", "transpose", "xor",
))  # fmt: skip
"""Operations that processors have, and those that only move numbers. XLA's own functions are not
among them: with vectors of 512 bits its arctangent is wrong (0.10.2)."""


class Layout(NamedTuple):
    """The distribution of a batch's rows over devices, chunks and lanes.

    - `devices`: JAX devices, each with an equal share.
    - `chunks`: number of parts of a share, which are processed one after the other.
    - `lanes`: number of rows in a chunk, which are processed together.
    - `wide`: whether XLA may use the widest vectors of the processor.
    """

    devices: Sequence[Device]
    chunks: int
    lanes: int
    wide: bool = False

    @classmethod
    def of(
        cls, problem: Problem, batch: int, devices: Sequence[Device], lanes: int | None = None
    ) -> "Layout":
        """Return the layout of a problem's batches, with the number of lanes of its system.

        - `lanes`: another number of lanes.
        """
        # A batch smaller than the number of devices is not worth splitting.
        devices = devices[: max(1, min(len(devices), batch))]
        if lanes is None:
            return cls(devices, *chunks_and_lanes(problem, batch, len(devices)))
        return cls(devices, -(-batch // (lanes * len(devices))), lanes)

    @property
    def padded(self) -> int:
        """Number of rows of the program."""
        return self.lanes * self.chunks * len(self.devices)

    @property
    def fills_machine(self) -> bool:
        """True if every core has its own rows, so that none is free to help another."""
        return 1 < len(self.devices) == len(jax.local_devices())

    def for_program(self, program: Any, anywhere: bool = True) -> "Layout":
        """Return the layout that suits the `Jaxpr` of one row, with the same number of rows.

        - `anywhere`: whether other threads may call Python; this one alone is in double precision.

        If all operations are on single numbers, a chunk needs little memory and starting an
        operation takes a fifth of the time, so chunks are twice as long. Other programs lose by
        longer chunks, since XLA then writes the operands of products and sums to memory.
        """
        if jax.default_backend() != "cpu":
            return self
        steps = list(_steps(program))
        layout = self._replace(wide=all(step.primitive.name in PLAIN for step in steps))
        if not anywhere and any("callback" in step.primitive.name for step in steps):
            layout = layout._replace(devices=self.devices[:1], chunks=self.padded // self.lanes)
        together = any(
            step.primitive.name.startswith(TOGETHER) and any(v.aval.size > 1 for v in step.invars)
            for step in steps
        )
        if together or layout.chunks % 2:
            return layout
        return layout._replace(chunks=layout.chunks // 2, lanes=2 * layout.lanes)

    def spread(self, one_row: Callable[..., Any], own_keys: bool) -> Callable[..., Any]:
        """Map a function of one row over chunks of lanes and over the devices.

        **Arguments:**
        - `one_row`: a function of a row, its random key, a temperature, the shared values, and the
          numbers that its program reads.
        - `own_keys`: whether each row has its own random key, instead of one derived from the run's
          key and the row number.
        """

        def on_device(
            rows: PyTree, numbers: Array, temperature: Array, key: Any, shared: PyTree,
            vector: Array,
        ) -> Any:  # fmt: skip
            def chunk(block: tuple[PyTree, Array, Array]) -> Any:
                keys = block[1]
                if not own_keys:
                    keys = jax.vmap(partial(simulation_key, key))(keys)
                each = jax.vmap(one_row, in_axes=(0, 0, 0, None, None))
                return each(block[0], keys, block[2], shared, vector)

            blocks = (rows, numbers, temperature)
            if self.chunks == 1:
                return chunk(blocks)
            cut = jax.tree.map(
                lambda leaf: leaf.reshape(self.chunks, self.lanes, *leaf.shape[1:]), blocks
            )
            results = jax.lax.map(chunk, cut)
            return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), results)

        split = (True, True, True, False, False, False)
        spread = spread_over_devices(on_device, split, self.devices)

        def program(
            rows: PyTree, number: Any, temperature: Array, shared: PyTree, vector: Array
        ) -> Any:
            if own_keys:
                return spread(rows, number, temperature, (), shared, vector)
            key, first = number
            numbers = first + jnp.arange(self.padded, dtype=jnp.int32)
            return spread(rows, numbers, temperature, key, shared, vector)

        return program


def chunks_and_lanes(problem: Problem, batch: int, devices: int) -> tuple[int, int]:
    """Return the number of chunks of a device's share of a batch, and the rows in one."""
    per_device = -(-batch // max(1, min(devices, batch)))
    factor = 1 if jax.default_backend() == "cpu" else ACCELERATOR_FACTOR
    chunks = -(-per_device // (factor * problem.system.lanes))
    return chunks, -(-per_device // chunks)


def _steps(program: Any) -> Iterator[Any]:
    """Yield the steps of a `Jaxpr`, in place of loops and calls those within them."""
    for step in program.eqns:
        inside = programs_in(step)
        for each in inside:
            yield from _steps(each)
        if not inside:
            yield step
