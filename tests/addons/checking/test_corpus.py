"""Counterexamples as files: what they hold, and every way in which a problem may have changed."""

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.addons.checking import Check, SavedCounterexample, save_counterexamples
from verifai_jax.addons.checking._replay_counterexamples import OTHER
from verifai_jax.addons.checking._test import tested_problem as problem_tested_by
from verifai_jax.addons.checking.corpus import renamed
from verifai_jax.cli.main import main

SPACE = {
    "a": vj.Box(0.0, 2.0),
    "wind": vj.Box((-1.0, -1.0), (1.0, 1.0)),
    "mode": vj.Categorical("calm", "storm"),
}


def system(f, key):
    shake = 0.01 * jax.random.uniform(key)
    x = f["a"] + f["wind"][0] + (f["mode"] == 1) * 0.5 + shake
    return vj.Trace({"x": jnp.full(3, x)}, dt=1.0)


def problem(system=system, space=SPACE, spec="always x < 2", **options):
    nominal = {"a": 0.5, "wind": (0.0, 0.0), "mode": "calm"}
    return vj.Problem("windy", space, system, spec, nominal=nominal, **options)


@pytest.fixture(scope="module")
def run():
    return vj.falsify(problem(), "uniform", 256, batch=256)


@pytest.fixture(scope="module")
def corpus(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    assert len(run.save_counterexamples(folder, max_count=3, budget=200)) == 3
    return folder


def states(result):
    return [one.state for one in result.replayed]


@pytest.mark.slow
def test_files_say_what_fails_and_how_it_was_found(run, corpus):
    for path in corpus.iterdir():
        content = json.loads(path.read_text())
        assert content["formulas"] == {"spec": "always (x < 2)"}
        assert set(content["features"]) == {"a", "wind[0]", "wind[1]", "mode"}
        assert content["robustness"]["spec"] < 0
        assert content["found"]["simulations"] == 256
        departs = {name: now for name, (_, now) in content["changed"].items()}
        assert 0 < len(departs) < 4
        assert content["features"]["wind[1]"] == pytest.approx(0.0, abs=1e-6)
        assert SavedCounterexample.read(path).name == path.name
    # The same run again writes the same files.
    again = save_counterexamples(run, corpus, max_count=3, budget=200)
    assert {p.name for p in again} == {p.name for p in corpus.iterdir()}


@pytest.mark.slow
def test_failing_fixed_and_without_a_verdict(corpus):
    result = vj.replay_counterexamples(problem(), corpus)
    assert states(result) == ["failing"] * 3
    for one in result.failing:
        assert one.robustness == pytest.approx(one.before, abs=1e-6)
    assert not result.passed
    assert str(result).startswith(f"windy: 3 counterexamples in {corpus}: 3 failing\n")
    calmer = vj.replay_counterexamples(
        problem(lambda f, key: vj.Trace({"x": 0 * system(f, key)["x"]}, dt=1.0)), corpus
    )
    assert states(calmer) == ["fixed"] * 3
    assert calmer.passed
    broken = vj.replay_counterexamples(
        problem(lambda f, key: vj.Trace({"x": jnp.nan * system(f, key)["x"]}, dt=1.0)), corpus
    )
    assert states(broken) == ["without a verdict"] * 3
    assert not broken.passed
    assert broken.table["note"].tolist() == ["nonfinite"] * 3
    changed = vj.replay_counterexamples(problem(spec="always x < 9"), corpus)
    assert states(changed) == ["fixed"] * 3
    assert changed.replayed[0].note == "the formulas were always (x < 2)"
    other = vj.replay_counterexamples(replace(problem(), name="calm"), corpus)
    assert states(other) == ["of another problem"] * 3
    assert str(other) == f"calm: 0 counterexamples in {corpus}\n  3 more files of other problems"


@pytest.mark.slow
def test_a_feature_that_was_renamed_moved_or_narrowed(corpus):
    def push(f, key):
        return system({**f, "wind": f["gust"]}, key)

    nominal = {"a": 0.5, "gust": (0.0, 0.0), "mode": "calm"}
    space = {"a": SPACE["a"], "gust": SPACE["wind"], "mode": SPACE["mode"]}
    later = vj.Problem("windy", space, push, "always x < 2", nominal=nominal)
    lost = vj.replay_counterexamples(later, corpus)
    assert states(lost) == ["no longer valid"] * 3
    reason = "the space has no feature wind[0], wind[1] and the file has no gust[0], gust[1]"
    assert lost.replayed[0].note == reason
    assert not lost.passed
    found = vj.replay_counterexamples(later, corpus, rename={"wind": "gust"})
    assert states(found) == ["failing"] * 3
    small = {"a": vj.Box(0.0, 0.5), "wind": vj.Box((-0.5, -1.0), (0.5, 1.0))}
    narrow = vj.replay_counterexamples(problem(space=SPACE | small), corpus)
    assert {one.state for one in narrow.replayed} == {"no longer valid"}
    assert "is not in the space any more; the nearest there is 0.5" in str(narrow)
    where = vj.FeatureSpace(SPACE, where=lambda f: f["a"] + f["wind"][0] < 1.0)
    refused = vj.replay_counterexamples(problem(space=where), corpus)
    assert "the constraint of the space refuses its features" in str(refused)


NAMESAKES = """
import numpy as np
import verifai_jax as vj

def simulate(features):
    return vj.Trace({{"x": np.full(3, features["a"])}}, dt=1.0)

def of(limit):
    space = {{"a": vj.Box(0.0, 1.0)}}
    return vj.Problem("brake", space, vj.blackbox(simulate), f"always x < {{limit}}")

first, second = of({}), of({})

@vj.test(of({}))
def test_third(): pass
"""


@pytest.mark.slow
def test_problems_that_share_a_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder, limits in (("a", (0.1, 2, 3)), ("b", (0.2, 2, 3))):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "brake.py").write_text(NAMESAKES.format(*limits))
    monkeypatch.syspath_prepend(tmp_path)
    modules = [importlib.import_module(f"{folder}.brake") for folder in "ab"]
    one, other = (module.first for module in modules)
    for each in (one, other):
        assert Check(8, search="uniform").run(each, "corpus").failed
    assert len(list(Path("corpus").iterdir())) == 2  # The same features, and two files.
    assert sorted(states(vj.replay_counterexamples(one, "corpus"))) == ["failing", OTHER]
    for same in (modules[0].second, problem_tested_by(modules[1].test_third)):
        assert set(states(vj.replay_counterexamples(same, "corpus"))) == {OTHER}
        assert not Check(8, search="uniform").run(same, "corpus").failed
    # A file that was moved still holds its problem.
    (tmp_path / "b" / "brake.py").rename(tmp_path / "b" / "braking.py")
    sys.modules.pop("b.brake")
    moved = importlib.import_module("b.braking").first
    assert sorted(states(vj.replay_counterexamples(moved, "corpus"))) == ["failing", OTHER]


