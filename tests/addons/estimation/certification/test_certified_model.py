"""Certificates, syntheses and repairs of a model that is edited: each knows what it was made of."""

import importlib
import sys
from dataclasses import replace

import pytest

import verifai_jax as vj
from verifai_jax.core.user_code.targets import load_target

SPEC = """
import numpy as np
import verifai_jax as vj
from gains import GAIN

def problem_of(policy):
    def simulate(features):
        return vj.Trace({"x": np.full(3, GAIN * features["a"] + policy["bias"])}, dt=0.1)
    return vj.Problem("biased", {"a": vj.Box(0.0, 1.0)}, vj.blackbox(simulate), "always x < 1.2")

def tuned(features):
    x = GAIN * features["a"] + features["bias"]
    return vj.Trace({"x": np.full(3, x)}, dt=0.1)

tuning = vj.Problem("tuning", {"a": vj.Box(0.0, 1.0), "bias": vj.Box(-1.0, 1.0)},
                    vj.blackbox(tuned), "always x < 1.2", nominal={"a": 0.0, "bias": 0.5})
"""


@pytest.fixture(autouse=True)
def project(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "certified_spec.py").write_text(SPEC)
    (tmp_path / "gains.py").write_text("GAIN = 1.0\n")
    yield tmp_path
    forget()


def forget():
    for name in ("gains", "certified_spec"):
        sys.modules.pop(name, None)


def tuning():
    forget()
    return load_target("certified_spec.py:tuning", vj.Problem)


def certified(memo):
    forget()
    problem_of = importlib.import_module("certified_spec").problem_of
    computed = []

    def remember(key, compute):
        if key not in memo:
            computed.append(key)
            memo[key] = compute()
        return memo[key]

    options = {"p": 0.1, "certification": vj.Certification(8, budget=8, attack_simulations=8)}
    found = vj.certify(problem_of, [{"bias": 0.0}], remember=remember, **options)
    return found, len(computed)


def names(result):
    return {name for name, *_ in result.sources["files"]}


@pytest.mark.slow
def test_blocks_of_another_model_are_no_part_of_a_certificate(project):
    memo = {}
    first, computed = certified(memo)
    assert {"certified_spec.py", "gains.py"} <= names(first)
    assert computed > 0
    assert certified(memo)[1] == 0
    (project / "gains.py").write_text("GAIN = 3.0\n")
    other, again = certified(memo)
    assert again >= computed
    assert first[0].failures == 0 < other[0].failures
    assert first.sources["files"] != other.sources["files"]


@pytest.mark.thorough
def test_a_synthesis_records_its_model():
    options = {"budget": 64, "environments": 2, "batch": 8, "progress": False}
    options["aim"] = vj.Aim(held_out=8)
    found = vj.synthesize(tuning(), "bias", **options)
    assert {"certified_spec.py", "gains.py"} <= names(found)
    assert found.sources["versions"]["verifai_jax"] == vj.__version__


@pytest.mark.slow
def test_a_repair_from_a_run_of_another_model_says_so(project):
    options = {"budget": 64, "aim": vj.Aim(held_out=8), "batch": 8, "progress": False}
    run = vj.falsify(tuning(), "uniform", 16, progress=False, confirm=False)
    found = vj.repair(run, "bias", **options)
    assert {"certified_spec.py", "gains.py"} <= names(found)
    assert "has changed" not in str(found)
    (project / "gains.py").write_text("GAIN = 3.0\n")
    found = vj.repair(replace(run, problem=tuning()), "bias", **options)
    assert str(found).startswith("The model has changed since the run: gains.py (SHA-256 ")
