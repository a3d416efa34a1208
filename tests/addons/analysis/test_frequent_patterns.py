import importlib
from itertools import combinations, product

import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked

from verifai_jax.addons.analysis import frequent_patterns
from verifai_jax.features import Box, Categorical, DiscreteBox, FeatureSpace

SPACE = FeatureSpace(
    {
        "weather": Categorical("clear", "rain", "fog"),
        "controller": Categorical("ppo", "sac"),
        "gear": Categorical(5, 3, 4),
        "speed": Box(0, 40),
        "lanes": DiscreteBox(1, 3),
    }
)


def driving(n=600, seed=0):
    """Fails in fog under sac, rarely elsewhere."""
    rng = np.random.default_rng(seed)
    frame = pd.DataFrame(
        {
            "weather": rng.choice(["clear", "rain", "fog"], n),
            "controller": rng.choice(["ppo", "sac"], n),
            "gear": rng.choice([3, 4, 5], n),
            "speed": rng.uniform(0, 40, n),
            "lanes": rng.integers(1, 4, n),
        }
    )
    bad = (frame["weather"] == "fog") & (frame["controller"] == "sac")
    return frame.assign(rho=np.where(rng.uniform(size=n) < np.where(bad, 0.9, 0.05), -1.0, 1.0))


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("minimum", [0.01, 0.2])
def test_agrees_with_counting_all_combinations(size, minimum):
    frame = driving()
    failing = frame[frame["rho"] < 0]
    names = ["weather", "controller", "gear"]
    expected = {}
    for count in range(1, size + 1):
        for columns in combinations(names, count):
            for values in product(*(SPACE[name].choices for name in columns)):
                part = (failing[list(columns)] == list(values)).all(axis=1)
                whole = (frame[list(columns)] == list(values)).all(axis=1)
                if part.mean() >= minimum:
                    text = ", ".join(f"{c}={v}" for c, v in zip(columns, values, strict=True))
                    expected[text] = (part.sum(), part.mean(), whole.mean())
    found = frequent_patterns(frame, size=size, minimum=minimum, space=SPACE)
    table = found.table.set_index("combination")
    assert set(table.index) == set(expected)
    for text, (count, share, whole) in expected.items():
        assert table.loc[text, "count"] == count
        assert table.loc[text, "share"] == pytest.approx(share)
        assert table.loc[text, "expected"] == pytest.approx(whole)
        assert table.loc[text, "lift"] == pytest.approx(share / whole)
    assert table["size"].is_monotonic_increasing


def test_finds_what_fails():
    frame = driving()
    found = frequent_patterns(frame, space=SPACE)
    assert found.top == {
        "weather": "fog",
        "controller": "sac",
        "gear": frame[frame["rho"] < 0]["gear"].mode()[0],
    }
    assert found.distinctive["combination"].iloc[0] == "weather=fog, controller=sac"
    rate = (frame["rho"] < 0).mean()
    bad = frame[(frame["weather"] == "fog") & (frame["controller"] == "sac")]
    # The lift is how many times as often as on average rows with these values fail.
    assert found.distinctive["lift"].iloc[0] == pytest.approx((bad["rho"] < 0).mean() / rate)


def test_rows_are_row_numbers_of_the_table():
    frame = driving()
    found = frequent_patterns(frame, space=SPACE)
    place = found.table["combination"].tolist().index("weather=fog, controller=sac")
    rows = frame.loc[found.rows(place)]
    assert len(rows) == found.table["count"][place]
    assert (rows["weather"] == "fog").all()
    assert (rows["controller"] == "sac").all()
    assert (rows["rho"] < 0).all()
    with pytest.raises(IndexError, match="combination 99 is not among the"):
        found.rows(99)


def test_values_lists_choices_that_never_occur():
    frame = pd.DataFrame({"weather": ["fog", "fog"], "controller": ["ppo", "sac"], "rho": -1.0})
    space = FeatureSpace({"weather": SPACE["weather"], "controller": SPACE["controller"]})
    values = frequent_patterns(frame, space=space).values
    assert values["value"].tolist() == ["fog", "clear", "rain", "ppo", "sac"]
    assert values["count"].tolist() == [2, 0, 0, 1, 1]


