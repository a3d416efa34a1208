"""`verifai-jax formula`: findings, mutants, traces that tell apart, examples and templates."""

import json

import pytest
from click.testing import CliRunner

from verifai_jax.cli.main import main

LOG = "time,speed,dist\ns,m/s,m\n" + "".join(f"{k / 10},{k % 7},{9 - k % 7}\n" for k in range(50))


def call(*arguments, code=0):
    result = CliRunner().invoke(main, ["formula", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.stdout


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(LOG)
    return path


def test_findings_fail_a_gate_and_are_json(log):
    text = "always (speed > 50 -> dist > near)"
    output = call("lint", text, log, "--const", "near=2", "--fail-on", "finding", "--json", code=1)
    found = json.loads(output)
    kinds = [finding["kind"] for finding in found["findings"]]
    assert kinds == ["units", "vacuous"]
    assert (found["recordings"], found["gate"]["passed"]) == (1, False)
    clean = call("lint", "always speed < 7", log, "--fail-on", "finding")
    assert clean.startswith("0 findings on 1 formula, with 1 recording")
    requirements = log.with_name("requirements.toml")
    requirements.write_text('[[requirement]]\nid = "far"\nformula = "always dist < 900"\n')
    assert "far  always (dist < 900)" in call("lint", requirements, log)


def test_units_are_given_by_option():
    assert "compares km with m" in call("lint", "always a < b", "--unit", "a=km", "--unit", "b=m")


def test_mutants_and_pairs(log):
    assert "survive" in call("mutants", "always speed < 7", log)
    call("mutants", "always speed < 7", log, "--fail-on", "survivor", code=1)
    output = call("distinguish", "always x > 1", "always x >= 1", "--fail-on", "apart", code=1)
    assert output.startswith("a free trace tells the formulas apart")
    assert "among 1 trace (of the recordings)" in call(
        "distinguish", "always speed < 8", "always speed < 9", log
    )


def test_templates_are_found_by_words():
    found = json.loads(call("templates", "aircraft 250 kt", "--json"))
    assert [each["id"] for each in found["templates"]] == ["speed-below-10000"]
    assert call("templates", "no", "such", "words") == "no template has all of these words\n"
    assert "industrial robots" in call("templates", "--domain", "robots")


@pytest.mark.thorough
def test_examples_are_drawn(tmp_path):
    output = call("examples", "always x > 1", "--plot", tmp_path / "examples.png")
    assert "barely" in output
    assert (tmp_path / "examples.png").exists()


def test_recordings_and_a_problem_are_not_both_given(log):
    result = CliRunner().invoke(
        main, ["formula", "lint", "always x > 1", str(log), "--problem", "a.py:b"]
    )
    assert result.exit_code == 2
    assert "give either recordings or --problem, and not both" in result.output


def test_gaps_of_a_recording_are_held_or_left_out(tmp_path):
    path = tmp_path / "gaps.csv"
    path.write_text("time,x\n0,3\n1,\n2,2\n3,4\n")
    runner = CliRunner()
    gap = runner.invoke(main, ["monitor", "always x > 1", str(path)])
    assert gap.exit_code == 3
    assert "signal 'x' is NaN at 1 s" in gap.output
    held = runner.invoke(main, ["monitor", "always x > 1", str(path), "--missing", "hold"])
    assert held.output.startswith("holds with robustness 1\n")
    requirements = tmp_path / "requirements.toml"
    requirements.write_text('[[requirement]]\nid = "x"\nformula = "always x > 1"\n')
    arguments = ["monitor", str(requirements), str(path), "--missing", "interpolate"]
    assert "0 of 1 verdicts fail" in runner.invoke(main, arguments).output
