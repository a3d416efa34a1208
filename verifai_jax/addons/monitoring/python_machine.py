"""The step of a monitor in Python, for machines without a compiler: some microseconds.

    machine = PythonMachine(plan, margins(plan, {}))
    machine.step([1.0, 0.0])                          # the numbers of one sample
    machine.out                                       # one number a formula

Each operation has a list of numbers as its memory, and corresponds to the operation of the same
name in `c_monitor`.
"""

import copy
import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from verifai_jax.addons.monitoring.margins import Margins, Step
from verifai_jax.mtl.expression import CONSTANT
from verifai_jax.mtl.host_values import FUNCTIONS
from verifai_jax.mtl.streams import Op, Plan

Memory = list[float]
Join = Callable[[float, float], float]


class PythonMachine:
    """The state of a monitor, and its step.

    - `out`: the results of the last step, one number for each formula.
    """

    def __init__(self, plan: Plan, front: Margins) -> None:
        now = _Stream(plan)
        self.out = now.out
        self._top = plan.top
        # By what unknown margins are taken for; the bounds are there from the first of them on.
        self._streams: dict[float | None, _Stream] = {None: now}
        self._counts = [
            _counted(PythonMachine(inner, own), columns) for inner, own, columns in front.counts
        ]
        # What is counted follows the columns of a sample.
        first = {"column": 0, "count": len(front.columns)}
        self._margins: list[tuple[Callable[..., float] | None, tuple[int, ...]]] = [
            (None, (first[each.kind] + int(each.number),))
            if each.kind in first
            else (_operation(each), each.inputs)
            for each in front.steps
        ]
        self._margin_of_leaf = front.leaves
        self._leaves = [math.nan] * len(plan.leaves)

    def step(self, sample: Sequence[float]) -> None:
        """Process one sample."""
        numbers = [float(value) for value in sample]
        numbers += [count(numbers) for count in self._counts]
        v: list[float] = []
        for function, inputs in self._margins:
            of = numbers[inputs[0]] if function is None else function(*[v[i] for i in inputs])
            v.append(of)
        leaves = self._leaves = [v[i] for i in self._margin_of_leaf]
        if len(self._streams) == 1 and any(x != x for x in leaves):
            now = self._streams[None]
            self._streams |= {bound: now.copy() for bound in (-self._top, self._top)}
        for bound, stream in self._streams.items():
            stream.follow(leaves if bound is None else [bound if x != x else x for x in leaves])

    def steps(self, rows: np.ndarray) -> np.ndarray:
        """Process samples `[time, columns]`, and return the results `[time, formulas]`."""
        out = np.empty((len(rows), len(self.out)))
        for k, row in enumerate(rows.tolist()):
            self.step(row)
            out[k] = self.out
        return out

    def ahead(self, steps: int, leaf: float | None) -> np.ndarray:
        """Return the results `[1 + steps, formulas]` of now and of further steps.

        **Arguments:**
        - `leaf`: the margin of all leaves from now on, and of those that were unknown: the lowest
          or the greatest; None keeps their present margins.
        """
        stream = self._streams.get(leaf, self._streams[None]).copy()
        leaves = self._leaves if leaf is None else [leaf] * len(self._leaves)
        out = np.empty((1 + steps, len(self.out)))
        out[0] = stream.out
        for row in out[1:]:
            stream.follow(leaves)
            row[:] = stream.out
        return out


class _Stream:
    """The memory of the operations, and their results."""

    def __init__(self, plan: Plan) -> None:
        self.out = [math.nan] * len(plan.outputs)
        self._outputs = plan.outputs
        self._steps = [(_STEPS[op.kind], op, _first(op, plan.top)) for op in plan.ops]
        self._now = 0

    def copy(self) -> "_Stream":
        new = copy.copy(self)
        new.out = list(self.out)
        new._steps = [(step, op, list(memory)) for step, op, memory in self._steps]
        return new

    def follow(self, leaves: Sequence[float]) -> None:
        v: list[float] = []
        for step, op, memory in self._steps:
            if op.kind == "leaf":
                v.append(leaves[op.n])
            else:
                v.append(step(op, memory, self._now - op.n, *[v[i] for i in op.inputs]))
        now = self._now
        self.out[:] = [v[slot] if now >= delay else math.nan for slot, delay, *_ in self._outputs]
        self._now = now + 1


def _lower(a: float, b: float) -> float:
    return b if b < a or b != b else a  # NaN if one is.


def _higher(a: float, b: float) -> float:
    return b if b > a or b != b else a


def _joins(sign: int) -> tuple[Join, Join]:
    return (_higher, _lower) if sign > 0 else (_lower, _higher)


# Operations: of what is kept, the instant of the inputs, and the inputs


def _first(op: Op, top: float) -> Memory:
    """Return the memory of an operation before any sample: blocks first, then running values."""
    top *= op.sign
    return {
        "delay": [op.number] * op.n + [0], "window": [-top] * op.n + [0, -top],
        "until": [top] * op.n + [-top] * op.n + [0, top, -top], "running": [-top],
        "since": [top] * op.n + [-top] * op.n + [0, top, -top], "recur": [-top],
        "accumulate": [-top], "reach": [-top, top],
    }.get(op.kind, [])  # fmt: skip


def _number(op: Op, memory: Memory, index: int) -> float:
    return op.number


def _join(op: Op, memory: Memory, index: int, *inputs: float) -> float:
    best, _ = _joins(op.sign)
    joined = inputs[0]
    for other in inputs[1:]:
        joined = best(joined, other)
    return joined


