"""Adversaries that see signals: laws of the domain, the function, and what they reach."""

import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from specs import sway
from verifai_jax.addons.events.reactive import Reactive
from verifai_jax.features import FeatureSpace
from verifai_jax.testing import check_domain

NETWORK = Reactive({"gap": (0, 60), "v": (0, 30)}, hidden=3, bounds=(-4, 2))
AFFINE = Reactive(("x", "y"))


@pytest.mark.thorough
@pytest.mark.parametrize("domain", [NETWORK, AFFINE], ids=["network", "affine"])
def test_the_laws_of_domains_hold(domain):
    check_domain(domain)


def test_the_function_is_that_of_numpy():
    parameters = np.random.default_rng(0).uniform(-3, 3, NETWORK.size).astype(np.float32)
    assert NETWORK.size == 3 * 3 + 4
    react = NETWORK.coerce(parameters)
    z = np.array([(20 - 30) / 30, (12 - 15) / 15])
    hidden = np.tanh(parameters[:6].reshape(3, 2) @ z + parameters[6:9])
    expected = -4 + 6 * (1 + np.tanh(parameters[9:12] @ hidden + parameters[12])) / 2
    assert float(react(gap=20.0, v=12.0)) == pytest.approx(expected, rel=1e-5)
    assert float(react(20.0, 12.0)) == pytest.approx(expected, rel=1e-5)
    compiled = jax.jit(lambda gap, v: react(gap, v=v))
    assert float(compiled(20.0, 12.0)) == pytest.approx(expected, rel=1e-5)
    on_host = jax.tree.map(np.asarray, react)(20.0, 12.0)
    assert isinstance(on_host, np.floating)
    assert float(on_host) == pytest.approx(expected, rel=1e-5)


def test_what_is_refused():
    react = AFFINE.coerce([0.0, 0.0, 0.0])
    assert float(react(1.0, 2.0)) == 0
    with pytest.raises(ValueError, match="needs y too"):
        react(1.0)
    with pytest.raises(ValueError, match="unknown input 'z'"):
        react(1.0, z=2.0)
    for arguments, message in (
        (((),), "inputs must be names"),
        ((("x", "x"),), "each once"),
        (({"x": (1, 0)},), "the range of x"),
        ((("x",), -1), "hidden must be"),
        ((("x",), 0, (1, 1)), "the range of the output"),
        ((("x",), 0, (0, 1), 0.0), "scale must be"),
    ):
        with unchecked(), pytest.raises(ValueError, match=message):
            Reactive(*arguments)
    with pytest.raises(ValueError, match="must be a reaction of"):
        NETWORK.check(react, "adversary")


def test_plain_data_and_names():
    space = FeatureSpace({"a": NETWORK, "b": AFFINE})
    data = json.loads(json.dumps(space.to_json()))
    assert FeatureSpace.from_json(data) == space
    assert space.columns[:2] == ("a[0]", "a[1]")
    assert AFFINE.labels("b") == ("b by x", "b by y", "b at the middle")
    assert eval(repr(NETWORK), {"Reactive": Reactive}) == NETWORK
    assert repr(AFFINE.coerce([0, 0, 0])) == "Reaction(x, y; affine, from -1 to 1)"


@pytest.mark.slow
def test_reacting_breaks_what_no_plan_of_the_same_size_can():
    assert sway.reactive.space.dim == sway.open_loop.space.dim == 9
    corners = np.array(list(itertools.product([-1.0, 1.0], repeat=9)), np.float32)
    # The displacement is linear in the pieces, so that its greatest value is at a corner.
    traces = jax.jit(
        jax.vmap(lambda knots: sway.planned({"push": vj.Waveform(knots, "constant")}, None)["x"])
    )(jnp.asarray(corners))
    assert float(jnp.max(jnp.abs(traces))) < 9
    run = vj.falsify(sway.reactive, "cross_entropy", 2048, stop=vj.Stop(after=1), progress=False)
    assert len(run.table.counterexamples)
