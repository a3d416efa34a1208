"""Masked and missing samples: gaps everywhere, of which no verdict is made."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.core.trace import Status, Trace
from verifai_jax.mtl import online, read, resample, robustness, satisfied
from verifai_jax.remote_client import encoded
from verifai_jax.systems.remote.wire import Frames, trace_of

HIDDEN = np.ma.masked_array([0.0, 9e9, 0.0], mask=[0, 1, 0])


def test_nothing_under_a_mask_is_judged():
    trace = Trace({"x": HIDDEN, "y": np.zeros(3)}, dt=1.0)
    np.testing.assert_array_equal(trace["x"], [0, np.nan, 0])
    assert np.isnan(robustness("G x <= 1.9", trace))
    assert robustness("G y <= 1.9", trace) == pytest.approx(1.9)
    with pytest.raises(ValueError, match="no verdict: signal 'x' is NaN at 1 s"):
        satisfied("G x <= 1.9", trace)
    np.testing.assert_array_equal(resample(trace, 0.5, "hold")["x"], np.zeros(5))
    whole = Trace({"x": np.ma.masked_array([1, 2], mask=False)}, dt=1.0)
    assert whole["x"].dtype == int
    assert type(whole["x"]) is np.ndarray


@pytest.mark.parametrize(
    ("signal", "wanted"),
    [
        (np.ma.masked_array([1, 2, 3], mask=[0, 0, 1]), [1, 2, np.nan]),
        (np.ma.masked_array([True, False, True], mask=[0, 0, 1]), [1, -1, np.nan]),
        (np.ma.masked_invalid([1.0, np.inf, 2.0]), [1, np.nan, 2]),
        (np.array([1.0, None, 2], object), [1, np.nan, 2]),
        (np.array([True, None, False], object), [1, np.nan, -1]),
        (pd.array([1, None, 3], dtype="Int64"), [1, np.nan, 3]),
        ([1.0, np.ma.masked, 3.0], [1, np.nan, 3]),
        (
            np.ma.masked_array([[1.0, 2], [3, 4]], mask=[[0, 1], [0, 0]]),
            [[1, np.nan], [3, 4]],
        ),
        ([np.ma.masked_array([1.0, 2], mask=[1, 0]), np.ma.ones(2)], [[np.nan, 2], [1, 1]]),
    ],
)
@pytest.mark.filterwarnings("ignore:Warning. converting a masked element to nan")
def test_every_way_to_be_missing(signal, wanted):
    with unchecked():
        trace = Trace({"x": signal}, dt=1.0)
        np.testing.assert_array_equal(np.asarray(trace["x"]), wanted)


def test_what_is_no_number_is_named():
    with unchecked(), pytest.raises(TypeError, match="'x' must hold real numbers; sample 1 is 'of"):
        Trace({"x": np.array([1.0, "off"], object)}, dt=1.0)
    times = np.ma.masked_array([0.0, 1.0, 2.0], mask=[0, 1, 0])
    with pytest.raises(ValueError, match="sample times must be known; that of sample 1 is masked"):
        Trace({"x": np.zeros(3)}, times=times)
    assert Trace({"x": np.zeros(2)}, times=np.ma.arange(2.0)).clock().tolist() == [0, 1]


def masked(features):
    return Trace({"x": np.ma.masked_array([0.0, 9e9, features["a"]], mask=[0, 1, 0])}, dt=1.0)


def masked_rows(features):
    x = np.tile([0.0, 9e9, 0.0], (len(features["a"]), 1))
    return vj.stack_traces({"x": np.ma.masked_array(x, mask=x > 1)}, dt=1.0)


@pytest.mark.parametrize(
    "system", [vj.blackbox(masked), vj.blackbox(masked_rows, vectorised=True)], ids=["one", "many"]
)
def test_black_boxes_with_masks_have_no_verdict(system):
    problem = vj.Problem("masked", {"a": vj.Box(0, 1)}, system, "always x <= 1.9")
    run = vj.falsify(problem, "uniform", budget=4, progress=False)
    assert not run.table.all["violated"].any()
    assert set(run.table.all["status"]) == {"nonfinite"}


def test_online_monitors_and_the_wire_see_gaps():
    monitor = online("G x <= 1.9", 1.0)
    state = monitor.step(monitor.init(), {"x": jnp.float32(0.0)})
    with unchecked():
        state = monitor.step(state, {"x": np.ma.masked})
    assert np.isnan(monitor.finish(state))
    (message,) = Frames(1 << 20).feed(encoded(1, {"signals": {"x": HIDDEN}, "dt": 1.0}))
    np.testing.assert_array_equal(trace_of(message)["x"], [0, np.nan, 0])


def test_frames_with_missing_values_have_gaps():
    frame = pd.DataFrame(
        {
            "time": [0.0, 1.0, 2.0],
            "x": [1, None, 3],
            "on": [True, None, False],
            "n": pd.array([1, None, 3], dtype="Int64"),
            "o": pd.Series([1, None, 2.5], dtype=object),
        }
    )
    trace = read(frame)
    np.testing.assert_array_equal(trace["x"], [1, np.nan, 3])
    np.testing.assert_array_equal(trace["on"], [1, np.nan, -1])
    np.testing.assert_array_equal(trace["n"], [1, np.nan, 3])
    np.testing.assert_array_equal(trace["o"], [1, np.nan, 2.5])
    assert Trace({"x": HIDDEN}, dt=1.0).status in (None, Status.OK)
