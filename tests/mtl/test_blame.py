"""Instants that break a formula: they alone keep it broken, and without them it holds."""

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.mtl import parse
from verifai_jax.mtl.blame import broken_at, certain_from
from verifai_jax.mtl.host_values import HostValues

# In each, a predicate stands where more of it can only help; `condition` makes no difference.
FORMULAS = [
    "always p > 0",
    "always[3, 5] p > 0",
    "eventually[3, 5] p > 0",
    "always[0, 6] eventually[0, 2] (p > 0 & q > 0)",
    "eventually[0, 4] always[0, 3] (p > 0 | q > 0)",
    "p > 0 until[2, 7] q > 0",
    "(p > 0 weak_until[0, 5] q > 0) & (always[4, 5] next p > 0)",
    "p > 0 release[1, 6] q > 0",
    "always[2, 9] (p > 0 since[0, 3] q > 0)",
    "always[4, 9] once[1, 3] p > 0",
    "always[4, 9] historically[1, 3] (p > 0 | prev q > 0)",
    "!(eventually[2, 5] (p <= 0 | always[0, 2] q <= 0))",
    "always (c > 0 -> always[1, 2] p > 0)",
]


@pytest.mark.thorough
@pytest.mark.parametrize("end", ["hold", "truncate"])
@pytest.mark.parametrize("text", FORMULAS)
def test_against_what_changes_when_instants_do(text, end):
    rng, formula, broken = np.random.default_rng(0), parse(text), 0
    for _ in range(60):
        signals = {name: rng.choice([-1.0, 1.0], 12) for name in "pqc"}
        for _ in range(24):
            trace = vj.Trace(signals, dt=1.0)
            blamed = {part.signals()[0]: at for part, at in broken_at(formula, trace, end).items()}
            if HostValues.of(trace, end).holds(formula):
                assert not blamed
                break
            broken += 1
            assert blamed
            assert "c" not in blamed
            assert all((signals[name][at] < 0).all() for name, at in blamed.items())
            none = np.zeros(12, bool)
            others = {n: np.where(blamed.get(n, none), x, 1.0) for n, x in signals.items()}
            others["c"] = signals["c"]
            assert not HostValues.of(vj.Trace(others, dt=1.0), end).holds(formula)
            signals |= {n: np.where(at, 1.0, signals[n]) for n, at in blamed.items()}
        else:
            raise AssertionError("the formula holds as soon as what breaks it is repaired")
    assert broken > 3


def test_only_windows_are_to_blame():
    x = np.where(np.arange(101) < 34, -1.0, 1.0)
    x[80] = -1
    (at,) = broken_at(parse("always[70, 100] x > 0"), vj.Trace({"x": x}, dt=1.0)).values()
    assert list(np.flatnonzero(at)) == [80]
    assert not broken_at(parse("always[90, 100] x > 0"), vj.Trace({"x": x}, dt=1.0))


HELPS = {"p": 1.0, "q": 1.0, "c": -1.0}  # the values that help each of the formulas


@pytest.mark.thorough
@pytest.mark.parametrize("end", ["hold", "truncate"])
@pytest.mark.parametrize("text", FORMULAS)
def test_a_formula_is_broken_from_where_the_best_that_may_follow_does_not_help(text, end):
    rng, formula, instants = np.random.default_rng(1), parse(text), set()
    for _ in range(100):
        signals = {name: rng.choice([-1.0, 1.0], 12) for name in HELPS}
        found = None
        for k in reversed(range(12)):
            then = {n: np.where(np.arange(12) <= k, x, HELPS[n]) for n, x in signals.items()}
            if HostValues.of(vj.Trace(then, dt=1.0), end).holds(formula):
                break
            found = k
        assert certain_from(formula, vj.Trace(signals, dt=1.0), end) == found
        instants.add(found)
    assert len(instants) > 1


def test_what_never_comes_is_broken_at_the_end_of_its_window():
    low = vj.Trace({"x": -np.ones(11)}, dt=0.5)
    assert certain_from(parse("eventually[0, 3] x > 0"), low) == 6
    assert certain_from(parse("always x > 0"), low) == 0
    assert certain_from(parse("always (x > -0.5 | x < 0)"), low) is None
