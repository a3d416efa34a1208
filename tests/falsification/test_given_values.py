"""What a person writes is what is simulated, in whatever form, or it is refused by name."""

from decimal import Decimal
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.features.given import given_features

SPACE = {
    "wind": vj.Normal(0, 1),
    "load": vj.TruncatedNormal(0, 1, -8, 8),
    "mass": vj.LogNormal(0, 1),
    "side": vj.Box(0, 1),
    "count": vj.DiscreteBox(0, 9),
    "size": vj.Categorical(2, 1, 0, "auto"),
}
NUMBERS = ["wind", "load", "mass", "side"]
ROW = {"wind": 5.0, "load": 5.5, "mass": 300.1, "side": 0.1, "count": 3, "size": 2}


def system(f, key):
    return vj.Trace({name: f[name] * jnp.ones(2) for name in NUMBERS}, dt=1.0)


PROBLEM = vj.Problem("given", SPACE, system, "wind < 4.5 & load < 6 & mass < 1e4 & side < 2")
BLACK_BOX = vj.Problem(
    "given",
    SPACE,
    vj.blackbox(lambda f: vj.Trace({name: np.full(2, f[name]) for name in NUMBERS}, dt=1.0)),
    "wind < 4.5 & load < 6 & mass < 1e4 & side < 2",
)


def numbers(precision):
    return np.array([ROW[name] for name in NUMBERS], precision).tolist()


def as_forms(rows):
    frame = pd.DataFrame(rows)
    yield rows
    yield frame
    yield [row for _, row in frame.iterrows()]
    yield list(frame.itertuples(index=False))
    yield [{**row, "rho": 1.0, "status": "ok"} for row in rows]


@pytest.mark.slow
@pytest.mark.parametrize("problem", [PROBLEM, BLACK_BOX], ids=["traced", "black box"])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_every_form_is_simulated_as_it_is(problem, precision):
    rows = [ROW, ROW | {"wind": 4.0, "load": -7.25, "size": "auto"}, ROW | {"wind": 7.0, "size": 0}]
    wanted = {name: np.array([row[name] for row in rows], precision) for name in NUMBERS}
    for given in as_forms(rows):
        table = vj.simulate(problem, given, precision=precision, batch=4).table.all
        for name in NUMBERS:
            np.testing.assert_array_equal(table[name], wanted[name])
        assert table["size"].tolist() == ["2", "auto", "0"]
        assert table["count"].tolist() == [3, 3, 3]
        rho = np.min([4.5 - wanted["wind"], 6 - wanted["load"]], axis=0)
        np.testing.assert_allclose(table["rho"], np.minimum(rho, 1.9), rtol=1e-6)
        # The row of a table is one more form.
        again = vj.simulate(problem, table, precision=precision, batch=4).table.all
        assert again.equals(table)
    one = vj.simulate(problem, table.loc[2], precision=precision, batch=4).table.all
    assert one.loc[0].equals(table.loc[2].rename(0))


@pytest.mark.slow
def test_rows_before_a_search(tmp_path):
    options = {"batch": 8, "folder": tmp_path / "run"}
    run = vj.falsify(PROBLEM, vj.Start("cross_entropy", rows=[ROW]), 16, **options)
    assert run.table.all.loc[0, NUMBERS].tolist() == numbers("float32")
    assert run.table.all.loc[0, "verdict"] == "confirmed"
    assert (
        vj.resume(tmp_path / "run", PROBLEM, budget=24)
        .table.all.head(1)
        .equals(run.table.all.head(1))
    )


