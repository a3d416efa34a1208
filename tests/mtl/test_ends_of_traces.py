"""The ends of a trace: the table of docs/formulas.md, and every operator against its definition."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest
from mtl_oracle import DT, Oracle

from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import HorizonError, online, parse, robustness, robustness_signal, satisfied

PAGE = Path(__file__).parents[2] / "docs" / "formulas.md"
X, Y = [1.0, 2.0, -3.0, 0.5, -0.25], [-1.0, 1.0, 2.0, -2.0, 0.75]
OPERATORS = [
    "x > 0",
    "X x",
    "!X x",
    "X X x",
    "F[0.5,0.5] x",
    "G[0.5,0.5] x",
    "F[0.5,1.5] x",
    "G[0,1] x",
    "F x",
    "G x",
    "y U[0.5,1] x",
    "y U x",
    "x W[0,1] y",
    "x R[0,1] y",
    "Y x",
    "!Y x",
    "O[0.5,1] x",
    "H[0.5,1] x",
    "O x",
    "H x",
    "x S[0.5,1] y",
    "x S y",
    "F[0.5,1] (O[0.5,0.5] x)",
    "G[0,0.5] X x",
    "X (Y x)",
]


@pytest.fixture(autouse=True, scope="module")
def _interpreted():
    with jax.enable_x64(True), jax.disable_jit():
        yield


def trace_of(length, valid=None):
    signals = {"x": np.array(X[:length]), "y": np.array(Y[:length])}
    return Trace(signals, dt=DT, valid=valid)


def definition(text, length, end):
    """Return the value at every sample, NaN where `end` leaves none."""
    formula = parse(text)
    recording = {"x": X[:length], "y": Y[:length]}
    oracle = Oracle(recording, "hold" if end == "hold" else "truncate")
    values = np.array([oracle.rho(formula, i) for i in range(length)])
    if end == "strict":
        left = (length - 1 - np.arange(length)) * DT
        values[left < formula.horizon(DT)] = np.nan
    return values


@pytest.mark.thorough
@pytest.mark.parametrize("end", ["hold", "truncate", "strict"])
@pytest.mark.parametrize("text", OPERATORS)
def test_every_operator_is_its_definition_at_both_ends(text, end):
    wanted = definition(text, 5, end)
    if np.isnan(wanted[0]):
        with pytest.raises(HorizonError):
            robustness_signal(text, trace_of(5), end=end)
        return
    np.testing.assert_array_equal(robustness_signal(text, trace_of(5), end=end), wanted)
    assert robustness(text, trace_of(5), end=end) == wanted[0]
    # Samples that do not count are as good as not there.
    short = definition(text, 3, end)
    if np.isnan(short[0]):
        return
    values = np.asarray(robustness_signal(text, trace_of(5, valid=3), end=end))
    np.testing.assert_array_equal(values[:3], short)
    assert robustness(text, trace_of(5, valid=3), end=end) == short[0]
    if end != "hold":
        assert np.isnan(values[3:]).all()


@pytest.mark.thorough
@pytest.mark.parametrize("text", OPERATORS)
def test_online_ends_as_a_held_trace(text):
    monitor = online(text, DT)
    state = monitor.init()
    for k in range(5):
        state = monitor.step(state, {"x": X[k], "y": Y[k]})
        assert monitor.finish(state) == definition(text, k + 1, "hold")[0]


@pytest.mark.slow
def test_the_table_of_the_page_is_what_is_computed():
    rows = re.findall(
        r"^\| `([^`]+)` \| (\[.*?\]) \| (\[.*?\]) \| (.+?) \|", PAGE.read_text(), re.M
    )
    assert len(rows) >= 12
    trace = Trace({"x": np.array([1.0, 2.0, -3.0]), "y": np.array([-1.0, 1.0, 2.0])}, dt=1.0)
    for text, *columns in rows:
        for end, column in zip(("hold", "truncate", "strict"), columns, strict=True):
            if column == "error":
                with pytest.raises(HorizonError):
                    robustness_signal(text, trace, end=end)
                continue
            written = [np.nan if v == "none" else float(v) for v in column.strip("[]").split(", ")]
            values = robustness_signal(text, trace, end=end)
            np.testing.assert_array_equal(values, written, f"{text} under {end}")


def test_strict_says_so_at_the_first_sample_too():
    trace = trace_of(3)
    assert np.isnan(robustness_signal("X x", trace, end="strict")[2])
    with pytest.raises(HorizonError, match=r"looks 1\.5 s ahead, but the trace lasts 1 s"):
        robustness("X X X x", trace, end="strict")
    assert not satisfied("X X x", trace, end="strict")
