"""Many requirements on many recordings: the verdicts of each alone, and what is said of all."""

import concurrent.futures
import hashlib
import json
from xml.etree import ElementTree

import jax
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import explain, judge, parse, read, read_requirements, robustness

TOML = """
[constants]
near = 1.5
[definitions]
slow = "speed < 3"

[[requirement]]
id = "gap"
text = "The car keeps its distance"
formula = "always dist > near"
unit = "m"
source = "ISO 15622, 6.2"

[[requirement]]
id = "brake"
formula = "G (dist < 2 -> F[0, 0.2] slow)"

[[requirement]]
id = "start"
formula = "dist >= 2"
"""


@pytest.fixture
def logs(tmp_path):
    (tmp_path / "requirements.toml").write_text(TOML)
    folder = tmp_path / "logs"
    (folder / "later").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for k, name in enumerate(["a.csv", "b.csv", "later/c.parquet"]):
        n = 50 + 10 * k
        columns = {"time": np.arange(n) * 0.1, "dist": 3 + k + rng.normal(size=n), "speed": 2.0}
        frame = pd.DataFrame(columns)
        frame.loc[0, "dist"] = 2.0
        path = folder / name
        frame.to_csv(path, index=False) if path.suffix == ".csv" else frame.to_parquet(path)
    (folder / "torn.csv").write_text("time,dist\n0,1\n0,2\n")
    return folder


@pytest.mark.slow
def test_a_fleet_has_the_verdicts_of_its_recordings_alone(logs, tmp_path):
    requirements = read_requirements(tmp_path / "requirements.toml")
    found = judge(requirements, logs)
    assert len(found.rows) == 12
    assert len(found.without_verdict) == 3
    for row in found.without_verdict:
        assert row.error.endswith(
            "torn.csv: sample times must increase; row 1 has 0 s and row 2 0 s"
        )
    formulas = {each.id: each.formula for each in requirements}
    with jax.enable_x64(True):
        for row in found.rows:
            if row.verdict:
                trace = read(row.file)
                assert row.robustness == robustness(formulas[row.requirement], trace)
                why = explain(formulas[row.requirement], trace)
                assert (row.verdict == "holds") == why.holds
                assert row.instant == pytest.approx(why.time)
                assert str(why.predicate) in row.explanation
    assert [row.verdict for row in found.of("start")] == ["holds"] * 3
    assert all(row.robustness == 0 for row in found.of("start"))
    assert found.table.columns[0] == "file"
    spread = found.quantiles((0.0, 1.0))
    least = min(row.robustness for row in found.of("gap"))
    assert spread.loc["gap", "0"] == least
    assert found.failing[0].robustness == least
    assert "gap, brake, start on " in str(found)
    assert found.tightest is not None
    assert found.tightest.requirement == "gap"
    assert "<table" in found._repr_html_()

    suites = ElementTree.parse(found.junit(tmp_path / "out" / "junit.xml")).getroot()
    assert [suite.get("errors") for suite in suites] == ["1", "1", "1"]
    assert "ISO 15622, 6.2" in suites[0].findall(".//failure")[0].text
    page = found.report(tmp_path / "report.html").read_text()
    assert "ISO 15622, 6.2" in page
    assert "sample times must increase" in page
    claims = json.loads((tmp_path / "report.claims.json").read_text())
    assert claims["claims"][0]["claim"] == "gap fails on 1 of 3 recordings with a verdict."
    files = [path for path in logs.rglob("*") if path.is_file()]
    assert len(found.inputs) >= len(files)
    for path in files:
        content = path.read_bytes()
        (own,) = (each for each in found.inputs if each.name.endswith(path.name))
        assert own.role == f"a recording, {len(content):,} bytes"
        assert own.sha256 == hashlib.sha256(content).hexdigest()
        assert own.sha256 in page
    with concurrent.futures.ThreadPoolExecutor(1) as executor:
        assert judge(requirements, logs, run_on=vj.RunOn(executor=executor)) == found