@pytest.mark.slow
def test_nominal_values_are_held_as_they_are():
    problem = vj.Problem("given", SPACE, system, "side < 2", nominal=ROW)
    held = problem.only("count")
    for precision in ("float32", "float64"):
        table = vj.falsify(held, "uniform", 2, batch=2, precision=precision).table.all
        assert (
            table.loc[0, NUMBERS].tolist()
            == np.array([ROW[n] for n in NUMBERS], precision).tolist()
        )
        assert set(table["size"]) == {"2"}
        assert vj.simulate(held, table, precision=precision).table.all.equals(
            table.drop(columns="verdict")
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"load": 9.0}, r"load must lie in \[-8, 8\]; got 9; the nearest value is 8"),
        ({"wind": float("nan")}, "wind must be finite; got nan"),
        ({"wind": 1e39}, r"wind must fit into float32; got 1e\+39"),
        ({"mass": 0.0}, "mass must be finite and above 0; got 0"),
        ({"side": 1.01}, r"side must lie in \[0, 1\]; got 1.01; the nearest value is 1"),
        ({"side": "0.5"}, "side must be a number"),
        ({"count": 2.5}, "count must be an integer"),
        ({"count": 10}, "count must be an integer from 0 to 9; got 10; the nearest value is 9"),
        ({"count": 2**40}, "count must"),
        ({"size": 3}, "size must be one of 2, 1, 0, 'auto'; got 3"),
        ({"size": True}, "size must be one of 2, 1, 0, 'auto'; got True"),
        ({"side": None}, "side must"),
    ],
)
def test_what_is_outside_is_refused_in_every_form(change, message):
    rows = [ROW, ROW | change]
    for given in as_forms(rows):
        with pytest.raises(ValueError, match=message) as caught:
            vj.simulate(PROBLEM, given)
        assert "row 1: " in str(caught.value) or "integer; got" in str(caught.value)
    with pytest.raises(ValueError, match=message):
        vj.Problem("given", SPACE, system, "side < 2", nominal=ROW | change)
    with pytest.raises(ValueError, match=message):
        vj.falsify(PROBLEM, vj.Start(run=pd.DataFrame(rows).assign(rho=1.0)))


def test_other_forms_are_refused():
    with pytest.raises(TypeError, match=r"with pandas.read_csv first\); got 'rows.csv'"):
        vj.simulate(PROBLEM, "rows.csv")
    with pytest.raises(ValueError, match="row 0: features must be a dictionary, or a row of a tab"):
        vj.simulate(PROBLEM, [(1.0, 2.0), (3.0, 4.0)])
    with pytest.raises(ValueError, match="unknown feature 'winds'"):
        vj.simulate(PROBLEM, ROW | {"winds": 1.0})
    cars = vj.Problem(
        "cars",
        {"cars": vj.Array(vj.Box(0, 9), length=(1, 2))},
        lambda f, key: vj.Trace({"x": f["cars"].values}, dt=1.0),
        "x < 99",
    )
    frame = pd.DataFrame({"cars.length": [2, 1], "cars[0]": [1.0, 2.0], "cars[1]": [3.0, 4.0]})
    with pytest.raises(
        ValueError, match=r"row 1: cars\[1\] must be empty where cars.length is 1; got 4.0"
    ):
        vj.simulate(cars, frame)


@pytest.mark.parametrize(
    ("choices", "value", "choice"),
    [
        ((2, 1, 0, "auto"), 2, "2"),
        ((2, 1, 0, "auto"), np.int64(0), "0"),
        ((2, 1, 0, "auto"), 2.0, "2"),
        ((2, 1, 0, "auto"), "2", "2"),
        ((16, 64, "auto"), 64, "64"),
        ((16, 64, "auto"), 0, None),
        (("2", "1", "0"), 2, "2"),
        (("slow", "fast"), 1, "fast"),
        (("slow", "fast"), 2, None),
        (((1, 2), (3, 4)), (3, 4), "(3, 4)"),
    ],
)
def test_a_number_is_the_choice_before_it_is_an_index(choices, value, choice):
    domain = vj.Categorical(*choices)
    if choice is None:
        with pytest.raises(ValueError, match=f"c must be one of .*; got {value}"):
            domain.check(value, "c")
        return
    if not isinstance(value, tuple):
        domain.check(value, "c")
    else:
        value = choices[1]
        assert domain._index_of(value) == 1
        return
    index = domain.coerce(value)
    assert domain.to_columns(np.asarray(index)[None], "c")["c"].tolist() == [choice]
    # What a system sees is an index as ever.
    assert int(domain.coerce(jnp.int32(0))) == int(domain.coerce(np.array(0, np.int32))) == 0


