"""A truth value is 1 or 0 in an expression and a comparison, and 1 or -1 as a formula by itself."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from verifai_jax import mtl
from verifai_jax.addons.searches.trace_form import TraceForm, signals_of
from verifai_jax.core.values.trace import Trace

OFF, ON = np.zeros(4, bool), np.ones(4, bool)
PULSE = np.array([False, True, True, False])
SPEED = np.array([1.0, 2.0, 4.0, 8.0])
SIGNALS = {"off": OFF, "on": ON, "pulse": PULSE, "speed": SPEED, "v": np.stack([OFF, PULSE], 1)}
FORMULAS = {
    "always off == 0": 0.0,
    "always off + on >= 1": 0.0,
    "always off >= 0": 0.0,
    "always not off": 1.0,
    "always on": 1.0,
    "eventually off": -1.0,
    "always (pulse -> speed < 3)": -1.0,
    "always off == on": -1.0,
    "eventually abs(pulse) >= 1": 0.0,
    "always -pulse > -0.5": -0.5,
    "eventually pulse * speed > 3": 1.0,
    "always min(pulse, speed) >= 0": 0.0,
    "always v[0] + v[1] == pulse": 0.0,
    "always (v[1] or speed < 1.5)": -1.0,
    "eventually norm(v) > 0.75": 0.25,
    "eventually (pulse & pulse > 0.75)": 0.25,
    "eventually duration(pulse, 0.2) > 0.15": 0.05,
}


@pytest.mark.parametrize("formula", FORMULAS)
def test_every_way_of_judging_reads_a_truth_value_alike(formula):
    wanted, trace = FORMULAS[formula], Trace(SIGNALS, dt=0.1)
    got = mtl.judge({"a": formula}, trace).rows[0]
    assert got.robustness == pytest.approx(wanted, abs=1e-12)
    watched = mtl.watch(formula, 0.1, sizes={"v": 2})
    for row in range(4):
        watched.step({name: signal[row] for name, signal in SIGNALS.items()})
    at_once = mtl.watch(formula, 0.1, sizes={"v": 2})
    at_once.steps(SIGNALS)
    assert watched.finish() == at_once.finish() == got.robustness
    if "duration" not in formula:
        assert mtl.dense_robustness(formula, trace, "hold") == wanted


def test_jax_reads_a_truth_value_alike():
    formula = "always ((pulse -> speed < 3) & off + on >= 1 & not (v[0] | off > 0))"
    assert float(mtl.robustness(formula, Trace(SIGNALS, dt=0.1))) == -1.0
    assert not bool(mtl.satisfied(formula, Trace(SIGNALS, dt=0.1)))
    monitor = mtl.online("always (on & on == 1)", 0.1)
    assert float(monitor.finish(monitor.step(monitor.init(), {"on": True}))) == 0.0


def test_truth_values_with_gaps_are_still_truth_values(tmp_path):
    frame = pd.DataFrame({"time": [0.0, 0.1, 0.2, 0.3], "b": [False, None, True, False]})
    frame.to_parquet(tmp_path / "a.parquet")
    frame.to_csv(tmp_path / "a.csv", index=False)
    for source in (frame, tmp_path / "a.parquet", tmp_path / "a.csv"):
        trace = mtl.read(source, missing="hold")
        assert trace.is_truth("b")
        found = mtl.judge(["eventually[0,0.1] b", "always[0,0.1] b == 0"], trace)
        assert [row.robustness for row in found.rows] == [-1.0, 0.0]


def test_truth_values_of_one_clock_among_others_are_still_truth_values(tmp_path):
    pd.DataFrame({"time": [0.0, 0.2], "x": [1.0, 2.0]}).to_csv(tmp_path / "x.csv", index=False)
    pd.DataFrame({"time": [0.0, 0.1], "b": [True, False]}).to_csv(tmp_path / "b.csv", index=False)
    files = [tmp_path / "x.csv", tmp_path / "b.csv"]
    trace = mtl.read(files, resample_to=0.1, method="hold")
    found = mtl.judge(["eventually[0.1,0.2] b", "always[0.1,0.2] b + x <= 2"], trace)
    assert [row.robustness for row in found.rows] == [-1.0, 0.0]


def test_words_for_truth_values_in_a_table(tmp_path):
    for on, off in (("true", "false"), ("ON", "OFF"), ("yes", "no"), ("True", "FALSE")):
        path = tmp_path / f"{on}.csv"
        path.write_text(f"time,b\n0,{on}\n1,{off}\n2,{on}\n")
        np.testing.assert_array_equal(mtl.read(path)["b"], [True, False, True])


def test_a_modelled_trace_keeps_its_truth_values():
    trace = Trace(SIGNALS, dt=0.1)
    form = TraceForm(signals_of(trace, ["pulse", "speed", "v"]), 0.1, 4)
    modelled = form.trace(jnp.asarray(form.flat(trace)))
    assert sorted(modelled.truths) == ["pulse", "v"]
    assert float(mtl.robustness("always[0.1,0.2] (pulse & pulse == 1)", modelled)) == 0.0
