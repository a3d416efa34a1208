"""`verifai-jax fmea`: a table, its file, and commands that replay its counterexamples."""

import json
import shlex

import pandas as pd
import pytest
from click.testing import CliRunner

from verifai_jax.cli.main import main

PROBLEM = """
import jax.numpy as jnp
import verifai_jax as vj

system = vj.ode(
    lambda time, state, control, features: {"x": control["push"]},
    lambda features, key: {"x": features["x0"]},
    controller=lambda time, state, features: {"push": -state["x"]},
    dt=0.1, duration=2.0,
)
held = vj.Problem("held", {"x0": vj.Box(0, 1)}, system, "always x <= 1", nominal={"x0": 0.5})
faulty = held.with_faults(
    vj.faults.Stuck("push", value=1.0, onset=vj.Box(0, 1), duration=vj.Box(0, 2)),
    vj.faults.Freeze("x", duration=vj.Box(0, 1)),
)
"""


def call(*arguments, code=0):
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    assert result.exit_code == code, result.output
    return result.stdout


@pytest.mark.slow
def test_a_table_and_its_replays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(PROBLEM)
    options = ["--samples", 100, "--budget", 200, "--rate", 1e-3, "--mission-time", 8]
    found = json.loads(call("fmea", "spec.py:faulty", *options, "--json"))
    stuck, freeze = found["effects"]
    assert (stuck["faults"], stuck["verdict"]) == (["push_stuck"], "confirmed")
    assert not freeze["fails"]
    table = pd.read_csv("runs/fmea-faulty/fmea.csv", index_col="fault")
    assert table.loc["push_stuck", "replay"] == stuck["command"]
    words = shlex.split(stuck["command"])
    assert words[:3] == ["verifai-jax", "replay", "runs/fmea-faulty/counterexamples"]
    assert "status ok; violated" in call(*words[1:])
    refusal = call("fmea", "spec.py:held", code=2)
    assert refusal == ""
