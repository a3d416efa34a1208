"""Rules for failure regions that are known."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

import verifai_jax as vj
from verifai_jax.addons.analysis._rules import rows_set_aside, rules
from verifai_jax.addons.analysis.conditions import Between, OneOf, Region, short_number
from verifai_jax.addons.analysis.data.columns import Column


def frame(n=4000, seed=0):
    """Uniform features; nothing fails yet."""
    g = np.random.default_rng(seed)
    return pd.DataFrame(
        {
            "x": g.random(n).astype(np.float32),
            "y": g.uniform(-1, 1, n),
            "colour": g.choice(["red", "orange", "blue", "green"], n),
            "lanes": g.integers(1, 5, n),
            "same": np.ones(n),
            "status": "ok",
        }
    )


def test_a_box_is_found_and_measured_on_other_rows():
    table = frame()
    table["violated"] = (table.x > 0.6) & (table.y <= -0.2)
    found = rules(table)
    assert len(found.rules) == 1
    rule = found.rules[0]
    by_feature = {c.feature: c for c in rule.conditions}
    assert set(by_feature) == {"x", "y"}  # nothing redundant
    assert by_feature["x"].above == pytest.approx(0.6, abs=0.005)
    assert by_feature["y"].upto == pytest.approx(-0.2, abs=0.01)
    assert rule.coverage > 0.98
    # Kept aside are four tenths of failing and safe rows; the interval is the binomial one.
    assert found.measured == pytest.approx(0.4 * 4000, abs=1)
    exact = binomtest(rule.precision.failures, rule.precision.simulations).proportion_ci()
    assert rule.precision.low == pytest.approx(exact.low, abs=1e-9)
    assert rule.precision.high == pytest.approx(exact.high, abs=1e-9)
    inside = rule.matches(table)
    assert np.mean(table["violated"][inside]) > 0.98
    assert str(found).startswith(f"x > {by_feature['x'].above:g} and y <= ")
    assert "95 % interval" in str(found)


def test_of_many_rows_a_sample_makes_the_rules_and_all_kept_aside_measure_them():
    table = frame(150_000)
    table["violated"] = (table.x > 0.6) & (table.y <= -0.2)
    found = rules(table)
    failing = int(table["violated"].sum())
    assert found.made == 20_000 + min(20_000, failing - round(0.4 * failing))
    assert found.measured == pytest.approx(60_000, abs=1)
    assert f"(made from {found.made:,} of 90,000 rows, measured on 60,000 rows kept" in str(found)
    by_feature = {c.feature: c for c in found.rules[0].conditions}
    assert set(by_feature) == {"x", "y"}
    assert by_feature["x"].above == pytest.approx(0.6, abs=0.002)
    # Rare failures all take part, so few as they are, and weights keep them rare.
    table["violated"] &= table.x > 0.997
    rare = rules(table)
    assert 20_000 < rare.made < 20_200
    assert rare.precision is not None
    assert rare.precision.estimate > 0.8


def test_unordered_values_and_whole_numbers():
    table = frame()
    table["violated"] = (table.colour == "orange") & (table.lanes == 3)
    assert rules(table).rules[0].words == "lanes = 3 and colour is orange"
    table["violated"] = (table.colour != "orange") & (table.lanes >= 3)
    assert rules(table).rules[0].words == "lanes > 2 and colour is not orange"
    table["violated"] = table.colour.isin(["orange", "blue"]) & (table.x > 0.5)
    only = rules(table, depth=2).rules
    # Two features are enough: the subset of colours is one condition.
    assert len(only) == 1
    assert only[0].words.endswith("colour is one of blue, orange")
    assert np.array_equal(rules(table).matches(table), only[0].matches(table))


def test_a_rule_is_bounded_on_both_sides_of_each_of_its_features():
    table = frame()
    table["violated"] = (abs(table.x - 0.5) < 0.2) & (abs(table.y) < 0.4) & (table.lanes == 2)
    (rule,) = rules(table, depth=3).rules
    assert [c.feature for c in rule.conditions] == ["x", "y", "lanes"]
    ends = [rule.conditions[0].above, rule.conditions[0].upto, rule.conditions[1].above]
    np.testing.assert_allclose(ends, [0.3, 0.7, -0.4], atol=0.06)
    assert rule.coverage > 0.9
    assert rule.precision.estimate > 0.9
    (rule,) = rules(table, depth=2).rules
    assert len(rule.conditions) == 2


def test_rare_and_scattered_failures():
    table = frame(20000)
    ball = (table.x - 0.8) ** 2 + (table.y / 2 - 0.2) ** 2 < 0.02**2
    table["violated"] = ball | ((table.x < 0.05) & (table.y > 0.8) & (table.colour == "red"))
    assert 30 < table["violated"].sum() < 100  # a few in a thousand
    found = rules(table, depth=4)
    assert len(found.rules) == 2
    assert found.coverage > 0.8
    assert found.precision.estimate > 0.5
    assert "together: " in str(found)
    assert np.array_equal(
        found.matches(table), found.rules[0].matches(table) | found.rules[1].matches(table)
    )
    assert len(found.table) == 2
    assert found.table["failures"].sum() <= found.table["rows"].sum()


@pytest.mark.parametrize("seed", range(3))
def test_the_numbers_are_those_of_the_rows_kept_aside(seed):
    table = frame(1500, seed)
    g = np.random.default_rng(seed)
    table["violated"] = ((table.x > 0.7) & (table.colour != "red")) ^ (g.random(1500) < 0.1)
    found = rules(table, seed=seed)
    failing = table["violated"].to_numpy()
    aside = table[rows_set_aside(failing, 0.4, seed)]
    assert len(aside) == found.measured
    assert aside["violated"].mean() == pytest.approx(failing.mean(), abs=0.01)
    for rule in (*found.rules, found):
        inside = rule.matches(aside)
        hits = int((inside & aside["violated"]).sum())
        assert rule.coverage == hits / aside["violated"].sum()
        assert (rule.precision.failures, rule.precision.simulations) == (hits, inside.sum())
    # Nothing is learned from them: with other features there, the rules are the same.
    other = table.copy()
    for verdict in (False, True):
        rows = aside.index[aside["violated"] == verdict]
        other.loc[rows, "x"] = g.permutation(other.loc[rows, "x"])
        other.loc[rows, "y"] = -1.0
    assert [r.words for r in rules(other, seed=seed).rules] == [r.words for r in found.rules]


def test_chance_is_not_described():
    table = frame(1000)
    table["violated"] = np.random.default_rng(7).random(1000) < 0.3
    # Whatever fits the rows looked at does not hold on those kept aside.
    found = rules(table)
    assert not found.rules
    assert found.unsupported
    assert str(found).startswith("no rule for the 3")
    assert "does not hold on those kept aside" in str(found)
    table["violated"] = np.arange(1000) % 2 == 0
    assert "no rule describes the failures of 'table'" in str(rules(table[["same", "violated"]]))


def test_too_few_failures_are_told_instead_of_rules(tmp_path):
    table = frame(200)
    for count in (1, 9):
        table["violated"] = table["x"] > np.sort(table["x"])[-1 - count]
        found = rules(table)
        assert not found.rules
        assert found.table.empty
        assert str(found).startswith(f"no rules for 'table': only {count} of 200 rows fail")
    found.plot(tmp_path / "none.png")
    table["violated"] = ~table["violated"]
    assert "only 9 of 200 rows are safe" in str(rules(table))
    table["violated"] = table["x"] > np.sort(table["x"])[-21]
    assert [c.feature for rule in rules(table).rules for c in rule.conditions] == ["x"]


@pytest.mark.parametrize("seed", range(4))
def test_no_rule_is_told_without_measured_rows_that_support_it(seed):
    table = frame(20000, seed)
    table["violated"] = np.random.default_rng(seed).permutation(20000) < 49
    for depth in (2, 4):
        found = rules(table, depth=depth, seed=seed)
        base = 49 / 20000
        for rule in found.rules:
            assert rule.precision.failures >= 3
            assert rule.precision.low > base
        text = str(found)
        assert "covers 0 %" not in text
        assert "no measured row inside" not in text
        assert found.rules or "no rule" in text


def test_absent_entries_fulfil_no_condition():
    table = frame(2000)
    table["violated"] = table["x"] > 0.5
    table.loc[table.index % 4 == 0, "x"] = np.nan
    found = rules(table)
    assert not found.matches(table)[table["x"].isna()].any()


def test_rows_without_a_verdict_are_no_evidence():
    table = frame(2000)
    table["violated"] = table["x"] > 0.5
    table.loc[table["y"] > 0, "status"] = "error"
    table.loc[table["y"] > 0, "violated"] = False
    assert [c.feature for r in rules(table).rules for c in r.conditions] == ["x"]


@pytest.mark.parametrize(
    ("least", "below", "near", "short"),
    [
        (0.3071, 0.3164, 0.31175, 0.31),
        (-0.5, 0.4, -0.05, 0.0),
        (0.0012341, 0.0012349, 0.0012345, 0.0012345),
        (1234.5, 1310.0, 1272.0, 1300.0),
        (-7.31, -7.29, -7.3, -7.3),
        (2.0, 3.0, 2.5, 2.0),
        (0.1, 0.1, 0.1, 0.1),
        (99.0, 101.0, 100.0, 100.0),
        (5e-324, 1e-323, 5e-324, 5e-324),
    ],
)
def test_short_numbers_part_the_same_values(least, below, near, short):
    assert short_number(least, below, near) == short


def test_rounding_covers_the_same_rows():
    g = np.random.default_rng(3)
    values = np.column_stack([g.random(300), g.integers(0, 6, 300).astype(float)])
    codes = np.zeros((300, 0), int)
    for low, high in g.random((50, 2)):
        region = Region((low / 2, 1.5), (0.6 + high / 3, 4.5), ())
        rounded = region.round(values, codes, (False, True))
        assert np.array_equal(region.covers(values, codes), rounded.covers(values, codes))
        assert rounded.above[1] == 1
        assert rounded.upto[1] == 4
        assert all(len(repr(end)) <= 8 for end in (*rounded.above, *rounded.upto))


def test_conditions_in_words():
    assert str(Between("x", 0.1, 0.5)) == "0.1 < x <= 0.5"
    assert str(Between("n", upto=4, integer=True)) == "n <= 4"
    column = Column("c", ordered=False, choices=("a", "b", "c", "d", "e"))
    assert str(OneOf(column, (2,))) == "c is c"
    assert str(OneOf(column, (0, 2, 3, 4))) == "c is not b"
    assert str(OneOf(column, (0, 4))) == "c is one of a, e"
    assert str(OneOf(column, (0, 1, 4))) == "c is none of c, d"


@pytest.mark.slow
def test_what_precision_means_depends_on_the_search():
    def system(features, key):
        return vj.Trace({"y": features["a"][None] - 0.25}, dt=1.0)

    problem = vj.Problem("p", {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}, system, "y >= 0")
    run = vj.falsify(problem, "uniform", 256, batch=256)
    assert "precision is the rate of failure inside" in str(rules(run))
    other = vj.falsify(problem, "cross_entropy", 256, batch=256)
    assert "no rate of failure: this search does not sample the prior" in str(rules(other))
    assert "may not be samples of the prior" in str(rules(run.table))
    stopped = vj.falsify(problem, "uniform", 256, batch=256, stop=vj.Stop(after=20))
    assert "was stopped by its own counterexamples" in str(rules(stopped))
    assert str(rules(run)) == str(rules(run))


def test_what_cannot_work_is_refused_with_the_reason():
    table = frame(100)
    table["violated"] = False
    with pytest.raises(ValueError, match="no row of 100 fails; search longer"):
        rules(table)
    table["violated"] = True
    with pytest.raises(ValueError, match="all of 100 rows fail; simulate more of the space"):
        rules(table)
    with pytest.raises(ValueError, match="held_out must lie between 0 and 1; got 1"):
        rules(table, held_out=1)
    with pytest.raises(ValueError, match="depth must be an integer of at least 1; got 0"):
        rules(table, depth=0)
    with pytest.raises(ValueError, match="the table is empty"):
        rules(table.iloc[:0])


@pytest.mark.slow
def test_pictures_are_drawn_and_written(tmp_path):
    from PIL import Image

    table = frame(500)
    for i, violated in enumerate(
        [
            (table.x > 0.5) & (table.colour == "red"),
            (table.x > 0.5) & (table.y > 0.1) & (table.lanes == 2),
            np.arange(500) % 2 == 0,
        ]
    ):
        table["violated"] = violated
        rules(table).plot(tmp_path / f"{i}.png")
        rules(table[["same", "violated"]]).plot(tmp_path / f"{i}.png")
        with Image.open(tmp_path / f"{i}.png") as image:
            assert image.size[0] > 300


def planted(seed, rows=2000):
    """Return a table whose failures depend on `turn` alone: 53 % above 5, 19 % elsewhere."""
    rng = np.random.default_rng(seed)
    table = pd.DataFrame(
        {
            "which": rng.integers(0, 2000, rows),
            "turn": rng.uniform(-45, 45, rows),
            "shade": rng.uniform(0, 1, rows),
            "grain": rng.integers(0, 2**20, rows),
        }
    )
    table["violated"] = rng.uniform(size=rows) < np.where(table["turn"] > 5, 0.53, 0.19)
    table["rho"] = np.where(table["violated"], -1.0, 1.0)
    table["status"] = "ok"
    return table


@pytest.mark.parametrize("seed", range(6))
def test_conditions_that_rows_kept_aside_do_not_support_are_dropped(seed):
    (rule,) = rules(planted(seed)).rules
    (condition,) = rule.conditions
    assert condition.feature == "turn"
    assert abs(condition.above - 5) < 4
    assert condition.upto == np.inf
    assert rule.coverage > 0.6
    assert rule.precision.low < 0.53 < rule.precision.high


@pytest.mark.slow
def test_a_random_key_is_never_in_a_rule():
    """Whole numbers of so many values need far more support than chance ever gives."""
    for seed in range(20):
        table = planted(seed, 400).drop(columns="turn")
        assert all(
            condition.feature != "grain"
            for rule in rules(table).rules
            for condition in rule.conditions
        )
    # Where failures do depend on such a number, the rule has it.
    table["violated"] = table["grain"] > 700_000
    assert "grain > 699149" in str(rules(table))
