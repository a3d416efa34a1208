"""Traces that tell readings of a requirement apart, mutants, and examples of formulas."""

import numpy as np
import pytest

from verifai_jax import mtl
from verifai_jax.core.values.trace import Trace

PAIRS = [
    # How far an operator reaches.
    ("always[0, 5] (x > 1 -> eventually y > 3)", "(always[0, 5] x > 1) -> eventually y > 3"),
    ("always (x > 1 & y > 3)", "(always x > 1) & y > 3"),
    ("eventually (x > 1 & y > 3)", "(eventually x > 1) & (eventually y > 3)"),
    ("always (x > 1 | y > 3)", "(always x > 1) | (always y > 3)"),
    ("always !(x > 1)", "!(always x > 1)"),
    ("x > 1 -> (y > 3 -> z > 0)", "(x > 1 -> y > 3) -> z > 0"),
    ("(x > 1 | y > 3) & z > 0", "x > 1 | (y > 3 & z > 0)"),
    ("next (x > 1 & y > 3)", "(next x > 1) & y > 3"),
    # Which until.
    ("x > 1 until y > 3", "x > 1 weak_until y > 3"),
    ("x > 1 until y > 3", "eventually y > 3"),
    ("x > 1 until y > 3", "y > 3 release x > 1"),
    ("x > 1 weak_until y > 3", "y > 3 release x > 1"),
    ("x > 1 until[0, 2] y > 3", "x > 1 until[0, 3] y > 3"),
    ("x > 1 until[1, 2] y > 3", "x > 1 until[0, 2] y > 3"),
    ("x > 1 until (y > 3 until z > 0)", "(x > 1 until y > 3) until z > 0"),
    ("(x > 1 until y > 3) & always x > 0", "x > 1 until y > 3"),
    # Windows.
    ("always[0, 10] x > 1", "always[0, 11] x > 1"),
    ("always[0, 10] x > 1", "always[1, 10] x > 1"),
    ("eventually[0, 10] x > 1", "eventually[0, 9] x > 1"),
    ("always[0, 5] eventually[0, 2] x > 1", "eventually[0, 2] always[0, 5] x > 1"),
    ("always eventually x > 1", "eventually x > 1"),
    ("always[0, 5] x > 1", "always[0, 0.5] x > 1"),
    ("F[0, 10] G[0, 3] abs(x - 1) < 0.1", "F[0, 10] G[0, 3.5] abs(x - 1) < 0.1"),
    ("always[2, 4] x > 1", "eventually[2, 4] x > 1"),
    ("always (x > 1 -> eventually[0, 60] y > 3)", "always (x > 1 -> eventually[0, 30] y > 3)"),
    ("next x > 1", "eventually[1, 1] x > 1"),
    # Bounds and comparisons, at equality too.
    ("always x > 1", "always x >= 1"),
    ("always x > 1", "always x > 1.01"),
    ("always abs(x) < 2", "always x < 2"),
    ("always abs(x - 1) < 2", "always abs(x) < 2"),
    ("always x == 1", "always (x >= 0.9 & x <= 1.1)"),
    ("always mode == 2", "always mode >= 2"),
    ("always max(x, y) > 1", "always min(x, y) > 1"),
    ("always x - y > 1", "always abs(x - y) > 1"),
    ("always norm(p) < 2", "always (abs(p[0]) < 2 & abs(p[1]) < 2)"),
    ("always dist > 2 * speed", "always dist > 2.1 * speed"),
    ("always dist - 0.5 * speed > 1", "always dist > 1"),
    ("always x**2 < 4", "always x < 2"),
    # Implication, equivalence, exclusive or.
    ("always (x > 1 -> y > 3)", "always (x > 1 <-> y > 3)"),
    ("always (x > 1 -> y > 3)", "always (y > 3 -> x > 1)"),
    ("always (x > 1 -> y > 3)", "always (x > 1 & y > 3)"),
    ("x > 1 | y > 3", "x > 1 xor y > 3"),
    ("eventually (x > 1 -> y > 3)", "eventually (x > 1 & y > 3)"),
    ("always (x > 1 -> always y > 3)", "always (x > 1 -> y > 3)"),
    # Clauses left out, of many.
    ("always (a > 0 & b > 0 & c > 0 & d > 0)", "always (a > 0 & b > 0 & c > 0)"),
    ("G (a>0 & b>0 & c>0 & d>0 & e>0 & f>0)", "G (a>0 & b>0 & c>0 & d>0 & e>0)"),
    ("always (a > 0 | b > 0 | c > 0 | d > 0)", "always (a > 0 | b > 0 | c > 0)"),
    # The past.
    ("always (x > 1 -> once[0, 2] y > 3)", "always (x > 1 -> once[0, 3] y > 3)"),
    ("always (x > 1 -> (y > 3 since z > 0))", "always (x > 1 -> once z > 0)"),
    ("always (x > 1 -> historically y > 3)", "always (x > 1 -> prev y > 3)"),
]  # fmt: skip


def test_free_traces_tell_fifty_pairs_apart():
    assert len(PAIRS) == 50
    missed = [pair for pair in PAIRS if not mtl.distinguish(*pair)]
    assert not missed


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("always x > 1", "always !(x <= 1)"),
        ("x > 1 -> y > 3", "!(x > 1) | y > 3"),
        ("eventually (x > 1 | y > 3)", "(eventually x > 1) | (eventually y > 3)"),
        ("true until x > 1", "eventually x > 1"),
    ],
)
def test_the_same_formula_is_told_from_itself_by_nothing(one, other):
    found = mtl.distinguish(one, other)
    assert not found
    assert "no proof that they are the same" in str(found)


