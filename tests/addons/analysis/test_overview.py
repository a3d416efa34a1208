"""The overview of runs and tables, odd ones among them."""

import jax.numpy as jnp
import numpy as np
import pytest
from failing_table import failing_table
from PIL import Image

import verifai_jax as vj
from verifai_jax.addons.analysis.overview import TITLES, Analysis, Part, analyze


@pytest.fixture(scope="module")
def found():
    return analyze(failing_table(600))


def test_every_analysis_speaks(found):
    assert [part.name for part in found.parts] == list(TITLES)
    assert all(part.result is not None for part in found.parts[1:])
    text = str(found)
    for title in TITLES.values():
        assert f"\n{title}\n  " in text
    assert "violate the property" in text
    assert "colour is not red: covers" in text
    assert "failing depends on x (" in text
    assert found["rules"].rules[0].coverage > 0.9
    with pytest.raises(ValueError, match="unknown analysis 'rule'; did you mean 'rules'"):
        found["rule"]


def test_representatives_are_failures(found):
    rows = found.representatives
    assert rows
    assert found.samples.table.loc[rows, "violated"].all()


def test_features_in_one_table(found):
    features = found.table
    assert features.index[0] == "x"
    assert set(features.index) == {"x", "y", "colour", "lanes", "same"}
    assert features.loc["x", "max_failing"] == pytest.approx(0.3, abs=0.02)
    assert features.loc["colour", "occupied"] == 1
    assert np.isnan(features.loc["colour", "max_failing"])


def test_names_of_others_do_not_write_the_report(tmp_path):
    words = "```\n<script>alert(1)</script>\x1b[2J"
    text = Analysis("a\n# <b>", (Part("failures", words),), None).save(tmp_path).read_text()
    assert text.splitlines()[0] == "# a # &lt;b&gt;"
    # Whatever the words hold stays within their block.
    assert text.count("````") == 2
    assert text.index("````text") < text.index("<script>") < text.rindex("````")
    assert "\x1b" not in text


@pytest.mark.slow
def test_report_on_disk(found, tmp_path):
    report = found.save(tmp_path / "report")
    text = report.read_text()
    assert text.startswith("# table")
    names = "overview rules importance clusters pca frequent_patterns coverage"
    for name in names.split():
        assert f"({name}.png)" in text
        with Image.open(tmp_path / "report" / f"{name}.png") as image:
            assert image.size[0] > 200
    page = found._repr_html_()
    assert "<h4>Where it fails</h4>" in page
    assert "x &lt;= 0.3" in page or "&lt;= " in page


@pytest.mark.slow
@pytest.mark.parametrize("failing", ["none", "one", "three", "all", "any", "empty", "single"])
def test_odd_tables(failing, tmp_path):
    frame = failing_table(60)
    if failing in ("none", "all"):
        frame["violated"] = failing == "all"
    elif failing in ("one", "three"):
        frame["violated"] = np.arange(60) < {"one": 1, "three": 3}[failing]
    elif failing == "empty":
        frame = frame.iloc[:0]
    elif failing == "single":
        frame = frame.iloc[:1]
    found = analyze(frame)
    assert str(found).startswith("table\n\nFailures\n  ")
    assert found._repr_html_()
    assert found.save(tmp_path).exists()
    words = {part.name: part.words for part in found.parts}
    if failing == "none":
        assert words["rules"] == "skipped: no row fails"
        assert words["frequent_patterns"] == "skipped: no row fails"
        assert words["failures"].splitlines()[1].startswith("nearest: row ")
    if failing == "one":
        assert words["clusters"] == "skipped: only one row fails"
    if failing == "all":
        assert words["rules"].startswith("skipped: rules tell failing rows from safe ones, and all")
        assert found["clusters"] is not None
    if failing == "empty":
        assert list(words.values()) == [
            "nothing to analyse: the table is empty: there are no simulations to analyse"
        ]
        assert found.representatives == []
        assert len(found.table) == 0


def test_only_constant_columns():
    frame = failing_table(30)[["same", "rho", "violated", "status"]]
    found = analyze(frame)
    assert found["coverage"] is None
    assert "nothing varies" in str(found)


@pytest.mark.slow
def test_runs_are_described_by_their_search(tmp_path):
    def system(features, key):
        broken = features["a"] > 0.9
        y = jnp.where(broken, jnp.nan, features["a"] - 0.25 + 0 * features["b"])
        return vj.Trace({"y": y[None]}, dt=1.0)

    problem = vj.Problem("slope", {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}, system, "y >= 0")
    run = vj.falsify(problem, "uniform", 256, batch=256)
    text = repr(run.analyze())
    assert text.startswith("slope\n")
    assert "have no verdict" in text
    assert "failure rate 2" in text
    assert "precision is the rate of failure inside" in text
    active = vj.falsify(problem, "cross_entropy", 256, batch=256)
    assert "failure rate not given: this search goes where failures are" in str(analyze(active))
