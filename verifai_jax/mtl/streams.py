"""Formulas as streams: the operations of a monitor at each sample, in constant memory.

    plan = streams(formula, dt=0.1)                   # operations over the margins of the leaves
    plan.ops, plan.outputs                            # each reads results of earlier ones

After sample k a stream gives the value at instant k - delay, where the delay is the distance that
it looks ahead. A part needed only at time 0 is *anchored*: it accumulates a stream without storing
it. Negations are moved into the leaves, so every operation is increasing in each of its inputs.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._parse import parse
from verifai_jax.mtl.evaluate import span_of
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.rewriting import expand, simplify
from verifai_jax.mtl.sampled import sampled_in
from verifai_jax.mtl.semantics import Semantics, hard
from verifai_jax.mtl.tree import missing_case

LARGEST = 2**27
"""Samples that the windows of a plan may hold: 1 GiB of numbers."""


class Op(NamedTuple):
    """One operation; every backend has a case for each `kind`.

    - `leaf`: margin number `n`; `number`: the constant `number`.
    - `join`: minimum (`sign` -1) or maximum (1) of the inputs.
    - `delay`: the input `n` samples ago; before that exists, `number`.
    - `begun`: the input from sample `n` on; before, `number`.
    - `window`, `running`: extreme of the last `n` samples, or of all; initially `number`.
    - `until`: `max(g[0], min(f[0], max(g[1], ...)))` over the last `n` pairs, starting with the
      oldest, and `since` starting with the newest; for `sign` -1 with minimum and maximum
      exchanged.
    - `recur`: since, over all samples.
    - `accumulate`, `reach`: always (or eventually) and until from `start` to `end` at time 0, with
      inputs that are `n` samples late.
    """

    kind: str
    inputs: tuple[int, ...] = ()
    n: int = 0
    sign: int = 1
    number: float = 0.0
    start: int = 0
    end: float = 0.0


class Output(NamedTuple):
    """The result of one formula.

    - `slot`: index of its operation.
    - `delay`: number of samples by which it is late; 0 if it is evaluated at time 0.
    - `wait`: number of samples after which constant inputs determine it: at time 0, its final
      value; at every instant, the value of the latest sample.
    - `ends`: whether all operators look ahead by a finite time.
    """

    slot: int
    delay: int
    wait: int
    ends: bool


class Plan(NamedTuple):
    """The operations at each sample of monitors of several formulas.

    - `formulas`: the formulas by name.
    - `leaves`: the leaves with the signs of their margins.
    - `top`: the maximum value: infinity, or 1 for truth values.
    - `dt`: the sampling period in seconds.
    """

    formulas: Mapping[str, Formula]
    leaves: tuple[tuple[Formula, int], ...]
    ops: tuple[Op, ...]
    outputs: tuple[Output, ...]
    top: float
    dt: float

    @property
    def memory(self) -> int:
        """Number of samples stored in the windows."""
        held = {"delay": 1, "window": 1, "until": 2, "since": 2}
        sampled = sampled_in(*(f for f, _ in self.leaves))
        spans = [span_of(e.window, self.dt) for e in sampled if e.window is not None]
        stored = int(sum(2 * (last + 1) for _, last in spans))
        return stored + sum(op.n * held.get(op.kind, 0) for op in self.ops)


def streams(
    formulas: Formula | str | Mapping[str, Formula | str], dt: float, semantics: Semantics = hard,
    every: bool = False,
) -> Plan:  # fmt: skip
    """Plan the operations of one or several formulas; common parts occur once.

    **Arguments:**
    - `dt`: sampling period in seconds.
    - `semantics`: `hard` or `boolean`.
    - `every`: whether each formula is evaluated at every instant, not only at time 0.
    **Raises:** `IntervalError` for an interval that is not a multiple of `dt`; `ValueError` for no
    formula, smooth semantics, a period that is not positive, and formulas that need unbounded
    memory.
    """
    named = formulas if isinstance(formulas, Mapping) else {"": formulas}
    parsed = {name: parse(f) if isinstance(f, str) else f for name, f in named.items()}
    if not dt > 0:
        raise ValueError(f"the sampling period dt must be positive; got {dt}")
    if not parsed:
        raise ValueError("a monitor needs one formula or more; got none")
    if semantics.kind == "smooth":
        raise ValueError("an online monitor has hard or boolean semantics; got smooth ones")
    plan = _Layout(dt, 1.0 if semantics.kind == "boolean" else math.inf)
    outputs: list[Output] = []
    for formula in parsed.values():
        f = simplify(expand(formula))
        slot, delay = plan.stream(f, 1) if every else (plan.at_start(f, 1), 0)
        wait = delay if every else plan.settling(f) + 1
        outputs.append(Output(slot, delay, wait, plan.ends(f)))
    made = Plan(parsed, tuple(plan.leaves), tuple(plan.ops), tuple(outputs), plan.top, dt)
    if made.memory > LARGEST:
        raise ValueError(
            f"the windows hold {made.memory} samples, and a monitor may hold {LARGEST}: sample "
            "less often, or take shorter intervals"
        )
    return made


class _Layout:
    """The operations so far, each at the number under which the others read it."""

    def __init__(self, dt: float, top: float) -> None:
        self.dt = dt
        self.top = top
        self.leaves: dict[tuple[Formula, int], int] = {}
        self.ops: dict[Op, int] = {}
        self._streams: dict[tuple[Formula, int], tuple[int, int]] = {}
        self._settlings: dict[Formula, int] = {}

    def span(self, interval: ast.Interval) -> tuple[int, float]:
        return span_of(interval, self.dt)

    def op(self, kind: str, inputs: tuple[int, ...] = (), n: int = 0, sign: int = 1,
           number: float = 0.0, start: int = 0, end: float = 0.0) -> int:  # fmt: skip
        return self.ops.setdefault(Op(kind, inputs, n, sign, number, start, end), len(self.ops))

    def settling(self, f: Formula) -> int:
        """Count the samples after which everything below has taken in a constant input."""
        if f not in self._settlings:
            below = max((self.settling(p) for p in f.operands()), default=0)
            first, last = f.span(self.dt)
            if f.operands() and f.operator.timed:
                first, last = self.span(f.interval)
            elif f.side:
                first = last = 1
            # An unbounded operator is anchored, and then needs no more than its operands.
            own = {"ahead": 0 if math.isinf(last) else last, "": 0}.get(
                f.side, (first if math.isinf(last) else last) + 1
            )
            self._settlings[f] = below + int(own)
        return self._settlings[f]

    def ends(self, f: Formula) -> bool:
        """Return whether no operator looks ahead without end."""
        ahead = (g for g in f.subformulas() if isinstance(g, ast.Window | ast.Witness))
        return all(math.isfinite(g.interval.end) for g in ahead if g.side == "ahead")

    # Streams

    def stream(self, f: Formula, sign: int) -> tuple[int, int]:
        """Return the operation that gives `f`, or its negation for sign -1, and its delay."""
        if (f, sign) not in self._streams:
            self._streams[f, sign] = self._stream(f, sign)
        return self._streams[f, sign]

    def _stream(self, f: Formula, sign: int) -> tuple[int, int]:
        match f:
            case ast.Constant(value):
                return self.op("number", number=self.top if value == (sign > 0) else -self.top), 0
            case ast.Leaf():
                return self.op("leaf", n=self.leaves.setdefault((f, sign), len(self.leaves))), 0
            case ast.Not(p):
                return self.stream(p, -sign)
            case ast.Join(parts):
                return self.join([self.stream(p, sign) for p in parts], sign * f.sign)
            case ast.Next(p):
                slot, delay = self.stream(p, sign)
                return slot, delay + 1
            case ast.Prev(p, weak):
                return self.past(self.stream(p, sign), 1, 1, -sign if weak else sign)
            case ast.Window(p, i):
                a, b = self.span(i)
                if f.side == "back":
                    return self.past(self.stream(p, sign), a, b, sign * f.sign)
                self.refuse_endless(f, b)
                slot, delay = self.stream(p, sign)
                return self.window(slot, int(b) - a + 1, sign * f.sign), delay + int(b)
            case ast.Witness(p, q, i):
                left, right = self.stream(p, sign), self.stream(q, sign)
                a, b = self.span(i)
                if f.side == "back":
                    return self.since(left, right, a, b, sign)
                self.refuse_endless(f, b)
                return self.until(left, right, a, int(b), sign)
        raise missing_case("the online monitor", f)

    def refuse_endless(self, f: Formula, b: float) -> None:
        if math.isinf(b):
            raise ValueError(
                f"{f} looks ahead without end within another operator, which would need unbounded "
                "memory: give it an end, or monitor the recorded trace"
            )

    def delay(self, slot: int, n: int, number: float) -> int:
        return self.op("delay", (slot,), n, number=number) if n else slot

    def window(self, slot: int, n: int, sign: int) -> int:
        number = -sign * self.top
        return self.op("window", (slot,), n, sign, number) if n > 1 else slot

    def align(self, parts: Sequence[tuple[int, int]]) -> tuple[list[int], int]:
        """Delay all streams as much as the slowest; return them and the delay."""
        slowest = max(delay for _, delay in parts)
        return [self.delay(slot, slowest - delay, 0.0) for slot, delay in parts], slowest

    def join(self, parts: Sequence[tuple[int, int]], sign: int) -> tuple[int, int]:
        slots, delay = self.align(parts)
        first, *others = dict.fromkeys(slots)
        return self.op("join", (first, *others), sign=sign) if others else first, delay

    def begun(self, slot: int, delay: int, number: float) -> int:
        # A stream that is not late has no value from before time 0.
        return self.op("begun", (slot,), delay, number=number) if delay else slot

    def past(self, part: tuple[int, int], a: int, b: float, sign: int) -> tuple[int, int]:
        slot, delay = part
        nothing = -sign * self.top
        slot = self.delay(self.begun(slot, delay, nothing), a, nothing)
        if math.isinf(b):
            return self.op("running", (slot,), sign=sign, number=nothing), delay
        return self.window(slot, int(b) - a + 1, sign), delay

    def until(
        self, left: tuple[int, int], right: tuple[int, int], a: int, b: int, sign: int
    ) -> tuple[int, int]:
        # p U[a,b] q = G[0,a-1] p & X^a (p U[0,b-a] q), where X^a is a delay that nobody waits for.
        slot, delay = right
        if b > a:
            slots, delay = self.align([left, right])
            slot = self.op("until", tuple(slots), b - a + 1, sign)
        terms = [(slot, delay + b)]
        if a:
            terms.append((self.window(left[0], a, -sign), left[1] + a - 1))
        return self.join(terms, -sign)

    def since(
        self, left: tuple[int, int], right: tuple[int, int], a: int, b: float, sign: int
    ) -> tuple[int, int]:
        # p S[a,b] q = H[0,a-1] p & Y^a (p S[0,b-a] q)
        (f, g), delay = self.align([left, right])
        f, g = (self.begun(x, delay, s * self.top) for x, s in ((f, sign), (g, -sign)))
        if math.isinf(b):
            g = self.op("recur", (f, g), sign=sign)
        elif b > a:
            g = self.op("since", (f, g), int(b) - a + 1, sign)
        terms = [(self.delay(g, a, -sign * self.top), delay)]
        if a:
            terms.append((self.window(f, a, -sign), delay))
        return self.join(terms, -sign)

    # Anchored at time 0

    def at_start(self, f: Formula, sign: int) -> int:
        """Return the operation that gives `f` at time 0 if every stream stays as it is now."""
        match f:
            case ast.Constant():
                return self.stream(f, sign)[0]
            case ast.Not(p):
                return self.at_start(p, -sign)
            case ast.Join(parts):
                return self.join([(self.at_start(p, sign), 0) for p in parts], sign * f.sign)[0]
            case ast.Window(p, i) if f.side == "ahead":
                a, b = self.span(i)
                slot, delay = self.stream(p, sign)
                return self.op("accumulate", (slot,), delay, sign * f.sign, 0.0, a, b)
            case ast.Witness(p, q, i) if f.side == "ahead":
                a, b = self.span(i)
                slots, delay = self.align([self.stream(p, sign), self.stream(q, sign)])
                return self.op("reach", tuple(slots), delay, sign, 0.0, a, b)
        slot, delay = self.stream(f, sign)
        return self.op("accumulate", (slot,), delay, -1)
