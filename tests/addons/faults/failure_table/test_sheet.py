"""The sheet of an FMEA, and the detector on board: against the table, and closed forms."""

import json
import math

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.addons import faults
from verifai_jax.addons.faults.failure_table.detection import as_detector
from verifai_jax.addons.faults.failure_table.result import Detection, Effect, FailureTable
from verifai_jax.cli.main import main
from verifai_jax.core.messages.errors import MissingExtra
from verifai_jax.statistics.binomial import clopper_pearson

WORDS = {
    "gyro_bias": {"component": "gyro", "cause": "=heat", "severity": 8, "owner": "Ada"},
    "motor_stuck": {"component": "motor", "effect": "runs away", "severity": 10, "owner": "Ada"},
    "a_dropout": {"component": "a", "cause": "plug"},
    "b_dropout": {"component": "b", "cause": "plug"},
}


def effect(*names, high=0.0, missed=None, **options):
    seen = None if missed is None else Detection(clopper_pearson(missed, 40), True, 0.25)
    made = {"probability": high / 2, "low": high / 4, "high": high, "detection": seen}
    return Effect(names, high > 0, 3, 512, **made, **options)


def table(*effects):
    return FailureTable("lab", effects, None, None, None, 0.95, True, 1.0, clopper_pearson(1, 500))


@pytest.fixture
def sheet():
    found = table(
        effect("gyro_bias", high=0.02, missed=7, broken="upright", delay=0.75, verdict="confirmed"),
        effect("motor_stuck", high=3e-5, missed=40, broken="upright", delay=0.1),
        effect("a_dropout", "b_dropout", high=1e-10),
    )
    return found, found.sheet(WORDS)


def test_the_sheet_agrees_with_the_table(sheet):
    found, made = sheet
    rows, measured = made.table, found.table
    assert list(rows.index) == list(measured.index)
    for column in ("probability", "low", "high", "missed", "alarm_after", "verdict", "replay"):
        pd.testing.assert_series_equal(rows[column], measured[column])
    # The least decade above the upper end, and the tenth of the upper end of missed failures.
    for name, row in rows.iterrows():
        high = measured.loc[name, "high"]
        assert row["occurrence"] == max(1, min(10, 11 + math.floor(math.log10(high))))
        missed = measured.loc[name, "missed_high"]
        assert row["detection"] == (None if math.isnan(missed) else min(int(10 * missed) + 1, 10))
    assert rows.loc["gyro_bias", "rpn"] == 8 * 9 * rows.loc["gyro_bias", "detection"]
    assert rows.loc["motor_stuck", "rpn"] == 10 * 6 * 10
    assert rows.loc["a_dropout + b_dropout", "rpn"] is None
    assert rows.loc["gyro_bias", "effect"] == "breaks upright 0.75 s after the onset"
    assert rows.loc["motor_stuck", "effect"] == "runs away"
    pair = rows.loc["a_dropout + b_dropout"]
    assert (pair["component"], pair["cause"], pair["owner"]) == ("a; b", "plug", "")
    assert made.notes["false alarms"].startswith("0.2 %")
    assert (
        "of a failure given that the fault happens, with 95 % intervals"
        in made.notes["probability"]
    )


def test_a_scale_of_the_user(sheet):
    found, _ = sheet
    own = faults.Scale(
        "of the house", tuple(k / 100 for k in range(1, 10)), tuple(k / 10 for k in range(1, 10)),
        lambda s, o, d: "high" if s >= 8 and o > 2 else "low",
    )  # fmt: skip
    rows = found.sheet(WORDS, own).table
    assert rows["occurrence"].tolist() == [3, 1, 1]
    assert rows["priority"].tolist() == ["high", "low", ""]
    with pytest.raises(ValueError, match="occurrence of a scale must be nine rising numbers"):
        faults.Scale("short", (0.1, 0.2), own.detection)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"gyro": {}}, "unknown row of the failure table 'gyro'; did you mean 'gyro_bias'"),
        ({"gyro_bias": {"causes": "x"}}, "unknown column of 'gyro_bias' 'causes'; did you mean 'c"),
        ({"gyro_bias": {"severity": 11}}, "severity of 'gyro_bias' must be a whole number from 1"),
        ({"gyro_bias": {"owner": 3}}, "owner of 'gyro_bias' must be a text; got 3"),
    ],
)
def test_wrong_words_are_named(sheet, words, message):
    with pytest.raises(ValueError, match=message):
        sheet[0].sheet(words)


def test_words_of_a_file(sheet, tmp_path):
    file = tmp_path / "words.csv"
    file.write_text("fault;component;severity\ngyro_bias;Gyro, left;8\nmotor_stuck;;\n")
    rows = sheet[0].sheet(file).table
    assert rows.loc["gyro_bias", ["component", "severity"]].tolist() == ["Gyro, left", 8]
    assert rows.loc["motor_stuck", "severity"] is None
    file.write_text("fault,severity\ngyro_bias,high\n")
    with pytest.raises(ValueError, match=r"severity of 'gyro_bias' must be a whole number.*'high'"):
        sheet[0].sheet(file)
    file.write_text("name,severity\ngyro_bias,3\n")
    with pytest.raises(ValueError, match="needs a column 'fault'; it has name, severity"):
        sheet[0].sheet(file)