def test_the_trace_is_one_on_which_the_verdicts_differ():
    one, other = PAIRS[0]
    found = mtl.distinguish(one, other)
    assert found.trace is not None
    verdicts = [bool(mtl.satisfied(text, found.trace)) for text in (one, other)]
    assert tuple(verdicts) == found.holds
    assert verdicts[0] != verdicts[1]
    assert str(found).startswith("a free trace tells the formulas apart (12,288 traces tried):")


def test_recordings_tell_formulas_apart():
    quiet, loud = (Trace({"x": np.array([1.0, top, 1.0])}, dt=1.0) for top in (1.5, 3.0))
    found = mtl.distinguish("always x < 2", "always x < 4", {"quiet": quiet, "loud": loud})
    assert (found.source, found.holds, found.robustness) == ("loud", (False, True), (-1.0, 1.0))
    assert not mtl.distinguish("always x < 4", "always x < 5", [quiet, loud])


def test_mutants_are_killed_or_reported():
    x = np.array([0.0, 0.5, 1.9, 0.2])
    safe, late = Trace({"x": x}, dt=1.0), Trace({"x": x + 0.2}, dt=1.0)
    found = mtl.mutants("always[0, 2] x < 2", {"safe": safe, "late": late})
    table = found.table.set_index("change")["killed_by"]
    assert table["x < 2 becomes x > 2"] == "safe"
    assert table["x < 2 becomes x < 1.8"] == "safe"
    assert table["x < 2 becomes x < 2.2"] == "late"
    assert table["[0,2] becomes [0,1] in always[0,2] (x < 2)"] == "late"
    assert table["[0,2] becomes [0,4] in always[0,2] (x < 2)"] == ""
    survivors = {mutant.change: mutant for mutant in found.surviving}
    mutant = survivors["[0,2] becomes [0,4] in always[0,2] (x < 2)"]
    verdicts = [bool(mtl.satisfied(f, mutant.example)) for f in (found.formula, mutant.formula)]
    assert verdicts == [True, False]
    killed = len(found) - len(found.surviving) - len(found.equivalent)
    assert f"{killed} of {len(found)} mutants killed by 2 recordings" in str(found)


def test_mutants_change_every_kind_of_part():
    text = "(G[0, 5] (abs(x) > 1 & !brake -> (y < 3 until[0, 2] z > 0))) & (eventually x < 9)"
    found = mtl.mutants(text)
    kinds = {mutant.kind for mutant in found}
    assert kinds == {"bound", "window", "operator", "comparison", "clause", "guard"}
    assert len({mutant.formula for mutant in found}) == len(found)
    assert len(found.surviving) >= 0.9 * len(found)


def test_a_mutant_that_means_the_same_is_called_so():
    found = mtl.mutants("(x > 1 & x > 1) -> eventually x > 1")
    assert found.equivalent
    assert "told apart by no trace" in str(found)


@pytest.fixture(scope="module")
def shown():
    return mtl.examples("always[0, 5] (x > 1 -> eventually[0, 2] y > 3)")


@pytest.mark.thorough
def test_examples_satisfy_barely_satisfy_and_break(shown):
    verdicts = {name: bool(mtl.satisfied(shown.formula, t)) for name, t in shown.traces.items()}
    assert verdicts == {"satisfying": True, "barely": True, "breaking": False}
    rho = shown.robustness
    assert rho["breaking"] < -0.05
    assert 0 <= rho["barely"] < 1e-3 < 0.1 < rho["satisfying"]
    # It shows how: the left side holds at some time at which it is asked.
    assert np.asarray(shown.satisfying["x"])[:11].max() > 1


@pytest.mark.slow
def test_pictures_have_a_row_for_each_signal_and_truth(shown, tmp_path):
    figure = shown.plot(tmp_path / "examples.png")
    assert len(figure.axes) == 9
    assert (tmp_path / "examples.png").stat().st_size > 10_000
    assert figure.axes[0].get_title().startswith("satisfies (+")
    apart = mtl.distinguish("always x > 1", "always x > 2")
    assert len(apart.plot().axes) == 3


@pytest.mark.thorough
def test_a_contradiction_has_no_example_that_satisfies():
    found = mtl.examples("mode == 1 & mode == 2")
    assert list(found.traces) == ["breaking"]
    assert "no trace that was tried satisfies it" in str(found)


def test_what_cannot_be_shown_is_refused():
    with pytest.raises(ValueError, match="has no signal, so there are no examples"):
        mtl.examples("true")
    with pytest.raises(ValueError, match="give a longer period dt"):
        mtl.distinguish("always[0, 3600] x > 1", "always[0, 3600] eventually[0, 0.01] x > 1")


def test_limits_of_what_is_counted_are_told_apart():
    one, other = (f"always duration(x > 3, 10) <= {limit}" for limit in (3, 4))
    found = mtl.distinguish(one, other)
    assert found.trace is not None
    assert not mtl.satisfied(one, found.trace)
    assert mtl.satisfied(other, found.trace)
    shown = mtl.examples("always duration(x > 3, 3600) <= 10.1")  # on no clock of tenths
    assert {"satisfying", "breaking"} <= set(shown.traces)