@pytest.mark.thorough
def test_numbers_of_other_types_are_simulated_or_refused_by_name():
    written = {"wind": Decimal("0.5"), "load": Fraction(1, 4), "mass": np.array(2.0, object)}
    row = ROW | written | {"side": np.float16(0.5), "count": Decimal(3)}
    (found,) = vj.simulate(BLACK_BOX, [row], progress=False).table.all[NUMBERS].to_numpy().tolist()
    assert found == [0.5, 0.25, 2.0, 0.5]
    with pytest.raises(ValueError, match="wind must be a number; got 1000"):
        vj.simulate(BLACK_BOX, [ROW | {"wind": 10**400}])


@pytest.mark.thorough
def test_a_column_that_is_there_twice_is_refused():
    frame = pd.DataFrame([[*ROW.values(), 3.0]], columns=[*ROW, "wind"])
    for rows in (frame, frame.iloc[0]):
        with pytest.raises(ValueError, match="there are 2 columns 'wind', and nothing says which"):
            vj.simulate(BLACK_BOX, rows)
    # Of others nothing is taken.
    other = pd.DataFrame([[*ROW.values(), 1, 2]], columns=[*ROW, "note", "note"])
    assert len(vj.simulate(BLACK_BOX, other, progress=False).table) == 1


@pytest.mark.thorough
def test_a_frame_without_rows_is_as_a_list_without():
    frame = pd.DataFrame([ROW]).iloc[:0]
    for rows in ([], frame):
        with pytest.raises(ValueError, match="got no rows"):
            vj.simulate(BLACK_BOX, rows)
        run = vj.falsify(BLACK_BOX, vj.Start("uniform", rows=rows), 2, progress=False)
        assert run.failure_rate is not None
    with pytest.raises(ValueError, match="unknown column 'size'"):
        vj.simulate(BLACK_BOX, frame.drop(columns="size"))


ODD = {
    "wind": vj.Normal(5e9, 1e9),
    "count": vj.DiscreteBox(0, 9),
    "size": vj.Categorical(2, 1, 0, "auto"),
}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("wind", [1.0], "wind must be one (number|value in each row); got"),
        ("count", [1], "count must be one (integer|value in each row); got"),
        ("count", (1, 2), "count must be one (integer|value in each row); got"),
        ("count", range(2), "count must be one (integer|value in each row); got"),
        ("count", {"a": 1}, "count must be (a number|one value in each row); got {'a': 1}"),
        ("size", [2], "size must be one "),
        ("size", {2}, "size must be one "),
        ("wind", np.complex64(1), r"wind must be a number; got .*1\+0j"),
        ("wind", np.datetime64(1, "s"), "wind must be a number; got"),
        ("wind", np.timedelta64(1, "s"), "wind must be a number; got"),
    ],
)
@pytest.mark.parametrize("form", ["dictionary", "frame", "row"])
def test_what_is_no_single_number_is_named_in_every_form(form, name, value, message):
    row = {"wind": 5e9, "count": 3, "size": 2, name: value}
    rows = row
    if form != "dictionary":
        rows = pd.DataFrame({key: pd.Series([each], dtype=object) for key, each in row.items()})
        rows = rows.iloc[0] if form == "row" else rows
    with pytest.raises(ValueError, match=message):
        given_features(vj.FeatureSpace(ODD), rows)


@pytest.mark.parametrize(
    ("value", "wanted"),
    [(5_000_000_000, 5e9), (2**70, 2.0**70), (np.longdouble(7e9), 7e9), (np.array(6e9), 6e9)],
)
@pytest.mark.parametrize("framed", [False, True])
def test_numbers_of_every_type_and_size_are_taken(framed, value, wanted):
    row = {"wind": value, "count": np.array(3), "size": 2}
    rows = pd.DataFrame({k: pd.Series([v], dtype=object) for k, v in row.items()})
    found = given_features(vj.FeatureSpace(ODD), rows if framed else row)
    assert found["wind"].tolist() == [np.float32(wanted)]
    assert found["count"].tolist() == [3]
