"""`verifai-jax verify`: a file, its exit codes and its file to go on with."""

import json

import pytest
from click.testing import CliRunner

from verifai_jax.cli.main import main

MODEL = """
import jax.numpy as jnp
import verifai_jax as vj

def system(features, key):
    return vj.Trace({"x": features["x"] * jnp.ones(3)}, dt=1.0)

safe = vj.Problem("safe", {"x": vj.Box(0, 1)}, system, "always x <= 1")
half = vj.Problem("half", {"x": vj.Box(0, 1)}, system, "always x <= 0.5")
"""


@pytest.mark.slow
def test_the_command_prints_saves_goes_on_and_fails_by_its_gate(tmp_path):
    file, into = tmp_path / "model.py", tmp_path / "half.json"
    file.write_text(MODEL)

    def call(*arguments):
        options = ("--boxes", "20", "--samples", "64", "--no-progress")
        return CliRunner().invoke(main, ["verify", *arguments, *options])

    done = call(f"{file}:safe", "--fail-on", "undecided")
    assert done.exit_code == 0, done.output
    assert done.output.startswith("safe: 100 % of the prior is proved, 0 % broken, 0 % undecided")
    done = call(f"{file}:half", "--into", str(into), "--fail-on", "counterexample", "--json")
    assert done.exit_code == 1, done.output
    result = json.loads(done.stdout)
    assert result["proved"]["mass"] == pytest.approx(0.5, abs=0.05)
    parts = [result[part]["mass"] for part in ("proved", "broken", "undecided")]
    assert sum(parts) == pytest.approx(1.0)
    done = call(f"{file}:half", "--into", str(into), "--report", str(tmp_path / "now.html"))
    assert "of 40 that were looked at" in done.output
    done = CliRunner().invoke(main, ["report", str(into), "--problem", f"{file}:half"])
    assert done.exit_code == 0, done.output
    later, now = ((tmp_path / name).read_text() for name in ("half.html", "now.html"))
    # The file that was read is listed; all else is the same.
    assert "Further files that this report rests on" in later
    found = [page.split('<section id="found">')[1].split("</section>")[0] for page in (later, now)]
    assert found[0] == found[1]
    assert "evidence report on a verification" in now
    options = ["--method", "monte_carlo", "--budget", "200", "--proved", str(into)]
    done = CliRunner().invoke(main, ["estimate", f"{file}:half", *options])
    assert "that fails for certain" in done.output
    options = ["--search", "uniform", "--budget", "50", "--proved", str(into)]
    done = CliRunner().invoke(main, ["falsify", f"{file}:half", *options, "--no-progress",
                                     "--folder", str(tmp_path / "run")])  # fmt: skip
    assert "is proved and not simulated" in done.output
