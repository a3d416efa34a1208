"""The sentences of a summary follow from the table: what helps, what does not, what is unknown."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.addons.training.augmentation.result import Augmentation
from verifai_jax.addons.training.augmentation.summary import findings, summarize
from verifai_jax.addons.training.augmentation.task import SupervisedTask

OPTIONS = {
    "initial": 100,
    "added": 20,
    "further_steps": 300,
    "search": "Uniform()",
    "budget": 200,
    "hard": 50,
}


def outcome(errors, why=None, wrong=30, complete=True):
    """Return an outcome with these errors of each arm, NaN for a network that is not finite."""
    rows = []
    for arm, values in errors.items():
        for seed, error in enumerate(values):
            rows.append(
                {
                    "arm": arm,
                    "seed": seed,
                    "status": "trained" if math.isfinite(error) else "not finite",
                    "added": 0 if arm in ("base", "none") or why else 20,
                    "wrong_added": math.nan,
                    "rendered": 20,
                    "error": error,
                    "why": why if why and arm not in ("base", "none", "random") else "",
                }
            )
    seeds = len(next(iter(errors.values())))
    violated = np.arange(200) < wrong
    table = pd.DataFrame({"violated": violated, "status": "ok"})
    arms = tuple(arm for arm in errors if arm != "base")
    tables = dict.fromkeys(range(seeds), table)
    task, added = SupervisedTask("toy", {"x": vj.Box(0, 1)}, *[abs] * 5), pd.DataFrame()
    made = (task, arms, pd.DataFrame(rows), added, tables, {}, OPTIONS, 0.95, complete, "0.1.0")
    return Augmentation(*made)


def test_what_helps_is_named_with_its_size():
    found = outcome(
        {
            "base": [0.20, 0.22, 0.21],
            "none": [0.18, 0.20, 0.19],
            "random": [0.17, 0.19, 0.18],
            "counterexamples": [0.14, 0.161, 0.15],
            "rules": [0.25, 0.271, 0.26],
        }
    )
    text = summarize(found)
    assert "base         errs on 21 % of new inputs (20 % to 22 % over seeds)" in text
    assert "30 counterexamples in 200 inputs of Uniform()" in text
    assert "Lower error than none, beyond chance: counterexamples by 3.97 points, random by" in text
    assert "Higher error than none, beyond chance: rules by 7.03 points." in text
    assert "Lower error than random, beyond chance: counterexamples by 2.97 points." in text
    assert "lower the mean error 4 times as much as random inputs do, both against none." in text
    assert "NOT FINISHED" not in text
    (line,) = [line for line in text.splitlines() if line.startswith("  counterexamples ")]
    assert "-3.97 points (-4.11 to -3.82)" in line


def test_nothing_helps():
    found = outcome(
        {
            "base": [0.2, 0.2, 0.2],
            "none": [0.18, 0.20, 0.19],
            "random": [0.19, 0.18, 0.20],
            "counterexamples": [0.17, 0.21, 0.19],
        }
    )
    assert findings(found) == [
        "No arm has a lower error than none beyond chance.",
        "No arm has a lower error than random beyond chance.",
    ]


def test_one_seed_gives_no_interval():
    found = outcome({"base": [0.2], "none": [0.18], "random": [0.17], "counterexamples": [0.1]})
    text = summarize(found)
    assert "One seed gives no interval: these differences may be chance." in text
    assert "beyond chance" not in text
    assert "-8.00 points" in text
    assert "(-8" not in text


def test_a_base_that_is_never_wrong_has_no_counterexamples():
    why = "the error table has no counterexamples in 200 rows"
    found = outcome({"base": [0.0] * 2, "none": [0.0] * 2, "counterexamples": [0.0] * 2}, why, 0)
    text = summarize(found)
    assert "0 counterexamples in 200 inputs" in text
    assert "no seed has a counterexample, so arms that draw from the error table add nothing" in (
        text
    )
    assert f"counterexamples added fewer than 20 in 2 seeds; seed 0: {why}" in text


def test_networks_that_are_not_finite_are_counted_and_left_out():
    found = outcome(
        {
            "base": [0.2, 0.2, 0.2],
            "none": [0.18, 0.20, 0.19],
            "random": [0.1, math.nan, 0.11],
            "counterexamples": [math.nan, math.nan, math.nan],
        }
    )
    text = summarize(found)
    assert "not finite   4 networks (1 of random, 3 of counterexamples): left out" in text
    assert found.compare("error", "none")["random"].pairs == 2
    assert found.compare("error", "none")["counterexamples"].pairs == 0
    assert found.means.loc["random", "error"] == pytest.approx(0.105)
    (line,) = [line for line in text.splitlines() if line.startswith("  counterexamples ")]
    assert line.split()[1:] == ["-", "-", "-", "-"]


def test_nothing_is_finite():
    nothing = [math.nan, math.nan]
    text = summarize(outcome({"base": nothing, "none": nothing, "random": nothing}))
    assert "not finite   6 networks" in text
    assert "errs on" not in text
    assert "chance" not in text


def test_an_interrupted_study_says_so():
    found = outcome({"base": [0.2, 0.2], "none": [0.18, 0.2]}, complete=False)
    assert "NOT FINISHED: interrupted" in summarize(found)
    empty = replace(found, table=pd.DataFrame())
    assert summarize(empty) == "toy: interrupted before a network was trained"
