"""Case studies from requirements to reports: the commands of each page leave no link missing."""

import shlex
import shutil
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from verifai_jax.cli.main import main

CASES = Path(__file__).parents[4] / "examples/case_studies"
CHANGES = {
    "infusion_pump": [
        ("pump.py", "always given <= 30", "always given <= 29", {"PUMP-2"}),
        ("pump.py", "/ 1200.0", "/ 1300.0", {"PUMP-1", "PUMP-2", "PUMP-3", "PUMP-4"}),
        ("pump.py", "LogUniform(15.0", "LogUniform(14.0", {"PUMP-1", "PUMP-2", "PUMP-3", "PUMP-4"}),
        ("pump.py", "for weak and strong patients", "for everybody", set()),
        ("requirements.yaml", "severity: minor", "severity: major", {"PUMP-4"}),
        ("requirements.yaml", "at least 8 times", "at least 9 times", {"PUMP-1"}),
    ],
    "cart_pole": [
        ("balance.py", "0.20944", "0.2", {"CP-2"}),
        ("balance.py", "duration=4.0", 'duration=4.0, method="rk4"', {"CP-1", "CP-2"}),
        ("requirements.yaml", "critical", "major", {"CP-1"}),
    ],
    "tempe": [
        ("crossing.py", "ego_y > 10", "ego_y > 11", {"TEMPE-3"}),
        ("crossing.py", "tempe(),", "tempe(eyes=True),", {"TEMPE-1", "TEMPE-2", "TEMPE-3"}),
        ("requirements.yaml", "comfort of the passengers", "a standard", {"TEMPE-2"}),
    ],
}
"""File, text, what takes its place, and the requirements whose links that makes suspect."""


def commands(name: str) -> list[list[str]]:
    """Return the arguments of the commands of a case's page."""
    text = (CASES / name / "README.md").read_text()
    lines = text.split("```sh\n")[1].split("```")[0].splitlines()
    return [shlex.split(line.removeprefix("verifai-jax ")) for line in lines]


def trace(arguments: list[str]):
    """Trace as another process would: nothing that was imported before is known."""
    from verifai_jax.addons.checking._test import load, problems_of

    load.cache_clear()
    problems_of.cache_clear()
    return CliRunner().invoke(main, arguments)


@pytest.mark.thorough
@pytest.mark.parametrize("name", CHANGES)
def test_each_requirement_has_a_formula_and_a_test(name, monkeypatch):
    monkeypatch.chdir(CASES.parents[1])
    monkeypatch.setattr(sys, "path", [*sys.path])
    words = commands(name)[-1]
    asked = words[: words.index("--runs")]
    done = trace([*asked, "--without", "runs", "--without", "reports", "--fail-on", "incomplete"])
    assert done.exit_code == 0, done.output
    assert "every link is there, and fits" in done.output


@pytest.mark.slow  # Runs, estimates and pictures of a whole study.
@pytest.mark.parametrize("name", CHANGES)
def test_no_link_is_missing_and_a_change_touches_what_depends_on_it(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    folder = tmp_path / "examples/case_studies" / name
    shutil.copytree(CASES / name, folder)
    *before, last = commands(name)
    for each in before:
        each += ["--no-studies", "--traces", "2"] if each[0] == "report" else []
        done = CliRunner().invoke(main, each)
        assert done.exit_code == 0, done.output
    done = trace(last)
    assert done.exit_code == 0, done.output
    assert "every link is there, and fits" in done.output
    for file, old, new, suspect in CHANGES[name]:
        path = folder / file
        text = path.read_text()
        assert text.count(old) == 1
        path.write_text(text.replace(old, new))
        done = trace(last)
        path.write_text(text)
        assert done.exit_code == bool(suspect), done.output
        named = done.output.partition("Suspect:")[2]
        found = {line.split(":")[0].strip() for line in named.splitlines() if "since" in line}
        assert found == suspect, done.output
        assert "Missing:" not in done.output