def test_compares_with_the_prior_where_there_are_only_failures():
    frame = driving()
    failing = frame[frame["rho"] < 0]
    found = frequent_patterns(failing, space=SPACE, bins=4, size=3)
    assert found.against == "prior"
    table = found.table.set_index("combination")
    expected = {
        "weather=fog, controller=sac": 1 / 6,
        "gear=3": 1 / 3,
        "lanes=2": 1 / 3,
        "speed in [10, 20)": 1 / 4,
        "weather=fog, controller=sac, speed in [30, 40]": 1 / 24,
    }
    for text, share in expected.items():
        assert table.loc[text, "expected"] == pytest.approx(share)
    nothing = frequent_patterns(failing)
    assert nothing.against == "nothing"
    assert nothing.table["lift"].isna().all()
    with pytest.raises(ValueError, match="prior of every column; that of weather is not known"):
        frequent_patterns(failing, against="prior")


def test_cells_of_numbers():
    frame = pd.DataFrame({"x": [0.0, 1.0, 2.0, 3.9, 4.0, np.nan], "n": [1, 2, 3, 4, 5, 6]})
    values = frequent_patterns(frame, bins=4, minimum=0.01).values
    keys = values["column"] + ":" + values["value"].astype(str)
    counts = dict(zip(keys, values["count"], strict=True))
    assert {key: count for key, count in counts.items() if key.startswith("x")} == {
        "x:[0, 1)": 1,
        "x:[1, 2)": 1,
        "x:[2, 3)": 1,
        "x:[3, 4]": 2,
    }
    assert [counts[f"n:{cell}"] for cell in ("[1, 2.25)", "[2.25, 3.5)", "[4.75, 6]")] == [2, 1, 2]
    space = FeatureSpace({"n": DiscreteBox(1, 7)})
    expected = frequent_patterns(frame[["n"]], bins=4, minimum=0.01, space=space).table
    prior = dict(zip(expected["combination"], expected["expected"], strict=True))
    assert prior["n in [1, 2.5)"] == pytest.approx(2 / 7)
    assert prior["n in [4, 5.5)"] == pytest.approx(2 / 7)
    assert prior["n in [2.5, 4)"] == pytest.approx(1 / 7)


def test_absent_items_have_no_value():
    frame = pd.DataFrame({"a": ["p", "p", None, "q"], "b": ["u", "u", "u", "u"]})
    table = frequent_patterns(frame, minimum=0.01).table.set_index("combination")
    assert table["count"].to_dict() == {
        "b=u": 4,
        "a=p": 2,
        "a=q": 1,
        "a=p, b=u": 2,
        "a=q, b=u": 1,
    }


def test_size_beyond_the_columns_is_all_of_them():
    frame = driving(60)
    wide = frequent_patterns(frame, size=9, minimum=0.01, space=SPACE)
    assert wide.table.equals(frequent_patterns(frame, size=3, minimum=0.01, space=SPACE).table)


def test_what_is_wrong_is_refused_where_it_is_made(monkeypatch):
    frame = driving(60)
    with pytest.raises(ValueError, match=r"without bins=\.\.\. needs an unordered column"):
        frequent_patterns(frame, columns=["speed"])
    with pytest.raises(ValueError, match="minimum is a share, above 0 and at most 1; got 5"):
        frequent_patterns(frame, minimum=5)
    with pytest.raises(ValueError, match="size must be an integer of at least 1; got 0"):
        frequent_patterns(frame, size=0)
    with (
        unchecked(),
        pytest.raises(ValueError, match="against must be 'auto', 'table' or 'prior'; got 'safe'"),
    ):
        frequent_patterns(frame, against="safe")  # pyright: ignore[reportArgumentType]
    # The package has a function of that name.
    module = importlib.import_module("verifai_jax.addons.analysis._frequent_patterns")
    monkeypatch.setattr(module, "MAX_COMBINATIONS", 5)
    with pytest.raises(ValueError, match=r"more than 5 combinations of up to 2 values .*raise min"):
        frequent_patterns(frame, minimum=0.01)


@pytest.mark.thorough
@pytest.mark.parametrize("which", ["counterexamples", "safe", "all"])
def test_tells_and_draws(which, tmp_path):
    found = frequent_patterns(driving(), which=which, space=SPACE)
    text = str(found)
    assert "most frequent: weather=" in text
    if which == "counterexamples":
        assert "weather=fog, controller=sac: " in text
        assert "times the share among all rows" in text
    found.plot(tmp_path / "values.png")
    assert (tmp_path / "values.png").stat().st_size > 1000
    rare = frequent_patterns(pd.DataFrame({"a": ["p", "q", "r"]}), minimum=0.9)
    assert len(rare.table) == 0
    rare.plot()
    assert "0 values and 0 combinations" in str(rare)
