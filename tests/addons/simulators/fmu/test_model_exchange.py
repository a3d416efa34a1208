"""FMUs for model exchange: our integrator, and events of every kind."""

import sys

import numpy as np
import pytest

import verifai_jax as vj
from tests.addons.simulators.fmu.compiled_fmu import build_ball

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="binaries of Linux are compiled")
TIMES = {"duration": 1.5, "dt": 0.05}
CLOCK = np.arange(31) * 0.05
G = 9.81


@pytest.fixture(scope="module", params=[2, 3])
def file(request, tmp_path_factory):
    return build_ball(tmp_path_factory.mktemp("ball"), request.param)


def bouncing(e, height=1.0, push=0.0):
    """Heights of a ball that falls from rest, in closed form."""
    g, begin, heights, v = G - push, 0.0, [], 0.0
    h, after = height, lambda: (v + np.sqrt(v * v + 2 * g * h)) / g
    for t in CLOCK:
        while t - begin > after():
            begin, v, h = begin + after(), e * np.sqrt(v * v + 2 * g * h), 0.0
        heights.append(h + v * (t - begin) - g * (t - begin) ** 2 / 2)
    return np.array(heights)


class TestEvents:
    def test_a_change_of_sign(self, file):
        trace = vj.fmu(file, **TIMES, workers=None)({"e": 0.8, "h": 0.5})
        np.testing.assert_allclose(trace.signals["h"], bouncing(0.8, 0.5), atol=1e-5)
        assert trace.signals["bounces"][-1] == 3

    @pytest.mark.parametrize("at", [0.23, 0.15])
    def test_a_time_that_is_known(self, file, at):
        system = vj.fmu(file, **TIMES, workers=None)
        trace = system({"kick_at": at, "g": 0.0})
        # A kick of 2 m/s without gravity, between two times of communication, or at one.
        np.testing.assert_allclose(trace.signals["h"], 1 + 2 * np.maximum(CLOCK - at, 0), atol=1e-6)

    def test_one_that_a_step_asks_for(self, file):
        system = vj.fmu(file, **TIMES, workers=None)
        trace = system({"e": 1.0, "asks_at": 3.0})
        # Each time the ball is faster than 3 m/s upwards, its speed is taken away.
        assert trace.signals["v"].max() <= 3.0
        assert trace.signals["h"][-1] < 0.5

    def test_a_change_of_an_input(self, file):
        space = vj.FeatureSpace({"push": vj.Signal(vj.Box(-20.0, 20.0), knots=2)})
        system = vj.fmu(file, **TIMES, workers=None)
        trace = system(space.coerce({"push": [4.0, 4.0]}))
        np.testing.assert_allclose(trace.signals["h"], bouncing(0.7, push=4.0), atol=1e-5)

        def hover(time, outputs, features):
            return {"push": G - 4.0 * outputs["v"] - 4.0 * (outputs["h"] - 0.6)}

        held = vj.fmu(file, **TIMES, workers=None, controller=hover)({})
        assert held.signals["bounces"][-1] == 0
        assert held.signals["h"][-1] == pytest.approx(0.6, abs=0.1)

    def test_the_end(self, file):
        trace = vj.fmu(file, **TIMES, workers=None)({"mode": 2})
        # At 0.32 s the ball is below half a metre.
        assert int(trace.valid) == 7
        assert set(trace.signals) == {"h", "v", "bounces"}

    def test_events_that_do_not_end(self, file):
        system = vj.fmu(file, **TIMES, workers=None)
        with pytest.raises(RuntimeError, match="more than 1,000 rounds of one event at 0 s"):
            system({"mode": 1})
        # The instance that failed is not used again.
        assert int(system({}).signals["bounces"][-1]) > 0


@pytest.mark.thorough
def test_a_ball_is_falsified(file):
    space = {"e": vj.Box(0.5, 0.9), "h": vj.Box(0.5, 1.5)}
    problem = vj.Problem(
        "ball", space, vj.fmu(file, **TIMES, workers=None), "always[0.7, 1.5] h < 0.6"
    )
    problem.check()
    run = vj.falsify(problem, "uniform", budget=20, seed=1)
    failed = run.table.counterexamples
    assert 0 < len(failed) < 20
    row = failed.iloc[0]
    heights = bouncing(row["e"], row["h"])[14:]
    assert row["rho"] == pytest.approx(0.6 - heights.max(), abs=1e-4)
