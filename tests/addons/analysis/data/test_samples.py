import jax
import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked

from verifai_jax.addons.analysis.data.samples import Samples, generator
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.features import (
    Array,
    Box,
    Categorical,
    Constant,
    DiscreteBox,
    FeatureSpace,
    LogUniform,
    Normal,
    Signal,
    Struct,
    TruncatedNormal,
)


def table_of(**columns):
    """Rows 0 safe, 1 and 3 failing, 2 without a verdict."""
    table = ErrorTable(tuple(columns))
    rho = np.array([1.0, -1.0, np.nan, -2.0], np.float32)
    status = np.array(["ok", "ok", "timeout", "ok"], object)
    columns = {name: np.array(values) for name, values in columns.items()}
    table.append({**columns, "rho": rho, "violated": rho < 0, "status": status})
    return table


def run_of(table):
    return Run("mine", {}, table, "uniform()", 0, 4, "budget", 0.0, 1.0, "0", prior=True)


@pytest.mark.parametrize(
    ("which", "rows"),
    [("counterexamples", [1, 3]), ("safe", [0]), ("failed", [2]), ("all", [0, 1, 3])],
)
def test_rows_are_row_numbers_of_the_table(which, rows):
    table = table_of(x=[0.0, 1.0, 2.0, 3.0])
    for source in (run_of(table), table, table.all):
        samples = Samples.of(source, which)
        assert samples.rows.tolist() == rows
        assert samples.values()[:, 0].tolist() == rows
        assert samples.names == ("x",)


def test_numbers_of_rows_survive_another_order_of_the_frame():
    frame = table_of(x=[0.0, 1.0, 2.0, 3.0]).all.iloc[[3, 2, 0, 1]]
    samples = Samples.of(frame)
    assert samples.rows.tolist() == [3, 1]
    assert samples.frame["x"].tolist() == [3.0, 1.0]
    assert samples.failing.tolist() == [True, True]
    assert samples.rows[samples.worst] == 3
    assert Samples.of(frame, "all").failing.tolist() == [True, False, True]


def test_a_frame_is_judged_by_what_it_has():
    assert Samples.of(pd.DataFrame({"x": [0, 1], "rho": [1.0, -1.0]})).rows.tolist() == [1]
    assert Samples.of(pd.DataFrame({"x": [0, 1]})).rows.tolist() == [0, 1]
    frame = pd.DataFrame({"x": [0, 1], "rho": [0.0, 0.0], "violated": [True, False]})
    assert Samples.of(frame).rows.tolist() == [0]


def test_columns_without_a_space_are_as_their_entries_are():
    frame = pd.DataFrame(
        {
            "real": [0.5, 1.5],
            "whole": [1, 2],
            "text": ["b", "a"],
            "flag": [True, False],
            "rho.first": [-1.0, -2.0],
            "rho": [-1.0, -2.0],
            "status": ["ok", "ok"],
        }
    )
    samples = Samples.of(frame)
    assert [column.name for column in samples.ordered] == ["real", "whole"]
    assert [column.name for column in samples.unordered] == ["text", "flag"]
    assert samples.codes().tolist() == [[1, 1], [0, 0]]
    assert [column.integer for column in samples.ordered] == [False, True]
    assert Samples.of(frame, columns=["rho", "real"]).values().tolist() == [[-1, 0.5], [-2, 1.5]]


SPACE = FeatureSpace(
    {
        "gears": Categorical(6, 4, 5),
        "cars": Array(Struct({"x": Box(0, 50), "kind": Categorical("van", "bus")}), length=2),
        "count": DiscreteBox(1, 5),
        "point": Box([0, 0], [2, 4]),
        "g": Constant(9.8),
    }
)
ROWS = pd.DataFrame(
    {
        "gears": [4, 6],
        "cars[0].x": [10.0, 20.0],
        "cars[0].kind": ["van", "bus"],
        "cars[1].x": [5.0, 50.0],
        "cars[1].kind": ["van", "van"],
        "count": [1, 3],
        "point[0]": [1.0, 2.0],
        "point[1]": [1.0, 0.0],
        "rho": [-1.0, -1.0],
    }
)


def test_a_space_says_what_columns_are():
    samples = Samples.of(ROWS, space=SPACE)
    ordered = {column.name: (column.low, column.high) for column in samples.ordered}
    assert ordered == {
        "cars[0].x": (0, 50),
        "cars[1].x": (0, 50),
        "count": (1, 5),
        "point[0]": (0, 2),
        "point[1]": (0, 4),
    }
    assert [column.choices for column in samples.unordered] == [
        (6, 4, 5),
        ("van", "bus"),
        ("van", "bus"),
    ]
    assert samples.codes().tolist() == [[1, 0, 0], [0, 1, 0]]
    np.testing.assert_allclose(
        samples.matrix(), [[0.2, 0.1, 0, 0.5, 0.25], [0.4, 1.0, 0.5, 1.0, 0.0]]
    )


