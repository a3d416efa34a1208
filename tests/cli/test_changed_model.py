"""Commands on results whose model has been edited since."""

import hashlib
import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from verifai_jax.cli.main import main
from verifai_jax.core.display import progress

SPEC = """
import numpy as np
import verifai_jax as vj

LIMIT = 1.2
calls = []

def simulate(features):
    return vj.Trace({"x": np.full(3, features["a"] + features["b"])}, dt=0.1)

def remember(features):
    calls.append(1)
    return vj.Trace({"x": np.full(3, features["a"] + len(calls))}, dt=0.1)

space = {"a": vj.Box(0.0, 1.0), "b": vj.Box(0.0, 1.0)}
nominal = {"a": 0.0, "b": 0.0}
sum = vj.Problem("sum", space, vj.blackbox(simulate), "always x < 1.2", nominal=nominal)
memory = vj.Problem("memory", space, vj.blackbox(remember), "always x < 1.2", nominal=nominal)
"""
OTHER = SPEC.replace('features["a"] + f', '2.0 * features["a"] + f')
CHANGED = "The model has changed since "


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # However slow the machine is, no command takes so long that it says how to go on.
    monkeypatch.setattr(progress, "MOMENT", 3600.0)
    Path("spec.py").write_text(SPEC)

    def run(words, code=0):
        result = CliRunner().invoke(main, words.split())
        assert result.exit_code == code, result.output
        return result.output

    return run


@pytest.fixture
def folder(call):
    call("falsify spec.py:sum --search uniform --budget 32 --no-confirm --no-pictures --folder run")
    return Path("run")


def sha(text):
    return hashlib.sha256(text.encode()).hexdigest()


@pytest.mark.thorough
def test_resume_is_refused_and_may_be_meant(call, folder):
    call("falsify --resume run --budget 40 --no-pictures")
    Path("spec.py").write_text(OTHER)
    output = call("falsify --resume run --budget 48 --no-pictures", code=2)
    assert f"spec.py (SHA-256 {sha(SPEC)[:12]} then, {sha(OTHER)[:12]} now)" in output
    assert "--even-if-changed" in output
    output = call("falsify --resume run --budget 48 --no-pictures --even-if-changed")
    assert "they are of several models" in output.splitlines()[0]
    assert "from row 40 on with another model" in output
    assert [part["first"] for part in json.loads(Path("run/run.json").read_text())["sources"]] == [
        0,
        40,
    ]


@pytest.mark.thorough
def test_a_replay_says_so_and_ends_with_a_code_of_its_own(call, folder):
    assert CHANGED not in call("replay run --no-pictures")
    Path("spec.py").write_text(OTHER)
    output = call("replay run --no-pictures", code=4)
    assert output.startswith(f"{CHANGED}row ")
    assert "does not give its number again: robustness" in output.splitlines()[1]
    assert output == call("replay run --no-pictures --even-if-changed")
    output = call("replay run --no-pictures --json --even-if-changed")
    result = json.loads(output[output.index("\n{") :])
    assert result["changed"] == [{"name": "spec.py", "was": sha(SPEC), "now": sha(OTHER)}]
    assert "does not give its number" in result["finding"]


def test_a_comment_changes_the_file_and_no_number(call, folder):
    Path("spec.py").write_text(f"{SPEC}# Checked.\n")
    output = call("replay run --no-pictures")
    assert output.startswith(CHANGED)
    assert "its number again" not in output


def test_a_system_with_memory_ends_with_the_same_code(call):
    call("falsify spec.py:memory --search uniform --budget 8 --no-confirm --no-pictures")
    output = call("replay runs/memory-1 2 --no-pictures", code=4)
    assert "the system has memory, chance or state of its own" in output
    assert CHANGED not in output


@pytest.mark.slow
@pytest.mark.parametrize("command", ["explain", "shrink", "confirm"])
def test_studies_of_a_row_say_it_first(call, folder, command):
    pictures = "" if command == "confirm" else "--no-pictures"
    Path("spec.py").write_text(OTHER)
    output = call(f"{command} run {pictures}", code=4)
    assert output.startswith(CHANGED)
    assert call(f"{command} run {pictures} --even-if-changed").startswith(CHANGED)


@pytest.mark.slow
def test_a_report_has_both_hashes_on_its_first_page(call, folder):
    call("report run --traces 4")
    text = Path("run/report.html").read_text()
    assert "has changed since this result was made" not in text
    assert "Yes: 1 file, by hash." in text
    assert sha(SPEC) in text
    Path("spec.py").write_text(OTHER)
    for option in ("", "--without-problem"):
        call(f"report run --traces 4 {option}")
        text = Path("run/report.html").read_text()
        first, _, rest = text.partition("<nav")
        assert "The model has changed since this result was made." in first
        assert sha(SPEC) in first
        assert sha(OTHER) in first
        assert ("do not give their numbers" in first) == (not option)
        assert "No: spec.py" in rest
    # The file has the hash that it had when it ran.
    inputs = rest[rest.index("SHA-256</th><th") :]
    assert sha(SPEC) in inputs
    assert sha(OTHER) not in inputs


@pytest.mark.slow
def test_a_run_that_recorded_no_model_is_reported_as_such(call, folder):
    from verifai_jax.core.store.files import sealed

    record = json.loads((folder / "run.json").read_text())
    record["sources"] = []
    (folder / "run.json").write_text(json.dumps(sealed(record)))
    call("report run --traces 1 --no-studies")
    assert "Not recorded: nobody can say" in (folder / "report.html").read_text()


@pytest.mark.slow
def test_an_estimate_and_a_comparison_are_reported_with_both_hashes(call):
    Path("new.py").write_text(SPEC)
    estimate = call("estimate spec.py:sum --budget 400 --method monte_carlo --json")
    Path("estimate.json").write_text(estimate[estimate.index("\n{") :])
    compared = call("compare spec.py:sum new.py:sum --budget 400 --margin 0.3 --json")
    Path("compared.json").write_text(compared[compared.index("\n{") :])
    for file, edited in (("estimate.json", "spec.py"), ("compared.json", "new.py")):
        for text in (SPEC, OTHER):
            Path(edited).write_text(text)
            call(f"report {file} --problem spec.py:sum")
            first = Path(file).with_suffix(".html").read_text().partition("<nav")[0]
            assert ("has changed since this result was made" in first) == (text == OTHER)
            assert (sha(OTHER) in first) == (text == OTHER)
        Path(edited).write_text(SPEC)
