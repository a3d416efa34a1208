"""Formulas between samples against the definitions, on every time that can matter or very many."""

import functools
import math

import numpy as np
import pytest

from verifai_jax import mtl
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import Number, signal

X, Y = signal("x"), signal("y")


class Definition:
    """Robustness by the definitions, over a grid of times; signals are functions of time.

    Held signals that change at even numbers of steps are constant between them, so that a grid
    with the odd numbers has every value there is.
    """

    def __init__(self, signals, step, final):
        self.signals, self.step, self.final = signals, step, final
        self.at = functools.cache(self._at)

    def window(self, interval, k, side):
        a = round(interval.start / self.step)
        b = math.inf if math.isinf(interval.end) else round(interval.end / self.step)
        if side == "back":
            return range(max(0, k - b) if b < math.inf else 0, k - a + 1)
        return range(k + a, (k + b if b < math.inf else max(self.final, k + a)) + 1)

    def _at(self, f, k):
        match f:
            case ast.Predicate(_, left, Number(value)):
                return self.signals[left.name](k * self.step) - value
            case ast.Not(p):
                return -self.at(p, k)
            case ast.Join(parts):
                return (min if f.sign < 0 else max)(self.at(p, k) for p in parts)
            case ast.Window(p, i):
                best = min if f.sign < 0 else max
                values = (self.at(p, j) for j in self.window(i, k, f.side))
                return best(values, default=-f.sign * math.inf)
            case ast.Witness(p, q, i):
                ahead = f.side == "ahead"
                found = -math.inf
                for j in self.window(i, k, f.side):
                    kept = range(k, j) if ahead else range(j + 1, k + 1)
                    # Within a piece there are times between the witness and the end of the piece.
                    also = [self.at(p, j)] if j != k and j % 2 else []
                    kept = [*also, *(self.at(p, n) for n in kept)]
                    found = max(found, min([self.at(q, j), *kept]))
                return found


def random_formula(random, depth, spans):
    kind = random.integers(0, 7 if depth else 1)
    grow = functools.partial(random_formula, random, depth - 1, spans)
    start = spans * random.integers(0, 3)
    end = start + spans * random.integers(0, 4) if random.random() < 0.8 else math.inf
    interval = ast.Interval(start, end)
    match kind:
        case 0:
            return (X, Y)[random.integers(2)] > random.integers(-4, 5) / 2
        case 1:
            return ~grow()
        case 2:
            return grow() & grow() if random.random() < 0.5 else grow() | grow()
        case 3 | 4:
            kinds = (ast.Always, ast.Eventually, ast.Historically, ast.Once)
            return kinds[random.integers(4)](grow(), interval)
    return (ast.Until, ast.Since)[random.integers(2)](grow(), grow(), interval)


def check_held(seed):
    """Exact, at every time: samples and ends of windows are multiples of two steps."""
    random = np.random.default_rng(seed)
    times = 2.0 * np.cumsum(np.append(0, random.integers(1, 3, size=random.integers(0, 5))))
    values = {name: random.integers(-4, 5, size=len(times)) / 2 for name in "xy"}
    f = random_formula(random, 2, 2.0)

    def held(name):
        return lambda t: values[name][np.searchsorted(times, t, "right") - 1]

    last = round(times[-1])
    final = last + 2 * 14
    oracle = Definition({name: held(name) for name in values}, 1.0, final)
    got = mtl.dense_signal(f, Trace(values, times=times) if last else Trace(values, dt=1.0), "hold")
    asked = np.arange(last + 6.0)
    expected = [oracle.at(f, k) for k in range(last + 6)]
    np.testing.assert_array_equal(got(asked), expected, err_msg=f"{seed} {f}")


def check_straight(seed):
    """Within what a function of slope 2 changes between two times of a fine grid."""
    random = np.random.default_rng(seed)
    times = np.cumsum(np.append(0.0, random.integers(1, 3, size=3)))
    values = {
        name: np.append(0, np.cumsum(random.uniform(-2, 2, 3) * np.diff(times))) for name in "xy"
    }
    f, step = random_formula(random, 1, 0.5), 1 / 16
    signals = {name: lambda t, v=v: np.interp(t, times, v) for name, v in values.items()}
    last = round(times[-1] / step)
    oracle = Definition(signals, step, last + round(12 / step))
    got = mtl.dense_signal(f, Trace(values, times=times))
    asked = np.arange(0, last, 7)
    expected = np.array([oracle.at(f, int(k)) for k in asked])
    np.testing.assert_allclose(got(asked * step), expected, atol=2.5 * step, err_msg=f"{seed} {f}")


def test_held_signals_have_the_value_of_the_definition():
    for seed in range(150):
        check_held(seed)


def test_straight_signals_have_the_value_of_the_definition():
    for seed in range(20):
        check_straight(seed)


@pytest.mark.proves
def test_ten_thousand_cases_have_the_value_of_the_definition():
    for seed in range(9000):
        check_held(1000 + seed)
    for seed in range(1000):
        check_straight(1000 + seed)


def test_what_is_between_the_samples_counts():
    trace = Trace({"x": np.array([0.0, 2.0, 0.0]), "y": np.array([2.0, 0.0, 2.0])}, dt=1.0)
    assert float(mtl.robustness("always (x > 0.5 | y > 0.5)", trace)) == 1.5
    assert mtl.dense_robustness("always (x > 0.5 | y > 0.5)", trace) == 0.5
    assert mtl.dense_robustness("always (x > 0.5 | y > 0.5)", trace, "hold") == 1.5
    assert mtl.dense_robustness("eventually[0.25, 0.3] x > 0", trace) == pytest.approx(0.6)
    assert mtl.dense_robustness("always abs(x - y) >= 0", trace) == 0.0
    assert mtl.dense_robustness("(x < 1) until[0, 2] (y <= 1)", trace) == 0.0
    assert mtl.dense_robustness("eventually x * y > 1", trace, "hold") == -1.0


def test_what_has_no_meaning_between_samples_is_refused():
    trace = Trace({"x": np.array([0.0, 2.0]), "ok": np.array([True, False])}, dt=1.0)
    with pytest.raises(ValueError, match=r"x \* x is not straight between samples: judge it with"):
        mtl.dense_robustness("always x * x > 0", trace)
    with pytest.raises(ValueError, match=r"next \(x > 0\) counts samples"):
        mtl.dense_robustness("next (x > 0)", trace)
    with pytest.raises(ValueError, match="no verdict: signal 'x' is NaN"):
        mtl.dense_robustness("x > 0", Trace({"x": np.array([0.0, np.nan])}, dt=1.0))
    assert mtl.dense_robustness("always[0, 0.9] ok", trace) == 1.0


def test_the_slope_in_a_time_is_that_of_the_signal_at_the_end_of_the_window():
    trace = Trace({"x": np.array([4.0, 3.0, 1.0, 2.0])}, dt=1.0)
    text = "always[?a, ?b] x > ?d"
    slopes = mtl.dense_gradient(text, trace, {"a": 0.0, "b": 1.5, "d": 0.5})
    assert slopes == pytest.approx({"a": 0.0, "b": -2.0, "d": -1.0}, abs=1e-6)
    slopes = mtl.dense_gradient(text, trace, {"a": 2.25, "b": 3.0, "d": 0.5})
    assert slopes == pytest.approx({"a": 1.0, "b": 0.0, "d": -1.0}, abs=1e-6)