def test_columns_are_scaled_as_asked():
    frame = pd.DataFrame({"x": [1.0, 2.0, 4.0], "c": [7.0, 7.0, 7.0]})
    samples = Samples.of(frame)
    np.testing.assert_allclose(samples.matrix("rows"), [[0, 0], [1 / 3, 0], [1, 0]])
    standard = samples.matrix("standard")
    np.testing.assert_allclose(standard.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(standard.std(axis=0), [1, 0])
    np.testing.assert_allclose(samples.matrix("raw"), frame)
    # The range is that of the whole table, also where few rows are looked at.
    frame["rho"] = [1.0, -1.0, -1.0]
    np.testing.assert_allclose(Samples.of(frame).matrix()[:, 0], [1 / 3, 1])


def test_distances_of_mixed_rows():
    rng = np.random.default_rng(0)
    n = 30
    frame = pd.DataFrame(
        {
            "x": rng.uniform(0, 1, n),
            "item": np.where(rng.uniform(size=n) < 0.3, np.nan, rng.uniform(0, 1, n)),
            "a": rng.choice(["p", "q", "r"], n),
            "b": pd.Series(rng.choice([True, False], n)),
        }
    )
    frame.loc[0, ["x", "item"]] = 0.0
    frame.loc[1, ["x", "item"]] = 1.0
    points = Samples.of(frame).points()
    squared = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    for i in range(n):
        for j in range(n):
            one, two = frame.loc[i], frame.loc[j]
            expected = (one["x"] - two["x"]) ** 2 + (one["a"] != two["a"]) + (one["b"] != two["b"])
            gone = [np.isnan(one["item"]), np.isnan(two["item"])]
            if not any(gone):
                expected += (one["item"] - two["item"]) ** 2
            if any(gone) and not all(gone):
                assert expected + 0.75 - 1e-9 <= squared[i, j] <= expected + 1 + 1e-9
            else:
                assert squared[i, j] == pytest.approx(expected)


def test_absent_entries():
    frame = pd.DataFrame({"x": [0.0, np.nan, 1.0, 0.5], "c": ["a", None, "b", "a"]})
    samples = Samples.of(frame)
    assert samples.matrix()[:, 0].tolist() == [0.0, 0.5, 1.0, 0.5]
    assert samples.codes()[:, 0].tolist() == [0, -1, 1, 0]
    assert np.isfinite(samples.points()).all()


def test_a_float32_choice_is_the_choice():
    space = FeatureSpace({"dt": Categorical(0.1, 0.2)})
    frame = pd.DataFrame({"dt": np.array([0.2, 0.1], np.float32)})
    assert Samples.of(frame, space=space).codes()[:, 0].tolist() == [1, 0]
    with pytest.raises(ValueError, match=r"holds 0.3, which is not one of its choices 0.1, 0.2"):
        Samples.of(pd.DataFrame({"dt": [0.3]}), space=space).codes()


def test_empty_parts_say_what_there_is():
    table = table_of(x=[0.0, 1.0, 2.0, 3.0])
    safe_only = table.all.loc[[0, 2]]
    with pytest.raises(
        ValueError,
        match=r"no counterexamples among 2 simulations \(0 failing, 1 safe, 1 without",
    ):
        Samples.of(safe_only)
    with pytest.raises(ValueError, match="the table is empty: there are no simulations"):
        Samples.of(ErrorTable(("x",)))


def test_what_is_wrong_is_refused_where_it_is_made():
    frame = pd.DataFrame({"speed": [1.0], "alg": ["a"]})
    with pytest.raises(UnknownNameError, match="unknown column 'sped'; did you mean 'speed'"):
        Samples.of(frame, columns=["sped"])
    with (
        unchecked(),
        pytest.raises(ValueError, match=r"must be one of 'counterexamples', 'safe', .*got 'good'"),
    ):
        Samples.of(frame, "good")  # pyright: ignore[reportArgumentType]
    with (
        unchecked(),
        pytest.raises(TypeError, match="come from a run, its table or a DataFrame; got list"),
    ):
        Samples.of([1, 2])  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="'alg' is named twice"):
        Samples.of(frame, columns=["alg", "speed", "alg"])
    with pytest.raises(ValueError, match="no column to analyse"):
        Samples.of(frame, columns=[])
    with pytest.raises(ValueError, match="a list of names; got 'speed'"):
        Samples.of(frame, columns="speed")
    with pytest.raises(ValueError, match="unique integers; reset_index"):
        Samples.of(pd.concat([frame, frame]))
    with pytest.raises(ValueError, match="'speed' is infinite in row 1"):
        Samples.of(pd.DataFrame({"speed": [1.0, np.inf]}))
    with (
        unchecked(),
        pytest.raises(ValueError, match=r"scale must be one of 'range', 'rows', .*got 'log'"),
    ):
        Samples.of(frame).matrix("log")  # pyright: ignore[reportArgumentType]
    with pytest.raises(UnknownNameError, match="unknown column 'gears'"):
        Samples.of(frame, space=SPACE)
    with pytest.raises(ValueError, match=r"PCA needs an ordered column \(numbers\); alg is unord"):
        Samples.of(frame, columns=["alg"]).need_ordered("PCA")
    with pytest.raises(IndexError, match="row 7 is not in the table of 1 rows"):
        Samples.of(frame).at([0, 7])


