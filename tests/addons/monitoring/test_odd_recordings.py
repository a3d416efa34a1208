"""Recordings with odd clocks, units and truth values, judged as a definition over all times does.

Times are whole ticks of 50 ms. Held signals are constant at each tick and between each two, so an
evaluation at even numbers (the ticks) and odd ones (the times between) sees every value there is.
"""

import functools
import math

import h5py
import numpy as np
import pandas as pd
import pytest

from verifai_jax import mtl

TICK = 0.05
EPOCH = 1_700_000_000


class Definition:
    """Formulas as nested tuples, on signals as functions of half ticks."""

    def __init__(self, signals, final):
        self.signals, self.final = signals, final
        self.at = functools.cache(self._at)

    def term(self, e, i):
        match e:
            case ("number", value):
                return value
            case ("signal", name):
                return float(self.signals[name](i))
            case ("abs", a):
                return abs(self.term(a, i))
            case ("min" | "max" as word, a, b):
                return (min if word == "min" else max)(self.term(a, i), self.term(b, i))
            case (sign, a, b):
                x, y = self.term(a, i), self.term(b, i)
                return {"+": x + y, "-": x - y, "*": x * y}[sign]

    def _at(self, f, i):
        """Return the robustness, and whether it holds."""
        match f:
            case ("truth", name):
                truth = bool(self.signals[name](i))
                return (1.0 if truth else -1.0), truth
            case ("compare", sign, left, right):
                x, y = self.term(left, i), self.term(right, i)
                margin = {">": x - y, ">=": x - y, "<": y - x, "<=": y - x}.get(sign, -abs(x - y))
                return margin, margin > 0 or (margin == 0 and sign in (">=", "<=", "=="))
            case ("not", p):
                rho, holds = self.at(p, i)
                return -rho, not holds
            case ("and" | "or" as word, p, q):
                one, two = self.at(p, i), self.at(q, i)
                best = min if word == "and" else max
                return best(one[0], two[0]), (all if word == "and" else any)((one[1], two[1]))
            case ("implies", p, q):
                return self.at(("or", ("not", p), q), i)
            case ("always" | "historically" as word, a, b, p):
                values = [self.at(p, j) for j in self.window(i, a, b, word == "always")]
                return min((v[0] for v in values), default=math.inf), all(v[1] for v in values)
            case ("eventually" | "once" as word, a, b, p):
                values = [self.at(p, j) for j in self.window(i, a, b, word == "eventually")]
                return max((v[0] for v in values), default=-math.inf), any(v[1] for v in values)
            case ("until" | "since" as word, a, b, p, q):
                found = []
                for j in self.window(i, a, b, word == "until"):
                    kept = list(range(i, j) if word == "until" else range(j + 1, i + 1))
                    kept += [j] if j % 2 and j != i else []
                    values = [self.at(q, j), *(self.at(p, k) for k in kept)]
                    found.append((min(v[0] for v in values), all(v[1] for v in values)))
                return max((v[0] for v in found), default=-math.inf), any(v[1] for v in found)

    def window(self, i, a, b, ahead):
        if ahead:
            last = max(self.final, i + 2 * a)
            return range(i + 2 * a, (last if b is None else min(i + 2 * b, last)) + 1)
        return range(max(0, -1 if b is None else i - 2 * b), i - 2 * a + 1)


def look_back(f):
    """Return the ticks for which past operators see the time before, which is over by then."""
    if f[0] in ("historically", "once", "since"):
        own = f[1] if f[2] is None else f[2]
        return own + max(map(look_back, f[3:]))
    return max((look_back(part) for part in f if isinstance(part, tuple)), default=0)


def text_of(f):
    match f:
        case ("number", value):
            return f"{value:g}" if value >= 0 else f"({value:g})"
        case ("signal" | "truth", name):
            return name
        case ("abs", a):
            return f"abs({text_of(a)})"
        case ("min" | "max" as word, a, b):
            return f"{word}({text_of(a)}, {text_of(b)})"
        case ("+" | "-" | "*" as sign, a, b):
            return f"({text_of(a)} {sign} {text_of(b)})"
        case ("compare", sign, a, b):
            return f"({text_of(a)} {sign} {text_of(b)})"
        case ("not", p):
            return f"(not {text_of(p)})"
        case ("and" | "or" as word, p, q):
            return f"({text_of(p)} {word} {text_of(q)})"
        case ("implies", p, q):
            return f"({text_of(p)} -> {text_of(q)})"
        case (word, a, b, *parts):
            interval = f"[{a * TICK:.2f},{'inf' if b is None else f'{b * TICK:.2f}'}]"
            left = f"({text_of(parts[0])}) " if len(parts) > 1 else ""
            return f"({left}{word}{interval} ({text_of(parts[-1])}))"


def random_term(random, depth):
    kind = random.integers(0, 7 if depth else 3)
    if kind == 0:
        return ("number", float(random.integers(-4, 5)) / 2)
    if kind in (1, 2):
        return ("signal", ("x", "b")[random.integers(2)])
    parts = random_term(random, depth - 1), random_term(random, depth - 1)
    return ("abs", parts[0]) if kind == 3 else (("+-*")[kind - 4], *parts)