def test_names_of_columns():
    columns = {"wind[0]": 1, "wind.x": 2, "window": 3, "a": 4}
    assert renamed(columns, {"wind": "gust", "a": "b"}) == {
        "gust[0]": 1,
        "gust.x": 2,
        "window": 3,
        "b": 4,
    }


@pytest.mark.thorough
def test_bad_files_are_named_and_do_not_stop_the_others(tmp_path):
    (tmp_path / "a.json").write_text("{")
    (tmp_path / "b.json").write_text('{"format": 7}')
    (tmp_path / "c.json").write_text('{"format": 1}')
    result = vj.replay_counterexamples(problem(), tmp_path)
    assert states(result) == ["no longer valid"] * 3
    text = str(result)
    assert "a.json cannot be read" in text
    assert "b.json is not a counterexample of format 1; its format is 7" in text
    assert "c.json lacks problem, target" in text
    with pytest.raises(FileNotFoundError, match="there is no corpus of counterexamples in"):
        vj.replay_counterexamples(problem(), tmp_path / "none")
    never = vj.falsify(problem(spec="always x < 99"), "uniform", 8, batch=8)
    with pytest.raises(ValueError, match="claims no counterexample in 8 simulations"):
        never.save_counterexamples(tmp_path)


@pytest.mark.thorough
def test_an_edited_file_is_read_and_said_to_be_edited(corpus, tmp_path):
    path = sorted(corpus.iterdir())[0]
    content = json.loads(path.read_text())
    # As editors of Windows save it.
    (tmp_path / path.name).write_text(json.dumps(content), encoding="utf-8-sig")
    assert vj.replay_counterexamples(problem(), tmp_path).replayed[0].note == ""
    content["features"]["a"] = 2.0
    content["features"]["wind[0]"] = 1.0
    (tmp_path / path.name).write_text(json.dumps(content))
    [one] = vj.replay_counterexamples(problem(), tmp_path).replayed
    assert one.state == "failing"
    assert one.note == "it does not give its number again: the file was edited or renamed since"
    content["features"]["a"], content["robustness"] = 2**70, {}
    (tmp_path / path.name).write_text(json.dumps(content))
    [one] = vj.replay_counterexamples(problem(), tmp_path).replayed
    assert one.note.startswith("a = 1180591620717411303424 is not in the space any more")
    content["features"]["a"], content["robustness"] = 2.0, {"spec": -(2**70)}
    (tmp_path / path.name).write_text(json.dumps(content))
    assert vj.replay_counterexamples(problem(), tmp_path).replayed[0].before == -(2.0**70)


@pytest.mark.slow
def test_a_full_disk_is_one_error_that_names_the_file_and_hides_no_failure(
    run, tmp_path, monkeypatch
):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(
        OSError, match=r"\.json cannot be written \(No space left on device\); make room"
    ):
        run.save_counterexamples(tmp_path / "corpus", max_count=1)
    assert list((tmp_path / "corpus").iterdir()) == []
    outcome = Check(budget=64).run(problem(), corpus=tmp_path / "corpus")
    assert outcome.failed
    assert "simulations violate the property" in str(outcome)
    assert "not saved    " in str(outcome)


@pytest.mark.slow
def test_the_command_saves_counterexamples(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(
        "import jax.numpy as jnp\nimport verifai_jax as vj\n"
        "ramp = vj.Problem('ramp', {'a': vj.Box(0.0, 1.0)}, lambda f, key: vj.Trace("
        "{'x': f['a'] * jnp.ones(3)}, dt=1.0), 'always x < 0.5', nominal={'a': 0.1})\n"
    )

    def call(*arguments, code=0):
        result = CliRunner().invoke(main, [str(a) for a in arguments])
        assert result.exit_code == code, result.output
        return result.output

    call("falsify", "spec.py:ramp", "--search", "uniform", "--budget", 64, "--folder", "one")
    (path,) = call("save-counterexamples", "one", "--max-count", 1).split()
    reproduce = json.loads((tmp_path / path).read_text())["reproduce"]
    output = call(*reproduce.split()[1:])
    assert "ramp: 1 counterexample in" in output
    assert "1 failing" in output
    assert np.isclose(json.loads((tmp_path / path).read_text())["features"]["a"], 0.5, atol=0.01)
    call("replay-counterexamples", "spec.py:ramp", "--fail-on", "counterexample", code=1)
