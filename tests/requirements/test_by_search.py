"""Requirements against a problem: mined bounds that no search breaks, traces that tell apart."""

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax import mtl

pytestmark = pytest.mark.thorough


def falling(features, key):
    t = 0.1 * jnp.arange(11)
    return vj.Trace({"x": features["top"] - features["speed"] * t, "t": t}, dt=0.1)


@pytest.fixture(scope="module")
def problem():
    space = {"top": vj.Box(4.0, 5.0), "speed": vj.Box(0.0, 2.0)}
    return vj.Problem("falls", space, falling, "always x > 0")


def test_the_tightest_bound_that_no_search_breaks(problem):
    mined = mtl.mine("always x > ?d", problem, budget=1500)
    assert mined.values["d"] == pytest.approx(2.0, abs=0.02)
    assert mined.searched > 0
    assert "found by search, no proof" in mined.summary()


def test_a_trace_tells_two_readings_apart(problem):
    one, other = mtl.parse("always x > 3"), mtl.parse("always[0, 0.5] x > 3")
    found = mtl.distinguish(one, other, problem, budget=500)
    assert bool(mtl.satisfied(other, found.trace))
    assert not bool(mtl.satisfied(one, found.trace))
    assert "holds: always[0,0.5] (x > 3)" in str(found)
    assert mtl.distinguish("always x > -5", "always x > -6", problem, budget=100) is None


def test_simulations_are_evidence(problem):
    kinds = [found.kind for found in mtl.lint("always (x > 40 -> t > 2)", problem)]
    assert "vacuous" in kinds
    killed = mtl.kill(mtl.mutants("always x > 3"), problem)
    assert killed.survivors != killed.mutants
    assert np.isin("x < 3", [str(m.formula)[8:-1] for m in killed.mutants])
