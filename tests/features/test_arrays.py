"""Arrays of variable length: masks, the table, what absent items hold, what a person may write."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked

from verifai_jax.features import (
    Array,
    Box,
    Categorical,
    Constant,
    DiscreteBox,
    FeatureSpace,
    Items,
    Normal,
    Signal,
    Struct,
)
from verifai_jax.features.fixed import Fixed
from verifai_jax.testing import check_domain

CAR = Struct(
    {
        "x": Box(0, 50),
        "color": Categorical("r", "g", "b"),
        "gear": DiscreteBox(0, 3),
        "lights": Categorical(True, False),
    }
)
DOMAINS = [
    Array(CAR, length=(0, 2)),
    Array(Box([0, 0], [1, 2]), length=(1, 3)),
    Array(Normal(3, 1), length=(2, 2)),
    Array(Array(DiscreteBox(0, 4), length=(0, 2)), length=(1, 2)),
    Array(Array(Box(0, 1), length=(0, 2)), length=2),
    Array(Signal(Box(0, 1), 2), length=(1, 2)),
    Array(Categorical("a", "b", weights=[0.8, 0.2]), length=(0, 3)),
    Array(Constant(3), length=(0, 2)),
    Struct({"cars": Array(CAR, length=(0, 2)), "w": Signal(Normal(0, 1), 2), "k": Constant(1)}),
    Fixed(Array(CAR, length=(0, 2)), [{"x": 1, "color": "g", "gear": 2, "lights": True}]),
    Fixed(Box(0, 1), 0.5),
    Struct({"a": Constant(1), "b": Fixed(Categorical("a", "b"), "b")}),
]


@pytest.mark.thorough
@pytest.mark.parametrize("domain", DOMAINS, ids=repr)
def test_the_laws_of_domains_hold(domain):
    check_domain(domain)


SPACE = FeatureSpace({"cars": Array(CAR, length=(0, 2)), "n": Array(Box(0, 1), length=(1, 2))})


def test_coordinates():
    assert SPACE.levels == (3, 0, 3, 4, 2, 0, 3, 4, 2, 2, 0, 0)
    assert SPACE.lengths == (0, 9)
    assert SPACE.coordinates[:3] == ("cars.length", "cars[0].x", "cars[0].color")
    assert SPACE.coordinates == SPACE.columns
    assert SPACE.ordered == (True, True, False, True, False) + (
        (True, False, True, False) + (True,) * 3
    )
    nested = Array(Array(Box(0, 1), length=(0, 2)), length=(1, 2))
    assert nested.lengths == (0, 1, 4)
    assert Array(Box(0, 1), length=(2, 2)).levels == (0, 0)


def test_lengths_are_equally_likely_and_masks_follow():
    u = jax.random.uniform(jax.random.key(0), (6000, SPACE.dim))
    cars = jax.jit(jax.vmap(SPACE.unflatten))(u)["cars"]
    counts = np.bincount(cars.length)
    assert np.all(np.abs(counts - 2000) < 183)
    assert cars.mask.shape == (6000, 2)
    np.testing.assert_array_equal(cars.mask.sum(1), cars.length)
    np.testing.assert_array_equal(cars["x"], cars.values["x"])


@pytest.mark.slow
def test_absent_items_have_no_influence():
    u = jnp.linspace(0.05, 0.95, SPACE.dim).at[0].set(0.5)  # One car.
    other = u.at[5:9].set(0.01)  # All coordinates of the second.
    one, two = SPACE.unflatten(u), SPACE.unflatten(other)
    jax.tree.map(np.testing.assert_array_equal, one, two)
    slope = jax.grad(lambda u: jnp.sum(SPACE.unflatten(u)["cars"]["x"]))(u)
    np.testing.assert_allclose(slope[jnp.array([1, 5])], [50, 0])
    np.testing.assert_array_equal(one["cars"].mask, [True, False])
    # A value with anything behind its length is the same value.
    spoiled = Items({**one["cars"].values, "x": jnp.array([9.5, jnp.nan])}, jnp.int32(1))
    clean = Items({**one["cars"].values, "x": jnp.array([9.5, 25.0])}, jnp.int32(1))
    same = [SPACE.coerce({**one, "cars": cars})["cars"] for cars in (spoiled, clean)]
    jax.tree.map(np.testing.assert_array_equal, *same)
    assert np.all(np.isfinite(SPACE.flatten({**one, "cars": spoiled})))


class TestTable:
    def batch(self, lengths):
        u = jax.random.uniform(jax.random.key(1), (len(lengths), SPACE.dim))
        u = u.at[:, 0].set((jnp.array(lengths) + 0.5) / 3)
        return jax.vmap(SPACE.unflatten)(u)

    @pytest.mark.thorough
    def test_absent_entries_are_empty(self):
        rows = SPACE.rows(self.batch([0, 1, 2]))
        assert rows["cars[1].color"][0] is None
        table = pd.DataFrame(rows)
        assert table["cars.length"].tolist() == [0, 1, 2]
        for column in ("x", "color", "gear", "lights"):
            assert table[f"cars[0].{column}"].isna().tolist() == [True, False, False]
            assert table[f"cars[1].{column}"].isna().tolist() == [True, True, False]

    @pytest.mark.thorough
    def test_columns_have_the_same_kinds_in_every_batch(self):
        kinds = [
            {name: column.dtype for name, column in SPACE.rows(self.batch(lengths)).items()}
            for lengths in ([0, 0], [2, 2], [0, 2])
        ]
        assert kinds[0] == kinds[1] == kinds[2]
        assert kinds[0]["cars[1].gear"] == np.float64

    @pytest.mark.thorough
    @pytest.mark.parametrize("form", ["csv", "parquet"])
    def test_rows_come_back_exactly(self, form, tmp_path):
        features = self.batch([0, 1, 2, 1])
        table = pd.DataFrame(SPACE.rows(features))
        path = tmp_path / f"table.{form}"
        if form == "csv":
            table.to_csv(path, index=False)
            table = pd.read_csv(path)
        else:
            table.to_parquet(path)
            table = pd.read_parquet(path)
        for i in range(4):
            wanted = jax.tree.map(lambda leaf, i=i: leaf[i], features)
            again = SPACE.from_row(table.iloc[i])
            jax.tree.map(np.testing.assert_array_equal, again, wanted)
            assert jax.tree.map(jax.typeof, again) == jax.tree.map(jax.typeof, wanted)

    @pytest.mark.thorough
    def test_wrong_lengths(self):
        row = pd.DataFrame(SPACE.rows(self.batch([2]))).iloc[0].to_dict()
        for length in (3, 0.5, float("nan")):
            with pytest.raises(ValueError, match=r"cars.length must be an integer from 0 to 2; go"):
                SPACE.from_row({**row, "cars.length": length})


class TestWritten:
    @pytest.mark.thorough
    def test_lists_of_as_many_items_as_there_are(self):
        car = {"x": 25, "color": "b", "gear": 1, "lights": False}
        features = SPACE.coerce({"cars": [car], "n": [0.25, 1]})
        cars = features["cars"]
        assert int(cars.length) == 1
        assert [float(cars["x"][0]), int(cars["color"][0])] == [25, 2]
        np.testing.assert_allclose(SPACE.flatten(features)[:5], [0.5, 0.5, 5 / 6, 0.375, 0.75])
        assert int(SPACE.coerce({"cars": [], "n": [0]})["cars"].length) == 0
        stacked = {name: [entry] for name, entry in car.items()}
        again = SPACE.coerce({"cars": stacked, "n": [0.25, 1]})
        jax.tree.map(np.testing.assert_array_equal, again, features)

    def test_fixed_arrays_of_structures_item_by_item(self):
        space = FeatureSpace({"v": Array(Struct({"x": Box(0, 1)}), length=2)})
        assert space.coerce({"v": [{"x": 0.25}, {"x": 1}]})["v"]["x"].tolist() == [0.25, 1]

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            ([0.5, 0.5, 0.5], "n must have 1 to 2 items; got 3"),
            ([], "n must have 1 to 2 items; got 0"),
            (0.5, "n must be a list of items; got 0.5"),
            ("ab", "n must be a list of items; got 'ab'"),
            ([0.5, 2], r"n\[1\] must lie in \[0, 1\]; got 2"),
            (Items(jnp.zeros(2), jnp.int32(0)), "n must have 1 to 2 items; got 0"),
        ],
    )
    def test_what_is_wrong_is_refused_where_it_is_made(self, value, message):
        with unchecked(), pytest.raises(ValueError, match=message):
            SPACE.check({"cars": [], "n": value})

    @pytest.mark.thorough
    @pytest.mark.parametrize(
        "length", [(3, 1), (-1, 2), (0, 0), (1, 2, 3), (1.5, 2), (True, 2), ("a", "b")]
    )
    def test_refused_lengths(self, length):
        with unchecked(), pytest.raises(ValueError, match=r"variable length.*got \("):
            Array(Box(0, 1), length=length)