def _begun(op: Op, memory: Memory, index: int, x: float) -> float:
    return x if index >= 0 else op.number


def _delayed(op: Op, memory: Memory, index: int, x: float) -> float:
    k = int(memory[-1])
    before, memory[k] = memory[k], x
    memory[-1] = k + 1 if k + 1 < op.n else 0
    return before


def _window(op: Op, memory: Memory, index: int, x: float) -> float:
    best, _ = _joins(op.sign)
    k, n = int(memory[-2]), op.n
    result = memory[-1] = best(memory[-1], x) if k else x
    memory[k] = x
    if k < n - 1:
        memory[-2] = k + 1
        return best(result, memory[k + 1])
    for i in range(n - 2, -1, -1):
        memory[i] = best(memory[i], memory[i + 1])
    memory[-2] = 0
    return result


def _pairs(op: Op, memory: Memory, index: int, f: float, g: float) -> float:
    best, worst = _joins(op.sign)
    k, n = int(memory[-3]), op.n

    def both(f: float, g: float, newer_f: float, newer_g: float) -> float:
        if op.kind == "since":
            return best(newer_g, worst(newer_f, g))
        return best(g, worst(f, newer_g))

    result = both(memory[-2], memory[-1], f, g) if k else g
    memory[-2:] = [worst(memory[-2], f) if k else f, result]
    memory[k], memory[n + k] = f, g
    if k < n - 1:
        memory[-3] = k + 1
        return both(memory[k + 1], memory[n + k + 1], memory[-2], memory[-1])
    for i in range(n - 2, -1, -1):
        memory[n + i] = both(memory[i], memory[n + i], memory[i + 1], memory[n + i + 1])
        memory[i] = worst(memory[i], memory[i + 1])
    memory[-3] = 0
    return result


def _running(op: Op, memory: Memory, index: int, x: float) -> float:
    memory[0] = _joins(op.sign)[0](memory[0], x)
    return memory[0]


def _recur(op: Op, memory: Memory, index: int, f: float, g: float) -> float:
    best, worst = _joins(op.sign)
    memory[0] = best(g, worst(f, memory[0]))
    return memory[0]


def _accumulate(op: Op, memory: Memory, index: int, x: float) -> float:
    before = memory[0]
    both = _joins(op.sign)[0](before, x)
    if op.start <= index <= op.end:
        memory[0] = both
    # What is still to come in the window is what the stream gives now.
    return math.nan if index < 0 else both if index <= op.end else before


def _reach(op: Op, memory: Memory, index: int, f: float, g: float) -> float:
    best, worst = _joins(op.sign)
    found, kept = memory
    through = worst(kept, f)
    if op.start <= index <= op.end:
        memory[0] = best(found, worst(g, kept))
    if index >= 0:
        memory[1] = through
    # A window still ahead is reached through `f` as it is now.
    coming = best(found, worst(g, kept if index >= op.start else through))
    return math.nan if index < 0 else coming if index <= op.end else found


_STEPS: dict[str, Callable[..., float]] = {
    "leaf": _number, "number": _number, "join": _join, "begun": _begun, "delay": _delayed,
    "window": _window, "until": _pairs, "since": _pairs, "running": _running, "recur": _recur,
    "accumulate": _accumulate, "reach": _reach,
}  # fmt: skip


# Margins


def _counted(machine: PythonMachine, columns: Sequence[int]) -> Callable[[Sequence[float]], float]:
    """Return the function that tells, sample by sample, whether a formula holds: 1, 0 or NaN."""

    def holds(x: Sequence[float]) -> float:
        machine.step([x[k] for k in columns])
        (now,) = machine.out
        return now if now != now else float(now > 0)

    return holds


def _delay(n: int, held: bool) -> Callable[[float], float]:
    """Return the function that gives what it was given `n` samples ago."""
    last: deque[float] = deque(maxlen=n)

    def before(x: float) -> float:
        if not last:
            last.extend([x if held else 0.0] * n)
        ago = last[0]
        last.append(x)
        return ago

    return before


def _latest() -> Callable[[float, float], float]:
    """Return the function that keeps a value from one event to the next."""
    kept: list[float] = []

    def latest(event: float, x: float) -> float:
        if event != event or event > 0 or not kept:
            kept[:] = [event if event != event else x]
        return kept[0]

    return latest


def _operation(step: Step) -> Callable[..., float]:
    """Return the function of an operation on margins."""
    match step.kind:
        case "number":
            return lambda: step.number
        case "power":
            power = _safe("**")
            return lambda x: power(x, step.number)
        case "truth":
            at_zero = bool(step.number)
            return lambda x: x if x != x else 1.0 if x > 0 or (at_zero and x == 0) else -1.0
        case "norm":
            return _norm
        case "delay" | "lag":
            return _delay(int(step.number), step.kind == "lag")
        case "latest":
            return _latest()
    return _safe(step.kind)


def _norm(*vector: float) -> float:
    return math.sqrt(sum(x * x for x in vector))


def _safe(name: str) -> Callable[..., float]:
    """Return a function that is NaN or infinite where Python's own raises."""
    if name in ("min", "max"):
        return lambda *values: _join(Op("join", sign=1 if name == "max" else -1), [], 0, *values)

    def compute(*values: float) -> float:
        try:
            return CONSTANT[name](*values)
        except (ArithmeticError, ValueError):
            with np.errstate(all="ignore"):
                return float(FUNCTIONS[name](*map(np.float64, values)))

    return compute
