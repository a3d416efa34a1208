"""Functions of samples, half-open windows and elements against their definitions, written out."""

import math

import numpy as np
import pytest

from verifai_jax import mtl
from verifai_jax.addons.monitoring.margins import margins
from verifai_jax.addons.monitoring.python_machine import PythonMachine
from verifai_jax.addons.monitoring.quantities import completed
from verifai_jax.addons.reports.english import formula_words
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.streams import streams

DT = 0.5
COMPARED = {
    "<": (lambda a, b: b - a, False), "<=": (lambda a, b: b - a, True),
    ">": (lambda a, b: a - b, False), ">=": (lambda a, b: a - b, True),
}  # fmt: skip


class Definitions:
    """The value of formulas and expressions, as nested tuples, at each sample of lists."""

    def __init__(self, signals):
        self.signals, self.last = signals, len(signals["x"]) - 1

    def number(self, e, i, k=None):
        i = min(i, self.last)  # What is recorded, and computed of it, keeps its last value.
        word, *parts = e
        if word == "signal":
            value = self.signals[parts[0]][i]
            return value if k is None else value[k]
        if word == "constant":
            return parts[0]
        if word in ("+", "-"):
            one, other = (self.number(part, i, k) for part in parts)
            return one + other if word == "+" else one - other
        if word == "abs":
            return abs(self.number(parts[0], i, k))
        if word == "at_last":
            event, e = parts
            j = next((j for j in range(i, -1, -1) if self.holds(event, j)), 0)
            return self.number(e, j, k)
        operand, (first, last) = parts
        seen = [j for j in range(i - last, i - first + 1) if j >= 0]
        if word in ("count", "duration"):
            found = sum(self.holds(operand, j) for j in seen)
            return found * DT if word == "duration" else float(found)
        if word == "rate":
            new, old = (self.number(operand, max(i - n, 0), k) for n in (first, last))
            return (new - old) / ((last - first) * DT)
        values = [self.number(operand, j, k) for j in seen or [0]]
        return sum(values) / len(values) if word == "mean" else max(values) - min(values)

    def holds(self, f, i):
        return self.value(f, i, True) > 0

    def value(self, f, i, boolean=False):
        word, *parts = f
        top = 1.0 if boolean else math.inf
        if word in COMPARED:
            margin, equal = COMPARED[word]
            left, right, every = parts
            cases = [None] if every is None else [0, 1, 2]
            found = [margin(self.number(left, i, k), self.number(right, i, k)) for k in cases]
            value = max(found) if every is False else min(found)
            return value if not boolean else 1.0 if value > 0 or (equal and value == 0) else -1.0
        if word == "!":
            return -self.value(parts[0], i, boolean)
        if word in ("&", "|"):
            both = [self.value(part, i, boolean) for part in parts]
            return min(both) if word == "&" else max(both)
        if word == "rise":
            before = -self.value(parts[0], i - 1, boolean) if i else -top
            return min(self.value(parts[0], i, boolean), before)
        *operands, (first, last) = parts
        if word == "until":
            left, right = operands
            best = -top
            for j in range(i + first, i + last + 1):
                kept = [self.value(left, m, boolean) for m in range(i, j)]
                best = max(best, min([self.value(right, j, boolean), *kept]))
            return best
        back = word in ("once", "historically")
        js = range(i - last, i - first + 1) if back else range(i + first, i + last + 1)
        values = [self.value(operands[0], j, boolean) for j in js if j >= 0]
        if word in ("always", "historically"):
            return min(values, default=top)
        return max(values, default=-top)


