"""A monitor that is fed sample by sample, in memory that does not grow with the trace.

    monitor = online("G (req > 0 -> F[0,0.5] (gnt > 0))", dt=0.1)
    state = monitor.init()
    state = monitor.step(state, {"req": 1.0, "gnt": 0.0})     # pure: also within `lax.scan`
    low, high = monitor.interval(state)                       # whatever may still come
    monitor.finish(state)                                     # if this was the last sample

Sub-formulas are *streams*: after sample k each gives its value at instant k - delay, where the
delay is how far it looks ahead. What is asked only at time 0 is *anchored*: it accumulates a
stream and stores none of it.

Source: the interval is that of J. Deshmukh et al., "Robust online monitoring of signal temporal
logic", RV 2015: unknown predicates are anything from -inf to +inf.
"""

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from verifai_jax.core.errors import missing_name
from verifai_jax.core.gaps import with_gaps
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.evaluate import Evaluator, samples
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.rewriting import expand, simplify
from verifai_jax.mtl.semantics import Semantics, hard
from verifai_jax.mtl.tree import missing_case

Leaf = Callable[[Formula, int], Array]
Cells = dict[str, Any]
_JOIN = {-1: jnp.minimum, 1: jnp.maximum}


class State(NamedTuple):
    """A pytree: how many samples came, the last one's predicates, and what the operators keep."""

    count: Array
    last: tuple[Array, ...]
    cells: Cells


@dataclass(frozen=True)
class Online:
    """An online monitor; made by `online`. Hashable, so it may be static under `jit`."""

    formula: Formula
    dt: float
    kind: Literal["hard", "boolean"] = "hard"

    def init(self) -> State:
        """Return the state before any sample."""
        leaves = tuple(jnp.asarray(jnp.nan) for _ in _leaves(self.formula))
        machine = _Machine(self.dt, lambda f, sign: jnp.asarray(jnp.nan), jnp.int32(-1), {})
        machine.value_at_start("", self.formula, 1)
        return State(jnp.int32(0), leaves, machine.fresh)

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

    def finish(self, state: State) -> Float[Array, ""]:
        """Return the robustness at time 0 if the trace ends here and is held: the offline value.

        NaN before the first sample.
        """
        return _end_with(self, state, None)

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
    formula = simplify(expand(parse(formula) if isinstance(formula, str) else formula))
    if not dt > 0:
        raise ValueError(f"the sampling period dt must be positive; got {dt}")
    if semantics.kind == "smooth":
        raise ValueError("an online monitor has hard or boolean semantics; got smooth ones")
    monitor = Online(formula, float(dt), semantics.kind)
    jax.eval_shape(monitor.init)
    return monitor


def _leaves(f: Formula) -> tuple[Formula, ...]:
    return tuple(dict.fromkeys(g for g in f.subformulas() if not g.operands()))


@functools.partial(jax.jit, static_argnums=0, inline=True)
def _step(monitor: Online, state: State, sample: dict[str, Any]) -> State:
    signals = {name: jnp.asarray(value)[None] for name, value in sample.items()}
    signals = {
        name: jnp.where(a, 1.0, -1.0) if a.dtype == bool else a.astype(state.last[0].dtype)
        for name, a in signals.items()
    }
    evaluator = Evaluator(signals, 1, monitor.dt, kind=monitor.kind)
    last = tuple(
        jnp.asarray(evaluator.value(f, 0, 0)[0], old.dtype)
        for f, old in zip(_leaves(monitor.formula), state.last, strict=True)
    )
    return _advance(monitor, state, last)


def _advance(monitor: Online, state: State, last: tuple[Array, ...]) -> State:
    values = dict(zip(_leaves(monitor.formula), last, strict=True))
    machine = _Machine(monitor.dt, lambda f, sign: values[f], state.count, state.cells)
    machine.value_at_start("", monitor.formula, 1)
    return State(state.count + 1, last, machine.fresh)