def test_what_a_recording_lacks_is_said_for_the_requirement_alone():
    trace = Trace({"x": np.array([1.0, 2.0, np.nan]), "v": np.ones((3, 2))}, dt=0.5)
    found = judge(
        {"other": "y > 0", "vector": "v > 0", "period": "F[0,0.3] x > 0", "gap": "G x > 0",
         "strict": "F[0,1] norm(v) > 0", "longer": "F[0,9] norm(v) > 0"},
        {"log": trace}, end="strict", explain=False,
    )  # fmt: skip
    errors = {row.requirement: row.error for row in found.rows}
    assert errors["other"].startswith("the recording has no signal 'y'")
    assert "is a vector of 2 components" in errors["vector"]
    assert "0.3 s is not a multiple" in errors["period"]
    assert errors["gap"].startswith("the formula has no end")
    assert errors["strict"] == ""
    assert "looks 9 s ahead" in errors["longer"]
    (row,) = judge("x > 0 & X X x > 0", trace).rows
    assert row.error == "no verdict: signal 'x' is NaN at 1 s"
    with pytest.raises(ValueError, match="there is no recording to judge"):
        judge("x > 0", [])
    with pytest.raises(FileNotFoundError, match="there is no recording nowhere"):
        judge("x > 0", "nowhere")


def test_truncated_recordings_end_where_they_end():
    traces = [Trace({"x": np.arange(float(n)) - 1}, dt=1.0) for n in (2, 5)]
    for formula in ("F[3,4] x > 2", "G[3,4] x > 2", "F (x > 2)"):
        found = judge(formula, traces, end="truncate", explain=False)
        expected = [float(robustness(formula, trace, end="truncate")) for trace in traces]
        assert [row.robustness for row in found.rows] == expected


def test_outliers_are_unlike_the_others():
    traces = {f"log {k}": Trace({"x": np.array([2.0 + 0.1 * k])}, dt=1.0) for k in range(9)}
    traces["odd"] = Trace({"x": np.array([90.0])}, dt=1.0)
    found = judge({"x": "x > 1"}, traces, explain=False)
    assert list(found.outliers().file) == ["odd"]
    assert found.all_hold


def test_files_of_requirements(tmp_path):
    toml = tmp_path / "some.toml"
    toml.write_text(TOML)
    first, second, _ = read_requirements(toml)
    assert (first.id, first.unit, first.source) == ("gap", "m", "ISO 15622, 6.2")
    assert first.formula == parse("always dist > 1.5")
    assert second.formula == parse("G (dist < 2 -> F[0, 0.2] speed < 3)")
    assert read_requirements(toml, {"near": 9})[0].formula == parse("always dist > 9")
    table = tmp_path / "some.csv"
    table.write_text('id,formula,unit\ngap,"always[0, 4] dist > 1",m\nslow,G speed < 3,\n')
    assert [each.unit for each in read_requirements(table)] == ["m", ""]

    def refused(text, match, kind=ValueError):
        toml.write_text(text)
        with pytest.raises(kind, match=match):
            read_requirements(toml)

    refused('[[requirement]]\nid = "a"', "requirement 1 of .* has no formula")
    refused('[[requirement]]\nid = "a"\nformula = "x >"', "requirement 1 of .*, 'a': ")
    refused('[[requirement]]\nid = "a"\nformel = "x > 1"', "'formel'; did", UnknownNameError)
    refused('[[requirement]]\nid = 1\nformula = "x > 1"', "id must be a text; got 1")
    twice = '[[requirement]]\nid = "a"\nformula = "x > 1"\n'
    refused(2 * twice, "more than one requirement 'a'")
    refused("[constants]\na = 'b'", "constant 'a' must be a number")
    refused("requirement = 3", "begins with a line")
    refused("", "has no requirement")
    refused("a = ", "is not TOML")
    (tmp_path / "some.txt").write_text("")
    with pytest.raises(ValueError, match=r"ends with .toml, .yaml, .* got some.txt"):
        read_requirements(tmp_path / "some.txt")


def test_a_requirement_that_says_less_than_it_seems_to_has_a_note():
    trace = Trace({"x": np.sin(np.arange(51) * 0.5), "still": np.zeros(51, bool)}, dt=0.1)
    asked = {"settles": "eventually[0, 5] always[0, 1] x < 0", "at once": "x >= 0", "off": "!still"}
    found = judge({**asked, "sound": "always x < 2"}, [trace, trace])
    notes = [row.note for row in found.rows[:4]]
    assert notes[0].endswith("Probably meant: eventually[0,4] always[0,1] (x < 0)")
    assert notes[1].startswith("there is no temporal operator")
    assert notes[2:] == ["", ""]
    assert str(found).count("\nNote on ") == 2
