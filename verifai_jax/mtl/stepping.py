"""One step of a plan, in JAX or NumPy: a function of the memory before it, which it leaves alone.

    cells = first_cells(plan, jnp)
    results, cells = advance(plan, jnp, now, leaves, cells)

A step reads whole windows. `watch` compiles steps that do not, from the code of `c_monitor`.
"""

from collections.abc import Callable, Sequence
from types import ModuleType

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from verifai_jax.mtl.streams import Op, Plan
from verifai_jax.mtl.tree import missing_case

Cell = Array | np.ndarray
"""What an operation keeps, a vector or a number."""
Value = Float[Array, ""] | Float[np.ndarray, ""] | np.floating | float


def first_cells(plan: Plan, xp: ModuleType) -> tuple[Cell, ...]:
    """Return the memory before any sample, in the default precision of `xp`."""
    cells: list[Cell] = []
    for op in plan.ops:
        top = op.sign * plan.top
        starts = {
            "delay": [op.number], "window": [-top], "running": [-top], "recur": [-top],
            "until": [top, -top], "since": [top, -top], "accumulate": [-top], "reach": [-top, top],
        }.get(op.kind, [])  # fmt: skip
        shape = (op.n,) if op.kind in ("delay", "window", "until", "since") else ()
        cells.extend(xp.full(shape, start) for start in starts)
    return tuple(cells)


def advance(
    plan: Plan,
    xp: ModuleType,
    now: Int[Array, ""] | int,
    leaves: Sequence[Value],
    cells: Sequence[Cell],
) -> tuple[list[Value], tuple[Cell, ...]]:
    """Compute the results of one more sample.

    **Arguments:**

    - `xp`: `jax.numpy` or `numpy`.
    - `now`: number of the sample.
    - `leaves`: margins of the plan's leaves.
    - `cells`: memory before the step.

    **Returns:** the result of each formula, NaN where it has none yet, and the memory after it.
    """
    step = _Step(xp, now, leaves, cells)
    values: list[Value] = []
    for op in plan.ops:
        values.append(step.value(op, [values[i] for i in op.inputs]))
    results = [
        xp.where(now >= delay, values[slot], xp.nan) if delay else values[slot]
        for slot, delay, *_ in plan.outputs
    ]
    return results, tuple(step.after)


class _Step:
    def __init__(
        self,
        xp: ModuleType,
        now: Int[Array, ""] | int,
        leaves: Sequence[Value],
        cells: Sequence[Cell],
    ) -> None:
        self.xp, self.now, self.leaves = xp, now, leaves
        self.before = iter(cells)
        self.after: list[Cell] = []

    def push(self, value: Value) -> Array | np.ndarray:
        """Keep a stream's last values, and return them, the newest last, after the one before."""
        before = next(self.before)
        newest = self.xp.asarray(value, before.dtype)
        joined = self.xp.concatenate([before, newest[None]])
        self.after.append(joined[1:])
        return joined

    def keep(self, value: Value) -> Value:
        self.after.append(self.xp.asarray(value))
        return value

    def value(self, op: Op, inputs: Sequence[Value]) -> Value:
        best, worst = (self.xp.maximum, self.xp.minimum)[:: op.sign]
        index = self.now - op.n
        match op.kind:
            case "leaf":
                return self.leaves[op.n]
            case "number":
                return self.xp.asarray(op.number)
            case "join":
                joined, *others = inputs
                for other in others:
                    joined = best(joined, other)
                return joined
            case "begun":
                return self.xp.where(index >= 0, inputs[0], op.number)
            case "delay":
                return self.push(inputs[0])[0]
            case "window":
                values = self.push(inputs[0])[1:]
                return values.max() if op.sign > 0 else values.min()
            case "running":
                return self.keep(best(next(self.before), inputs[0]))
            case "recur":
                return self.keep(best(inputs[1], worst(inputs[0], next(self.before))))
            case "until" | "since":
                return self.witness(op, *(self.push(each)[1:] for each in inputs))
            case "accumulate":
                before = next(self.before)
                both = best(before, inputs[0])
                self.keep(self.xp.where(self.within(op, index), both, before))
                # What is still to come in the window is what the stream gives now.
                return self.begun(index, self.xp.where(index <= op.end, both, before))
            case "reach":
                return self.reach(op, index, inputs, best, worst)
        raise missing_case("the online monitor", op)

    def within(self, op: Op, index: Int[Array, ""] | int) -> Value:
        return (index >= op.start) & (index <= op.end)

    def begun(self, index: Int[Array, ""] | int, value: Value) -> Value:
        return self.xp.where(index >= 0, value, self.xp.nan)

    def witness(self, op: Op, lefts: Cell, rights: Cell) -> Value:
        if op.kind == "since":
            lefts, rights = lefts[::-1], rights[::-1]
        if op.sign < 0:
            lefts, rights = -lefts, -rights
        top = self.xp.full((1,), self.xp.inf, lefts.dtype)
        before = self.xp.concatenate([top, lefts[:-1]])
        running = np.minimum.accumulate if self.xp is np else jax.lax.cummin
        return op.sign * self.xp.minimum(rights, running(before)).max()

    def reach(
        self, op: Op, index: Int[Array, ""] | int, inputs: Sequence[Value],
        best: Callable[[Value, Value], Value], worst: Callable[[Value, Value], Value],
    ) -> Value:  # fmt: skip
        found, kept = next(self.before), next(self.before)
        left, right = inputs
        through = worst(kept, left)
        here = best(found, worst(right, kept))
        self.keep(self.xp.where(self.within(op, index), here, found))
        self.keep(self.xp.where(index >= 0, through, kept))
        # A window still ahead is reached through `left` as it is now.
        coming = best(found, worst(right, self.xp.where(index >= op.start, kept, through)))
        return self.begun(index, self.xp.where(index <= op.end, coming, found))
