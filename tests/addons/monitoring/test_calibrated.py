"""Monitors with conformal guarantees: what they promise, on systems whose law is known."""

import numpy as np
import pytest

from verifai_jax import mtl
from verifai_jax.addons.monitoring.conformal import conformal_p_value, conformal_threshold
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Trace

DT, LENGTH = 0.1, 40


def runs(random, count, push=0.0):
    """A car that is pushed about at random in front of a wall at 0."""
    speed = np.cumsum(random.normal(push, 0.12, size=(count, LENGTH)), axis=1)
    gap = 3.0 + np.cumsum(speed * DT, axis=1)
    return [Trace({"gap": g, "speed": s}, dt=DT) for g, s in zip(gap, speed, strict=True)]


def test_a_threshold_is_exceeded_as_seldom_as_it_says():
    random = np.random.default_rng(0)
    sets = random.normal(size=(4000, 10))
    exceeded = [last > conformal_threshold(others, 0.2) for *others, last in sets]
    unlikely = [conformal_p_value(others, last) <= 0.2 for *others, last in sets]
    assert 0.17 < np.mean(exceeded) <= 0.22
    assert 0.17 < np.mean(unlikely) <= 0.22
    with pytest.raises(ValueError, match=r"at alpha=0.05 needs 19 runs or more .*; got 18"):
        conformal_threshold(range(18), 0.05)
    assert conformal_threshold(range(19), 0.05) == 18


def check_guarantees(sets, further):
    false, above, caught, strange = [], [], [], []
    for seed in range(sets):
        random = np.random.default_rng(seed)
        traces = runs(random, 120)
        monitor = mtl.predictive_monitor("always gap > 0", traces, 0.5, alpha=0.1)
        domain = mtl.domain_monitor(traces, alpha=0.1)
        for trace in runs(random, further):
            forecasts = monitor.forecasts(trace)
            alarms = [forecast.alarm for forecast in forecasts]
            worst = np.array([trace["gap"][k : k + 6].min() for k in range(LENGTH)])
            above.append(any(f.low > w for f, w in zip(forecasts, worst, strict=True)))
            broken = np.flatnonzero(trace["gap"] <= 0)
            (caught if len(broken) else false).append(
                any(alarms[: broken[0] + 1] if len(broken) else alarms)
            )
            strange.append(any(d.alarm for d in domain.distances(trace)))
    return [np.mean(each) for each in (false, above, strange, caught)]


@pytest.mark.slow
def test_alarms_are_false_as_seldom_as_they_say():
    false, above, strange, caught = check_guarantees(12, 40)
    assert max(false, above, strange) < 0.16
    assert caught > 0.9


@pytest.mark.proves
def test_the_rates_of_two_hundred_sets_are_within_alpha():
    false, above, strange, _ = check_guarantees(200, 30)
    assert max(false, above, strange) <= 0.1 + 0.012  # Three deviations of the mean.


def test_a_run_is_followed_sample_by_sample():
    random = np.random.default_rng(1)
    traces, trace = runs(random, 100), runs(random, 1)[0]
    monitor = mtl.predictive_monitor("always gap > 0", traces, 0.5, lags=(0, 2))
    step = monitor.start()
    samples = [{name: trace[name][k] for name in ("gap", "speed")} for k in range(LENGTH)]
    for forecast, expected in zip(map(step, samples), monitor.forecasts(trace), strict=True):
        np.testing.assert_allclose(forecast, expected, rtol=1e-9)
    with pytest.raises(UnknownNameError, match="the sample has no signal 'gap'"):
        monitor.start()({"speed": 1.0})
    alone = mtl.predictive_monitor("always gap > 0", traces, 0.5, signals=["gap"]).start()
    assert alone({"gap": 3.0}).low < 3.0


def test_an_input_far_from_all_that_was_tested_raises_an_alarm():
    random = np.random.default_rng(2)
    monitor = mtl.domain_monitor(runs(random, 60), signals=["speed"])
    step = monitor.start()
    assert not step({"speed": 0.1}).alarm
    far = step({"speed": 40.0})
    assert far.alarm
    assert far.p_value == 1 / 31
    assert far.distance > monitor.reach


def test_too_few_runs_are_refused():
    traces = runs(np.random.default_rng(3), 30)
    with pytest.raises(ValueError, match="needs 19 runs or more to calibrate; got"):
        mtl.predictive_monitor("always gap > 0", traces, 0.5)
    with pytest.raises(ValueError, match="two runs or more are needed"):
        mtl.domain_monitor(traces[:1])
    with pytest.raises(mtl.IntervalError, match="not a multiple"):
        mtl.predictive_monitor("always gap > 0", traces, 0.55, alpha=0.3)
