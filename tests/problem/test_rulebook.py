"""The order of a rulebook against its definition, and what a search is told of it."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from verifai_jax.problem.rulebook import Objective, Rulebook

# The graph and vectors of the predecessor's own example, in which it walked depth first and so
# let objective 4 count before objective 1.
EXAMPLE = Rulebook("01234", [("0", "2"), ("1", "3"), ("2", "4"), ("3", "4")])
VECTORS = {"A": "00001", "B": "10000", "C": "01000", "D": "10100", "E": "00100"}
GRAVER = {"BA", "BE", "CA", "DA", "DB", "DE", "EA"}


def bits(text):
    return [int(c) for c in text]


@pytest.mark.parametrize(("one", "other"), list(itertools.permutations(VECTORS, 2)))
def test_the_example_of_the_paper_is_ordered_as_there(one, other):
    graver = EXAMPLE.graver(bits(VECTORS[one]), bits(VECTORS[other]))
    assert graver == (one + other in GRAVER)


def test_running_front():
    seen = []
    fronts = []
    for name in "AEBCD":
        seen.append(name)
        kept = EXAMPLE.front([bits(VECTORS[n]) for n in seen])
        fronts.append("".join(n for n, keep in zip(seen, kept, strict=True) if keep))
    assert fronts == ["A", "E", "B", "BC", "CD"]


def test_order_is_topological():
    assert EXAMPLE.order == ("0", "1", "2", "3", "4")
    assert Rulebook("abc", [("c", "a")]).order == ("b", "c", "a")


@st.composite
def rulebooks(draw):
    k = draw(st.integers(1, 5))
    names = tuple("abcde"[:k])
    ranks = draw(st.permutations(names))
    pairs = [(x, y) for i, x in enumerate(ranks) for y in ranks[i + 1 :]]
    edges = draw(st.lists(st.sampled_from(pairs), max_size=6)) if pairs else []
    return Rulebook(names, edges)


def reachable(rulebook, higher, lower):
    below = {low for high, low in rulebook.edges if high == higher}
    return lower in below or any(reachable(rulebook, b, lower) for b in below)


def by_definition(rulebook, one, other):
    names = rulebook.names
    worse = [n for i, n in enumerate(names) if other[i] > one[i]]
    mine = [n for i, n in enumerate(names) if one[i] > other[i]]
    return bool(mine) and all(any(reachable(rulebook, m, w) for m in mine) for w in worse)


@given(rulebooks(), st.data())
@settings(max_examples=80, deadline=None)
def test_the_order_is_the_one_of_the_definition(rulebook, data):
    degrees = st.lists(
        st.integers(0, 2), min_size=len(rulebook.names), max_size=len(rulebook.names)
    )
    rows = data.draw(st.lists(degrees, min_size=1, max_size=6))
    for one, other in itertools.product(rows, repeat=2):
        assert rulebook.graver(one, other) == by_definition(rulebook, one, other)
    front = [not any(by_definition(rulebook, o, row) for o in rows) for row in rows]
    assert rulebook.front(rows).tolist() == front
    # The grade is a linear extension of the order on what is broken.
    broken = np.array(rows) > 0
    grade = rulebook.grade(broken)
    for i, j in itertools.product(range(len(rows)), repeat=2):
        if rulebook.graver(broken[i], broken[j]):
            assert grade[i] > grade[j]


class TestObjective:
    def test_graver_rows_score_lower(self):
        objective = Objective(Rulebook(("safe", "smooth"), [("safe", "smooth")]))
        rho = np.array([[1.0, 1.0], [0.2, 1.0], [1.0, 0.2], [np.nan, 1.0]])
        kept = objective(rho, rho < 0)
        assert np.all(kept[:3] > 0)
        assert np.isnan(kept[3])
        assert kept[1] < kept[2] < kept[0]

        rho = np.array([[1.0, -1.0], [1.0, 1.0]])
        assert np.array_equal(np.sign(objective(rho, rho < 0)), [-1, 1])

        rho = np.array([[-0.1, 1.0], [1.0, -5.0], [-0.1, -0.1]])
        scores = objective(rho, rho < 0)
        assert scores[2] < 0 < scores[0] < scores[1]

    def test_a_lesser_failure_is_no_success_once_a_graver_one_is_known(self):
        objective = Objective(Rulebook(("safe", "smooth"), [("safe", "smooth")]))
        objective(np.array([[-1.0, 1.0]]), np.array([[True, False]]))
        assert objective(np.array([[1.0, -9.0]]), np.array([[False, True]])) > 0
        again = Objective(objective.rulebook)
        again.state = dict(objective.state)
        assert again(np.array([[1.0, -9.0]]), np.array([[False, True]])) > 0


@pytest.mark.parametrize(
    ("names", "edges", "message"),
    [
        (("safe",), [("safe", "sahe")], "unknown rule 'sahe'; did you mean 'safe'"),
        (("a", "b"), [("a", "b"), ("b", "a")], "go round in a circle: [ab] > [ab] > [ab]"),
        (("a", "b"), ["ab"], r"a pair \(higher, lower\); got 'ab'"),
        (tuple(map(str, range(31))), [], "at most 30 rules; got 31"),
    ],
)
def test_bad_input(names, edges, message):
    with pytest.raises(ValueError, match=message):
        Rulebook(names, edges)
