"""A node that a walk over a formula has no case for: an error that names the walk and the node."""

import dataclasses
import re
from typing import ClassVar

import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax import mtl
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl import parse
from verifai_jax.mtl.clauses import goals_of
from verifai_jax.mtl.expression import Arithmetic, expression
from verifai_jax.mtl.rewriting import nnf, simplify

TRACE = Trace({"x": np.arange(4.0)}, dt=1.0)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Mostly(ast.Formula):
    """An operator of somebody else's."""

    operand: ast.Formula
    children: ClassVar[tuple[str, ...]] = ("operand",)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Coin(ast.Formula):
    """A leaf of somebody else's."""


WALKS = {
    "the text": str,
    "the horizon, or the history,": lambda f: f.horizon(0.1),
    "the history": lambda f: f.history(),
    "the robustness": lambda f: mtl.robustness(f, TRACE),
    "the smoothing error": lambda f: mtl.smoothing_error(f, TRACE),
    "the LaTeX": mtl.latex,
    "the negation normal form": nnf,
    "the rewriting": simplify,
    "the online monitor": lambda f: mtl.online(f, 1.0),
    "the explanation": lambda f: mtl.explain(f, TRACE),
    "the goals": lambda f: goals_of([f]),
    "the normalization": lambda f: mtl.normalize(f, {"x": 1.0}),
    "the words": lambda f: lazy_import("verifai_jax.addons.reports.english", "formula_words")(f),
}


OF_ADD_ONS = ("the normalization", "the words")


@pytest.mark.parametrize(
    "walk",
    [pytest.param(e, marks=pytest.mark.addons if e in OF_ADD_ONS else ()) for e in WALKS],
)
@pytest.mark.parametrize("node", [Mostly(parse("x > 0")), Coin()], ids=["operator", "leaf"])
@pytest.mark.parametrize("inside", [False, True], ids=["root", "inside"])
def test_a_node_without_a_case_is_an_error_that_names_both(walk, node, inside):
    formula = ast.Always(ast.And((parse("x > 1"), node)), ast.Interval(0, 2)) if inside else node
    if walk == "the normalization" and not formula.signals():
        pytest.skip("a scale of no signal is refused before")
    kind = type(node).__name__
    with pytest.raises(TypeError, match=f"of a formula has no case for a node {kind} ") as caught:
        WALKS[walk](formula)
    assert re.match("(the|an) ", str(caught.value))


def test_such_a_node_can_be_shown():
    assert repr(Mostly(parse("x > 0"))) == "Mostly(...)"
    assert repr(ast.Not(Coin())) == "Not(...)"
    assert repr(parse("x > 0")) == "Predicate('x > 0')"


def test_what_is_no_trace_is_told_how_to_become_one():
    says = r"got a dict, which has no clock: write vj\.Trace\(\{'x': \.\.\.\}, dt=0\.1\)"
    for verb in (mtl.robustness, mtl.satisfied, mtl.explain, mtl.smoothing_error):
        with unchecked(), pytest.raises(TypeError, match=says):
            verb("x > 0", {"x": [1.0, 2.0]})
    with (
        unchecked(),
        pytest.raises(TypeError, match="a Trace is needed here; got a list: write"),
    ):
        mtl.robustness("x > 0", [1.0, 2.0])
    assert float(mtl.robustness("x > 0", Trace({"x": np.array([1.0, 2.0])}, dt=0.1))) == 1.0


def test_a_comparison_or_a_function_that_there_is_not_is_refused():
    x = mtl.signal("x")
    with pytest.raises(ValueError, match=r"unknown comparison '=<'; .*Known: <=, <, >=, >, ==, !="):
        ast.Predicate("=<", x, expression(1.0))
    with pytest.raises(ValueError, match=r"unknown function 'tan'\. Known: abs, sqrt, sin, cos"):
        Arithmetic("tan", (x,))
