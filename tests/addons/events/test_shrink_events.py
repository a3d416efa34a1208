"""Events go first: the fewest events that still fail, then what departs within them."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.counterexamples.candidates import Candidates
from verifai_jax.counterexamples.nominal import Nominal
from verifai_jax.counterexamples.remove_items import remove_items

ANY = vj.Box(0.1, 1)
EVENTS = vj.events.Automaton(
    "off",
    {
        ("off", "on"): {"to": "on", "wait": ANY},
        ("on", "off"): {"to": "off", "wait": ANY},
        ("on", "push"): {"wait": ANY, "force": vj.Box(0, 10)},
        ("off", "noise"): {"wait": ANY},
        ("on", "noise"): {"wait": ANY},
    },
    max_events=7,
)


def pushed(features, key):
    """Two pushes of more than 4 N in all that come while it is on."""
    events, times = features["events"], jnp.arange(30) * 0.25
    force = jnp.where(events.are("push") & (events.times <= times[:, None]), events["force"], 0.0)
    twice = events.count(times, "push") >= 2
    return vj.Trace({"x": jnp.where(twice, force.sum(axis=1) + features["bias"], 0.0)}, dt=0.25)


PUSHED = vj.Problem(
    "pushed", {"events": EVENTS, "bias": vj.Box(-1, 1)}, pushed, "always x < 4", nominal={"bias": 0}
)
WRITTEN = [
    {"kind": "noise", "wait": 0.3},
    {"kind": "on", "wait": 0.3},
    {"kind": "push", "wait": 0.3, "force": 9.0},
    {"kind": "off", "wait": 0.2},
    {"kind": "on", "wait": 0.2},
    {"kind": "noise", "wait": 0.2},
    {"kind": "push", "wait": 0.4, "force": 3.0},
]


@pytest.mark.slow
def test_events_go_first_and_pairs_of_them_together():
    run = vj.simulate(PUSHED, {"events": WRITTEN, "bias": 0.7})
    assert run.table.all["violated"].all()
    nominal = Nominal.of(PUSHED)
    candidates = Candidates(PUSHED, nominal, 500)
    u = nominal.settle(PUSHED.space.points(run.table.all))[0]
    least = remove_items(candidates, u)
    # Off and on again goes as a pair only.
    events = PUSHED.space.unflatten(jnp.asarray(least))["events"]
    assert [event["kind"] for event in events.listed()] == ["on", "push", "push"]
    assert nominal.items(least[None]) == [3]


@pytest.mark.slow
def test_many_items_are_removed_in_runs():
    wanted = {3, 11}

    def cars(features, key):
        there = features["cars"].mask & (features["cars"].values > 0.7)
        return vj.Trace({"many": jnp.full(2, jnp.sum(there))}, dt=1.0)

    space = {"cars": vj.Array(vj.Box(0, 1), length=(0, 14))}
    problem = vj.Problem("cars", space, cars, "always many < 2", nominal={"cars": []})
    values = [0.9 if i in wanted else 0.1 for i in range(14)]
    candidates = Candidates(problem, Nominal.of(problem), 600)
    u = np.asarray(problem.space.point_of(problem.space.coerce({"cars": values})))
    cars = problem.space.unflatten(jnp.asarray(remove_items(candidates, u)))["cars"]
    assert int(cars.length) == 2
    assert np.all(np.asarray(cars.values[:2]) > 0.69)


def test_sets_of_few_items_are_all_subsets():
    from verifai_jax.counterexamples.remove_items import item_sets

    found = {tuple(each) for each in item_sets(np.array([1, 4, 6]))}
    subsets = [c for n in (1, 2, 3) for c in itertools.combinations([1, 4, 6], n)]
    assert found == set(subsets)