def test_the_workbook_has_the_rows_of_the_sheet(sheet, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    _, made = sheet
    book = openpyxl.load_workbook(made.to_xlsx(tmp_path / "fmea.xlsx"))
    head, *rows = book["FMEA"].iter_rows(values_only=True)
    assert head == ("fault", *made.table.columns)
    for row, (name, entries) in zip(rows, made.table.iterrows(), strict=True):
        assert row[0] == name
        for value, own in zip(row[1:], entries, strict=True):
            empty = own == "" or own != own
            # Excel keeps 16 digits.
            digits = pytest.approx(own, rel=1e-14) if type(own) is float else own
            assert value == (None if empty else digits)
    # No text becomes a formula.
    assert [c.data_type for c in book["FMEA"]["C"]] == ["s", "s", "n", "s"]
    notes = dict(book["Notes"].iter_rows(values_only=True))
    assert notes == dict(made.notes)


def test_the_error_names_the_extra(sheet, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "openpyxl", None)
    with pytest.raises(MissingExtra, match=r"pip install 'verifai_jax\[xlsx\]'"):
        sheet[1].to_xlsx(tmp_path / "fmea.xlsx")


def test_a_formula_that_looks_ahead_gives_its_alarm_later():
    trace = vj.Trace({"x": np.array([0.0, 2, 2, 0, 2, 2, 2, 2])}, dt=0.1)
    assert as_detector("x > 1")(trace).tolist() == [False, *[True] * 2, False, *[True] * 4]
    assert np.argmax(as_detector("historically[0, 0.2] x > 1")(trace)) == 6
    assert np.argmax(as_detector("always[0, 0.2] x > 1")(trace)) == 6
    assert np.argmax(as_detector(vj.parse("historically[0, 0.2] x > 1"))(trace)) == 6
    assert as_detector(lambda trace: np.asarray(trace["x"]) > 1)(trace).sum() == 6
    with pytest.raises(ValueError, match="looks ahead without end, and so never gives an alarm"):
        as_detector("always x > 1")
    with pytest.raises(ValueError, match="must return 8 truth values, one for each sample"):
        as_detector(lambda trace: 1.0)(trace)
    with pytest.raises(TypeError, match="detector must be a formula, its text, or a function"):
        as_detector(3)


LOOP = """
import jax.numpy as jnp
import verifai_jax as vj

system = vj.ode(
    lambda time, state, control, features: {"x": jnp.zeros(())},
    lambda features, key: {"x": jnp.ones(())},
    controller=lambda time, state, features: {
        "level": state["x"], "noise": features["noise"] + 0.0 * state["x"]
    },
    dt=0.05, duration=2.0,
)
lab = vj.Problem(
    "lab", {"noise": vj.Box(-0.1, 0.1)}, system, "always level <= 2", nominal={"noise": 0.0}
)
faulty = lab.with_faults(vj.faults.Drift("x", rate=vj.Box(0, 4)))
"""


@pytest.mark.slow
def test_the_detector_is_measured_as_a_closed_form_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab.py").write_text(LOOP)
    (tmp_path / "words.csv").write_text("fault,severity\nx_drift,7\n")
    arguments = [
        "fmea", "lab.py:faulty", "--samples", "200", "--budget", "0", "--no-pairs", "--words",
        "words.csv", "--detector", "level > 1.9 | noise > 0.05", "--json",
    ]  # fmt: skip
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    (drift,) = found["effects"]
    assert found["false_alarms"]["low"] < 0.25 < found["false_alarms"]["high"]
    # Rates that fail within 2 s, and the first samples above the two levels.
    rates = np.linspace(0.5, 4, 4001)[1:]
    clock = np.arange(41) * 0.05
    alarm, broken = (np.argmax(rates[:, None] * clock > level, axis=1) for level in (0.9, 1.0))
    missed, seen = drift["detection"]["missed"], alarm < broken
    assert missed["low"] < 1 - seen.mean() < missed["high"]
    assert drift["detection"]["failing"]
    assert drift["detection"]["delay"] == pytest.approx(np.median(clock[alarm[seen]]), abs=0.12)
    sheet = pd.read_csv("runs/fmea-faulty/sheet.csv", index_col="fault")
    assert sheet.loc["x_drift", "severity"] == 7
    assert sheet.loc["x_drift", "rpn"] == 7 * math.prod(
        sheet.loc["x_drift", ["occurrence", "detection"]]
    )


@pytest.mark.slow
def test_a_detector_that_is_a_function(tmp_path):
    scope = {}
    exec(compile(LOOP, "lab.py", "exec"), scope)
    found = vj.fmea(
        scope["faulty"], samples=30, budget=0, progress=False,
        detector=lambda trace: np.asarray(trace["level"]) > 1e9,
    )  # fmt: skip
    assert found["x_drift"].missed == 1.0
    assert found.false_alarms.failures == 0
    assert math.isnan(found["x_drift"].alarm_after)
    assert "the detector misses 100 %" in str(found)