def random_formula(random, depth):
    if not depth or random.random() < 0.1:
        if random.random() < 0.3:
            return ("truth", ("b", "c")[random.integers(2)])
        sign = (">", ">=", "<", "<=", "==")[random.integers(5)]
        left = ("signal", ("x", "y", "b", "c")[random.integers(4)])
        left = left if random.random() < 0.5 else ("+", left, random_term(random, 1))
        return ("compare", sign, left, random_term(random, 1))
    grow = functools.partial(random_formula, random, depth - 1)
    a = int(random.integers(0, 6) * random.integers(0, 2))
    b = None if random.random() < 0.2 else a + int(random.integers(0, 12))
    kind = random.integers(0, 9)
    match kind:
        case 0:
            return ("not", grow())
        case 1 | 2:
            return (("and", "or", "implies")[random.integers(3)], grow(), grow())
        case 3 | 4 | 5:
            return (("always", "eventually")[random.integers(2)], a, b, grow())
        case 6:
            return (("historically", "once")[random.integers(2)], a, b, grow())
    return (("until", "since")[random.integers(2)], a, b, grow(), grow())


def random_clock(random, even):
    if even:
        return 2 * np.arange(random.integers(4, 12))
    return np.cumsum(np.append(0, random.integers(1, 6, size=random.integers(3, 10))))


def stamps_of(random, ticks):
    """Return a name for the column of times, a row of units or nothing, and the stamps."""
    kind = random.integers(0, 9)
    seconds = ticks * TICK
    match kind:
        case 0:
            return "time_ms", "", ticks * 50
        case 1:
            return "Time [us]", "", ticks * 50_000 + 123_450_000
        case 2:
            return "time", "ms", ticks * 50.0
        case 3:
            return "time", "", EPOCH + seconds + 0.3
        case 4:
            return "time", "", (EPOCH * 20 + ticks) * 50_000_000
        case 5:
            return "time(min)", "", seconds / 60
        case 6:
            return "time", "(s)", np.cumsum(np.append(0.0, np.diff(ticks) * TICK))
        case 7:
            begin = np.datetime64("2024-03-01T10:00:00.000")
            return "time", "", (begin + (ticks * 50).astype("timedelta64[ms]")).astype(str)
    return "timeNs", "", ticks * 50_000_000


def cells_of(random, values):
    if values.dtype != bool:
        return values
    on, off = (("true", "false"), ("ON", "OFF"), ("True", "False"))[random.integers(3)]
    return np.where(values, on, off)


def write(random, path, clock, columns):
    name, unit, stamps = stamps_of(random, clock)
    if path.suffix == ".h5" and stamps.dtype.kind in "if":
        with h5py.File(path, "w") as file:
            # Big-endian, as some machines write.
            file.create_dataset(name, data=stamps.astype(stamps.dtype.newbyteorder(">")))
            file[name].attrs["units"] = unit
            for each, values in columns.items():
                file.create_dataset(each, data=values)
        return path
    frame = pd.DataFrame({name: stamps} | columns)
    if path.suffix == ".parquet" and not unit:
        frame.to_parquet(path)
        return path
    path = path.with_suffix(".csv")
    frame = pd.DataFrame({n: cells_of(random, np.asarray(v)) for n, v in frame.items()})
    row = f"{','.join([unit, *('-' for _ in columns)])}\n" if unit else ""
    head, _, rows = frame.to_csv(index=False, sep=",").partition("\n")
    path.write_text(f"{head}\n{row}{rows}", encoding=("utf-8", "utf-16")[random.integers(2)])
    return path


def held(clock, values, begin):
    clock = clock - begin
    return lambda i: values[max(0, np.searchsorted(clock * 2, i, "right") - 1)]


def check(seed, folder):
    random = np.random.default_rng(seed)
    even = random.random() < 0.3
    clocks = [random_clock(random, even)]
    clocks.append(clocks[0] if random.random() < 0.5 else random_clock(random, even))
    values = {
        "x": random.integers(-4, 5, len(clocks[0])) / 2, "b": random.random(len(clocks[0])) < 0.5,
        "y": random.integers(-4, 5, len(clocks[1])) / 2, "c": random.random(len(clocks[1])) < 0.5,
    }  # fmt: skip
    ending = (".csv", ".parquet", ".h5")[random.integers(3)]
    parts = [{n: values[n] for n in "xb"}, {n: values[n] for n in "yc"}]
    if clocks[0] is clocks[1] and random.random() < 0.5:
        source = write(random, folder / f"{seed}{ending}", clocks[0], parts[0] | parts[1])
    else:
        # Both on one calendar, or both from their start.
        state = random.bit_generator.state
        source = []
        for k, (clock, part) in enumerate(zip(clocks, parts, strict=True)):
            random.bit_generator.state = state
            source.append(write(random, folder / f"{seed}-{k}{ending}", clock, part))
    f = random_formula(random, 3)
    signals = {n: held(clocks[n in "yc"], values[n], 0) for n in values}
    final = 2 * int(max(clock[-1] for clock in clocks) + look_back(f)) + 1
    robustness, holds = Definition(signals, final).at(f, 0)
    trace = mtl.read(source)
    (row,) = mtl.judge(text_of(f), trace, method="hold").rows
    assert row.error == "", (seed, text_of(f), row.error)
    assert row.robustness == pytest.approx(robustness, abs=1e-9), (seed, text_of(f), trace)
    assert (row.verdict == "holds") == holds, (seed, text_of(f))


@pytest.mark.slow
def test_formulas_on_odd_recordings_have_the_value_of_the_definition(tmp_path):
    for seed in range(40):
        check(seed, tmp_path)


@pytest.mark.proves
def test_a_thousand_formulas_on_odd_recordings(tmp_path):
    for seed in range(1000, 2000):
        check(seed, tmp_path)
