"""The adversary stays where the prior has its probability, and says so."""

import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.addons.synthesis.parametric import FeatureParameters
from verifai_jax.addons.synthesis.region import region_of


def gusts(features, key):
    return vj.Trace(
        {"left": jnp.full(2, features["k"] - jnp.abs(features["x"]) - jnp.abs(features["y"]))},
        dt=1.0,
    )


SPACE = {"k": vj.Box(0, 9.5), "x": vj.Normal(0, 1), "y": vj.Normal(0, 1)}
PROBLEM = vj.Problem("gusts", SPACE, gusts, "left > 0", nominal={"k": 1.0, "x": 0.0, "y": 0.0})


def _region(space, names, mass=0.999):
    problem = vj.Problem("p", space, gusts, "left > 0")
    return region_of(FeatureParameters(problem, names, gradient=False), mass)


def test_tails_are_held_together_and_boxes_stay():
    items = vj.Array(vj.Struct({"a": vj.Exponential(1.0), "b": vj.Categorical(1, 2)}), length=2)
    space = {
        "k": vj.Box(0, 1), "flat": vj.Box(0, 1), "log": vj.LogUniform(1, 9), "n": vj.Normal(0, 1),
        "items": items, "wind": vj.Signal(vj.Normal(0, 1), knots=2, duration=1.0),
    }  # fmt: skip
    region = _region(space, ["k"])
    assert region.tailed.tolist() == [False, False, True, True, False, True, False, True, True]
    assert region.describe() == (
        "chose k, varied flat, log, n, items, wind, where the prior has a probability of 99.9 %: "
        "n, items, wind within 4.53 standard deviations together (mass=)"
    )
    random = np.random.default_rng(0)
    points = random.random((20_000, 9)).astype(np.float32)
    assert 1 - region.contains(points).mean() == pytest.approx(0.001, abs=0.0008)
    corner = np.ones((1, 9), np.float32)
    moved = region.project(corner)
    assert region.contains(moved).all()
    assert not region.contains(corner).any()
    np.testing.assert_array_equal(moved[0, ~region.tailed], 1.0)
    inside = points[region.contains(points)]
    assert region.project(inside) is inside


def test_what_is_no_probability_is_refused():
    for mass in (0, 1.2, "most", True):
        with unchecked(), pytest.raises(ValueError, match="mass must be a probability above 0"):
            _region(SPACE, ["k"], mass)
    assert _region(SPACE, None) is None
    assert _region(SPACE, ["k"], 1).describe() == (
        "chose k, varied x, y, everywhere, in the whole of the tails of x, y"
    )


@pytest.mark.slow
def test_a_repair_is_found_where_the_prior_has_its_mass():
    repaired = vj.repair(PROBLEM, ["k"], budget=6000, seed=1)
    assert repaired.stopped == "repaired"
    # The ball of two normal features with 99.9 % reaches 3.717, and the sum 5.257.
    assert 5.0 < repaired.parameters["k"] < 5.6
    # It fails with a probability of 4e-4, which is below what was left out.
    assert repaired.held_out_after.failures <= 5
    assert (
        "note: chose k, varied x, y, where the prior has a probability of 99.9 %: x, y within "
        "3.72 standard deviations together (mass=)"
    ) in str(repaired)
    whole = vj.repair(PROBLEM, ["k"], budget=3000, seed=1, aim=vj.Aim(mass=1.0, held_out=0))
    assert whole.stopped == "no parameters"
    # Before and after can be compared: what is held is no part of what is sampled.
    compared = vj.compare(PROBLEM.only("x", "y"), {"repaired": repaired.problem}, budget=4000)
    assert compared.verdict == "better"
    assert any(note.startswith("k is held in repaired: ") for note in compared.notes)


@pytest.mark.slow
def test_a_synthesis_says_what_it_varied():
    found = vj.synthesize(PROBLEM, ["k"], budget=3000, environments=8, aim=vj.Aim(held_out=200))
    assert found.holds
    assert "chose k, varied x, y, where the prior has a probability of 99.9 %" in str(found)
