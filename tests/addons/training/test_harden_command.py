"""`verifai-jax harden`: a study is hardened, its folder holds the work, and the gate decides."""

import json
import textwrap

import pytest
from click.testing import CliRunner

from verifai_jax.cli.main import main

SPEC = """
from dataclasses import replace

import jax.numpy as jnp

import verifai_jax as vj
from verifai_jax.addons.rl import PPO, Continuous
from verifai_jax.addons.rl.task.ode import ode_task

NOMINAL = {"x0": 0.1, "pull": 1.0}
LOOP = vj.ode(
    lambda time, state, force, features: {"x": features["pull"] * state["x"] + force},
    lambda features, key: {"x": features["x0"]},
    dt=0.1, steps=10,
)
TASK = ode_task(
    LOOP, Continuous(-1.0, 1.0), features=NOMINAL,
    reward=lambda time, state, force, after: 1.0 - jnp.abs(after["x"]),
)
SMALL = PPO(hidden=(4,), value_hidden=(4,), environments=4, horizon=16, minibatches=1)

def staying(policy):
    loop = replace(
        LOOP, controller=lambda time, state, features: policy.act(state["x"][None])[0]
    )
    space = {"x0": vj.Box(-1.0, 1.0), "pull": vj.Box(0.5, 1.5)}
    return vj.Problem("stay", space, loop, "always x <= 1.5", nominal=NOMINAL)

study = vj.Study(
    "stay", {"steps": vj.Categorical(128)}, vj.Trainer(TASK, SMALL, steps=128), staying, p=0.05
)
"""


@pytest.mark.slow
def test_a_study_is_hardened(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.py").write_text(textwrap.dedent(SPEC))
    words = ["harden", "spec.py:study", "--rounds", "1", "--samples", "32"]
    words += ["--attack-simulations", "32", "--json", "--fail-on", "unsafe"]
    ended = CliRunner().invoke(main, words)
    assert ended.exit_code in (0, 1), ended.output
    found = json.loads(ended.stdout)
    assert found["stopped"] in ("certified", "budget")
    assert (tmp_path / "runs" / "harden-study").is_dir()
    assert (ended.exit_code == 1) == (not found["verdict"].startswith("safe"))
    again = CliRunner().invoke(main, words)
    for one, other in zip(json.loads(again.stdout)["table"], found["table"], strict=True):
        # The second call takes everything from the folder.
        assert {**one, "seconds": 0} == {**other, "seconds": 0}
    refused = CliRunner().invoke(main, ["harden", "spec.py:TASK"])
    assert refused.exit_code == 2
    assert "unknown study in spec.py 'TASK'" in refused.output
