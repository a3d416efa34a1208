"""`verifai-jax fuzz`: a run that says what it covered, and that other commands go on with."""

import json

import pytest
from click.testing import CliRunner

from verifai_jax.cli.main import main

PROBLEM = """
import jax.numpy as jnp
import verifai_jax as vj

traffic = vj.events.Automaton(
    "free",
    {("free", "join"): {"to": "busy", "wait": vj.Box(0.1, 1)},
     ("busy", "leave"): {"to": "free", "wait": vj.Box(0.1, 1)}},
    max_events=3,
)

def level(features, key):
    events, times = features["events"], jnp.arange(12) * 0.25
    return vj.Trace({"n": events.count(times)}, dt=0.25)

ramp = vj.Problem("ramp", {"events": traffic}, level, "always n < 3")
"""


def call(*arguments, code=0):
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    assert result.exit_code == code, result.output
    return result.output


@pytest.mark.slow
def test_fuzz_then_shrink(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(PROBLEM)
    options = ["--budget", 256, "--batch", 64, "--cells", "n=-0.5:3.5:4", "--no-pictures"]
    output = call("fuzz", "spec.py:ramp", *options, "--fail-on", "counterexample", code=1)
    assert "  covered" in output
    assert "2 of 2" in output
    assert "simulations extended coverage" in output
    told = CliRunner().invoke(main, ["fuzz", "spec.py:ramp", *map(str, options), "--json"])
    coverage = json.loads(told.stdout)["coverage"]
    assert {"of", "kind", "covered", "total"} == set(coverage[0])
    assert coverage[0]["covered"] == coverage[0]["total"] == 2
    assert "3 events: join at" in call("shrink", "runs/ramp-1", "--no-pictures")


def test_cells_that_are_none(tmp_path):
    result = CliRunner().invoke(main, ["fuzz", "spec.py:ramp", "--cells", "n=3"])
    assert result.exit_code == 2
    assert "--cells n must be LOW:HIGH:COUNT, such as 0:30:6; got '3'" in result.output