@functools.partial(jax.jit, static_argnums=(0, 2), inline=True)
def _end_with(monitor: Online, state: State, unknown: float | None) -> Array:
    """Compute the value at time 0 if all further leaves are `unknown` (the last, if None)."""
    values = dict(zip(_leaves(monitor.formula), state.last, strict=True))

    def leaf(f: Formula, sign: int) -> Array:
        known = values[f]
        if unknown is None or isinstance(f, ast.Constant):
            return known
        return jnp.full_like(known, sign * unknown)

    machine = _Machine(monitor.dt, leaf, state.count, state.cells)
    settling = machine.settling(monitor.formula)

    def more(i: Array, cells: Cells) -> Cells:
        machine = _Machine(monitor.dt, leaf, state.count + i, cells)
        machine.value_at_start("", monitor.formula, 1)
        return machine.fresh

    def settled() -> Cells:
        return jax.lax.fori_loop(0, settling, more, state.cells)

    if settling and machine.ends(monitor.formula):
        # Once every window is past nothing changes any more: all that came is enough.
        cells = jax.lax.cond(state.count > settling, lambda: state.cells, settled)
    else:
        cells = settled()
    final = _Machine(monitor.dt, leaf, state.count + settling, cells)
    return final.value_at_start("", monitor.formula, 1)


