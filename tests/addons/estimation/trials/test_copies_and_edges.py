"""Trials that look like copies, and posteriors that end at the edge of a domain, are named."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import verifai_jax as vj
from verifai_jax.addons.estimation.trials.reading import copies


@pytest.fixture(scope="module")
def problem():
    def system(features, key):
        return vj.Trace({"y": (features["a"] - features["k"]) * jnp.ones(2)}, dt=1.0)

    return vj.Problem("k", {"a": vj.Box(0, 1), "k": vj.Box(0, 1)}, system, "always y > 0")


def test_copies_are_named_by_their_rows():
    frame = pd.DataFrame({"a": [0.1, 0.2, 0.1, 0.3], "b": [1.0, 1.0, 1.0, 1.0], "n": [1, 1, 1, 1]})
    [note] = copies(frame)
    assert "all real features (a)" in note
    assert "rows 0, 2." in note
    assert copies(frame.iloc[:2]) == []
    # Choices and whole numbers agree by chance, and one constant says nothing.
    assert copies(frame[["n"]]) == copies(frame[["b"]]) == []


@pytest.mark.thorough
def test_both_results_of_trials_say_it(problem):
    a = np.linspace(0.1, 0.9, 5)
    frame = pd.DataFrame({"a": np.repeat(a, 2), "k": 0.5, "failed": np.repeat(a < 0.5, 2)})
    found = vj.real_trials(problem, frame, simulations=64, progress=False)
    assert any("agree in every digit" in note for note in found.notes)
    pairs = pd.DataFrame({
        "pair": np.tile(np.arange(10), 2), "policy": ["old"] * 10 + ["new"] * 10,
        "a": np.tile(np.repeat(a, 2), 2), "failed": ["no"] * 20,
    })  # fmt: skip
    assert "agree in every digit" in str(vj.compare_trials(pairs, "old", "new"))
    assert not vj.compare_trials(pairs.drop(columns="a"), "old", "new").notes


@pytest.mark.thorough
@pytest.mark.parametrize(("truth", "word"), [(1.3, "highest"), (-0.3, "lowest"), (0.5, "")])
def test_a_calibration_says_when_it_ends_at_an_edge(problem, truth, word):
    a = np.linspace(0.02, 0.98, 12)
    trials = pd.DataFrame({"a": a, "robustness": a - truth})
    found = vj.calibrate(problem, trials, ["k"], simulations=2400)
    assert [word in note for note in found.notes] == [True] * bool(word)
    assert ("edge of its domain" in str(found)) == bool(word)
