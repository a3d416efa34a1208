"""Given features are simulated in their order, each once."""

import gc
import weakref

import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import PointList
from verifai_jax.testing import check_batch_independence, check_search

SPACE = vj.FeatureSpace({"a": vj.Box(0, 2), "kind": vj.Categorical("slow", "fast")})


@pytest.fixture(scope="module")
def problem():
    def system(features, key):
        return vj.Trace({"x": features["a"] * (1 + features["kind"]) * jnp.ones(2)}, dt=1.0)

    return vj.Problem("given", SPACE, system, "x < 2.5")


@pytest.mark.thorough
def test_rows_of_a_table(problem):
    earlier = vj.falsify(problem, "uniform", 50, batch=50)
    wanted = earlier.table.all.iloc[[7, 3, 41]]
    run = vj.simulate(problem, wanted, batch=2)
    assert (run.stopped, run.simulations) == ("budget", 3)
    for column in ("a", "kind", "rho"):
        assert list(run.table.all[column]) == list(wanted[column])
    assert run.failure_rate is None


def test_features_as_a_person_writes_them(problem):
    one = vj.simulate(problem, {"a": 1.5, "kind": "fast"}).table.all
    assert one["rho"].tolist() == pytest.approx([-0.5])
    two = vj.simulate(problem, [{"a": 1.0, "kind": "slow"}, {"a": 2.0, "kind": "fast"}]).table.all
    np.testing.assert_allclose(two["rho"], [1.5, -1.5], rtol=1e-6)


@pytest.mark.thorough
def test_the_contract_of_searches_holds():
    points = np.random.default_rng(0).random((50, 2), np.float32)
    check_search(PointList(points), Cube((0, 0)))
    check_batch_independence(PointList(points), Cube((0, 0)))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: vj.simulate(p, {"a": 3, "kind": "fast"}), r"a must lie in \[0, 2\]; got 3"),
        (lambda p: vj.simulate(p, {"a": 1}), "kind is missing"),
        (
            lambda p: vj.simulate(p, vj.falsify(p, budget=4).table.all.drop(columns="kind")),
            "unknown column 'kind'",
        ),
        (lambda p: PointList(np.zeros((0, 2))), r"n >= 1; got shape \[0, 2\]"),
        (lambda p: PointList([[1.5, 0]]), "must lie in the unit cube"),
        (
            lambda p: vj.falsify(p, PointList([[0.5]])),
            "the points have 1 coordinates, the space has 2",
        ),
    ],
)
def test_bad_input(problem, make, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        make(problem)


def test_only_holds_the_others_where_it_is_told_to():
    def system(features, key):
        return vj.Trace({"x": (features["a"] + features["w"])[None]}, dt=1.0)

    space = {"a": vj.Box(0, 1), "w": vj.Box(-1, 1)}
    problem = vj.Problem("held", space, system, "x <= 9", nominal={"a": 0.5, "w": 0.0})
    held = problem.only("a", nominal={"w": 0.25})
    assert held.nominal == {"a": 0.5, "w": 0.25}
    assert set(vj.falsify(held, "uniform", 4, batch=4).table.all["w"]) == {0.25}


def test_a_replay_in_words(problem):
    again = vj.simulate(problem, {"a": 0.25, "kind": "fast"}).replay(0)
    assert repr(again) == f"Replay(row 0 of {problem.name!r}, {again._verdict()})"
    first, *rest = str(again).splitlines()
    assert first == f"row 0 of {problem.name}: {again._verdict()}"
    assert any(line.strip() == "features     a=0.25, kind=fast" for line in rest)
    assert any("samples every" in line for line in rest)


@pytest.mark.thorough
def test_a_problem_that_was_simulated_is_freed():
    mine = vj.Problem(
        "freed", {"a": vj.Box(0.0, 1.0)},
        lambda features, key: vj.Trace({"x": features["a"] * jnp.ones(3)}, dt=0.1), "always x < 2",
    )  # fmt: skip
    vj.falsify(mine, "uniform", 8, progress=False).replay(0)
    freed = weakref.ref(mine)
    del mine
    gc.collect()
    assert freed() is None
