"""Searches that propose to a stranger's runner of Scenic, with a fake simulator."""

import math

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.scenic.compilation import without_verifai

PROGRAM = """
ego = new Object at Range(-10, 10) @ Range(-10, 10), with speed Range(0, 30)
other = new Object at Range(30, 60) @ 0, with requireVisible False
require other.position.x - ego.position.x > 22
"""
EXTERNAL = """
ego = new Object at VerifaiRange(-10, 10) @ VerifaiRange(-10, 10, weights=[1, 3]),
    with speed VerifaiRange(0, 30), with lane VerifaiDiscreteRange(1, 4)
require ego.position.x > -9
"""


def simulate(scene):
    """A fake simulator: it fails where three values are near those of a planted failure."""
    ego = scene.egoObject
    away = (ego.position.x - 6.1) / 20, (ego.position.y + 7.3) / 20, (ego.speed - 24) / 30
    return math.hypot(*away) - 0.06  # About one scene in 1100.


def scenes_until_failure(scenario, limit=6000):
    rho = None
    for count in range(1, limit + 1):
        scene, _ = scenario.generate(maxIterations=2000, feedback=rho)
        rho = simulate(scene)
        if rho < 0:
            return count
    return limit


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("installed")
class TestWithScenic:
    @pytest.mark.slow
    def test_a_planted_failure_is_found_in_a_fifth_of_scenics_own_samples(self, monkeypatch):
        import random

        import scenic

        own, steered = [], []
        for seed in range(10):
            random.seed(seed)
            np.random.seed(seed)  # noqa: NPY002 - what Scenic draws from
            own.append(scenes_until_failure(scenic.scenarioFromString(PROGRAM, mode2D=True)))
            scenario = vj.scenic(PROGRAM).steered("cross_entropy", seed=seed)
            steered.append(scenes_until_failure(scenario))
        assert np.median(steered) <= np.median(own) / 5
        # The failure is Scenic's own scene at the features of the search.
        program = scenario.program
        assert simulate(program.scene(scenario.features)) < 0

    @pytest.mark.slow
    def test_an_external_sampler_of_scenic(self):
        import scenic

        with without_verifai():
            sampler = vj.scenic_sampler("cross_entropy", seed=3)
            scenario = scenic.scenarioFromString(
                EXTERNAL, mode2D=True, params={"externalSampler": sampler}
            )
            first = [scenario.generate()[0] for _ in range(300)]
            scenario.resetExternalSampler()
            found = scenes_until_failure(scenario, 1000)
        x, y, speed, lane = (
            np.array([getattr(scene.egoObject, name) for scene in first])
            for name in ("x", "y", "speed", "lane")
        )
        assert x.min() > -9
        assert x.max() <= 10
        assert 0.65 < np.mean(y > 0) < 0.85  # Three to one.
        assert np.abs(np.histogram(speed, 3, (0, 30))[0] / 300 - 1 / 3).max() < 0.09
        assert set(lane) == {1, 2, 3, 4}
        assert found < 600

    def test_what_a_sampler_cannot_do(self):
        with pytest.raises(ValueError, match="learns from derivatives, and a feedback is one num"):
            vj.scenic_sampler("gradient")
        with pytest.raises(ValueError, match="unknown search 'cros_entropy'; did you mean 'cross"):
            vj.scenic(PROGRAM).steered("cros_entropy")
        grid = vj.scenic("ego = new Object at Range(0, 1) @ 0").steered("grid")
        for _ in range(grid._steps._proposals.total):
            grid.generate()
        with pytest.raises(ValueError, match="the search has no further point"):
            grid.generate()
