"""A monitor that processes samples one by one, in memory that does not grow with the trace.

    monitor = online("G (req > 0 -> F[0,0.5] (gnt > 0))", dt=0.1)
    state = monitor.init()
    state = monitor.step(state, {"req": 1.0, "gnt": 0.0})     # pure: also within `lax.scan`
    low, high = monitor.interval(state)                       # whatever may still come
    monitor.finish(state)                                     # if this was the last sample

It steps through a `Plan` of `streams` in JAX; `watch` does the same on the host.

Source: the interval is from J. Deshmukh et al., "Robust online monitoring of signal temporal
logic", RV 2015; unknown predicates, of gaps and of samples to come, range from -inf to inf.

The step, `advance`, reads whole windows, fast for batches; the step of `watch` updates them.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from verifai_jax.core.compute.compilation import jit_each
from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.values.gaps import with_gaps
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.evaluate import Evaluator
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.sampled import sampled_in
from verifai_jax.mtl.semantics import Kind, Semantics, hard
from verifai_jax.mtl.streams import Op, Plan, streams
from verifai_jax.mtl.tree import missing_case


class State(NamedTuple):
    """A pytree: the number of samples so far, the last predicates, and the operators' memory.

    The memory is there once, or three times: with unknown predicates as NaN, as the lowest value,
    and as the greatest.
    """

    count: Array
    last: tuple[Array, ...]
    cells: tuple[tuple[Array, ...], ...]


@dataclass(frozen=True)
class Online:
    """An online monitor; made by `online`. Hashable, so it may be static under `jit`."""

    formula: Formula
    dt: float
    kind: Kind = "hard"
    gaps: bool = True

    @property
    def plan(self) -> Plan:
        """The operations of a step."""
        return _plan(self)

    def init(self) -> State:
        """Return the state before any sample."""
        leaves = tuple(jnp.asarray(jnp.nan) for _ in self.plan.leaves)
        return State(jnp.int32(0), leaves, (first_cells(self.plan),) * len(self._unknown))

    def step(self, state: State, sample: Mapping[str, Any]) -> State:
        """Return the state after one more sample: numbers (or vectors `[k]`) by signal name.

        **Raises:** `UnknownNameError` for a signal that the sample does not contain.
        """
        for name in self.formula.signals():
            if name not in sample:
                raise missing_name("the sample", "signal", name, sample)
        own = {name: with_gaps(name, sample[name]) for name in self.formula.signals()}
        return _step(self, state, own)

    def interval(self, state: State) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the minimum and maximum robustness at time 0 that samples to come may give.

        So may samples that were unknown, with `gaps`; without, both are NaN after one that counts.
        """
        return _end_with(self, -1, None, state), _end_with(self, 1, None, state)

    def finish(self, state: State, count: int | None = None) -> Float[Array, ""]:
        """Return the robustness at time 0 if the trace ends here and is held, as computed offline.

        NaN before the first sample.

        **Arguments:**
        - `count`: number of samples so far, if it is known while JAX traces; the program then skips
          windows that have passed.
        """
        return _end_with(self, 0, count, state)

    @property
    def _unknown(self) -> tuple[float, ...]:
        """What unknown predicates are taken for in each memory; 0 if they stay unknown."""
        return (0.0, -self.plan.top, self.plan.top) if self.gaps else (0.0,)

    @property
    def memory(self) -> int:
        """Number of floats in the state."""
        return sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(self.init)))


def online(
    formula: Formula | str, dt: float, semantics: Semantics = hard, gaps: bool = True
) -> Online:
    """Make an online monitor of `formula` for samples `dt` seconds apart.

    **Arguments:**
    - `semantics`: `hard`, or `boolean`: values are above zero if the formula holds and below if
      not, even if its robustness is exactly zero.
    - `gaps`: whether `interval` is known after unknown samples (NaN), for three times the memory.
    **Raises:** `IntervalError` for an interval that is not a multiple of `dt`; `ValueError` for
    smooth semantics, and for an unbounded future operator inside another temporal operator, which
    would need unbounded memory.
    """
    formula = parse(formula) if isinstance(formula, str) else formula
    monitor = Online(formula, dt, semantics.kind, gaps)
    if sampled := sampled_in(formula):
        raise ValueError(f"{sampled[0]} is computed by watch and export_c, and not by online")
    _plan(monitor)
    return monitor


@functools.lru_cache(maxsize=64)
def _plan(monitor: Online) -> Plan:
    return streams(monitor.formula, monitor.dt, Semantics(monitor.kind))


@jit_each(inline=True)
def _step(monitor: Online, state: State, sample: dict[str, Any]) -> State:
    arrays = {name: jnp.asarray(value)[None] for name, value in sample.items()}
    truths = frozenset(name for name, array in arrays.items() if array.dtype == bool)
    dtype = jnp.result_type(float)
    signals = {name: array.astype(dtype) for name, array in arrays.items()}
    evaluator = Evaluator(signals, 1, monitor.dt, kind=monitor.kind, truths=truths)
    margins = [(evaluator.value(f, 0, 0)[0], sign) for f, sign in monitor.plan.leaves]
    last = tuple(jnp.asarray(m if sign > 0 else -m, dtype) for m, sign in margins)
    cells: list[tuple[Array, ...]] = []
    for unknown, own in zip(monitor._unknown, state.cells, strict=True):
        leaves = [jnp.where(jnp.isnan(x), unknown, x) for x in last] if unknown else last
        cells.append(advance(monitor.plan, state.count, leaves, own)[1])
    return State(state.count + 1, last, tuple(cells))


@jit_each(3, inline=True)
def _end_with(monitor: Online, side: int, count: int | None, state: State) -> Array:
    """Compute the value at time 0 if further margins are the last ones, or a bound by `side`."""
    plan, leaves = monitor.plan, state.last
    if side:
        leaves = tuple(jnp.full_like(leaf, side * plan.top) for leaf in leaves)
    last = state.cells[{0: 0, -1: 1, 1: 2}[side] if monitor.gaps else 0]
    settling, ends = plan.outputs[0].wait - 1, plan.outputs[0].ends
    now = state.count if count is None else count

    def more(i: Array, cells: tuple[Array, ...]) -> tuple[Array, ...]:
        return advance(plan, now + i, leaves, cells)[1]

    def settled() -> tuple[Array, ...]:
        return jax.lax.fori_loop(0, settling, more, last)

    if not (settling and ends):
        cells = settled()
    elif count is not None:
        cells = last if count > settling else settled()
    else:
        # Once every window is past nothing changes any more: all that came is enough.
        cells = jax.lax.cond(state.count > settling, lambda: last, settled)
    (value,), _ = advance(plan, jnp.asarray(now + settling), leaves, cells)
    return value


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
    - `now`: index of the sample.
    - `leaves`: margins of the plan's leaves.
    - `cells`: memory before the step.
    **Returns:** the result of each formula, NaN before its first, and the memory after the sample.
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
