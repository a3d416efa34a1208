"""A file of a corpus that is damaged is named, and the others are replayed."""

import json

import jax.numpy as jnp
import pytest

import verifai_jax as vj
from verifai_jax.addons.checking.check import Check

SPACE = {"a": vj.Box(0.0, 2.0), "mode": vj.Categorical("calm", "storm")}


def system(f, key):
    return vj.Trace({"x": jnp.full(3, f["a"] + (f["mode"] == 1))}, dt=1.0)


@pytest.fixture(scope="module")
def problem():
    return vj.Problem("windy", SPACE, system, "always x < 2")


@pytest.fixture(scope="module")
def saved(problem, tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    run = vj.falsify(problem, "uniform", 64, confirm=False, progress=False)
    (path,) = run.save_counterexamples(folder, max_count=1)
    return path.read_text()


DAMAGES = {
    "formulas": [{"spec": 0.5}, [], "always x < 2", None],
    "row": [2**70, -1, 0.5, True, None],
    "seed": [2**64, "0"],
    "features": [{"a": [1], "mode": "calm"}, {"a": "high", "mode": "calm"}, {"a": 2**2000}, {},
                 {"a": 1.0, "mode": 7}, {"a": {"b": 1}, "mode": "calm"}, {"a": True, "mode": None},
                 {"a": float("nan"), "mode": "calm"}, {"a": 1e400, "mode": "\ud800"}],
    "robustness": [{"spec": "low"}, 3, {"spec": [1.0]}],
    "backend": [3, "warp"],
    "problem": [None, ["windy"]],
    "target": [7],
    "verdict": [{}],
    "changed": [[], {"a": 1}],
    "found": [None, "here"],
    "precision": ["float16", None, ["float32"]],
    "format": [None, "1", 2],
}  # fmt: skip


@pytest.mark.thorough
def test_a_damaged_file_ends_no_replay(problem, saved, tmp_path):
    content, count = json.loads(saved), 0
    (tmp_path / "whole.json").write_text(saved)
    for name, values in DAMAGES.items():
        for value in values:
            count += 1
            (tmp_path / f"bad-{count}-{name}.json").write_text(json.dumps({**content, name: value}))
    for text in ("", "[" * 100_000, "[1]", '{"format": 1}', "\x00"):
        count += 1
        (tmp_path / f"bad-{count}-text.json").write_text(text)
    (tmp_path / "bad-bytes.json").write_bytes(b"\xff\xfe")
    (tmp_path / "bad-folder.json").mkdir()
    result = vj.replay_counterexamples(problem, tmp_path)
    bad = [one for one in result.replayed if one.path.name != "whole.json"]
    (whole,) = result.failing
    assert whole.path.name == "whole.json"
    assert len(bad) == count + 2
    assert {one.state for one in bad} == {"no longer valid"}
    assert all(one.note for one in bad)
    told = [one.note for one in bad if one.path.name.endswith("-formulas.json")]
    assert all("formulas must be an object of texts; got " in note for note in told)
    str(result).encode()
    assert len(max(str(result).splitlines(), key=len)) < 900


@pytest.mark.thorough
def test_no_file_is_passed_over_in_silence(problem, saved, tmp_path):
    (tmp_path / "below" / "deeper").mkdir(parents=True)
    for place in ("A.JSON", "below/b.json", "below/deeper/c.Json"):
        (tmp_path / place).write_text(saved)
    (tmp_path / ".hidden").mkdir()
    (tmp_path / ".hidden" / "d.json").write_text("{")
    (tmp_path / "README.md").write_text("What was found.")
    assert len(vj.replay_counterexamples(problem, tmp_path).failing) == 3
    assert len(vj.replay_counterexamples(problem, tmp_path / "A.JSON").failing) == 1
    with pytest.raises(ValueError, match=r"the corpus must be a folder .*A.JSON is a file"):
        Check(budget=16).run(problem, corpus=tmp_path / "A.JSON")
