"""Findings on formulas: planted mistakes of every kind are found, sound formulas have none."""

import numpy as np
import pytest

from verifai_jax import mtl
from verifai_jax.core.values.trace import Trace

UNITS = {
    "speed": "m/s", "limit": "km/h", "dist": "m", "theta": "rad", "heading": "deg",
    "glucose": "mg/dL", "carbs": "g", "temp": "degC",
}  # fmt: skip


def drive(seed):
    """Make a recording of 20 s in which all signals come near the bounds of the sound formulas."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 20, 0.1)
    phase = rng.uniform(0, 0.4)
    speed = 15 + 13 * np.sin(0.6 * t + phase)
    brake = np.sin(0.6 * t + phase + 0.5) > 0.6
    signals = {
        "speed": speed,
        "limit": 3.6 * 28 + 0 * t + np.sin(t),
        "dist": 22 + 18 * np.cos(0.6 * t + phase),
        "theta": 0.2 * np.sin(3 * t + phase),
        "heading": 90 * np.sin(0.3 * t),
        "brake": brake,
        "mode": np.floor(t / 7),
        "request": (np.sin(t + phase) > 0.9).astype(float),
        "grant": np.roll((np.sin(t + phase) > 0.9).astype(float), 5),
        "glucose": 130 + 55 * np.sin(t / 3),
        "carbs": 40 * np.exp(-((t - 5) ** 2)),
        "temp": 40 + 2 * t,
        "mass": np.full(t.shape, 1450.0),
        "p": np.stack([np.cos(t), np.sin(t)], axis=1) * (1 + 0.02 * t)[:, None],
    }
    return Trace(signals, dt=0.1)


@pytest.fixture(scope="module")
def drives():
    return [drive(seed) for seed in range(3)]


PLANTED = [
    # Signals misspelt, and names of other logs.
    ("signal", "always spede < 30"),
    ("signal", "always (speed < 30 & Dist > 2)"),
    ("signal", "always (brakes > 0 -> speed < 30)"),
    # Left sides that never hold: units, a typing mistake, contradictions, states that do not occur.
    ("vacuous", "always (speed > 120 -> eventually[0, 5] brake)"),
    ("vacuous", "always (mode == 7 -> speed < 20)"),
    ("vacuous", "always (speed < -1 -> brake)"),
    ("vacuous", "always (brake & speed > 50 -> dist > 2)"),
    ("vacuous", "always (temp > 373 -> eventually[0, 2] speed < 5)"),
    ("vacuous", "always (theta > 15 -> brake)"),
    ("vacuous", "always (glucose < 7 -> eventually[0, 5] carbs > 9)"),
    ("vacuous", "speed > 25 -> eventually[0, 5] speed < 10"),
    ("vacuous", "carbs > 20 -> eventually[0, 5] glucose < 180"),
    ("vacuous", "eventually (request > 0 -> grant > 0)"),
    ("vacuous", "eventually[0, 10] (speed > 25 -> brake)"),
    ("vacuous", "speed > 100 until speed > 5"),
    # Bounds in another unit, or off by a factor.
    ("never near", "always abs(theta) < 12"),
    ("never near", "always speed < 300"),
    ("never near", "always glucose < 1800"),
    ("never near", "always temp < 373"),
    ("never near", "always norm(p) < 20"),
    ("never near", "always speed < 120"),
    ("never near", "always mass < 9000"),
    ("never holds", "always glucose < 10"),
    ("never holds", "eventually speed > 90"),
    ("never holds", "eventually mode == 5"),
    ("never holds", "eventually speed == 12.5"),
    # Windows beyond the recording, milliseconds for seconds, windows that the clock does not have.
    ("window", "always[0, 500] speed < 30"),
    ("window", "always (request > 0 -> eventually[0, 200] grant > 0)"),
    ("window", "eventually[60, 90] dist < 10"),
    ("window", "historically speed < 30"),
    ("window", "once brake"),
    ("window", "always (brake -> once[25, 30] speed > 5)"),
    # Windows that the end cuts where the formula chooses or asks, and tests of one sample.
    ("window", "eventually always temp > 60"),
    ("window", "eventually always[0, 1] speed > 20"),
    ("window", "eventually[0, 20] always[0, 5] speed < 20"),
    ("window", "speed < 30 until[0, 20] always[0, 5] speed < 20"),
    ("window", "always[0, 10] eventually[0, 12] dist < 10"),
    ("window", "eventually[0, 20] historically[0, 5] dist > 10"),
    ("window", "always eventually brake"),
    ("window", "dist > 2 & always speed < 30"),
    ("window", "speed < 30"),
    ("window", "speed < 30 | dist < 40"),
    ("no verdict", "always (request > 0 -> eventually[0, 0.25] grant > 0)"),
    # Until where weak until is meant.
    ("until", "speed < 30 until mode == 3"),
    ("until", "dist > 2 until speed > 40"),
    ("until", "always (speed < 30 until brake)"),
    # Units.
    ("units", "always speed < limit"),
    ("units", "always (carbs > 20 -> eventually[0, 5] glucose < 180)"),
    ("units", "always (abs(theta) < 0.25 & abs(heading) < 100)"),
    ("units", "always sin(heading) < 0.9"),
    ("units", "always dist - speed > -30"),
    # Parts without effect, and parts that are always true or false.
    ("no effect", "always (speed < 30 & speed < 40)"),
    ("no effect", "dist > 2 until eventually brake"),
    ("no effect", "always (dist > 3 | dist > 5)"),
    ("always false", "always (speed > 5 & eventually speed < 3)"),
    ("always true", "eventually (speed > 3 | speed < 3 | speed == 3)"),
    ("always false", "always (speed > 20 & speed < 3)"),
    ("always false", "eventually (speed > 20 & speed < 3)"),
    ("always true", "always (speed > 3 | speed < 5)"),
    ("always true", "always (speed > 5 -> speed > 3)"),
    ("always false", "always abs(theta) < -0.2"),
]


@pytest.mark.parametrize(("kind", "text"), PLANTED)
def test_planted_mistakes_are_found(drives, kind, text):
    found = mtl.lint(text, drives, units=UNITS)
    assert kind in {finding.kind for finding in found}, str(found)


SOUND = [
    "always speed < 30",
    "always speed <= 28.5",
    "always dist > 2",
    "always (speed > 25 -> dist > 2)",
    "always (speed > 20 -> eventually[0, 8] speed < 10)",
    "always (request > 0 -> eventually[0, 1] grant > 0)",
    "always (request > 0 -> (grant <= 0 until grant > 0))",
    "eventually brake",
    "eventually[0, 10] speed < 5",
    "always[0, 10] speed < 30",
    "always[5, 15] dist > 2",
    "always abs(theta) <= 0.25",
    "always abs(theta) <= 12deg",
    "always (theta < 0.25 & theta > -0.25)",
    "always (brake -> speed > 1)",
    "always (brake -> eventually[0, 6] !brake)",
    "always (!brake -> eventually[0, 12] brake)",
    "always (mode == 1 -> speed < 30)",
    "always (mode < 3)",
    "eventually mode == 2",
    "always (mode == 2 -> always mode == 2)",
    "mode < 2 until mode == 2",
    "mode < 1 until mode >= 1",
    "always norm(p) < 1.5",
    "always norm(p) > 0.9",
    "always (p[0] < 1.4 & p[1] < 1.4)",
    "always glucose > 70",
    "always (glucose < 190)",
    "always (glucose > 180 -> eventually[0, 6] glucose < 180)",
    "always temp < 90",
    "always eventually[0, 12] brake",
    "always (speed < 30 | brake)",
    "speed < 30 weak_until mode == 3",
    "mode == 2 release speed < 30",
    "always (speed > 27 -> eventually[0, 2] (speed < 27))",
    "always (dist < 6 -> speed > 5)",
    "always (dist > 30 -> eventually[0, 6] dist < 30)",
    "always (speed - 15 < 14)",
    "always (abs(speed - 15) <= 14)",
    "always (max(speed, 20) < 30)",
    "always min(speed, 10) > 1",
    "always ((once[0, 12] brake) | mode == 0)",
    "always (grant > 0 -> once[0, 1] request > 0)",
    "always (grant > 0 -> once[0.4, 0.6] request > 0)",
    "always (mode == 2 -> historically[0, 1] speed < 30)",
    "always (grant > 0 -> (speed < 30 since request > 0))",
    "always (speed > 20 & dist < 10 -> eventually[0, 5] speed < 20)",
    "always (request > 0 -> next[0] grant <= 0)".replace("next[0]", "next"),
    "always (speed > 25 -> always[0, 1] speed > 10)",
    "eventually[5, 15] always[0, 1] dist > 30",
    "eventually[0, 18.9] always[0, 1] speed > 20",
    "eventually[0, 15] always temp > 60",
    "always[0, 7] eventually[0, 12] dist < 10",
    "(always[0, 10] speed < 30) & (always dist > 2)",
    "always (abs(heading) <= 90.5)",
    "always (heading > 45 -> eventually[0, 8] heading < 45)",
    "always (!(speed > 28.5) & !(dist < 3))",
    "always (2 * speed < 60)",
    "always (temp > 70 -> speed < 29)",
    "always mass < 2000",
]


def test_sound_formulas_have_at_most_two_false_alarms(drives):
    assert len(set(SOUND)) == 60
    findings = [finding for text in SOUND for finding in mtl.lint(text, drives)]
    assert len(findings) <= 2, [(f.kind, f.part) for f in findings]


def test_findings_are_sentences_and_a_table(drives):
    found = mtl.lint({"gap": "always abs(theta) < 12", "fine": "always speed < 30"}, drives)
    assert str(found).splitlines()[:4] == [
        "1 finding on 2 formulas, with 3 recordings",
        "",
        "gap  always (abs(theta) < 12)",
        "  never near: abs(theta) < 12 always holds in all of 3 recordings, and never by less than "
        "11.8: theta is from -0.2 to 0.2",
    ]
    assert list(found.table["requirement"]) == ["gap"]
    assert {"speed", "theta"}.isdisjoint(found.unread)
    assert "brake" in found.unread


def test_units_come_from_requirements_recordings_and_names(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,gap,carbs\ns,[m],g\n0,1,2\n1,2,3\n2,1.5,1\n")
    found = mtl.lint("always (carbs > 2 -> gap > 1.2)", path)
    (units,) = [finding for finding in found if finding.kind == "units"]
    assert "carbs > 2 in g and gap > 1.2 in m; " in units.sentence
    assert units.advice.endswith("{'carbs': 2.0, 'gap': 1.0}).")
    wrong = mtl.Requirement("R", mtl.parse('always "gap (m)" > 1'), unit="km")
    assert [f.kind for f in mtl.lint([wrong])] == ["units"]
    assert "compares m/s with km/h" in str(mtl.lint("always speed_mps < limit_kmh"))


def test_a_number_in_a_product_may_have_a_unit(drives):
    for text in (
        "always dist > 0.1 * speed",
        "always dist - speed / 10 > 0",
        "always (2 * speed < 60 & dist > 1)",
    ):
        assert "units" not in {each.kind for each in mtl.lint(text, drives, units=UNITS)}, text
    said = [
        each
        for each in mtl.lint("always dist > speed", drives, units=UNITS)
        if each.kind == "units"
    ]
    assert [each.sentence for each in said] == ["dist > speed compares m with m/s"]


def test_few_seconds_that_are_counted_are_near_their_limit(drives):
    assert not mtl.lint("always duration(speed > 28, 10) <= 3", drives, units=UNITS)


def test_findings_say_what_was_probably_meant(drives):
    (found,) = mtl.lint("eventually[0, 20] always[0, 5] speed < 20", drives)
    assert found.sentence == (
        "eventually[0,20] lets always[0,5] begin as late as 19.9 s, when 0 s of its 5 s are left "
        "of a trace of 19.9 s, in 3 of 3 recordings, such as recording 1"
    )
    assert found.advice == "Probably meant: eventually[0,14.9] always[0,5] (speed < 20)"
    # The time at which a constant is tested does not matter.
    assert not [each for each in mtl.lint("mass > 1400", drives) if each.kind == "window"]


def test_a_formula_alone_is_looked_at_without_recordings():
    assert [f.kind for f in mtl.lint("x > 5")] == ["window"]
    assert [f.kind for f in mtl.lint("eventually always[0, 1] x > 5")] == ["window"]
    assert [f.kind for f in mtl.lint("always (x > 5 & x < 3)")] == ["always false"]
    assert not mtl.lint("always (x > 5 -> eventually[0, 2] y < 3)")
    assert str(mtl.lint("always x > 5")) == "0 findings on 1 formula, with 0 recordings"
