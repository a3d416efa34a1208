"""Evidence reports on estimates, comparisons and sweeps."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from planted_sweep import SPACE, planted_rows, record_of

import verifai_jax as vj
from verifai_jax.addons.estimation.commands.compare import stored_candidate
from verifai_jax.addons.estimation.comparison.result import Compared, Comparison
from verifai_jax.addons.estimation.paired_rates import paired_rates
from verifai_jax.addons.estimation.result import Estimate
from verifai_jax.addons.reports.stored import read_result
from verifai_jax.addons.training.sweeps.result import Sweep, load_sweep
from verifai_jax.cli.json_output import as_plain
from verifai_jax.cli.main import main

PROBLEM = vj.Problem(
    "fall",
    {"a<b>": vj.Box(0.0, 1.0)},
    lambda features, key: vj.Trace({"x": features["a<b>"] * jnp.ones(4)}, dt=0.1),
    "always x <= 0.6",
)


def claims_of(path):
    return json.loads(path.with_suffix(".claims.json").read_text())["claims"]


def test_an_estimate(tmp_path):
    found = Estimate(
        "fall", 0.0012, 0.001, 0.0015, 0.95, "importance", 5000, 10_000, 700, 3, 0.004, 2000, 2, 1,
        p0=0.01, seed=4, version="0.1.0",
    )  # fmt: skip
    path = found.report(tmp_path / "fall.html", problem=PROBLEM, units={"a<b>": "m"})
    text = path.read_text()
    assert "Fails with probability 0.0012 (95 % interval 0.001 to 0.0015)" in text
    assert "guaranteed at most 0.004" in text
    assert "every part of the space in which failures are" in text
    assert "a&lt;b&gt;" in text
    assert "a<b>" not in text
    assert "seed=4" in text
    assert "That the probability is below 0.01 is shown." in [c["claim"] for c in claims_of(path)]
    again = found.report(tmp_path / "again.html", problem=PROBLEM, units={"a<b>": "m"})
    assert again.read_bytes() == path.read_bytes()


def test_a_comparison(tmp_path):
    rates = paired_rates(5, 60, 4000, 0.95)
    pairs = pd.DataFrame({"a<b>": np.linspace(0, 1, 65), "worse": [True] * 60 + [False] * 5})
    calm = paired_rates(1, 3, 4000, 0.95), 3, 5
    compared = Compared("new", rates, 20, 0.002, pairs, pairs, PROBLEM.space, calm)
    path = Comparison("old", (compared,), 8000, "decided", 1.0, 7).report(tmp_path / "c.html")
    text = path.read_text()
    assert "new is worse, compared with old. All verdicts hold together at 95 %." in text
    assert "the same random key" in text.replace("same \n", "same ")
    assert "10 of 65, in the order of sampling." in text
    assert str(rates) in claims_of(path)[0]["claim"]
    assert re.search(r"seed=7", text)
    without = (
        "new: without disturbances it fails in 0.125 % of the same pairs, the baseline in 0.075"
    )
    assert without in " ".join(text.split())


def test_what_a_command_wrote_as_json(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = Estimate(
        "fall", 0.0012, 0.001, 0.0015, 0.95, "monte_carlo", 5000, 10_000, 6, 0, 0.004, 5000, 6, 0
    )
    about = {"command": "estimate", "version": "0.1.0"}
    stored = tmp_path / "estimate.json"
    stored.write_text(json.dumps({**about, **as_plain(found)}))
    again = read_result(stored)
    assert str(again) == str(found)
    assert CliRunner().invoke(main, ["report", "estimate.json"]).exit_code == 0
    assert "Fails with probability 0.0012" in (tmp_path / "estimate.html").read_text()
    rates = paired_rates(5, 60, 4000, 0.95)
    frame, calm = pd.DataFrame(), (paired_rates(1, 3, 4000, 0.95), 3, 5)
    one = Compared("new", rates, 20, 0.002, frame, frame, PROBLEM.space, calm)
    stored_one = stored_candidate(one)
    whole = {"command": "compare", "baseline": "old", "candidates": [stored_one]}
    whole["simulations"] = 8000
    whole |= {"stopped": "decided", "seconds": 1.0, "seed": 7, "notes": []}
    stored.write_text(json.dumps(whole))
    again = read_result(stored, PROBLEM.space).candidates[0]
    assert (again.rates, again.undisturbed, str(again)) == (rates, calm, str(one))
    # A file of before has no arm without disturbances.
    del stored_one["undisturbed"]
    stored.write_text(json.dumps(whole))
    assert read_result(stored, PROBLEM.space).candidates[0].undisturbed is None
    with pytest.raises(ValueError, match="give a problem that was compared"):
        read_result(stored)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no json", "not a result of"),
        ("{}", "not a result of"),
        ('{"command": "estimate", "name": "x"}', "damaged: 'probability' is missing"),
        ('{"command": "compare", "baseline": "x", "candidates": []}', "damaged: 'candidates'"),
    ],
)
def test_files_that_are_no_result(tmp_path, text, message):
    stored = tmp_path / "some.json"
    stored.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_result(stored, PROBLEM.space)


@pytest.mark.slow
def test_a_sweep(tmp_path):
    sweep = Sweep(record_of(planted_rows()), space=SPACE)
    sweep.save(tmp_path / "toy-1")
    stored = load_sweep(tmp_path / "toy-1")
    path = stored.report(tmp_path / "toy.html")
    text = path.read_text()
    shown = f"{len(stored.safe)} of {len(stored.table)} policies are shown to fail with a"
    assert f"{shown} probability below" in text
    without = (~stored.table["status"].isin(["trained", "stopped"])).sum()
    assert f"{without} trainings gave no policy, or one that is not finite." in text
    assert "log-uniform between 0.0001 and 0.01" in text
    assert "sweep.json" in text
    again = load_sweep(tmp_path / "toy-1").report(tmp_path / "toy.html")
    assert again.read_bytes() == path.read_bytes()
