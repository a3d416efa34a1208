"""Sequences of events: every point is a legal sequence, by the stated prior; all can be covered."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

from verifai_jax.addons.events import Automaton, Events, Past
from verifai_jax.features import Array, Box, Categorical, DiscreteBox, FeatureSpace, Signal
from verifai_jax.testing import check_domain

CUT_IN = {"wait": Box(0.5, 4), "gap": Box(5, 20), "who": Categorical("car", "truck")}
TRAFFIC = Automaton(
    "cruise",
    {
        ("cruise", "cut_in"): {"to": "crowded", **CUT_IN},
        ("crowded", "brake"): {"to": "cruise", "wait": Box(0.2, 2), "rate": Box(2, 8), "weight": 2},
        ("crowded", "cut_in"): {**CUT_IN, "wait": Box(0.5, 1), "at_most": 2},
        ("cruise", "leave"): {
            "to": "over",
            "wait": Box(0, 1),
            "after": "brake",
            "guard": lambda past: past.count("cut_in") >= 2,
        },
    },
    max_events=5,
)
SPACE = FeatureSpace({"traffic": TRAFFIC, "v": Box(0, 1)})


def legal(automaton):
    """All sequences of transitions that the automaton allows, by brute force, with their prior."""
    found = {}

    def walk(state, past, taken, share):
        ways = [
            (number, each)
            for number, each in enumerate(automaton.transitions)
            if each.source == state and each.enabled(past)
        ]
        found[taken] = (share, not ways)
        total = sum(each.weight for _, each in ways)
        if len(taken) < automaton.max_events:
            for number, each in ways:
                own = share * each.weight / total
                walk(each.to, past.then(each.name), (*taken, number), own)

    walk(automaton.start, Past(), (), 1.0)
    lengths = automaton.max_events - automaton.min_events + 1
    prior = {}
    for taken, (share, ended) in found.items():
        if len(taken) >= automaton.min_events or ended:
            longer = automaton.max_events - len(taken) + 1 if ended else 1
            prior[taken] = share * longer / lengths
    return prior


def taken_by(points):
    marks = np.asarray(SPACE.coverage_ids_at(points))[:, : TRAFFIC.max_events]
    return [tuple(int(m) for m in row if m >= 0) for row in marks]


POINTS = np.asarray(jax.random.uniform(jax.random.key(2), (4096, SPACE.dim)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "automaton",
    [
        TRAFFIC,
        Automaton("a", {("a", "x"): {"wait": Box(0, 1)}}, max_events=3, min_events=3),
        Automaton(
            "a",
            {
                ("a", "x"): {"to": "b", "wait": Box(0, 1), "n": DiscreteBox(1, 3)},
                ("a", "y"): {"to": "b", "wait": Box(1, 2), "p": Box([0, 1], [2, 3])},
            },
            max_events=4,
            min_events=1,
        ),
    ],
    ids=["guards", "one event", "dead end"],
)
def test_the_laws_of_domains_hold(automaton):
    check_domain(automaton)


def test_every_point_is_a_legal_sequence_with_the_stated_prior():
    prior = legal(TRAFFIC)
    assert sum(prior.values()) == pytest.approx(1)
    counts = dict.fromkeys(prior, 0)
    for taken in taken_by(POINTS):
        counts[taken] += 1  # A KeyError is a sequence that is not legal.
    for taken, share in prior.items():
        spread = 5 * np.sqrt(share * (1 - share) * len(POINTS)) + 1
        assert abs(counts[taken] - share * len(POINTS)) < spread, taken


def test_what_can_be_covered_is_counted_exactly():
    sequences = legal(TRAFFIC)
    pairs = {pair for taken in sequences for pair in itertools.pairwise(taken)}
    assert set(TRAFFIC.graph.pairs) == pairs
    assert set(TRAFFIC.graph.transitions) == {number for taken in sequences for number in taken}
    assert set(TRAFFIC.graph.reachable_states) == {"cruise", "crowded", "over"}
    marks = np.asarray(SPACE.coverage_ids_at(POINTS))
    assert set(np.unique(marks)) == {-1, *range(TRAFFIC.coverage_id_count)}


def test_without_events_is_legal_too_and_closes_up():
    drop = np.random.default_rng(0).random((len(POINTS), SPACE.items)) < 0.4
    smaller = np.asarray(SPACE.without_items(POINTS, drop))
    allowed = set(legal(TRAFFIC))
    before, after = taken_by(POINTS), taken_by(smaller)
    assert set(after) <= allowed
    for old, new, gone in zip(before, after, drop, strict=True):
        kept = [TRAFFIC.transitions[n].name for n, g in zip(old, gone, strict=False) if not g]
        names = [TRAFFIC.transitions[n].name for n in new]
        left = iter(kept)
        assert all(name in left for name in names), (old, gone, new)
    nothing = np.asarray(SPACE.without_items(POINTS, np.ones_like(drop)))
    assert set(taken_by(nothing)) == {()}


def test_settled_points_mean_the_same():
    settled = np.asarray(SPACE.settle(POINTS))
    one, other = SPACE.features_at(POINTS), SPACE.features_at(settled)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(SPACE.settle(settled), settled)
    short = np.asarray(one["traffic"].length) == 0
    np.testing.assert_array_equal(settled[short][:, 1:-1], 0.5)


WRITTEN = [
    {"kind": "cut_in", "time": 1.0, "gap": 7.0, "who": "truck"},
    {"kind": "brake", "wait": 0.5, "rate": 3.0},
]


@pytest.mark.slow
def test_as_a_person_writes_it():
    features = SPACE.coerce({"traffic": WRITTEN, "v": 0.5})
    events = features["traffic"]
    assert repr(events) == "Events(cut_in at 1 s, brake at 1.5 s)"
    again = SPACE.unflatten(SPACE.flatten(features))["traffic"]
    np.testing.assert_allclose(again.waits, [1, 0.5, 0, 0, 0], rtol=1e-6)
    assert again.kinds.tolist() == [0, 1, -1, -1, -1]
    assert int(again["who"][0]) == 1
    assert int(SPACE.coerce({"v": 0.5})["traffic"].length) == 0
    assert len(SPACE.point_of(SPACE.coerce({"v": 0.1}))) == SPACE.dim


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ([{"kind": "brake", "wait": 1, "rate": 3}], "cannot be 'brake' here: in state 'cruise'"),
        ([{"kind": "cut_im", "wait": 1}], "did you mean 'cut_in'"),
        ([{"kind": "cut_in", "wait": 1, "gap": 7}], r"traffic\[0\].who is missing"),
        ([{"kind": "cut_in", "gap": 7}], r"traffic\[0\].wait is missing"),
        ([{**WRITTEN[0], "gap": 70}], r"traffic\[0\].gap"),
        ([{**WRITTEN[0], "gaps": 7}], "did you mean 'gap'"),
        ([WRITTEN[0]] * 6, "at most 5 events; got 6"),
        ("cut_in", "must be a list of events"),
    ],
)
def test_refused_values(events, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        SPACE.check({"traffic": events, "v": 0.5})


@pytest.mark.parametrize(
    ("events", "options", "message"),
    [
        ({}, {}, "events must be a dictionary"),
        ({("a", "x"): {"to": "b"}}, {}, "needs wait="),
        ({("b", "x"): {"wait": Box(0, 1)}}, {}, "unknown state to start in 'a'"),
        ({("a", "x"): {"wait": Box(-1, 1)}}, {}, "must not be negative"),
        ({("a", "x"): {"wait": Box(0, 1), "wieght": 2}}, {}, "did you mean 'weight'"),
        ({("a", "x"): {"wait": Box(0, 1), "weight": 0}}, {}, "weight of event"),
        ({("a", "x"): {"wait": Box(0, 1), "after": "y"}}, {}, "unknown event in after="),
        ({("a", "x"): {"wait": Box(0, 1), "time": Box(0, 1)}}, {}, "cannot be called 'time'"),
        (
            {("a", "x"): {"wait": Box(0, 1)}},
            {"min_events": 9},
            "min_events must be an integer from 0",
        ),
        ({("a", "x"): {"wait": Box(0, 1), "p": Signal(Box(0, 1), 3)}}, {}, "must be a number"),
        (
            {("a", "x"): {"wait": Box(0, 1), "guard": lambda past: False}},
            {},
            "no event is possible",
        ),
        (
            {
                ("a", "x"): {"wait": Box(0, 1), "p": Box(0, 1)},
                ("a", "y"): {"wait": Box(0, 1), "p": DiscreteBox(0, 1)},
            },
            {},
            "must be of one kind in all events",
        ),
    ],
)
def test_refused_automata(events, options, message):
    with unchecked(), pytest.raises((ValueError, TypeError), match=message):
        Automaton("a", events, **options)


W = {"wait": Box(0, 1)}


@pytest.mark.parametrize(
    ("events", "options", "message"),
    [
        (
            {("cruise", "cut"): {"to": "crowdd", **W}, ("crowded", "brake"): {"to": "cruise", **W}},
            {},
            "no event leaves the state 'crowdd' that cruise -cut-> crowdd leads to; did you mean "
            "'crowded'",
        ),
        (
            {("cruise", "cut"): {"to": "slow", **W}, ("slow", "go"): {"to": "criuse", **W}},
            {},
            "did you mean 'cruise'",
        ),
        (
            {("cruise", "cut"): W, ("far", "brake"): {"to": "cruise", **W}},
            {},
            "no sequence of events leads from 'cruise' to the state 'far' of far -brake-> cruise, "
            "only to cruise: correct its name, or add an event with to='far'",
        ),
        (
            {
                ("cruise", "cut"): W,
                ("b", "x"): {"to": "c", **W},
                ("c", "x"): {"to": "b", **W},
            },
            {},
            "leads from 'cruise' to the state 'b'",
        ),
        (
            {("cruise", "a"): {"to": "near", **W}, ("near", "b"): {"to": "over", **W}},
            {"min_events": 3},
            "min_events=3 events are impossible: no sequence from 'cruise' has more than 2",
        ),
        (
            {("cruise", "a"): {"at_most": 2, **W}},
            {"min_events": 4, "max_events": 5},
            "min_events=4 events are impossible: no sequence from 'cruise' has more than 2",
        ),
        ({("cruise", "a"): {"to": 3, **W}}, {}, "to of event .* must be the name of a state"),
    ],
)
def test_states_and_lengths_that_cannot_be_are_refused(events, options, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        Automaton("cruise", events, **options)


def test_a_state_in_which_a_sequence_ends_is_none_of_these():
    assert Automaton(
        "lane1", {("lane1", "change"): {"to": "lane2", **W}}, min_events=1, max_events=1
    ).max_events
    ends = Automaton("cruise", {("cruise", "hit"): {"to": "crash", **W}, ("cruise", "go"): W})
    assert ends.graph.longest(6) == 6


def test_plain_data_and_analysis_know_it():
    plain = Automaton(
        "a",
        {
            ("a", "x"): {"to": "b", "wait": Box(0, 1), "p": Box(0, 1), "weight": 2.0},
            ("b", "y"): {"to": "a", "wait": Box(0, 3), "after": ("x",), "at_most": 2},
        },
        max_events=3,
        min_events=1,
    )
    space = FeatureSpace({"e": plain})
    assert FeatureSpace.from_json(space.to_json()) == space
    with pytest.raises(ValueError, match="guard of cruise -leave-> over is code"):
        SPACE.to_json()
    rows = SPACE.rows(jax.tree.map(np.asarray, SPACE.features_at(POINTS[:8])))
    assert tuple(rows) == SPACE.columns
    assert set(rows["traffic[4].kind"]) <= {"", *TRAFFIC.names}
    assert set(rows["traffic[4].who"]) <= {"", "car", "truck"}


class TestEvents:
    """What a system asks of events, on the host and under jit."""

    KINDS, WAITS = np.array([0, 1, 0, -1], np.int32), np.array([1.0, 2.0, 0.5, 0.0], np.float32)
    EVENTS = Events(KINDS, WAITS, {"gap": np.array([7.0, 9, 5, 6], np.float32)}, ("gust", "drop"))

    @pytest.mark.parametrize("traced", [False, True])
    def test_functions_of_time(self, traced):
        def asked(events, time):
            return {
                "count": events.count(time),
                "gusts": events.count(time, "gust"),
                "active": events.active(time),
                "drop": events.active(time, "drop"),
                "since": events.since(time, "gust"),
                "within": events.within("gust", time, 0.6),
                "lasting": events.within("gust", time, "gap"),
                "gap": events.latest("gap", time, "gust", otherwise=100.0),
            }

        times = np.array([0.5, 1.0, 1.7, 3.0, 3.5, 99.0], np.float32)
        if traced:
            events = jax.tree.map(jnp.asarray, self.EVENTS)
            found = jax.jit(jax.vmap(asked, (None, 0)))(events, times)
        else:
            each = [asked(self.EVENTS, float(time)) for time in times]
            found = {name: np.stack([one[name] for one in each]) for name in each[0]}
            assert all(isinstance(value, np.ndarray) for value in found.values())
        expected = {
            "count": [0, 1, 1, 2, 3, 3],
            "gusts": [0, 1, 1, 1, 2, 2],
            "active": [-1, 0, 0, 1, 2, 2],
            "drop": [-1, -1, -1, 1, 1, 1],
            "since": [np.inf, 0, 0.7, 2, 0, 95.5],
            "within": [0, 1, 0, 0, 1, 0],
            "lasting": [0, 1, 1, 1, 1, 0],
            "gap": [100, 7, 7, 7, 5, 5],
        }
        for name, values in expected.items():
            np.testing.assert_allclose(found[name], values, rtol=1e-5, err_msg=name)

    def test_many_times_at_once(self):
        times = np.linspace(0, 5, 11)
        np.testing.assert_array_equal(
            self.EVENTS.count(times), [int(self.EVENTS.count(t)) for t in times]
        )
        np.testing.assert_array_equal(
            self.EVENTS.latest("gap", times), [self.EVENTS.latest("gap", t) for t in times]
        )

    def test_for_people(self):
        assert self.EVENTS.listed()[1] == {"time": 3.0, "kind": "drop", "gap": 9.0}
        with pytest.raises(ValueError, match="unknown event 'gusts'; did you mean 'gust'"):
            self.EVENTS.count(1.0, "gusts")
        with pytest.raises(ValueError, match="unknown parameter of events 'gaps'"):
            self.EVENTS["gaps"]


@pytest.mark.thorough
def test_items_of_an_array_go_too():
    space = FeatureSpace({"cars": Array(Box(0, 10), length=(1, 3))})
    point = np.asarray(space.flatten({"cars": [1.0, 2.0, 3.0]}))[None]
    fewer = space.without_items(point, np.array([[True, False, True]]))[0]
    items = space.unflatten(fewer)["cars"]
    assert int(items.length) == 1
    assert float(items.values[0]) == pytest.approx(2.0)