class Draw:
    """Random formulas, as text and as nested tuples."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)

    def window(self, alone, least=0):
        start, length = (int(n) for n in self.rng.integers(0, (3, 6)))
        low, high = bool(self.rng.integers(2)), bool(self.rng.integers(2))
        if alone and self.rng.integers(2):
            return f"{(length + 1) * DT:g}", (0, length)
        first, last = start + low, start + length + low + least
        text = f"{'[('[low]}{start * DT:g},{(last + high) * DT:g}{'])'[high]}"
        return text, (first, last)

    def expression(self, depth, vector=False):
        signal = "p" if vector else self.rng.choice(["x", "y"])
        kind = self.rng.integers(0, 9) if depth else 0
        if kind < 2 or (vector and kind in (2, 3)):
            return signal, ("signal", signal)
        if kind in (2, 3):
            word = ("count", "duration")[kind - 2]
            (f, tree), (text, span) = self.formula(depth - 1, past=True), self.window(True)
            return f"{word}({f}, {text})", (word, tree, span)
        one, tree = self.expression(depth - 1, vector)
        if kind in (4, 5):
            word = ("mean", "peak_to_peak")[kind - 4]
            text, span = self.window(True)
            return f"{word}({one}, {text})", (word, tree, span)
        if kind == 6:
            if self.rng.integers(2):
                return f"rate({one})", ("rate", tree, (0, 1))
            a, n = (int(k) for k in self.rng.integers(1, 4, 2))
            return f"rate({one}, [{a * DT:g},{(a + n) * DT:g}])", ("rate", tree, (a, a + n))
        if kind == 7:
            f, event = self.formula(depth - 1, past=True)
            return f"at_last({f}, {one})", ("at_last", event, tree)
        other, more = self.expression(depth - 1, vector)
        return f"(abs({one}) - ({other}))", ("-", ("abs", tree), more)

    def formula(self, depth, past=False):
        kind = self.rng.integers(0, 8) if depth else 0
        if kind < 3:
            word = str(self.rng.choice(list(COMPARED)))
            limit = float(self.rng.integers(-4, 5)) / 2
            every = [None, None, True, False][self.rng.integers(4)]
            text, tree = self.expression(depth, vector=every is not None)
            text = {None: text, True: f"all({text})", False: f"any({text})"}[every]
            return f"({text} {word} {limit})", (word, tree, ("constant", limit), every)
        one, tree = self.formula(depth - 1, past)
        if kind == 3:
            return f"(!{one})", ("!", tree)
        if kind == 4:
            return f"(rise {one})", ("rise", tree)
        text, span = self.window(False)
        if kind == 5 or (past and kind == 7):
            word = str(self.rng.choice(["once", "historically"]))
            return f"({word}{text} {one})", (word, tree, span)
        other, more = self.formula(depth - 1, past)
        if kind == 6:
            sign = str(self.rng.choice(["&", "|"]))
            return f"({one} {sign} {other})", (sign, tree, more)
        if self.rng.integers(2):
            return f"({one} until{text} {other})", ("until", tree, more, span)
        word = str(self.rng.choice(["always", "eventually"]))
        return f"({word}{text} {one})", (word, tree, span)


def agree(seed):
    draw = Draw(seed)
    text, tree = draw.formula(3)
    n = int(draw.rng.integers(1, 14))
    # Eighths are added exactly, in any order; few levels make events and ties.
    signals = {name: draw.rng.integers(-16, 17, n) / 8 for name in "xy"}
    signals["p"] = draw.rng.integers(-16, 17, (n, 3)) / 8
    if seed % 3 == 0:
        signals = {name: draw.rng.normal(size=x.shape) for name, x in signals.items()}
    definitions = Definitions({name: x.tolist() for name, x in signals.items()})
    f = mtl.parse(text)
    assert mtl.parse(str(f)) == f
    assert formula_words(f)
    values = HostValues.of(Trace(signals, dt=DT))
    expected = [definitions.value(tree, i) for i in range(n)]
    np.testing.assert_allclose(np.broadcast_to(values(f), n), expected, atol=1e-12, err_msg=text)
    truths = [definitions.value(tree, i, True) for i in range(n)]
    close = np.abs(expected) < 1e-12  # Thirds are rounded where means are compared.
    np.testing.assert_array_equal(
        np.broadcast_to(values.truth(f), n)[~close], np.array(truths)[~close], err_msg=text
    )
    watched = mtl.watch(f, DT, sizes={"p": 3})
    plan = streams(completed(f, {}, {"p": 3}), DT)
    front = margins(plan, {}, apart=True)
    machine = PythonMachine(plan, front)
    for k in range(n):
        sample = {name: x[k] for name, x in signals.items()}
        watched.step(sample)
        machine.step([sample[name] if i is None else sample[name][i] for name, i in front.columns])
        assert np.array_equal(list(watched._out), machine.out, equal_nan=True), text
    assert np.array_equal(watched.finish(), values(f)[0], equal_nan=True), text
    return f, signals, expected[0]


@pytest.mark.parametrize("seeds", [range(30), range(30, 60)], ids=str)
def test_values_are_those_of_the_definitions(seeds, monkeypatch):
    monkeypatch.setattr("verifai_jax.addons.monitoring.watching.CompiledMachine", PythonMachine)
    for seed in seeds:
        agree(seed)


@pytest.mark.thorough
@pytest.mark.parametrize("seeds", [
    range(k, k + 30) for k in range(60, 360, 30)
], ids=str)  # fmt: skip
def test_compiled_monitors_and_jax_have_the_same_values(seeds):
    for seed in seeds:
        f, signals, expected = agree(seed)
        if seed % 10 == 0:  # JAX compiles each.
            np.testing.assert_allclose(
                float(mtl.robustness(f, Trace(signals, dt=DT))), expected, rtol=1e-5, atol=1e-5
            )
