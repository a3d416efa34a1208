"""Phases of a run, and what is counted within a window, against definitions written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from verifai_jax import mtl
from verifai_jax.addons.reports.english import formula_words
from verifai_jax.core.values.trace import Trace
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


def seconds_held(truth, n, dt):
    """The definition: each of the last `n` samples stands for one period."""
    return [dt * sum(truth[max(0, k - n + 1) : k + 1]) for k in range(len(truth))]


@pytest.mark.thorough
def test_seconds_are_counted_within_a_window():
    x = RANDOM.normal(size=50)
    trace = Trace({"x": x}, dt=0.5)
    expected = seconds_held(x > 0.5, 6, 0.5)
    margin = mtl.parse("2 - duration(x > 0.5, 3) > 0")
    np.testing.assert_array_equal(mtl.robustness_signal(margin, trace), 2 - np.array(expected))
    np.testing.assert_array_equal(HostValues.of(trace)(margin), 2 - np.array(expected))
    limit = "always duration(x > 0.5, 3) <= "
    assert mtl.robustness(limit + "2", trace) == 2 - max(expected)
    assert mtl.mine(limit + "?s", [trace]).values["s"] == max(expected)
    level = mtl.mine("always duration(x > ?x, 3) <= 1", [trace]).values["x"]
    assert mtl.satisfied(f"always duration(x > {level}, 3) <= 1", trace)
    assert level in x


@pytest.mark.parametrize(
    ("x", "window", "expected"),
    [
        ([1.0, np.nan, 1.0, 1.0], 2, [1.0, np.nan, np.nan, 2.0]),  # a gap is unknown
        ([1.0, 1.0, 1.0], 60, [1.0, 2.0, 3.0]),  # a window beyond the trace
        ([-1.0, 0.0, 2.0], 1, [0.0, 0.0, 1.0]),
    ],
)
def test_a_count_is_unknown_while_its_window_has_a_gap(x, window, expected):
    trace = Trace({"x": np.array(x)}, dt=1.0)
    f = mtl.parse(f"duration(x > 0, {window}) > 0")
    np.testing.assert_array_equal(HostValues.of(trace)(f), expected)
    monitor = mtl.watch(f, 1.0, every=True)
    np.testing.assert_array_equal([monitor.step({"x": v}) for v in x], expected)


def test_after_the_end_nothing_is_counted():
    trace = Trace({"x": np.array([-1.0, 1.0])}, dt=1.0)
    assert mtl.satisfied("always duration(x > 0, 10) <= 1", trace)
    assert mtl.robustness("eventually[5, 9] duration(x > 0, 10) > 3", trace) == -2
    monitor = mtl.watch("always duration(x > 0, 10) <= 1", 1.0)
    for value in (-1.0, 1.0):
        monitor.step({"x": value})
    assert monitor.finish() == 0.0
    monitor.step({"x": 3.0})
    assert monitor.interval()[1] == -1.0  # whatever follows


@pytest.mark.thorough
def test_a_trace_that_ended_early_counts_to_its_end():
    x = jnp.asarray(RANDOM.normal(size=(3, 12)))
    valid = jnp.array([1, 7, 12])
    f = mtl.parse("always duration(x > 0, 3) <= 1")
    run = jax.vmap(lambda x, n: mtl.robustness(f, Trace({"x": x}, dt=0.5, valid=n)))
    expected = [
        1 - max(seconds_held(np.asarray(row[:n]) > 0, 6, 0.5))
        for row, n in zip(x, valid, strict=True)
    ]
    np.testing.assert_array_equal(run(x, valid), expected)


def test_what_was_recorded_between_two_instants_counts():
    even = mtl.resample(Trace({"x": np.array([1.0, -1.0, 1.0, 1.0])}, dt=0.5), 1.0, "hold")
    np.testing.assert_array_equal(
        HostValues.of(even)(mtl.parse("duration(x > 0, 2) > 0")), [0.5, 0.5, 1.0, 1.5]
    )


@pytest.mark.parametrize(
    "text",
    [
        "always (duration(speed > 30, 60) <= 3)",
        "always (2 * duration(ok & (once[0,2] (x > 1)), 0.5) + y > duration(!ok, 7))",
        'always (duration("gap (m)" < duration(x > 0, 2), 9) < 1)',
    ],
)
def test_the_text_of_what_is_counted_reads_back(text):
    parsed = mtl.parse(text)
    assert str(parsed) == text
    assert mtl.parse(str(parsed)) == parsed
    built = mtl.always(mtl.duration(mtl.signal("speed") > 30, 60) <= 3)
    assert str(built) == "always (duration(speed > 30, 60) <= 3)"
    assert built.signals() == ("speed",)
    assert formula_words(built) == (
        "at all times, the number of seconds of the last 60 s in which speed is above 30 "
        "is at most 3"
    )
    assert mtl.latex(built) == (
        r"\Box \left(\mathrm{duration}_{60}\left(\mathit{speed} > 30\right) \leq 3\right)"
    )


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("duration(eventually[0, 1] x > 0, 3) < 1", "looks ahead: use an operator that looks back"),
        ("duration(x > 0, 0) < 1", "must be a positive number of seconds; got 0"),
        ("duration(x > 0, y) < 1", "the window of duration is a number of seconds"),
        ("duration(x > 0) < 1", "no function 'duration'|duration"),
        ("duration(x > 0, 3)[0] < 1", "a component is a signal"),
        ("norm(duration(x > 0, 3)) < 1", "norm takes a vector signal"),
    ],
)
def test_what_cannot_be_counted_is_refused(text, error):
    with pytest.raises(mtl.FormulaSyntaxError, match=error):
        mtl.parse(text)


def test_where_nothing_counts_it_is_said():
    trace = Trace({"x": np.ones(4)}, dt=0.5)
    with pytest.raises(mtl.IntervalError, match="not a multiple"):
        mtl.robustness("duration(x > 0, 0.7) > 0", trace)
    with pytest.raises(ValueError, match="is computed by watch and export_c, and not by online"):
        mtl.online("duration(x > 0, 1) > 0", 0.5)
    with pytest.raises(ValueError, match="is about samples, and between samples there are none"):
        mtl.dense_robustness("duration(x > 0, 1) > 0", trace)
