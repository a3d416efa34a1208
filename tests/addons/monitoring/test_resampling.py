"""Resampling loses no sample: verdicts are those of the clock's samples and the recorded ones."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import explain, read, resample, robustness, robustness_signal

SPIKE = Trace(
    {"x": np.array([2.0, 1.703, 2.0, 2.0, 2.0])}, times=np.array([0, 0.05, 0.1, 0.2, 0.3])
)


def union(trace, dt, method):
    """Return the instants and values of the even clock and of the recording together."""
    times = np.asarray(trace.times) - trace.times[0]
    x = np.asarray(trace["x"])
    clock = dt * np.arange(int(np.floor(times[-1] / dt + 1e-9)) + 1)
    if method == "hold":
        at = x[np.searchsorted(times, clock + 1e-9, side="right") - 1]
    else:
        at = np.interp(clock, times, x)
    return np.concatenate([clock, times]), np.concatenate([at, x])


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["hold", "linear"])
@pytest.mark.parametrize("origin", [0.0, 1.7e9])
def test_verdicts_are_those_of_the_union(method, origin):
    rng = np.random.default_rng(3)
    with jax.enable_x64(True):
        for _ in range(3):
            times = origin + np.round(np.cumsum(rng.exponential(0.3, 40)), 3)
            times += 1e-3 * np.arange(40)
            trace = Trace({"x": rng.normal(size=40)}, times=times)
            instants, values = union(trace, 0.5, method)
            even = resample(trace, 0.5, method)
            for text, within in (
                ("x", instants > -1),
                ("[1,3]", (instants >= 1) & (instants <= 3)),
            ):
                window = "" if text == "x" else text
                chosen = values[within]
                for word, best in (("always", chosen.min()), ("eventually", chosen.max())):
                    got = float(robustness(f"{word}{window} x", even))
                    assert got == pytest.approx(best, abs=1e-6), (word, window)


@pytest.mark.parametrize("method", ["hold", "linear"])
def test_a_spike_between_two_samples_is_judged(method):
    even = resample(SPIKE, 0.1, method)
    assert even["x"].tolist() == [2.0, 2.0, 2.0, 2.0]
    rho = robustness("always x > 1.72", even)
    assert rho == pytest.approx(-0.017, abs=1e-6)
    signal = robustness_signal("always[0,0.1] x > 1.72", even)
    np.testing.assert_allclose(signal, [-0.017, 0.28, 0.28, 0.28], atol=1e-6)
    assert explain("always x > 1.72", even).time == pytest.approx(0.05)
    assert jax.jit(lambda t: robustness("always x > 1.72", t))(even) == rho
    both = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), even)
    assert jax.vmap(lambda t: robustness("always x > 1.72", t))(both).tolist() == [rho, rho]


def test_next_and_previous_are_samples_of_the_clock():
    even = resample(SPIKE, 0.1, "hold")
    np.testing.assert_array_equal(robustness_signal("X x", even), [2, 2, 2, 2])
    np.testing.assert_array_equal(robustness_signal("Y x", even), [-np.inf, 2, 2, 2])
    with pytest.raises(vj.mtl.IntervalError, match=r"does not fit the sampling period of 0\.1 s"):
        robustness("F[0,0.05] x", even)


def test_the_last_sample_counts_though_no_period_ends_there():
    trace = Trace({"x": np.array([2.0, 2, 2, 1.0])}, times=np.array([0, 0.1, 0.2, 0.25]))
    even = resample(trace, 0.1, "linear")
    assert even.length == 3
    assert robustness("always x > 1.72", even) == pytest.approx(-0.72)
    again = resample(even, 0.05, "linear")
    assert robustness("always x > 1.72", again) == pytest.approx(-0.72)


def test_samples_on_the_clock_leave_nothing_between():
    times = 1.7e9 + 0.1 * np.arange(50)
    even = resample(Trace({"x": np.arange(50.0)}, times=times), 0.1, "linear")
    assert even.between is None
    np.testing.assert_allclose(even["x"], np.arange(50.0), atol=1e-4)


def test_an_early_end_holds_what_lies_between_too():
    even = replace(resample(SPIKE, 0.1, "hold"), valid=1)
    assert robustness("always x > 1.72", even) == pytest.approx(0.28)
    assert robustness("always x > 1.72", even, end="truncate") == pytest.approx(0.28)
    assert even.trim().between.signals["x"].tolist() == [2.0]


def test_a_black_box_may_resample_what_it_recorded():
    def simulate(features):
        times = np.array([0.0, 0.06, 0.1, 0.2]) + 1.7e9
        return resample(
            Trace({"x": np.array([1, 1 - features["dip"], 1, 1])}, times=times), 0.1, "hold"
        )

    problem = vj.Problem("dip", {"dip": vj.Box(0.0, 2.0)}, vj.blackbox(simulate), "always x > 0")
    run = vj.falsify(problem, "uniform", budget=16, progress=False)
    dips, rho = (run.table.all[name].to_numpy(float) for name in ("dip", "rho"))
    np.testing.assert_allclose(rho, 1 - dips, atol=1e-5)


def test_each_column_is_held_from_its_own_last_value(tmp_path):
    (tmp_path / "log.csv").write_text("time,x,y\n0,1,\n1,1,0\n7,,1\n10,0,\n11,,0\n")
    held = read(tmp_path / "log.csv", resample_to=1.0, method="hold")
    assert held["x"].tolist() == [1] * 10 + [0, 0]
    np.testing.assert_array_equal(held["y"], [np.nan] + [0] * 6 + [1] * 4 + [0])
    assert "signal 'x' has no value in 2 of 5 rows: its last one is held there" in held.notes
    coarse = read(tmp_path / "log.csv", columns=["x"], resample_to=5.0, method="hold")
    assert coarse["x"].tolist() == [1, 1, 0]
    assert robustness("always x >= 0", coarse) == 0
