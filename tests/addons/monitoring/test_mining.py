"""The tightest parameters of recordings: planted numbers, fronts against all pairs, refusals."""

import itertools

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mtl_oracle import DT, Oracle, formulas, recordings

from verifai_jax import mtl
from verifai_jax.addons.monitoring.parametric import read_parametric
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.host_values import HostValues


def trace(dt=0.1, **signals):
    return Trace({name: np.array(values, float) for name, values in signals.items()}, dt=dt)


@pytest.mark.slow
@given(formulas(counted=True), recordings(), st.sampled_from(["hold", "truncate"]))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_values_in_numpy_are_those_of_the_definitions(formula, recording, end):
    signals = {name: np.asarray(v, float) for name, v in recording.items()}
    values, oracle = HostValues.of(Trace(signals, dt=DT), end), Oracle(recording, end)
    n = values.length
    np.testing.assert_array_equal(
        np.broadcast_to(values(formula), n), [oracle.rho(formula, i) for i in range(n)]
    )
    truth = np.broadcast_to(values.truth(formula), n) > 0
    np.testing.assert_array_equal(truth, [oracle.holds(formula, i) for i in range(n)])


def test_what_lies_between_the_samples_counts():
    spike = Trace({"x": np.array([2.0, 1.0, 2.0])}, times=np.array([0.0, 0.05, 0.2]))
    even = mtl.resample(spike, 0.2, "hold")
    assert mtl.mine("always x > ?d", even).values == {"d": 1.0}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("always x > ?d", 4.217),
        ("always !(x <= ?d)", 4.217),
        ("always x - ?d > 0", 4.217),
        ("always x <= ?d", 9.75),
        ("eventually x >= ?d", 9.75),
        ("always (y > 0 -> x > ?d)", 5.003),
        ("always abs(x - 6) < ?d", 3.75),
        ("always x > 2 * ?d", 4.217 / 2),
        ("always[0, ?T] x > 5", 0.1),
        ("eventually[0, ?T] x > 9", 0.3),
        ("always[?T, 0.4] x > 4.5", 0.3),
        ("eventually[0.1, ?T] x < 9", 0.1),
    ],
)
def test_planted_values_come_back_to_the_last_digit(text, expected):
    x = trace(x=[5.5, 6.125, 4.217, 9.75, 5.003], y=[-1, -1, -1, 1, 1])
    mined = mtl.mine(text, x)
    (value,) = mined.values.values()
    assert value == expected
    assert mtl.satisfied(mined.formula, trace(x=np.array(x["x"]), y=np.array(x["y"])))


def test_all_recordings_or_a_share_of_them():
    drives = [trace(x=[k + 0.5, 40.0]) for k in range(20)]
    mined = mtl.mine("always x > ?d", drives)
    assert mined.values == {"d": 0.5}
    assert mined.satisfied == 20
    mined = mtl.mine("always x > ?d", drives, share=0.9)
    assert mined.values == {"d": 2.5}
    assert mined.satisfied == 18
    assert (mined.broken.failures, mined.broken.simulations) == (2, 20)
    assert "2.5, the greatest that is satisfied" in mined.summary()
    assert "18 of 20 recordings" in str(mined)


@pytest.mark.parametrize("text", ["always x > ?d", "always (x > 2 -> eventually[0, ?T] x < ?d)"])
def test_what_many_recordings_satisfy_is_what_each_of_them_does(text):
    rng = np.random.default_rng(3)
    drives = [trace(x=rng.uniform(0, 5, 8).round(2)) for _ in range(12)]
    together = mtl.mine(text, drives)
    for corner in together.front:
        numbers = read_parametric(together.text).formula(corner)
        assert all(mtl.satisfied(numbers, each) for each in drives)
    again = mtl.mine(text, drives[::-1])
    assert again.front == together.front


def dominating(pairs, signs):
    """The pairs of which no other is at least as tight in both."""

    def tighter(p, q):
        return p != q and all(s * a <= s * b for s, a, b in zip(signs, p, q, strict=True))

    return sorted(p for p in pairs if not any(tighter(q, p) for q in pairs))


