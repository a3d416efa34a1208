"""A monitor that is fed sample by sample, in memory that does not grow with the trace.

    monitor = online("G (req > 0 -> F[0,0.5] (gnt > 0))", dt=0.1)
    state = monitor.init()
    state = monitor.step(state, {"req": 1.0, "gnt": 0.0})     # pure: also within `lax.scan`
    low, high = monitor.interval(state)                       # whatever may still come
    monitor.finish(state)                                     # if this was the last sample

It steps through a `Plan` of `streams` in JAX; `watch` does the same on the host.

Source: the interval is that of J. Deshmukh et al., "Robust online monitoring of signal temporal
logic", RV 2015: unknown predicates are anything from -inf to +inf.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from verifai_jax.core.errors import missing_name
from verifai_jax.core.gaps import with_gaps
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.evaluate import Evaluator
from verifai_jax.mtl.expression import durations_in
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.semantics import Kind, Semantics, hard
from verifai_jax.mtl.stepping import advance, first_cells
from verifai_jax.mtl.streams import Plan, streams


class State(NamedTuple):
    """A pytree: how many samples came, the last one's predicates, and what the operators keep."""

    count: Array
    last: tuple[Array, ...]
    cells: tuple[Array, ...]


@dataclass(frozen=True)
class Online:
    """An online monitor; made by `online`. Hashable, so it may be static under `jit`."""

    formula: Formula
    dt: float
    kind: Kind = "hard"

    @property
    def plan(self) -> Plan:
        """The operations of a step."""
        return _plan(self)

    def init(self) -> State:
        """Return the state before any sample."""
        leaves = tuple(jnp.asarray(jnp.nan) for _ in self.plan.leaves)
        return State(jnp.int32(0), leaves, first_cells(self.plan))

    def step(self, state: State, sample: Mapping[str, Any]) -> State:
        """Return the state after one more sample: numbers (or vectors `[k]`) by signal name.

        **Raises:** `UnknownNameError` for a signal that the sample lacks.
        """
        for name in self.formula.signals():
            if name not in sample:
                raise missing_name("the sample", "signal", name, sample)
        own = {name: with_gaps(name, sample[name]) for name in self.formula.signals()}
        return _step(self, state, own)

    def interval(self, state: State) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the lowest and the greatest robustness at time 0 that further samples allow."""
        return _end_with(self, state, -math.inf), _end_with(self, state, math.inf)

    def finish(self, state: State, count: int | None = None) -> Float[Array, ""]:
        """Return the robustness at time 0 if the trace ends here and is held: the offline value.

        NaN before the first sample.

        **Arguments:**

        - `count`: number of samples that came, where it is known while JAX traces; a program then
          does nothing for windows that are past.
        """
        return _end_with(self, state, None, count)

    @property
    def memory(self) -> int:
        """Number of numbers that the state holds."""
        return sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(self.init)))


def online(formula: Formula | str, dt: float, semantics: Semantics = hard) -> Online:
    """Make a monitor of `formula` for samples `dt` seconds apart.

    **Arguments:**

    - `semantics`: `hard`, or `boolean`, by which all values are above zero where the formula holds
      and below where it does not, also where its robustness is exactly zero.

    **Raises:** `IntervalError` for an interval that is not a multiple of `dt`; `ValueError` for
    smooth semantics, and for an unbounded future operator within another temporal operator, which
    no bounded memory can follow.
    """
    formula = parse(formula) if isinstance(formula, str) else formula
    monitor = Online(formula, dt, semantics.kind)
    if counted := durations_in(formula):
        raise ValueError(f"{counted[0]} is counted by watch and export_c, and not by online")
    _plan(monitor)
    return monitor


@functools.lru_cache(maxsize=256)
def _plan(monitor: Online) -> Plan:
    return streams(monitor.formula, monitor.dt, Semantics(monitor.kind))


@functools.partial(jax.jit, static_argnums=0, inline=True)
def _step(monitor: Online, state: State, sample: dict[str, Any]) -> State:
    signals = {name: jnp.asarray(value)[None] for name, value in sample.items()}
    dtype = jnp.result_type(float)
    signals = {
        name: jnp.where(a, 1.0, -1.0) if a.dtype == bool else a.astype(dtype)
        for name, a in signals.items()
    }
    evaluator = Evaluator(signals, 1, monitor.dt, kind=monitor.kind)
    margins = [(evaluator.value(f, 0, 0)[0], sign) for f, sign in monitor.plan.leaves]
    last = tuple(jnp.asarray(m if sign > 0 else -m, dtype) for m, sign in margins)
    _, cells = advance(monitor.plan, state.count, last, state.cells)
    return State(state.count + 1, last, cells)


@functools.partial(jax.jit, static_argnums=(0, 2, 3), inline=True)
def _end_with(
    monitor: Online, state: State, unknown: float | None, count: int | None = None
) -> Array:
    """Compute the value at time 0 if all further margins are `unknown` (the last, if None)."""
    plan, leaves = monitor.plan, state.last
    if unknown is not None:
        unknown = max(-plan.top, min(plan.top, unknown))
        leaves = tuple(jnp.full_like(leaf, unknown) for leaf in leaves)
    settling, ends = plan.outputs[0].wait - 1, plan.outputs[0].ends
    now = state.count if count is None else count

    def more(i: Array, cells: tuple[Array, ...]) -> tuple[Array, ...]:
        return advance(plan, now + i, leaves, cells)[1]

    def settled() -> tuple[Array, ...]:
        return jax.lax.fori_loop(0, settling, more, state.cells)

    if not (settling and ends):
        cells = settled()
    elif count is not None:
        cells = state.cells if count > settling else settled()
    else:
        # Once every window is past nothing changes any more: all that came is enough.
        cells = jax.lax.cond(state.count > settling, lambda: state.cells, settled)
    (value,), _ = advance(plan, jnp.asarray(now + settling), leaves, cells)
    return value