def test_other_rows_of_the_same_table():
    table = table_of(x=[0.0, 1.0, 2.0, 3.0], y=[0.0, 1.0, 2.0, 3.0])
    samples = Samples.of(table, columns=["y"])
    assert samples.others("safe").rows.tolist() == [0]
    assert samples.others("safe").names == ("y",)
    assert Samples.of(samples) is samples
    assert Samples.of(samples, columns=["x"]).names == ("x",)
    assert samples.kind == "2 counterexamples of table"
    assert samples.others("safe").kind == "1 safe row of table"


def test_a_seed_or_a_key_makes_the_same_generator():
    draws = [generator(seed).uniform() for seed in (3, 3, 4)]
    assert draws[0] == draws[1] != draws[2]
    keyed = [generator(jax.random.key(seed)).uniform() for seed in (3, 3, 4)]
    assert keyed[0] == keyed[1] != keyed[2]
    with pytest.raises(ValueError, match="the seed must be an integer of at least 0; got -1"):
        generator(-1)


@pytest.mark.thorough
def test_columns_of_every_kind_of_domain():
    item = Struct({"x": Normal(0, 1), "n": DiscreteBox(1, 9), "g": Categorical(3, 1)})
    space = FeatureSpace(
        {
            "free": Normal(10, 2),
            "cut": TruncatedNormal(0, 1, -2, 2),
            "rate": LogUniform(1e-3, 10),
            "alg": Categorical("ppo", "sac", weights=[0.75, 0.25]),
            "cars": Array(item, length=(0, 2)),
            "wind": Signal(Box(-1, 1), knots=2),
        }
    )
    rows = {
        "free": [9.0, 11.0],
        "cut": [0.0, 1.0],
        "rate": [0.1, 1.0],
        "alg": ["ppo", "sac"],
        "cars.length": [0, 1],
        "cars[0].x": [np.nan, 0.5],
        "cars[0].n": [None, 3],
        "cars[0].g": [np.nan, 1.0],
        "cars[1].x": [np.nan, np.nan],
        "cars[1].n": [None, None],
        "cars[1].g": [None, None],
        "wind[0]": [0.0, 0.5],
        "wind[1]": [0.5, 0.0],
    }
    samples = Samples.of(pd.DataFrame(rows), space=space)
    assert samples.names == space.columns
    columns = {column.name: column for column in samples.columns}
    ranges = {name: (c.near, c.far) for name, c in columns.items() if c.ordered}
    assert ranges.pop("free") == pytest.approx((10 - 3.09 * 2, 10 + 3.09 * 2), abs=0.01)
    for place in (0, 1):
        assert ranges.pop(f"cars[{place}].x") == pytest.approx((-3.09, 3.09), abs=0.01)
    assert columns["free"].low < 2 < 18 < columns["free"].high
    expected = {
        "cut": (-2, 2),
        "rate": (1e-3, 10),
        "cars.length": (0, 2),
        "cars[0].n": (1, 9),
        "cars[1].n": (1, 9),
        "wind[0]": (-1, 1),
        "wind[1]": (-1, 1),
    }
    assert set(ranges) == set(expected)
    for name, ends in expected.items():
        assert ranges[name] == pytest.approx(ends)
    assert [name for name, column in columns.items() if column.length] == ["cars.length"]
    assert columns["alg"].prior == pytest.approx((0.75, 0.25))
    # An item is there only in some simulations: its choices are rarer than their weights.
    assert columns["cars[0].g"].prior is None
    assert columns["cars[0].g"].choices == columns["cars[1].g"].choices == (3, 1)
    assert samples.codes().tolist() == [[0, -1, -1], [1, 1, -1]]
    assert np.isfinite(samples.points()).all()
