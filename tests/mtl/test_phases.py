"""Phases of a run, and what is counted within a window, against definitions written out."""

import numpy as np
import pytest

from verifai_jax import mtl
from verifai_jax.core.trace import Trace
from verifai_jax.mtl.host_values import HostValues

RANDOM = np.random.default_rng(5)


def in_phase(begins, ends):
    """The instants of a phase, by an automaton."""
    now, found = False, []
    for begin, end in zip(begins, ends, strict=True):
        now = (now or begin) and not end
        found.append(now)
    return np.array(found)


@pytest.mark.parametrize("seed", range(5))
def test_a_phase_goes_from_its_beginning_to_before_its_end(seed):
    random = np.random.default_rng(seed)
    down, touch, slow = random.random((3, 40)) < [[0.2], [0.2], [0.6]]
    trace = Trace({"down": down, "touch": touch, "slow": slow}, dt=1.0)
    landing = mtl.phase(mtl.signal("down"), mtl.signal("touch"))
    now = in_phase(down, touch)
    holds = HostValues.of(trace)
    np.testing.assert_array_equal(holds.truth(landing) > 0, now)
    assert holds.holds(mtl.during(landing, mtl.signal("slow"))) == bool(np.all(slow[now]))
    runs = np.split(np.arange(40), np.flatnonzero(np.diff(now)) + 1)
    each = [bool(np.any(slow[run])) for run in runs if now[run[0]]]
    assert holds.holds(mtl.sometime_during(landing, mtl.signal("slow"))) == all(each)


@pytest.mark.thorough
def test_seconds_are_counted_within_a_window():
    x = RANDOM.normal(size=50)
    trace = mtl.durations(Trace({"x": x}, dt=0.5), {"high": ("x > 0.5", 3.0)})
    expected = [0.5 * np.sum(x[max(0, k - 5) : k + 1] > 0.5) for k in range(50)]
    np.testing.assert_array_equal(trace["high"], expected)
    assert mtl.mine("always high <= ?s", [trace]).values["s"] == max(expected)
    gap = mtl.durations(
        Trace({"x": np.array([1.0, np.nan, 1.0, 1.0])}, dt=1.0), {"n": ("x > 0", 2)}
    )
    np.testing.assert_array_equal(gap["n"], [1.0, np.nan, np.nan, 2.0])
    whole = mtl.durations(Trace({"x": np.ones(3)}, dt=1.0), {"n": ("x > 0", 60.0)})
    np.testing.assert_array_equal(whole["n"], [1.0, 2.0, 3.0])


def test_what_cannot_be_counted_is_refused():
    trace = Trace({"x": np.ones(4)}, dt=0.5)
    for counted in ({"x": ("x > 0", 1.0)}, {"n": ("x > 0", 0.0)}):
        with pytest.raises(ValueError, match="a new name and a window of one sample or more"):
            mtl.durations(trace, counted)
    with pytest.raises(mtl.IntervalError, match="not a multiple"):
        mtl.durations(trace, {"n": ("x > 0", 0.7)})
    even = mtl.resample(Trace({"x": np.ones(4)}, dt=0.5), 1.0, "hold")
    with pytest.raises(ValueError, match="count before resampling"):
        mtl.durations(even, {"n": ("x > 0", 1.0)})
