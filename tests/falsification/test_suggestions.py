"""Suggestions: what is asked, what is simulated of the answers, and that nobody is asked twice."""

import json
import shutil
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax import search
from verifai_jax.addons.reports.commands import run_python
from verifai_jax.core.values.cube import Cube
from verifai_jax.falsification.suggestions import row_of
from verifai_jax.search.suggested import Absent

SPACE = {
    "a": vj.Box(0.0, 1.0),
    "b": vj.Box(0.0, 1.0),
    "kind": vj.Categorical("slow", "fast"),
    "gusts": vj.Array(vj.Box(-1.0, 1.0), length=2),
}
GOOD = {"a": 0.9, "b": 0.25, "kind": "fast", "gusts": [0.0, 0.5]}


def system(f, key):
    x = f["a"] - 0.5 * f["b"] + 0.01 * f["gusts"][0]
    return vj.Trace({"x": x * jnp.linspace(0.0, 1.0, 5), "y": jnp.zeros(5)}, dt=0.25)


PROBLEM = vj.Problem("ramp", SPACE, system, "always x < 0.9", description="a ramp that rises")
INNER = search.CrossEntropy()


class Asked:
    """Gives one suggestion a question, from the number of rows alone, and keeps the questions."""

    def __init__(self):
        self.questions = []

    def __call__(self, question):
        self.questions.append(json.loads(json.dumps(question)))
        return [GOOD | {"b": 1.0 / (2 + question["simulations"])}]


@pytest.mark.thorough
def test_a_question_is_plain_data_that_says_what_is_known():
    asked = Asked()
    options = {"times": 2, "every": 16, "rows": 10, "worst": 2, "units": {"a": "m"}}
    suggested = search.Suggested(asked, INNER, context="look at the gusts", **options)
    run = vj.falsify(PROBLEM, suggested, 40, batch=8)
    first, second = asked.questions
    assert (first["simulations"], first["rows"], first["worst"]) == (0, [], [])
    assert (first["problem"], first["description"]) == ("ramp", "a ramp that rises")
    assert first["formulas"] == {"spec": "always (x < 0.9)"}
    assert (first["context"], first["wanted"]) == ("look at the gusts", 4)
    by_name = {each["name"]: each for each in first["features"]}
    assert [by_name["a"][entry] for entry in ("kind", "low", "high", "unit")] == ["Box", 0, 1, "m"]
    assert by_name["kind"]["choices"] == ["slow", "fast"]
    assert by_name["gusts"]["columns"] == ["gusts[0]", "gusts[1]"]
    # After one suggestion and two rounds of eight.
    assert (second["simulations"], len(second["rows"])) == (17, 10)
    table = run.table.all
    assert second["worst"][0]["row"] == table["rho"][:17].idxmin()
    assert second["worst"][0]["rho"] == pytest.approx(table["rho"][:17].min(), abs=1e-5)
    shown = second["worst"][0]["trace"]["x"]
    assert shown["times"] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert 0.9 - shown["greatest"] == pytest.approx(second["worst"][0]["rho"], abs=1e-5)
    assert second["worst"][0]["critical"][0]["predicate"] == "x < 0.9"
    assert second["worst"][0]["critical"][0]["time"] == 1.0
    assert "decided by  x < 0.9  at 1 s" in second["worst"][0]["explanation"]
    # The answers are rows of the table, at the places where they were given.
    assert np.flatnonzero(table["suggested"]).tolist() == [0, 17]
    np.testing.assert_allclose(table["b"][[0, 17]], [1 / 2, 1 / 19], atol=1e-6)
    assert not run.prior
    assert any("2 from 2 questions" in note for note in run.notes)


@pytest.mark.thorough
def test_what_cannot_be_simulated_is_left_out_and_said():
    questions = []

    def ask(question):
        questions.append(question)
        wrong = [{"a": 2.0}, {"kind": "quick"}, {"gusts": [0.0]}]
        return [
            *(GOOD | each for each in wrong),
            {"aa": 1.0, **GOOD},
            pd.Series(GOOD).to_dict(),
        ]

    suggested = search.Suggested(ask, INNER, times=2, every=8, points=5)
    run = vj.falsify(PROBLEM, suggested, 16, batch=8)
    table = run.table.all
    assert np.flatnonzero(table["suggested"]).tolist() == [0, 9]
    left_out = [note for note in run.notes if note.startswith("suggestion left out")]
    assert len(left_out) == 8
    assert "number 1 of question 1: ValueError: a must lie in [0, 1]; got 2" in left_out[0]
    assert "kind must be one of 'slow', 'fast'; got 'quick'" in left_out[1]
    assert "gusts" in left_out[2]
    assert "unknown feature 'aa'; did you mean 'a'" in left_out[3]
    assert questions[0]["refused"] == []
    assert len(questions[1]["refused"]) == 4
    more = search.Suggested(lambda question: [GOOD] * 3, INNER, times=1, points=2)
    run = vj.falsify(PROBLEM, more, 8, batch=8)
    assert run.table.all["suggested"].sum() == 2
    assert any("only 2 were asked for" in note for note in run.notes)
    with pytest.raises(vj.RunError, match=r"suggested number 1 of question 1.*a must lie in"):
        vj.falsify(PROBLEM, replace(suggested, strict=True), 16, batch=8)
    with pytest.raises(vj.RunError, match=r"must return a list of suggestions.*it returned dict"):
        vj.falsify(PROBLEM, search.Suggested(lambda question: GOOD, INNER), 16, batch=8)