class _Machine:
    """One step of all operators: reads `cells`, the memory before it, and writes `fresh`.

    `now` is the instant of the sample that `leaf` gives. A cell is addressed by the path of its
    operator in the formula.
    """

    def __init__(self, dt: float, leaf: Leaf, now: Array, cells: Cells) -> None:
        self.dt = dt
        self.leaf = leaf
        self.now = now
        self.cells = cells
        self.fresh: Cells = {}
        self._delays: dict[Formula, int] = {}
        self._settlings: dict[Formula, int] = {}
        self._streams: dict[tuple[Formula, int], Array] = {}
        self._starts: dict[tuple[Formula, int], Array] = {}

    def span(self, interval: ast.Interval) -> tuple[int, float]:
        a = samples(interval.start, self.dt, interval)
        return int(a), samples(interval.end, self.dt, interval)

    def cell(self, path: str, value: Array, start: float, n: int = 0) -> Array:
        """Return the content of a cell; at first `start`, `n` times (once and scalar, if 0)."""
        default = jnp.full((n,) if n else (), start, value.dtype)
        return self.cells.get(path, default)

    def push(self, path: str, value: Array, start: float, n: int) -> Array:
        """Return the last `n` values of a stream, the newest last."""
        before = self.cell(path, value, start, n)
        self.fresh[path] = jnp.concatenate([before[1:], value[None]])
        return self.fresh[path]

    # Streams

    def delay(self, f: Formula) -> int:
        """Count the samples by which a stream is late."""
        if f not in self._delays:
            self._delays[f] = self._delay(f)
        return self._delays[f]

    def _delay(self, f: Formula) -> int:
        below = max((self.delay(p) for p in f.operands()), default=0)
        match f:
            case ast.Window() | ast.Witness() if f.side == "ahead":
                b = self.span(f.interval)[1]
                if math.isinf(b):
                    raise ValueError(
                        f"{f} looks ahead without end within another operator, which no bounded "
                        "memory can follow: give it an end, or monitor the recorded trace"
                    )
                return below + int(b)
            case ast.Next():
                return below + 1
            case ast.Leaf() | ast.Not() | ast.Join() | ast.Window() | ast.Prev() | ast.Witness():
                return below
        raise missing_case("the online monitor", f)

    def settling(self, f: Formula) -> int:
        """Count the samples after which everything below has taken in a constant input."""
        if f not in self._settlings:
            self._settlings[f] = self._settling(f)
        return self._settlings[f]

    def _settling(self, f: Formula) -> int:
        below = max((self.settling(p) for p in f.operands()), default=0)
        match f:
            case ast.Window() | ast.Witness() if f.side == "back":
                a, b = self.span(f.interval)
                return below + int(a if math.isinf(b) else b) + 1
            case ast.Window() | ast.Witness():
                b = self.span(f.interval)[1]
                # An unbounded operator is anchored, and then needs no more than its operands.
                return below + (0 if math.isinf(b) else int(b))
            case ast.Next() | ast.Prev():
                return below + 1
            case ast.Leaf() | ast.Not() | ast.Join():
                return below
        raise missing_case("the online monitor", f)

    def ends(self, f: Formula) -> bool:
        """Return whether no operator looks ahead without end."""
        ahead = (g for g in f.subformulas() if isinstance(g, ast.Window | ast.Witness))
        return all(math.isfinite(self.span(g.interval)[1]) for g in ahead if g.side == "ahead")

    def stream(self, path: str, f: Formula, sign: int) -> Array:
        """Return the value of `f` at the instant `now - delay(f)`; anything before time 0.

        A part that occurs several times is followed once, in the cells of its first occurrence.
        """
        if (f, sign) not in self._streams:
            self._streams[f, sign] = self._stream(path, f, sign)
        return self._streams[f, sign]

    def _stream(self, path: str, f: Formula, sign: int) -> Array:
        self.delay(f)  # Refuses what looks ahead without end.
        match f:
            case ast.Not(p):
                return -self.stream(path + "0", p, -sign)
            case ast.Join(parts):
                return functools.reduce(_JOIN[f.sign], self.align(path, parts, sign))
            case ast.Next(p):
                return self.stream(path + "0", p, sign)
            case ast.Prev(p, weak):
                value = self.past(path, p, sign, math.inf if weak else -math.inf)
                return self.push(path, value, math.inf if weak else -math.inf, 2)[0]
            case ast.Window(p, i) if f.side == "ahead":
                a, b = self.span(i)
                value = self.stream(path + "0", p, sign)
                window = self.push(path, value, 0.0, int(b) - a + 1)
                return window.min() if f.sign < 0 else window.max()
            case ast.Window(p, i):
                nothing = -f.sign * math.inf
                value = self.past(path, p, sign, nothing)
                return self.window(path, value, *self.span(i), nothing, f.sign < 0)
            case ast.Witness(p, q, i) if f.side == "ahead":
                a, b = self.span(i)
                left, right = self.align(path, (p, q), sign)
                n = int(b) + 1
                lefts = self.push(path + "l", left, 0.0, n)
                rights = self.push(path + "r", right, 0.0, n)
                before = jnp.concatenate([jnp.full(1, jnp.inf, left.dtype), lefts[:-1]])
                return jnp.minimum(rights, jax.lax.cummin(before))[a:].max()
            case ast.Witness(p, q, i):
                return self.since(path, p, q, *self.span(i), sign)
            case ast.Leaf():
                return self.leaf(f, sign)
        raise missing_case("the online monitor", f)

    def align(self, path: str, parts: tuple[Formula, ...], sign: int) -> list[Array]:
        """Return streams of several formulas, the quicker ones delayed to match the slowest."""
        slowest = max(map(self.delay, parts))
        values = []
        for k, part in enumerate(parts):
            value = self.stream(f"{path}{k}.", part, sign)
            wait = slowest - self.delay(part)
            if wait:
                value = self.push(f"{path}{k}w", value, 0.0, wait + 1)[0]
            values.append(value)
        return values

    def past(self, path: str, p: Formula, sign: int, nothing: float) -> Array:
        """Return the stream of `p`, `nothing` before time 0."""
        value = self.stream(path + "0", p, sign)
        return jnp.where(self.now - self.delay(p) >= 0, value, nothing)

    def window(
        self, path: str, value: Array, a: int, b: float, nothing: float, lowest: bool
    ) -> Array:
        """Return the lowest (else greatest) value of a stream from `b` to `a` samples ago."""
        if math.isfinite(b):
            window = self.push(path, value, nothing, int(b) + 1)[: int(b) - a + 1]
            return window.min() if lowest else window.max()
        if a:
            value = self.push(path + "w", value, nothing, a + 1)[0]
        before = self.cell(path, value, nothing)
        self.fresh[path] = jnp.minimum(before, value) if lowest else jnp.maximum(before, value)
        return self.fresh[path]

    def since(self, path: str, p: Formula, q: Formula, a: int, b: float, sign: int) -> Array:
        left, right = self.align(path, (p, q), sign)
        begun = self.now - max(self.delay(p), self.delay(q)) >= 0
        left, right = jnp.where(begun, left, jnp.inf), jnp.where(begun, right, -jnp.inf)
        if math.isfinite(b):
            n = int(b) + 1
            lefts = self.push(path + "l", left, 0.0, n)[::-1]
            rights = self.push(path + "r", right, -math.inf, n)[::-1]
            after = jnp.concatenate([jnp.full(1, jnp.inf, left.dtype), lefts[:-1]])
            return jnp.minimum(rights, jax.lax.cummin(after))[a:].max()
        before = self.cell(path, right, -math.inf)
        self.fresh[path] = value = jnp.maximum(right, jnp.minimum(left, before))
        if not a:
            return value
        # p S[a,inf) q = H[0,a-1] p & (p S q) a samples ago; before there are any, it fails anyway.
        recent = self.push(path + "l", left, math.inf, a).min()
        return jnp.minimum(recent, self.push(path + "s", value, -math.inf, a + 1)[0])

    # Anchored at time 0

    def value_at_start(self, path: str, f: Formula, sign: int) -> Array:
        """Return the value of `f` at time 0 if every stream stays as it is from now on.

        A part that occurs several times is followed once, in the cells of its first occurrence.
        """
        if (f, sign) not in self._starts:
            self._starts[f, sign] = self._value_at_start(path, f, sign)
        return self._starts[f, sign]

    def _value_at_start(self, path: str, f: Formula, sign: int) -> Array:
        match f:
            case ast.Constant():
                return self.constant(f)
            case ast.Not(p):
                return -self.value_at_start(path + "0", p, -sign)
            case ast.Join(parts):
                values = [self.value_at_start(f"{path}{k}.", p, sign) for k, p in enumerate(parts)]
                return functools.reduce(_JOIN[f.sign], values)
            case ast.Window(p, i) if f.side == "ahead":
                a, b = self.span(i)
                value = self.stream(path + "0", p, sign)
                return self.accumulate(path, value, self.now - self.delay(p), a, b, f.sign < 0)
            case ast.Witness(p, q, i) if f.side == "ahead":
                return self.until_at_start(path, p, q, *self.span(i), sign)
        value = self.stream(path + "s", f, sign)
        return self.accumulate(path, value, self.now - self.delay(f), 0, 0, True)

    def constant(self, f: ast.Constant) -> Array:
        return jnp.asarray(math.inf if f.value else -math.inf)

    def accumulate(
        self, path: str, value: Array, index: Array, a: int, b: float, lowest: bool
    ) -> Array:
        """Return the lowest (else greatest) value of a stream over the instants `a` to `b`."""
        before = self.cell(path, value, math.inf if lowest else -math.inf)
        both = jnp.minimum(before, value) if lowest else jnp.maximum(before, value)
        counts = (index >= a) & (index <= b)
        self.fresh[path] = jnp.where(counts, both, before)
        # What is still to come in the window is what the stream gives now.
        return jnp.where(index <= b, both, before)

    def until_at_start(
        self, path: str, p: Formula, q: Formula, a: int, b: float, sign: int
    ) -> Array:
        left, right = self.align(path, (p, q), sign)
        index = self.now - max(self.delay(p), self.delay(q))
        best = self.cell(path + "b", right, -math.inf)
        weakest = self.cell(path + "l", left, math.inf)
        here = jnp.maximum(best, jnp.minimum(right, weakest))
        self.fresh[path + "b"] = jnp.where((index >= a) & (index <= b), here, best)
        self.fresh[path + "l"] = jnp.where(index >= 0, jnp.minimum(weakest, left), weakest)
        # A window still ahead is reached through `left` as it is now.
        through = jnp.where(index >= a, weakest, jnp.minimum(weakest, left))
        coming = jnp.maximum(best, jnp.minimum(right, through))
        return jnp.where(index <= b, coming, best)
