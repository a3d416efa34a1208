"""Modes of systems that draw random numbers: two half-planes with noise are two modes."""

import jax
import numpy as np
import pytest
from scipy.stats import norm

import verifai_jax as vj

SPACE = {"x": vj.Normal(0.0, 1.0), "y": vj.Normal(0.0, 1.0)}
FORMULAS = {"a": "a < 2.5", "b": "b < 3"}


def noisy(features, key):
    noise = 0.5 * jax.random.normal(key)
    signals = {"a": (features["x"] + noise)[None], "b": (features["y"] + noise)[None]}
    return vj.Trace(signals, dt=1.0)


def noisy_on_the_host(features, seed):
    noise = 0.5 * np.random.default_rng(seed).standard_normal()
    signals = {"a": np.array([features["x"] + noise]), "b": np.array([features["y"] + noise])}
    return vj.Trace(signals, dt=1.0)


@pytest.fixture(scope="module")
def found():
    problem = vj.Problem("noisy", SPACE, noisy, FORMULAS, nominal={"x": 0.0, "y": 0.0})
    return vj.modes(problem, budget=20_000, progress=False)


@pytest.mark.thorough
def test_two_half_planes_with_noise_are_two_modes_with_their_probabilities(found):
    assert len(found) == 2
    assert found.simulations <= 20_000
    for mode, name, threshold in zip(found, "xy", (2.5, 3.0), strict=True):
        # Where both fail a failure counts once.
        assert mode.probability == pytest.approx(norm.sf(threshold / np.hypot(1, 0.5)), rel=0.25)
        assert mode.name.startswith(f"{name} > ")
        assert f"at 0 s {'a' if name == 'x' else 'b'} is" in mode.cause
    assert found.unexplained[0] < 0.02
    assert any("mode.random_key" in note for note in found.notes)


@pytest.mark.thorough
def test_what_a_mode_hands_out_fails_again(found):
    for mode, changed in zip(found, "xy", strict=True):
        again = mode.replay()
        assert again.violated
        trace = mode.problem.system(again.features, mode.random_key)
        assert float(trace.signals["a" if changed == "x" else "b"][0]) >= (2.5, 3.0)[mode.number]
        assert mode.run.replay(mode.row).violated
        assert mode.explain().replay.violated
        small = mode.shrink(budget=100)
        assert set(small.changed) == {changed}
        assert small.replay().violated


@pytest.mark.slow
def test_a_black_box_with_a_seed_is_one_that_draws():
    box = vj.blackbox(noisy_on_the_host, seeded=True)
    found = vj.modes(vj.Problem("box", SPACE, box, FORMULAS), budget=6000, progress=False)
    assert 1 <= len(found) <= 3
    assert all(mode.replay().violated for mode in found)
