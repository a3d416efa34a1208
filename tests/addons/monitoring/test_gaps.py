"""Masked and missing samples: gaps everywhere, of which no verdict is made."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.addons.simulators.remote.wire import Frames, trace_of
from verifai_jax.addons.simulators.remote_client import encoded
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.mtl import online, read, resample, robustness, satisfied

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
        (np.ma.masked_array([True, False, True], mask=[0, 0, 1]), [1, 0, np.nan]),
        (np.ma.masked_invalid([1.0, np.inf, 2.0]), [1, np.nan, 2]),
        (np.array([1.0, None, 2], object), [1, np.nan, 2]),
        (np.array([True, None, False], object), [1, np.nan, 0]),
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
    np.testing.assert_array_equal(trace["on"], [1, np.nan, 0])
    np.testing.assert_array_equal(trace["n"], [1, np.nan, 3])
    np.testing.assert_array_equal(trace["o"], [1, np.nan, 2.5])
    assert Trace({"x": HIDDEN}, dt=1.0).status in (None, Status.OK)


def test_a_masked_feature_is_refused():
    problem = vj.Problem("masked", {"a": vj.Box(0, 1)}, vj.blackbox(masked), "always x <= 1.9")
    with unchecked(), pytest.raises(ValueError, match="a must be a number; got one that is masked"):
        vj.simulate(problem, {"a": np.ma.masked_array(0.5, mask=True)}, progress=False)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"valid": 2.5}, "valid must be how many samples count, from 1 to 3; got 2.5"),
        ({"valid": "2"}, "valid must be .*; got '2'"),
        ({"valid": True}, "valid must be .*; got True"),
        ({"valid": [2]}, r"valid must be .*; got \[2\]"),
        ({"valid": np.float64(2)}, "valid must be .*; got np.float64"),
        ({"status": "ok"}, "status must be one of 0 .*; got 'ok'"),
        ({"status": 0.5}, "status must be one of 0 .*; got 0.5"),
        ({"dt": "fast"}, "the sampling period dt must be a number of seconds; got 'fast'"),
        ({"dt": 1j}, "the sampling period dt must be a number"),
        ({"dt": np.array([0.1])}, "the sampling period dt must be a number"),
        ({"times": ["a", "b", "c"]}, "sample times must be numbers of seconds; got <U1"),
        ({"times": np.array([0, 1, 2]) * 1j}, "sample times must be numbers of seconds"),
        ({"times": np.arange(3).astype("M8[s]")}, "numbers of seconds; got datetime64.* since the"),
        ({"times": np.array([0, None, 2])}, "that of sample 1 is masked or missing"),
        ({"signals": {"x": ["a", "b", "c"]}}, "signal 'x' must hold real numbers; got <U1"),
        ({"signals": {"x": np.zeros(3, "M8[s]")}}, "'x' must hold real numbers; got datetime64"),
        ({"signals": {"x": [[1, 2], [3], [4]]}}, "'x' must be .*its rows have several lengths"),
        ({"signals": {"\ud800": np.zeros(3)}}, "the name of a signal must be a text that UTF-8"),
        ({"signals": {3: np.zeros(3)}}, "the name of a signal must be a text .*; got 3"),
        ({"signals": [1, 2, 3]}, "signals must be a dictionary of arrays by name; got list"),
    ],
)
def test_what_a_trace_cannot_be_made_of_is_said(options, told):
    usual = {"signals": {"x": np.zeros(3)}} | (
        {} if {"dt", "times"} & options.keys() else {"dt": 1}
    )
    with unchecked(), pytest.raises((TypeError, ValueError), match=told):
        Trace(**(usual | options))


def test_small_integers_do_not_wrap():
    stamps = np.array([-128, 0, 127], np.int8)
    with unchecked():
        trace = Trace({"x": [1, 2**70, 3]}, times=stamps)
        assert trace.clock().tolist() == [-128, 0, 127]
        assert np.asarray(resample(trace, 1.0, "hold")["x"]).shape == (256,)
        assert trace["x"].dtype == float
        assert Trace({"x": np.ones(2, np.longdouble)}, dt=1.0)["x"].dtype == np.float64
        assert Trace({"x": np.zeros(2)}, dt=np.array(0.5)).dt == 0.5


def test_names_that_utf8_cannot_hold_are_refused():
    for make in (
        lambda: vj.FeatureSpace({"\udc80": vj.Box(0, 1)}),
        lambda: vj.Categorical("a", "\ud800"),
        lambda: vj.Problem("\ud800", {"a": vj.Box(0, 1)}, masked, "always x > 0"),
        lambda: vj.Problem("p", {"a": vj.Box(0, 1)}, masked, {"\ud800": "always x > 0"}),
    ):
        with pytest.raises(ValueError, match=r"must be a text that UTF-8 can hold; '.*surrogate"):
            make()


def test_columns_and_encodings_of_recordings(tmp_path):
    (tmp_path / "odd.csv").write_text("time,p[²],p[0]\n0,1,2\n1,3,4\n")
    assert read(tmp_path / "odd.csv")["p[²]"].tolist() == [1, 3]
    (tmp_path / "latin.csv").write_bytes("time,größe\n0,1\n1,2\n".encode("latin-1"))
    latin = read(tmp_path / "latin.csv")
    assert latin["größe"].tolist() == [1, 2]
    assert any("latin.csv is not UTF-8, and is read as Windows-1252" in n for n in latin.notes)
