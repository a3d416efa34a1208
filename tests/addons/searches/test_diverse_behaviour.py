"""Failures apart in what happens: outcomes against `explain` and by hand, and what is found."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.addons.searches.behaviour import SeenBehaviour
from verifai_jax.core.values.clauses import OUTCOME, SEGMENTS
from verifai_jax.core.values.cube import Cube
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.guidance import Guidance, outcome_of
from verifai_jax.mtl import explain, parse
from verifai_jax.mtl.deciding import deciding_instant, leaves_of
from verifai_jax.search import CrossEntropy, Diverse, from_json, to_json
from verifai_jax.testing import check_search

FORMULAS = [
    "always (x < 1.5 & y > -1.5)",
    "(eventually[1, 3] x > 0.5) & (always y < 2)",
    "always (x > 0 -> eventually[0, 1] y > 0)",
    "(x < 2) until[0, 3] (y > 0.3)",
    "!(eventually (historically[0, 0.5] x > 0)) | always[2, 4] y < 1",
]


@pytest.mark.thorough
@pytest.mark.parametrize("text", FORMULAS)
def test_the_deciding_instant_is_that_of_explain(text):
    formula, rng = parse(text), np.random.default_rng(0)
    traces = rng.normal(size=(12, 2, 17)).astype(np.float32)

    def found(signals):
        trace = vj.Trace({"x": signals[0], "y": signals[1]}, dt=0.25)
        return deciding_instant([formula], trace)

    predicates, samples = jax.jit(jax.vmap(found))(traces)
    for signals, predicate, sample in zip(traces, predicates, samples, strict=True):
        why = explain(formula, vj.Trace({"x": signals[0], "y": signals[1]}, dt=0.25))
        leaf = leaves_of([formula])[int(predicate)]
        name = next(iter(leaf.signals()))
        # Numbers are drawn from a continuum, so that one instant alone has this margin.
        assert set(leaf.signals()) == set(why.predicate.signals())
        value = signals["xy".index(name)][int(sample)]
        assert value == signals["xy".index(name)][round(why.time / 0.25)]


@pytest.mark.slow
def test_an_outcome_by_hand():
    def system(f, key):
        time = jnp.arange(16.0)
        x = jnp.where(time == 6, 3.0, f["a"])
        return vj.Trace({"x": x, "other": jnp.stack([time, -time], axis=1)}, dt=0.5)

    problem = vj.Problem(
        "spike", {"a": vj.Box(0, 1)}, system, {"low": "always x > -1", "high": "always x < 2"}
    )
    outcome = np.asarray(outcome_of(problem, system({"a": jnp.float32(0.5)}, None)))
    assert outcome.shape == (OUTCOME,)
    assert outcome[0] == 1
    assert outcome[1] == pytest.approx(6 / 15)
    shape = outcome[2:].reshape(-1, SEGMENTS)
    np.testing.assert_allclose(shape[0], [0.5, 0.5, 0.5, 1.75, 0.5, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(shape[1], np.arange(SEGMENTS) * 2 + 0.5)
    np.testing.assert_allclose(shape[2], -shape[1])
    assert not shape[3].any()
    # The same from the compiled evaluation, which is not asked for it otherwise.
    points = np.full((3, 1), 0.5, np.float32)
    told = Evaluator(problem, 4, guidance=Guidance(outcome=True))(points)
    np.testing.assert_allclose(told.guidance, np.tile(outcome, (3, 1)), atol=1e-6)
    plain = Evaluator(problem, 4)(points)
    assert plain.guidance is None
    np.testing.assert_array_equal(plain.rho, told.rho)
    # Fewer samples than parts of the time.
    short = vj.Trace({"x": jnp.array([0.0, 3.0])}, dt=1.0)
    few = np.asarray(outcome_of(problem, short))
    assert np.isfinite(few).all()
    assert (few[1], few[2], few[2 + SEGMENTS - 1]) == (1, 0, 3)


@pytest.mark.slow
def test_how_unlike_outcomes_are():
    one = np.zeros(OUTCOME, np.float32)
    other_predicate, later, steeper, unknown = (one.copy() for _ in range(4))
    other_predicate[0], later[1], steeper[2:10], unknown[3] = 2, 0.3, 5.0, np.nan
    every = jnp.asarray(np.stack([one, other_predicate, later, steeper, unknown]))
    seen = SeenBehaviour.nothing(4, 2).widened(every, jnp.ones(5))
    # The signal was seen from 0 to 5.
    expected = [0, 1, 0.3, 1, np.inf]
    np.testing.assert_allclose(seen.unlike(every[:1], every)[0], expected, atol=1e-6)
    assert bool(seen.level)
    assert not bool(seen.widened(every, jnp.arange(5.0)).level)
    # What happened as often as there are neighbours is well known, what never did is not at all.
    for _ in range(15):
        seen = seen.recorded(every[:1])
    known = np.asarray(seen.familiarity(every, jnp.float32(0.6)))
    np.testing.assert_allclose(known, [1, 0, 0.5, 0, 0], atol=1e-6)


@pytest.mark.slow
def test_contract_and_record():
    search = Diverse(CrossEntropy(), capacity=8, by="behaviour")
    check_search(search, Cube((0, 3)))
    assert from_json(to_json(search)) == search
    assert search.wants.outcomes
    assert not Diverse(CrossEntropy()).wants.outcomes
    with unchecked(), pytest.raises(ValueError, match="unknown way of being diverse 'behavior'"):
        Diverse(CrossEntropy(), by="behavior")


def banded(f, key):
    # A wide region in which all fails alike, and a thin one in which a decides when.
    time, a, b = jnp.arange(16), f["a"], f["b"]
    wide = b > 0.6
    thin = (b > 0.585) & ~wide
    x = jnp.where(wide, 2.0, b) * jnp.ones(16)
    y = jnp.where(thin & (time // 2 == jnp.floor(8 * a)), 2.0, 0.5)
    return vj.Trace({"x": x, "y": y}, dt=1.0)


BANDED = vj.Problem(
    "banded", {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}, banded, "always (x < 1 & y < 1)"
)


def kinds(run):
    """How many of the nine things that can happen have happened."""
    rows = run.table.counterexamples
    return len({-1 if row.b > 0.6 else int(8 * row.a) for row in rows.itertuples()})


@pytest.mark.proves
def test_it_finds_more_that_happens_where_inputs_say_little():
    options = {"budget": 500, "seed": 0, "confirm": False}
    assert kinds(vj.falsify(BANDED, vj.search.Diverse(vj.search.CrossEntropy()), **options)) <= 4
    run = vj.falsify(BANDED, vj.search.Diverse(vj.search.CrossEntropy(), by="behaviour"), **options)
    assert kinds(run) >= 8
    # Failures that are alike count once.
    some = vj.falsify(
        BANDED,
        vj.search.Diverse(vj.search.CrossEntropy(), by="behaviour"),
        stop=vj.Stop(after=3),
        **options,
    )
    assert some.stopped == "stop_after"
    assert kinds(some) >= 3


@pytest.mark.slow
def test_it_goes_on_as_it_was_also_with_gradients():
    search = vj.search.Diverse(vj.search.named("portfolio"), by="behaviour")
    options = {"seed": 1, "confirm": False, "batch": 16}
    whole = vj.falsify(BANDED, search, 120, **options)
    table = whole.table.all
    begins = np.flatnonzero(np.diff(table["differentiated"].to_numpy(int)) == 1) + 1
    part = vj.falsify(BANDED, search, int(begins[begins >= 40][0]), **options)
    assert vj.resume(part, budget=120).table.all.equals(table)
    guided = replace(BANDED, guide="always y < 0.9")
    assert len(vj.falsify(guided, search, 48, **options).table) == 48


def staged(f, key):
    # Six conditions, one after the other; the alarm alone is what the formula speaks of.
    x = jnp.stack([f[name] for name in "abcdef"])
    depth = jnp.sum(jnp.cumprod((x > 0.3) & (x < 0.5)))
    alarm = jnp.where(depth == 6, 1.0, 0.0)
    return vj.Trace({"alarm": alarm * jnp.ones(8), "depth": 1.0 * depth * jnp.ones(8)}, dt=1.0)


@pytest.mark.proves
def test_what_is_new_leads_on_where_the_robustness_says_nothing():
    space = {name: vj.Box(0, 1) for name in "abcdef"}
    problem = vj.Problem("staged", space, staged, "always alarm < 0.5")
    options = {"budget": 3000, "batch": 16, "stop": vj.Stop(after=1), "seed": 0}
    plain = vj.falsify(problem, vj.search.Diverse(vj.search.CrossEntropy()), **options)
    assert plain.table.counts.claimed == 0
    assert (
        vj.falsify(
            problem, vj.search.Diverse(vj.search.CrossEntropy(), by="behaviour"), **options
        ).simulations
        < 3000
    )


@pytest.mark.slow
def test_a_black_box_tells_what_happens_too():
    @vj.blackbox
    def box(f):
        a, b = float(f["a"]), float(f["b"])
        y = np.full(16, 0.5)
        if 0.585 < b <= 0.6:
            y[2 * int(8 * min(a, 0.999))] = 2.0
        return vj.Trace({"x": np.full(16, 2.0 if b > 0.6 else b), "y": y}, dt=1.0)

    problem = vj.Problem("box", BANDED.space, box, "always (x < 1 & y < 1)")
    run = vj.falsify(
        problem, vj.search.Diverse(vj.search.CrossEntropy(), by="behaviour"), 400, seed=0,
        confirm=False,
    )  # fmt: skip
    assert kinds(run) >= 7
