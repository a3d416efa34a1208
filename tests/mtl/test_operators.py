"""The table of operators: all that reads it agrees, and an operator is added by an entry."""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax import mtl
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl import parse
from verifai_jax.mtl.clauses import goals_of
from verifai_jax.mtl.rewriting import expand
from verifai_jax.mtl.words import OPERATORS, WORDS, Operator

RANDOM = np.random.default_rng(3)
TRACE = Trace({name: RANDOM.normal(size=7).astype(np.float32) for name in "xy"}, dt=1.0)


def made(word):
    operands = [parse("x > 0"), parse("y > 0")][: OPERATORS[word].operands]
    return ast.build(word, operands, ast.Interval(1, 2))


@pytest.mark.parametrize("word", OPERATORS)
def test_an_operator_is_read_as_it_is_built_and_printed(word):
    operator, f = OPERATORS[word], made(word)
    span = "[1,2]" if operator.timed else ""
    for each in operator.words:
        text = (
            f"{each}{span} (x > 0)" if operator.operands == 1 else f"(x > 0) {each}{span} (y > 0)"
        )
        assert parse(text) == f
    assert ast.surface(f)[0] == word
    assert parse(str(f)) == f
    assert operator.latex in mtl.latex(f)
    looks = {"ahead": f.horizon(1.0), "back": f.history(1.0)}
    assert (operator.side == "") == (looks == {"ahead": 0, "back": 0})
    assert all(seconds == 0 for side, seconds in looks.items() if side != operator.side)


@pytest.mark.parametrize("word", [word for word, operator in OPERATORS.items() if operator.dual])
def test_a_negation_moves_through_an_operator_to_its_dual(word):
    dual = OPERATORS[word].dual
    assert OPERATORS[dual].dual == word
    assert ast.surface(mtl.nnf(~made(word)))[0] == dual


def test_every_word_belongs_to_one_operator():
    words = [each for operator in WORDS.values() for each in operator]
    assert len(words) == len(set(words))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class WeakSince(ast.Derived):
    """`right` at some instant of the interval before now and `left` since, or `left` all along."""

    left: ast.Formula
    right: ast.Formula
    interval: ast.Interval = ast.EVERYTHING
    children: ClassVar[tuple[str, ...]] = ("left", "right")
    word = "weak_since"

    @functools.cached_property
    def meaning(self):
        since = ast.Since(self.left, self.right, self.interval)
        return ast.Or((since, ast.Historically(self.left, ast.Interval(0, self.interval.end))))


@pytest.fixture
def weak_since(monkeypatch):
    """An operator that somebody adds: an entry in the table, and a node with a meaning."""
    entry = Operator(
        ("weak_since",), r"\mathbin{\mathcal{B}}", "{0} since {1}{when}, or all the time",
        operands=2, side="back", timed=True,
    )  # fmt: skip
    monkeypatch.setitem(OPERATORS, "weak_since", entry)
    monkeypatch.setitem(ast.NODES, "weak_since", WeakSince)
    return ast.Always(
        WeakSince(parse("x > 0"), parse("y > 0"), ast.Interval(1, 2)), ast.Interval(0, 4)
    )


@pytest.mark.addons
def test_add_ons_write_and_scale_an_operator_made_of_others(weak_since):
    words = lazy_import("verifai_jax.addons.reports.english", "formula_words")
    assert words(weak_since) == (
        "at all times from 0 s to 4 s, (x is above 0 since y is above 0, 1 s to 2 s ago, or all "
        "the time)"
    )
    assert mtl.normalize(weak_since, {"x": 2.0, "y": 1.0}) == ast.Always(
        WeakSince(parse("x / 2 > 0"), parse("y / 1 > 0"), ast.Interval(1, 2)), ast.Interval(0, 4)
    )
    assert not any("{" in words(made(word)) for word in OPERATORS)


def test_an_operator_made_of_others_is_written_and_looked_at_as_any(weak_since):
    assert str(weak_since) == "always[0,4] ((x > 0) weak_since[1,2] (y > 0))"
    assert r"\mathcal{B}}_{[1, 2]}" in mtl.latex(weak_since)
    assert (weak_since.horizon(1.0), weak_since.history(1.0)) == (4, 2)
    assert weak_since.temporal_depth == 2
    assert mtl.nnf(~weak_since) == mtl.nnf(~expand(weak_since))
    assert goals_of([weak_since]) == goals_of([expand(weak_since)])


@pytest.mark.slow
def test_an_operator_made_of_others_has_every_semantics(weak_since):
    plain = expand(weak_since)
    assert plain != weak_since
    for semantics in (mtl.hard, mtl.smooth(0.1), mtl.boolean):
        one, other = (mtl.robustness(f, TRACE, semantics) for f in (weak_since, plain))
        assert float(one) == float(other)

    def slope(f):
        rho = lambda x: mtl.robustness(f, Trace({**TRACE.signals, "x": x}, dt=1.0), mtl.smooth(0.1))  # noqa: E731
        return np.asarray(jax.grad(rho)(jnp.asarray(TRACE.signals["x"])))

    assert np.any(slope(weak_since))
    assert np.array_equal(slope(weak_since), slope(plain))
    assert mtl.smoothing_error(weak_since, TRACE) == mtl.smoothing_error(plain, TRACE)
    monitor = mtl.online(weak_since, 1.0)
    state = monitor.init()
    for i in range(7):
        state = monitor.step(state, {name: values[i] for name, values in TRACE.signals.items()})
    assert float(monitor.finish(state)) == float(mtl.robustness(plain, TRACE))
    why, because = (mtl.explain(f, TRACE) for f in (weak_since, plain))
    assert (why.predicate, why.time) == (because.predicate, because.time)
    assert "weak_since[1,2]" in str(why)


def test_an_operator_made_of_others_needs_a_meaning():
    class Empty(ast.Derived):
        pass

    with pytest.raises(TypeError, match=r"abstract class Empty .*meaning"):
        Empty()


def test_a_rise_and_a_fall_are_at_the_samples_where_truth_changes():
    trace = Trace({"x": np.array([1.0, 2.0, -3.0, 4.0])}, dt=1.0)
    up, down = mtl.robustness_signal("rise x", trace), mtl.robustness_signal("fall x", trace)
    np.testing.assert_array_equal(up, [-np.inf, -1, -3, 3])
    np.testing.assert_array_equal(down, [-np.inf, -2, 2, -4])
    assert mtl.parse("fall (x > 0)") == mtl.fall(mtl.signal("x") > 0)
    assert str(mtl.rise(mtl.signal("x") > 0)) == "rise (x > 0)"


@pytest.mark.addons
def test_exponentials_and_powers_are_read():
    trace = Trace({"x": np.array([2.0, 1.0])}, dt=1.0)
    assert mtl.parse("pow(x, 3) < exp(x)") == mtl.parse("x**3 < exp(x)")
    np.testing.assert_allclose(mtl.robustness("exp(x) > 1", trace), np.exp(2.0) - 1, rtol=1e-6)
    assert r"\exp\left(\mathit{x}\right)" in mtl.latex(mtl.parse("exp(x) > 1"))
    assert mtl.mine("always exp(x) < ?top", [trace]).values["top"] == np.exp(2.0)
