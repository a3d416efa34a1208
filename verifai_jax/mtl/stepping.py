"""One step of a plan in JAX, a pure function.

    cells = first_cells(plan)
    results, cells = advance(plan, now, leaves, cells)

It reads whole windows, which is quick for a batch. The steps of `watch` update them.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from verifai_jax.mtl.streams import Op, Plan
from verifai_jax.mtl.tree import missing_case

Value = Float[Array, ""]
Instant = Int[Array, ""]


def first_cells(plan: Plan) -> tuple[Array, ...]:
    """Return the memory before any sample."""
    cells: list[Array] = []
    for op in plan.ops:
        top = op.sign * plan.top
        starts = {
            "delay": [op.number], "window": [-top], "running": [-top], "recur": [-top],
            "until": [top, -top], "since": [top, -top], "accumulate": [-top], "reach": [-top, top],
        }.get(op.kind, [])  # fmt: skip
        shape = (op.n,) if op.kind in ("delay", "window", "until", "since") else ()
        cells.extend(jnp.full(shape, start) for start in starts)
    return tuple(cells)


def advance(
    plan: Plan, now: Instant, leaves: Sequence[Value], cells: Sequence[Array]
) -> tuple[list[Value], tuple[Array, ...]]:
    """Compute the results of one more sample.

    **Arguments:**

    - `now`: number of the sample.
    - `leaves`: margins of the plan's leaves.
    - `cells`: memory before the step.

    **Returns:** the result of each formula, NaN where it has none yet, and the memory after it.
    """
    step = _Step(now, leaves, cells)
    values: list[Value] = []
    for op in plan.ops:
        values.append(step.value(op, [values[i] for i in op.inputs]))
    results = [
        jnp.where(now >= delay, values[slot], jnp.nan) if delay else values[slot]
        for slot, delay, *_ in plan.outputs
    ]
    return results, tuple(step.after)


class _Step:
    def __init__(self, now: Instant, leaves: Sequence[Value], cells: Sequence[Array]) -> None:
        self.now, self.leaves = now, leaves
        self.before = iter(cells)
        self.after: list[Array] = []

    def push(self, value: Value) -> Array:
        """Keep a stream's last values, and return them, the newest last, after the one before."""
        before = next(self.before)
        newest = jnp.asarray(value, before.dtype)
        joined = jnp.concatenate([before, newest[None]])
        self.after.append(joined[1:])
        return joined

    def keep(self, value: Value) -> Value:
        self.after.append(jnp.asarray(value))
        return value

    def value(self, op: Op, inputs: Sequence[Value]) -> Value:
        best, worst = (jnp.maximum, jnp.minimum)[:: op.sign]
        index = self.now - op.n
        match op.kind:
            case "leaf":
                return self.leaves[op.n]
            case "number":
                return jnp.asarray(op.number)
            case "join":
                joined, *others = inputs
                for other in others:
                    joined = best(joined, other)
                return joined
            case "begun":
                return jnp.where(index >= 0, inputs[0], op.number)
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
                self.keep(jnp.where(self.within(op, index), both, before))
                # What is still to come in the window is what the stream gives now.
                return self.begun(index, jnp.where(index <= op.end, both, before))
            case "reach":
                return self.reach(op, index, inputs, best, worst)
        raise missing_case("the online monitor", op)

    def within(self, op: Op, index: Instant) -> Array:
        return (index >= op.start) & (index <= op.end)

    def begun(self, index: Instant, value: Value) -> Value:
        return jnp.where(index >= 0, value, jnp.nan)

    def witness(self, op: Op, lefts: Array, rights: Array) -> Value:
        if op.kind == "since":
            lefts, rights = lefts[::-1], rights[::-1]
        if op.sign < 0:
            lefts, rights = -lefts, -rights
        top = jnp.full((1,), jnp.inf, lefts.dtype)
        before = jnp.concatenate([top, lefts[:-1]])
        return op.sign * jnp.minimum(rights, jax.lax.cummin(before)).max()

    def reach(
        self, op: Op, index: Instant, inputs: Sequence[Value],
        best: Callable[[Value, Value], Value], worst: Callable[[Value, Value], Value],
    ) -> Value:  # fmt: skip
        found, kept = next(self.before), next(self.before)
        left, right = inputs
        through = worst(kept, left)
        here = best(found, worst(right, kept))
        self.keep(jnp.where(self.within(op, index), here, found))
        self.keep(jnp.where(index >= 0, through, kept))
        # A window still ahead is reached through `left` as it is now.
        coming = best(found, worst(right, jnp.where(index >= op.start, kept, through)))
        return self.begun(index, jnp.where(index <= op.end, coming, found))
