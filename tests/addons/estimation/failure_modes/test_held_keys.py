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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_with_chance_of_its_own_modes_say_how_often_a_point_fails_within_the_budget():
    rng, count = np.random.default_rng(0), [0]

    def wavering(features):
        count[0] += 1
        far = abs(features["x"]) + 0.5 * rng.standard_normal()
        return vj.Trace({"a": np.array([far])}, dt=1.0)

    problem = vj.Problem("box", SPACE, vj.blackbox(wavering), "a < 2.5")
    found = vj.modes(problem, budget=8000, progress=False)
    assert {mode.name.split()[1] for mode in found} == {">", "<="}
    assert found.simulations <= count[0] <= 8000
    for mode in found:
        assert 0.4 < mode.share < 0.6
        assert 0.1 < mode.chance < 0.9
        assert "its likeliest failure fails in " in mode.cause
    assert "so each point fails with a probability" in str(found)


@pytest.mark.slow
@pytest.mark.parametrize("budget", [1000, 2600])
def test_what_fails_now_and_then_is_one_mode_with_its_probability(budget):
    count = [0]

    def seventh(features):
        count[0] += 1
        return vj.Trace({"a": np.array([0.0 if count[0] % 7 else 5.0])}, dt=1.0)

    problem = vj.Problem("counter", {"x": vj.Normal(0.0, 1.0)}, vj.blackbox(seventh), "a < 4")
    found = vj.modes(problem, budget=budget, progress=False)
    assert found.simulations <= count[0] <= budget
    assert found.probability == pytest.approx(1 / 7, abs=0.05)
    [mode] = found
    assert mode.chance == pytest.approx(1 / 7, abs=0.15)
    if mode.row is None:
        with pytest.raises(ValueError, match="does not fail when it is simulated again every time"):
            mode.explain()
