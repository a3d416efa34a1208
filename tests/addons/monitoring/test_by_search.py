"""Requirements against a problem: mined bounds that no search breaks, traces that tell apart."""

import jax.numpy as jnp
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


@pytest.mark.slow
def test_the_tightest_bound_that_no_search_breaks(problem):
    mined = mtl.mine("always x > ?d", problem, budget=1500)
    assert mined.values["d"] == pytest.approx(2.0, abs=0.02)
    assert mined.searched > 0
    assert "found by search, no proof" in mined.summary()


@pytest.mark.slow
def test_a_simulation_that_tells_two_readings_apart(problem):
    found = mtl.distinguish("always x > 3", "eventually[0, 0.5] x < 4.5", problem, budget=500)
    assert found.holds in [(True, False), (False, True)]
    assert found.source == "a simulation of falls"
    rare = mtl.distinguish("always x > 2.02", "always x > 2", problem, budget=1500)
    assert rare.tried > 64
    assert rare.holds == (False, True)


@pytest.mark.slow
def test_mutants_and_findings_of_simulations(problem):
    found = mtl.lint("always (x > 9 -> eventually t > 3)", problem)
    assert {finding.kind for finding in found} == {"vacuous", "never holds"}
    assert found.recordings == 64
    assert any(
        mutant.killed_by.startswith("simulation ")
        for mutant in mtl.mutants("always x > 3", problem)
    )
