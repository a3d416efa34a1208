"""The feature space: order, names, round trips with the table, and big spaces."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
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
    FeatureSpace,
    Struct,
)

SPACE = FeatureSpace(
    {
        "z": Box(-0.05, 0.05),
        "b": Box(0, 1),
        "alg": Categorical("ppo", "sac"),
        "rate": Categorical(0.1, 0.25),
        "gear": DiscreteBox(1, 4),
        "cars": Array(Struct({"x": Box(0, 50), "c": Categorical("r", "g", "b")}), length=2),
        "point": Box([0, 0], [1, 2]),
        "g": Constant(9.8),
        "one": DiscreteBox(2, 2),
    }
)


@pytest.mark.thorough
def test_the_order_is_the_one_written():
    assert SPACE.columns == (
        "z", "b", "alg", "rate", "gear", "cars[0].x", "cars[0].c", "cars[1].x", "cars[1].c",
        "point[0]", "point[1]", "one",
    )  # fmt: skip
    assert SPACE.levels == (0, 0, 2, 2, 4, 0, 3, 0, 3, 0, 0, 1)
    assert SPACE.dim == 12
    assert list(SPACE.unflatten(jnp.zeros(12))) == list(SPACE.domains)
    # Not lexicographic: param10 belongs behind param2.
    many = FeatureSpace({f"param{i}": Box(i, i + 1) for i in range(12)})
    assert many.columns[2] == "param2"
    values = many.unflatten(jnp.full(12, 0.5))
    assert [float(values[f"param{i}"]) for i in range(12)] == [i + 0.5 for i in range(12)]


def test_the_first_halton_points_of_a_two_dimensional_box():
    # The values that VerifAI gives for its space of x and y.
    space = FeatureSpace({"x": Box(-1, 1), "y": Box(0, 10)})
    u = jnp.array([[1 / 2, 1 / 3], [1 / 4, 2 / 3], [3 / 4, 1 / 9]])
    features = jax.vmap(space.unflatten)(u)
    np.testing.assert_allclose(features["x"], [0, -0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(features["y"], [10 / 3, 20 / 3, 10 / 9], rtol=1e-6)


@given(st.lists(st.floats(0, 1, width=32), min_size=12, max_size=12))
@settings(max_examples=25, deadline=None)
def test_round_trips(u):
    features = UNFLATTEN(jnp.array(u, jnp.float32))
    SPACE.check(features)
    back = FLATTEN(features)
    continuous = np.array(SPACE.levels) == 0
    np.testing.assert_allclose(back[continuous], np.array(u)[continuous], atol=1e-6)
    again = UNFLATTEN(back)
    for name in ("alg", "rate", "gear", "one"):
        assert again[name] == features[name]
    np.testing.assert_allclose(again["cars"]["x"], features["cars"]["x"], atol=5e-6)
    np.testing.assert_array_equal(FLATTEN(again)[~continuous], back[~continuous])


UNFLATTEN = jax.jit(SPACE.unflatten)
FLATTEN = jax.jit(SPACE.flatten)


class TestTable:
    def frame(self, n=20):
        u = jax.random.uniform(jax.random.key(1), (n, SPACE.dim))
        features = jax.jit(jax.vmap(SPACE.unflatten))(u)
        return features, pd.DataFrame(SPACE.rows(features))

    def test_columns_are_those_of_the_table(self):
        features, frame = self.frame()
        assert tuple(frame.columns) == SPACE.columns
        assert set(frame["alg"]) == {"ppo", "sac"}
        assert set(frame["rate"]) == {0.1, 0.25}
        assert set(frame["cars[1].c"]) <= {"r", "g", "b"}
        np.testing.assert_array_equal(frame["cars[1].x"], features["cars"]["x"][:, 1])
        assert frame["z"].dtype == np.float32

    def test_rows_are_exactly_what_was_simulated(self, tmp_path):
        features, frame = self.frame()
        frame["rho"] = 0.5
        frame.to_csv(tmp_path / "table.csv", index=False)
        text = pd.read_csv(tmp_path / "table.csv")
        for i in (0, 7, 19):
            wanted = jax.tree.map(lambda leaf, i=i: leaf[i], features)
            for row in (frame.iloc[i], frame.iloc[i].to_dict(), text.iloc[i]):
                got = SPACE.from_row(row)
                assert list(got) == list(SPACE.domains)
                jax.tree.map(np.testing.assert_array_equal, got, wanted)
                assert jax.tree.map(lambda x: x.dtype, got) == jax.tree.map(
                    lambda x: x.dtype, wanted
                )

    def test_missing_columns_name_the_nearest(self):
        _, frame = self.frame()
        row = frame.iloc[0].drop("gear")
        row["gears"] = 2
        with pytest.raises(ValueError, match="column 'gear'; did you mean 'gears'"):
            SPACE.from_row(row)

    @pytest.mark.parametrize(
        ("column", "entry", "message"),
        [
            ("z", "fast", "z must be a number; got 'fast'"),
            ("gear", 2.5, "gear must be an integer; got 2.5"),
            ("gear", float("nan"), "gear must be an integer; got nan"),
            ("alg", "pp", "alg must be one of 'ppo', 'sac'; got 'pp'"),
            ("rate", 0.2, "rate must be one of 0.1, 0.25; got 0.2"),
        ],
    )
    def test_entries_of_the_wrong_kind(self, column, entry, message):
        row = {**self.frame()[1].iloc[0].to_dict(), column: entry}
        with pytest.raises(ValueError, match=message):
            SPACE.from_row(row)


WRITTEN = {
    "z": 0,
    "b": 1,
    "alg": "sac",
    "rate": 0.25,
    "gear": 2,
    "cars": {"x": [1, 2], "c": ["r", "b"]},
    "point": [0.5, 1],
    "one": 2,
}


class TestFeatures:
    @pytest.mark.thorough
    def test_as_a_person_writes_them(self):
        SPACE.check(WRITTEN)
        u = SPACE.flatten(WRITTEN)
        np.testing.assert_allclose(u[:5], [0.5, 1, 0.75, 0.75, 0.375])
        features = SPACE.coerce(WRITTEN)
        assert float(features["g"]) == pytest.approx(9.8)
        assert features["cars"]["c"].tolist() == [0, 2]
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6),
            features,
            SPACE.unflatten(u),
        )

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"gears": 3}, "unknown feature 'gears'; did you mean 'gear'"),
            ({"gear": 7}, "gear must be an integer from 1 to 4; got 7"),
            ({"g": 1}, "g is a constant, 9.8; got 1"),
            ({"cars": {"x": [1, 99], "c": [0, 0]}}, r"cars\[1\].x must lie in \[0, 50\]; got 99"),
        ],
    )
    def test_what_is_wrong_is_refused_where_it_is_made(self, changes, message):
        with unchecked(), pytest.raises(ValueError, match=message):
            SPACE.coerce({**WRITTEN, **changes})

    def test_a_missing_feature_is_named(self):
        with pytest.raises(ValueError, match="point is missing"):
            SPACE.check({k: v for k, v in WRITTEN.items() if k != "point"})


class TestSpaces:
    def test_of_nothing_but_constants(self):
        space = FeatureSpace({"g": Constant(9.8)})
        assert (space.dim, space.columns) == (0, ())
        features = jax.vmap(space.unflatten)(jnp.zeros((3, 0)))
        assert features["g"].shape == (3,)
        assert space.rows(features) == {}
        assert space.flatten(space.from_row({})).shape == (0,)

    def test_with_200_features_trace_fast(self):
        space = FeatureSpace({f"w{i}": Box(-i - 1, i + 1) for i in range(200)})
        started = time.perf_counter()
        with unchecked():
            program = jax.make_jaxpr(space.unflatten)(jnp.zeros(200))
            back = jax.make_jaxpr(space.flatten)(jax.eval_shape(space.unflatten, jnp.zeros(200)))
        assert time.perf_counter() - started < 20
        # A slice each, and a handful of operations for them all.
        assert len(program.eqns) < 450
        assert len(back.eqns) < 450
        values = space.unflatten(jnp.full(200, 0.75))
        assert float(values["w199"]) == 100.0

    def test_are_values(self):
        assert FeatureSpace({"x": Box(0, 1)}) == FeatureSpace({"x": Box(0, 1)})
        assert hash(FeatureSpace({"x": Box(0, 1)})) == hash(FeatureSpace({"x": Box(0, 1)}))
        assert FeatureSpace({"x": Box(0, 1)}) != FeatureSpace({"x": Box(0, 2)})
        a, b = Box(0, 1), Box(0, 1)
        assert FeatureSpace({"x": a, "y": b}) != FeatureSpace({"y": b, "x": a})

    def test_print_themselves(self):
        assert repr(FeatureSpace({"x": Box(0, 1)})) == "FeatureSpace({'x': Box(0, 1)})"
        assert repr(SPACE).startswith("FeatureSpace({\n    'z': Box(-0.05, 0.05),\n")
        lines = SPACE.describe().splitlines()
        assert lines[1].split() == ["z", "Box(-0.05,", "0.05)", "1", "continuous"]
        assert lines[6].endswith("2 continuous, 2 discrete")
        page = FeatureSpace({"<x>": Categorical("a&b")})._repr_html_()
        assert "<td>&lt;x&gt;</td>" in page
        assert "a&amp;b" in page

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: FeatureSpace({}), "at least one field"),
            (
                lambda: FeatureSpace({"a.b": Box(0, 1), "a": Struct({"b": Box(0, 1)})}),
                "two features give the table column 'a.b'",
            ),
            (lambda: FeatureSpace({"x": 3}), "x must be a domain"),
            (lambda: FeatureSpace({"x": Box(0, 1)}, where=True), "where must be a function"),
            (lambda: SPACE["zz"], "unknown feature 'zz'; did you mean"),
            (lambda: SPACE.unflatten(jnp.zeros(3)), r"u must have shape \[12\].*got \[3\]"),
        ],
    )
    def test_what_is_wrong_is_refused_where_it_is_made(self, make, message):
        with unchecked(), pytest.raises((ValueError, TypeError), match=message):
            make()
