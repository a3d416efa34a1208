"""Explanations against a search over all predicates and instants."""

import itertools

import jax
import numpy as np
import pytest
from mtl_oracle import DT, Oracle

from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import explain, parse, robustness
from verifai_jax.mtl import formula as ast

FORMULAS = [
    "G[0,4] (abs(x) <= 1.5 & abs(y) <= 1.2)",
    "G[0,4] (x > 0 -> F[0.5,1.5] (y > 0.5))",
    "F[0,2] G[0,1] (x > 0.5)",
    "G[0,3] ((x > -0.5) U[0.5,2] (y > 0.5))",
    "(x > -1) U (y > 1.5)",
    "G[0,4] (O[0,1] (x > 0.5) | X (y > 0))",
    "G (x > 0 -> (x > -1) S[0,2] (y > 0))",
    "!(F[1,3] (x > y)) & (x > 0 ^ y > 0)",
    "G[1,3] ((y > 0) R[0,1] (x > -1)) ",
    "H (x > 0) & G weak_prev (y > -1)",
]


def deciding(formula, recording, rho):
    """All (predicate, sample) whose value is the robustness up to sign."""
    oracle = Oracle(recording)
    leaves = [f for f in formula.subformulas() if isinstance(f, ast.Predicate)]
    return {
        (leaf, i)
        for leaf, i in itertools.product(leaves, range(len(recording["x"])))
        if abs(oracle.rho(leaf, i)) == abs(rho)
    }


@pytest.mark.thorough
@pytest.mark.parametrize("text", FORMULAS)
def test_names_the_right_predicate_and_instant(text):
    formula = parse(text)
    rng = np.random.default_rng(0)
    failing = 0
    with jax.enable_x64(True):
        for _ in range(40):
            signals = {name: rng.normal(size=11) for name in ("x", "y")}
            recording = {name: list(values) for name, values in signals.items()}
            rho = Oracle(recording).rho(formula, 0)
            if not -np.inf < rho < 0:
                continue
            failing += 1
            why = explain(formula, Trace(signals, dt=DT))
            assert not why.holds
            assert why.robustness == rho
            assert (why.predicate, round(why.time / DT)) in deciding(formula, recording, rho)
            # Every step of the path has the value it claims, where it claims it.
            oracle = Oracle(recording)
            for _, node in why.tree.flat():
                np.testing.assert_array_equal(
                    node.series, [oracle.rho(node.formula, i) for i in range(11)]
                )
            assert all(abs(node.robustness) == abs(rho) for node in why.path)
            assert why.path[0].formula == formula
            if failing == 10:
                break
    assert failing == 10


@pytest.mark.thorough
def test_tells():
    t = np.arange(101) * 0.04
    trace = Trace(
        {"x": np.sin(t), "theta": 0.1 * t * np.sin(3 * t), "p": np.ones((101, 2))}, dt=0.04
    )
    why = explain("always[0,4] (abs(x) <= 2.4 & abs(theta) <= 0.2095 & norm(p) < 2 & TRUE)", trace)
    assert why.predicate == parse("abs(theta) <= 0.2095")
    assert why.time == pytest.approx(0.04 * np.argmax(np.abs(0.1 * t * np.sin(3 * t))))
    text = str(why)
    assert text.startswith("Fails with robustness -0.")
    assert f"decided by  abs(theta) <= 0.2095  at {why.time:g} s" in text
    assert "Most critical instants:" in text
    assert why.critical[0].predicate == why.predicate
    assert why.critical[0].time == why.time
    assert sum(instant.share for instant in why.critical) <= 1 + 1e-6


def test_the_end_of_the_trace_is_where_a_held_value_comes_from():
    trace = Trace({"x": np.array([3.0, 2.0, 1.0, 9.0])}, dt=0.5, valid=3)
    why = explain("F[3,4] (x > 2)", trace)
    assert (why.robustness, why.time) == (-1.0, 1.0)
    vacuous = explain("G[3,4] (x > 2)", trace, end="truncate")
    assert vacuous.holds
    assert vacuous.path[-1].formula == parse("G[3,4] (x > 2)")


def test_critical_instants_are_the_peaks():
    x = np.ones(40)
    x[[5, 20, 33]] = [-0.2, -0.5, -0.3]
    why = explain("G (x > 0)", Trace({"x": x}, dt=0.1), k=2)
    assert [round(i.time, 6) for i in why.critical] == [2.0, 3.3]
    assert why.critical[0].share > why.critical[1].share


@pytest.mark.thorough
def test_what_stands_in_many_places_is_written_out_once():
    text = "x > 0"
    for i in range(10):
        text = f"({text}) <-> (y > {i})"
    trace = Trace({"x": np.full(3, 2.0), "y": np.full(3, 3.5)}, dt=0.1)
    why = explain(text, trace)
    assert why.robustness == robustness(text, trace)
    assert len(why.tree.flat()) < 150
    assert "(as above)" in str(why)