def test_a_suggestion_may_be_a_row_of_a_table():
    wanted = np.asarray(PROBLEM.space.flatten(PROBLEM.space.coerce(GOOD)))
    row = {"a": 0.9, "b": 0.25, "kind": "fast", "gusts[0]": 0.0, "gusts[1]": 0.5, "rho": -1.0}
    for suggestion in (GOOD, row):
        point = row_of(PROBLEM, suggestion, "float64")
        np.testing.assert_allclose(point[: len(wanted)], wanted, atol=1e-6)
        # Behind the point are the numbers themselves, which are simulated.
        assert point[len(wanted) :].tolist() == [0.9, 0.25, 0.0, 0.5]
    with pytest.raises(ValueError, match=r"unknown column 'gusts\[2\]'; did you mean 'gusts"):
        row_of(PROBLEM, row | {"gusts[2]": 0.1}, "float32")
    with pytest.raises(TypeError, match="must be a mapping"):
        row_of(PROBLEM, [0.1, 0.2], "float32")
    space = vj.FeatureSpace(SPACE, where=lambda f: f["a"] > 0.95)
    narrow = vj.Problem("ramp", space, system, "always x < 0.9")
    with pytest.raises(ValueError, match="breaks the constraint"):
        row_of(narrow, GOOD, "float32")


@pytest.mark.thorough
def test_nobody_is_asked_twice(tmp_path):
    def options(asked):
        return search.Suggested(asked, INNER, times=3, every=16)

    whole = vj.falsify(PROBLEM, options(Asked()), 64, batch=8)
    first, folder, copy = Asked(), tmp_path / "run", tmp_path / "copy"

    def stop(step, values):
        # The round behind the second answer is lost: only what was written when it came is there.
        if len(first.questions) == 2 and not copy.exists():
            shutil.copytree(folder, copy)
        if len(first.questions) == 2 and step >= 33:
            raise KeyboardInterrupt

    part = vj.falsify(PROBLEM, options(first), 64, batch=8, folder=folder, callbacks=[stop])
    assert (part.stopped, len(first.questions)) == ("interrupted", 2)
    for place in (folder, copy):
        with pytest.raises(ValueError, match=r"came from .*Asked, which a record does not hold"):
            vj.resume(place, PROBLEM)
        second = Asked()
        resumed = vj.resume(place, PROBLEM, search=options(second), budget=64)
        assert [each["simulations"] for each in second.questions] == [34]
        assert resumed.table.all.equals(whole.table.all)
        assert resumed.notes[-1] == whole.notes[-1]
        # With no question left nobody is needed.
        again = vj.resume(place, PROBLEM, budget=72)
        assert len(again.table) == 72
    stored = vj.load(folder, PROBLEM)
    assert "search=suggested," in run_python(stored)
    assert isinstance(search.from_json(stored.search_data).suggest, Absent)
    assert search.from_json(stored.search_data).times == 3


NAMES = "abcdefghijkl"


def plateau(f, key):
    # Level, without a gradient, but in 0.008 % of the space, where it rises to a corner.
    mean = jnp.mean(jnp.stack([f[name] for name in NAMES]))
    return vj.Trace({"x": jnp.maximum(0.0, 1 - mean / 0.2)[None].repeat(2)}, dt=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gradient", "portfolio"])
def test_descents_start_from_suggestions_whenever_they_come(name):
    space = {each: vj.Box(0.0, 1.0) for each in NAMES}
    problem = vj.Problem("plateau", space, plateau, "always x < 0.95")
    near = dict.fromkeys(NAMES, 0.15)

    def ask(question):
        return [near] if question["simulations"] >= 32 else []

    inner, options = search.named(name), {"batch": 16, "stop_after": 1, "seed": 0}
    alone = vj.falsify(problem, inner, 400, **options)
    assert alone.table.counts.claimed == 0
    suggested = search.Suggested(ask, inner, times=2, every=32)
    run = vj.falsify(problem, suggested, 400, **options)
    assert run.table.counts.claimed > 0
    assert run.simulations < 100


def test_wrong_arguments_say_what_is_right():
    with pytest.raises(TypeError, match="suggest must be a function of a question"):
        search.Suggested([GOOD])
    with pytest.raises(ValueError, match=r"does not learn.*Portfolio.*first="):
        search.Suggested(list, search.Halton())
    with pytest.raises(TypeError, match="needs a search like Portfolio"):
        search.Suggested(list, "portfolio")
    with pytest.raises(ValueError, match="points"):
        search.Suggested(list, points=0)
    suggested = search.Suggested(list, INNER)
    with pytest.raises(ValueError, match="must be the search itself"):
        vj.repeat(PROBLEM, suggested, 16)
    with pytest.raises(ValueError, match="must be the search itself"):
        vj.falsify(PROBLEM, search.Split({"a": suggested}, INNER), 16)
    with pytest.raises(ValueError, match="must be the search itself"):
        search.Diverse(suggested).check(Cube((0,)))
