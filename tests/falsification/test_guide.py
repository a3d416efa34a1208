"""A guide steers the search, and nothing else: not one verdict, not one robustness."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.evaluation.engine import engine_for
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.guidance import Guidance

SPACE = {name: vj.Box(0.0, 1.0) for name in "abcd"}


def system(f, key):
    # Whether it trips is a matter of all or nothing; how warm it gets tells of it.
    x = jnp.stack([f[name] for name in "abcd"])
    heat = 1 - jnp.mean(jnp.abs(x - jnp.array([0.9, 0.2, 0.7, 0.4])))
    tripped = jnp.where(heat > 0.97, 1.0, 0.0)
    return vj.Trace(
        {"tripped": tripped * jnp.ones(3), "heat": heat * jnp.linspace(0.5, 1, 3)}, dt=1.0
    )


PLAIN = vj.Problem("trip", SPACE, system, "always tripped < 0.5")
GUIDED = replace(PLAIN, guide=vj.Guide("always heat < 0.9", weight=0.8, scale=0.1))


@pytest.mark.thorough
def test_it_finds_what_the_robustness_says_nothing_of():
    options = {"budget": 600, "batch": 16, "seed": 0, "stop": vj.Stop(after=1)}
    assert vj.falsify(PLAIN, "cross_entropy", **options).table.counts.claimed == 0
    run = vj.falsify(GUIDED, "cross_entropy", **options)
    assert run.table.counts.claimed > 0
    # The table knows nothing of the guide: 0.5 where nothing trips, -0.5 where something does.
    rho, failing = run.table.all["rho"].to_numpy(), run.table.all["violated"].to_numpy()
    assert set(np.round(rho, 6)) == {0.5, -0.5}
    np.testing.assert_array_equal(failing, rho < 0)
    assert run.guide == {"term": "always (heat < 0.9)", "weight": 0.8, "scale": 0.1}


@pytest.mark.thorough
def test_verdicts_and_robustness_are_those_without_it():
    points = np.random.default_rng(0).uniform(size=(64, 4)).astype(np.float32)
    points[:3] = [0.9, 0.2, 0.7, 0.4]
    plain = Evaluator(PLAIN, 64)(points)
    guided = Evaluator(GUIDED, 64, guidance=Guidance(guide=True))(points)
    np.testing.assert_array_equal(plain.rho, guided.rho)
    np.testing.assert_array_equal(plain.violated, guided.violated)
    assert guided.violated[:3].all()
    assert plain.guidance is None
    heat = 1 - np.mean(np.abs(points - np.float32([0.9, 0.2, 0.7, 0.4])), axis=1)
    np.testing.assert_allclose(guided.guidance[:, 0], 0.9 - heat, atol=1e-6)
    # Points of a sequence are simulated the same with it.
    rows = [{"a": 0.9, "b": 0.2, "c": 0.7, "d": 0.4}, {"a": 0.1, "b": 0.2, "c": 0.7, "d": 0.4}]
    one, two = vj.simulate(PLAIN, rows).table.all, vj.simulate(GUIDED, rows).table.all
    assert one.equals(two)


def test_what_is_told_is_the_weighted_sum_by_hand():
    guide = vj.Guide(lambda trace, features: 0.0, weight=0.25, scale=2.0)
    told = np.array([1.0, 0.0, -0.5, np.nan, 3.0, 3.0], np.float32)
    value = np.array([2.0, -2.0, -9.0, 1.0, np.inf, np.nan], np.float32)
    expected = [0.75 + 0.25 * 0.75, 0.25 * 0.25, -0.5, np.nan, 2.5, 2.5]
    np.testing.assert_allclose(guide.steer(told, value), expected, atol=1e-6)
    np.testing.assert_allclose(guide.share(jnp.asarray(value))[:2], [0.75, 0.25])
    # Where something is safe it stays safe, however good the term.
    assert guide.steer(np.zeros(1, np.float32), np.float32([-1e30]))[0] >= 0


@pytest.mark.thorough
@pytest.mark.parametrize("clauses", [False, True])
def test_its_gradient_passes(clauses):
    def ramp(f, key):
        return vj.Trace(
            {"x": f["a"] * jnp.linspace(0.0, 1.0, 3), "y": f["b"] ** 2 + jnp.zeros(3)}, 1.0
        )

    def term(trace, features):
        return 3.0 * features["b"] - trace["y"][0]

    guide = vj.Guide(term, weight=0.4, scale=0.5)
    space = {"a": vj.Box(0.0, 1.0), "b": vj.Box(0.0, 1.0)}
    problem = vj.Problem("ramp", space, ramp, "always x < 2", guide=guide)
    point = np.float32([[0.3, 0.6]])
    key = jax.random.key(0)

    def evaluate(of, **options):
        made = engine_for(of, 1, gradient=True, clauses=clauses, **options)
        return made.evaluate(point, key, 0, temperature=0.05)

    plain = evaluate(replace(problem, guide=None))
    guided = evaluate(problem, guidance=Guidance(guide=True))
    name = "clause_gradients" if clauses else "gradient"
    own, both = (np.reshape(getattr(each, name), (-1, 2))[0] for each in (plain, guided))

    def share(b):
        g = 3 * b - b**2
        return 0.5 * (1 + g / (abs(g) + 0.5))

    slope = (share(0.6 + 1e-5) - share(0.6 - 1e-5)) / 2e-5
    np.testing.assert_allclose(both, 0.6 * own + [0.0, 0.4 * slope], rtol=1e-3)
    np.testing.assert_array_equal(plain.rho, guided.rho)
    if clauses:
        expected = 0.6 * plain.clauses[0, 0] + 0.4 * share(0.6)
        assert guided.clauses[0, 0] == pytest.approx(expected, rel=1e-5)
        np.testing.assert_array_equal(plain.clauses[0, 1:], guided.clauses[0, 1:])


@pytest.mark.thorough
def test_a_black_box_is_guided_too_and_goes_on_as_it_was(tmp_path):
    @vj.blackbox
    def box(f):
        x = np.array([f[name] for name in "abcd"])
        heat = 1 - np.mean(np.abs(x - np.array([0.9, 0.2, 0.7, 0.4])))
        return vj.Trace({"tripped": np.full(3, float(heat > 0.97))}, dt=1.0)

    def distance(trace, features):
        x = jnp.stack([features[name] for name in "abcd"])
        return jnp.mean(jnp.abs(x - jnp.array([0.9, 0.2, 0.7, 0.4])))

    guide = vj.Guide(distance, scale=0.2)
    problem = vj.Problem("box", SPACE, box, "always tripped < 0.5", guide=guide)
    options = {"batch": 16, "seed": 0, "stop": vj.Stop(after=1)}
    whole = vj.falsify(problem, "cross_entropy", 600, **options)
    assert whole.table.counts.claimed > 0
    vj.falsify(problem, "cross_entropy", 64, folder=tmp_path / "run", **options)
    with pytest.raises(ValueError, match=r"was steered by the guide .*distance.* by no guide"):
        vj.resume(tmp_path / "run", replace(problem, guide=None), budget=600)
    resumed = vj.resume(tmp_path / "run", problem, budget=600, stop=vj.Stop(after=1))
    assert resumed.table.all.equals(whole.table.all)
    assert vj.load(tmp_path / "run").guide["weight"] == 0.5


@pytest.mark.addons
@pytest.mark.slow
def test_workers_of_an_executor_tell_the_same():
    search = vj.search.Diverse(vj.search.named("cross_entropy"), by="behaviour")
    options = {"budget": 96, "batch": 16, "seed": 0}
    here = vj.falsify(GUIDED, search, **options)
    with ThreadPoolExecutor(2) as pool:
        there = vj.falsify(GUIDED, search, run_on=vj.RunOn(executor=pool), **options)
    assert there.table.all.equals(here.table.all)


def test_it_is_refused_where_it_has_no_effect_and_where_it_is_wrong():
    for name in ("uniform", "halton"):
        with pytest.raises(ValueError, match=r"has a guide, which steers searches that learn"):
            vj.falsify(GUIDED, name, 16)
    with unchecked(), pytest.raises(TypeError, match="a guide must be a formula"):
        vj.Guide(3)
    with pytest.raises(ValueError, match="weight of a guide"):
        vj.Guide("always heat < 1", weight=0.0)
    with pytest.raises(ValueError, match="scale of a guide"):
        vj.Guide("always heat < 1", scale=-1.0)
    with pytest.raises(vj.mtl.FormulaSyntaxError):
        replace(PLAIN, guide="always heat <")
    # Before anything compiles, what it asks of the trace is checked.
    with pytest.raises(ValueError, match="no signal 'heet'; did you mean 'heat'"):
        vj.falsify(replace(PLAIN, guide="always heet < 1"), "cross_entropy", 16)
    with unchecked(), pytest.raises(TypeError, match="must return one number; got shape"):
        vj.falsify(replace(PLAIN, guide=lambda trace, f: trace["heat"]), "cross_entropy", 16)
