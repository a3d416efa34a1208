"""Hypothesis over a feature space: in the domains, with the constraint, shrunk to the simple."""

import builtins

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import find, given, settings

import verifai_jax as vj
from verifai_jax.testing import strategy

EVENTS = vj.events.Automaton(
    "off",
    {
        ("off", "on"): {"to": "on", "wait": vj.Box(0.1, 1)},
        ("on", "push"): {"wait": vj.Box(0.1, 1), "force": vj.Box(0, 10)},
    },
    max_events=4,
)
SPACE = vj.FeatureSpace(
    {"x": vj.Box(-1, 1), "n": vj.DiscreteBox(0, 5), "kind": vj.Categorical("a", "b"), "e": EVENTS},
    where=lambda f: f["x"] + 0.1 * f["n"] < 1.2,
)
SMALL = settings(max_examples=40, database=None, deadline=None)


@pytest.mark.thorough
@SMALL
@given(strategy(SPACE))
def test_examples_are_in_the_space_and_keep_the_constraint(features):
    SPACE.check(features)


@pytest.mark.slow
def test_shrinks_to_nominal_and_to_few_events():
    nominal = {"x": 0.25, "n": 2, "kind": "b"}

    def pushed(features):
        events = features["e"]
        return bool(np.any(events.are("push") & (np.asarray(events["force"]) > 7)))

    found = find(strategy(SPACE, nominal), pushed, settings=settings(SMALL, max_examples=2000))
    assert float(found["x"]) == pytest.approx(0.25, abs=1e-6)
    assert (int(found["n"]), int(found["kind"])) == (2, 1)
    assert [event["kind"] for event in found["e"].listed()] == ["on", "push"]


def test_what_is_missing_is_named(monkeypatch):
    real = builtins.__import__

    def without(name, *arguments, **options):
        if name == "hypothesis":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match="pip install hypothesis"):
        strategy(SPACE)
    monkeypatch.undo()
    with pytest.raises(TypeError, match="needs a FeatureSpace"):
        strategy({"x": jnp.zeros(())})
