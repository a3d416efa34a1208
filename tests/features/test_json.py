"""Spaces as JSON and back: every domain, nested at random; code is given, never read."""

import json

import jax.numpy as jnp
import pytest
from checked_types import unchecked
from hypothesis import given, settings
from hypothesis import strategies as st

from verifai_jax.features import (
    Array,
    Box,
    Categorical,
    Constant,
    DiscreteBox,
    Distribution,
    FeatureSpace,
    LogUniform,
    Normal,
    Signal,
    Struct,
    TruncatedNormal,
)
from verifai_jax.features.domain import Domain
from verifai_jax.features.fixed import Fixed

numbers = st.integers(-100, 100)
widths = st.integers(1, 50)
boxes = st.builds(lambda low, width: Box(low / 7, (low + width) / 7), numbers, widths)
vectors = st.builds(lambda box, n: Box([box.low] * n, [box.high] * n), boxes, st.integers(1, 3))
real = st.one_of(
    boxes,
    vectors,
    st.builds(lambda mean, std: Normal(mean / 3, std), numbers, widths),
    st.builds(lambda mean, low: TruncatedNormal(mean, 3, mean - low, mean + 1), numbers, widths),
    st.builds(lambda low, width: LogUniform(low / 9, low + width), widths, widths),
)
choices = st.lists(
    st.one_of(st.text(max_size=4), st.integers(-9, 9), st.none()), min_size=1, unique_by=str
)
leaves = st.one_of(
    real,
    st.builds(lambda low, width: DiscreteBox(low, low + width), numbers, widths),
    st.builds(lambda low, width: DiscreteBox([low, 0], [low + width, 4]), numbers, widths),
    choices.map(lambda names: Categorical(*names)),
    st.lists(widths, min_size=2, max_size=4).map(
        lambda w: Categorical(*range(len(w)), weights=[x / sum(w) for x in w])
    ),
    st.one_of(st.text(max_size=3), numbers, st.just([1, 2]), st.just(True)).map(Constant),
    st.builds(
        lambda domain, knots, duration: Signal(domain, knots, "constant", duration),
        real,
        st.integers(1, 3),
        st.sampled_from([None, 2.5]),
    ),
    boxes.map(lambda box: Fixed(box, (box.low + box.high) / 2)),
    boxes.map(lambda box: Fixed(Array(box, length=(0, 2)), [box.low])),
)
names = st.text("abc.[0]", min_size=1, max_size=4)
domains = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.dictionaries(names, inner, min_size=1, max_size=3).map(Struct),
        st.builds(lambda domain, length: Array(domain, length=length), inner, st.integers(1, 3)),
        st.builds(lambda domain, n: Array(domain, length=(n, n + 1)), inner, st.integers(0, 2)),
    ),
    max_leaves=6,
)


@pytest.mark.slow
@given(domains, domains)
@settings(max_examples=120, deadline=None)
def test_round_trip(one, other):
    space = FeatureSpace({"one": one, "other": other})
    text = json.dumps(space.to_json(), allow_nan=False)
    again = FeatureSpace.from_json(json.loads(text))
    assert again == space
    assert repr(again) == repr(space)
    assert (again.columns, again.levels, again.weights) == (
        space.columns, space.levels, space.weights
    )  # fmt: skip


def below(f):
    return f["x"] < f["d"]


TRIANGLE = Distribution(lambda u: 3 * jnp.sqrt(u), lambda x: (x / 3) ** 2, name="triangle")
CODE = FeatureSpace({"x": Box(0, 1), "d": TRIANGLE}, where=below)


def test_code_is_given():
    data = json.loads(json.dumps(CODE.to_json()))
    assert data["where"] == "below"
    given = {"where": below, "distributions": {"triangle": TRIANGLE}}
    assert FeatureSpace.from_json(data, **given) == CODE
    with pytest.raises(ValueError, match=r"constraint below .* is code.*from_json\(data, where="):
        FeatureSpace.from_json(data, distributions=given["distributions"])
    with pytest.raises(ValueError, match=r"Distribution 'triangle' are code.*distributions="):
        FeatureSpace.from_json(data, where=below)


class Mine(Domain):
    """A domain of the user's own, of which JSON knows nothing."""

    levels = ()
    from_unit = to_unit = coerce = check = to_columns = from_columns = lambda *_: None

    def columns(self, name):
        return (name,)


def only(entry, name="x"):
    return {"features": [[name, entry]]}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], r"does not describe a feature space: \[\]"),
        ({"features": []}, "at least one field"),
        ({"features": 3}, "does not describe a domain"),
        (only(3), "does not describe a domain"),
        (only({"kind": "Bix", "low": 0, "high": 1}), "unknown kind of domain 'Bix'; did you mean"),
        (only({"kind": "__import__"}), "unknown kind of domain '__import__'"),
        (only({"kind": "Box", "low": 0}), r"does not describe a domain \('high'\)"),
        (only({"kind": "Box", "low": 2, "high": 1}), "low must be below high in a Box"),
        (only({"kind": "Array", "domain": 3, "length": 2}), "does not describe a domain"),
        (
            only({"kind": "Fixed", "domain": {"kind": "Box", "low": 0, "high": 1},
                  "row": [["", 9]]}),
            r"must lie in \[0, 1\]; got 9",
        ),
        (
            {"features": [["x", {"kind": "Constant", "value": 1}]] * 2},
            r"the name 'x' comes twice; got \['x', 'x'\]",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_where_it_is_made(data, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        FeatureSpace.from_json(data)


def test_what_json_cannot_hold():
    with pytest.raises(ValueError, match="a domain of your own"):
        FeatureSpace({"x": Mine()}).to_json()
    with pytest.raises(ValueError, match=r"the choice \(1, 2\) is not plain data"):
        FeatureSpace({"x": Categorical((1, 2), "b")}).to_json()