FRONTS = {
    "always[0, ?T] x > ?d": (-1, -1),
    "eventually[0, ?T] x > ?d": (1, -1),
    "always (x > ?a | y > ?b)": (-1, -1),
    "always (x > ?a -> eventually[0, ?T] y > 4)": (1, 1),
    "eventually (x > ?a & y < ?b)": (-1, 1),
}


@pytest.mark.thorough
@pytest.mark.parametrize("text", FRONTS)
@pytest.mark.parametrize("seed", range(10))
def test_fronts_are_those_of_all_pairs(text, seed):
    random = np.random.default_rng(seed)
    drives = [trace(x=random.integers(0, 9, 8), y=random.integers(0, 9, 8)) for _ in range(2)]
    template = read_parametric(text)
    all_values = [HostValues.of(drive) for drive in drives]
    grids = [
        [round(0.1 * k, 12) for k in range(8)] if name in template.times else range(-1, 10)
        for name in template.names
    ]
    names = template.names
    good = [
        pair
        for pair in itertools.product(*grids)
        if all(v.holds(template.formula(dict(zip(names, pair, strict=True)))) for v in all_values)
    ]
    expected = dominating(good, FRONTS[text])
    # What a number of -1 or 9 satisfies, any satisfies: it is bounded by nothing.
    free = [
        p for p in expected
        if any(v in (-1, 9) for n, v in zip(names, p, strict=True) if n not in template.times)
    ]  # fmt: skip
    expected = [p for p in expected if p not in free]
    if not expected:
        with pytest.raises(ValueError, match="no tightest pair"):
            mtl.mine(text, drives)
        return
    front = mtl.mine(text, drives).front
    assert sorted(tuple(corner.values()) for corner in front) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("always x > 3", "has no parameter"),
        ("always[0, ?d] x > ?d", "use two names"),
        ("always[?a, ?b] x > ?c", "one parameter or two"),
        ("always (x > ?d & x < ?d + 6)", r"not monotone in \?d"),
        ("always x > ?a * y + ?b", "occur in one comparison"),
        ("(eventually x > 20) & always x > ?d", "no value of [?]d satisfies"),
        ("always (x > 0 | x > ?d)", "the data do not bound it"),
        ("always (x > 2 & y > ?q)", "signal 'y'"),
    ],
)
def test_refusals_say_why(text, words):
    with pytest.raises((ValueError, KeyError), match=words):
        mtl.mine(text, trace(x=[1.0, 4.0, 6.0], z=[0, 0, 0]) if "?q" in text
                 else trace(x=[1.0, 4.0, 6.0], y=[0, 0, 0]))  # fmt: skip


def test_monotone_is_found_by_trial_where_the_tree_does_not_tell():
    mined = mtl.mine("always x < abs(?d) + ?d", trace(x=[1.0, 3.0]))
    assert mined.values["d"] == pytest.approx(1.5)
    assert mined.sampled == ("d",)
    assert "monotone by trial" in mined.summary()


def test_a_gap_and_periods_that_differ_are_refused():
    with pytest.raises(ValueError, match="recording 1: no verdict"):
        mtl.mine("always x > ?d", [trace(x=[1.0, 2.0]), trace(x=[1.0, np.nan])])
    with pytest.raises(ValueError, match=r"periods of 0\.1 s, 0\.2 s: resample"):
        mtl.mine("always[0, ?T] x > 0", [trace(x=[1.0]), trace(0.2, x=[1.0])])


def test_a_front_is_drawn(tmp_path):
    mined = mtl.mine("always[0, ?T] x > ?d", trace(x=[5.5, 6.1, 4.2, 9.7, 3.0]))
    mined.plot(tmp_path / "front.png")
    assert (tmp_path / "front.png").stat().st_size > 1000
    with pytest.raises(ValueError, match="no front to draw"):
        mtl.mine("always x > ?d", trace(x=[5.5, 6.1])).plot()


@given(formulas(counted=True), recordings(), st.sampled_from(["hold", "truncate"]), st.booleans())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_the_first_sample_alone_has_the_same_value(formula, recording, end, boolean):
    signals = {name: np.asarray(v, float) for name, v in recording.items()}
    alone, every = (HostValues.of(Trace(signals, dt=DT), end) for _ in range(2))
    expected = (every.truth if boolean else every)(formula)[0]
    np.testing.assert_array_equal(alone.first(formula, boolean), expected)
