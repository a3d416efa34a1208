"""Numbers with units, elements of vectors, and intervals without an end, wherever formulas go."""

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax import mtl
from verifai_jax.addons.monitoring.quantities import SIZES
from verifai_jax.addons.reports.english import formula_words
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.words import RESERVED

KMH = Trace({"v": np.array([90.0, 126.0, 108.0])}, dt=1.0, units={"v": "km/h"})


@pytest.mark.parametrize(
    ("text", "robustness"),
    [
        ("always v <= 130 km/h", 4.0),
        ("always v <= 30 m/s", -18.0),
        ("always 2 * v <= 60 m/s + 18 km/h", -18.0),
        ("always abs(v - 30 m/s) <= 5 m/s", 0.0),
        ("always abs(rate(v)) <= 10 m/s^2", 0.0),
        ("always mean(v, 2) <= 36 m/s", 12.6),
        ("always duration(v > 30 m/s, 1 min) <= 2 s", 1.0),
        ("always duration(v > 30 m/s, 1 min) < 0.5 min", 29.0),
        ("eventually count(v >= 30 m/s, [0, 2]) > 1", 1.0),
    ],
)
def test_a_quantity_is_in_the_unit_of_its_signals(text, robustness):
    f = mtl.parse(text)
    assert mtl.parse(str(f)) == f
    assert formula_words(f)
    assert mtl.latex(f)
    assert float(HostValues.of(KMH)(f)[0]) == pytest.approx(robustness)
    assert float(mtl.robustness(f, KMH)) == pytest.approx(robustness, rel=1e-5)
    watched = mtl.watch(f, 1.0, units={"v": "kph"})
    watched.steps({"v": KMH["v"]})
    assert watched.finish() == float(HostValues.of(KMH)(f)[0])
    assert mtl.judge(f, KMH).rows[0].robustness == pytest.approx(robustness)
    assert mtl.judge(f, KMH).rows[0].note.count("granted") == 0


def test_what_is_not_known_is_said():
    plain = Trace({"v": np.array([20.0, 40.0]), "a": np.array([0.1, 0.2])}, dt=1.0)
    row = mtl.judge("always v <= 108 km/h", plain).rows[0]
    assert row.robustness == -10.0
    assert "no unit is known of v in v <= 108 km/h, and m/s is taken for granted" in row.note
    assert [f.kind for f in mtl.lint("always v <= 108 km/h", plain)] == ["units"]
    assert not mtl.judge("always a <= 12deg", plain).rows[0].note  # rad, as everywhere
    for export in (mtl.watch, mtl.export_c):
        with pytest.raises(ValueError, match=r"no unit is known of v .* give it, as in units="):
            export("always v <= 108 km/h", 1.0)
    named = Trace({"v (km/h)": np.array([100.0])}, dt=1.0)
    assert mtl.judge('"v (km/h)" <= 30 m/s', named).rows[0].robustness == 8.0
    degrees = Trace({"a": np.array([10.0])}, dt=1.0, units={"a": "deg"})
    assert mtl.robustness("a < 12deg", degrees) == 2.0


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("always v <= 3 kg", "v has a unit of m/s, and 3 kg one of kg"),
        ("v <= 3 m/s + 1 s", "1 s has a unit of s, and 3 m/s one of m/s"),
        ("v * v <= 3 m/s", "has a quantity in a product, where v is not converted"),
        ("all(v) < 3", "needs a vector: v as"),
        ("mean(all(p), 2) < 3", "is one number, and all.p. stands for several"),
        ("all(p) > any(p)", "asks for all and for any"),
        ("all(p - q) > 0", "needs vectors of one size; got {'p': 3, 'q': 2}"),
        ("F[0, 1) (v < 3)", "has no sample"),
    ],
)
def test_what_does_not_go_together_is_refused(text, error):
    signals = {"v": np.ones(4), "p": np.ones((4, 3)), "q": np.ones((4, 2))}
    trace = Trace(signals, dt=1.0, units={"v": "km/h"})
    if error == "has no sample":
        text = text.replace("[", "(")
    for evaluate in (mtl.robustness, lambda f, trace: HostValues.of(trace)(f)):
        with pytest.raises(ValueError, match=error):
            evaluate(mtl.parse(text), trace)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("v < 3 foo", "if 'foo' is a unit, leave it out"),
        ("duration(v > 1, 3 km) < 1", "a time is needed here; got 3 km"),
        ("F[0, 3 km] v < 1", "unknown unit of time 'km'"),
        ("count(v > 1) < 1", r"count takes \(operand, window\): missing"),
        ("count(F v > 1, 3) < 1", "looks ahead: use an operator that looks back"),
        ("mean(v, [0, inf]) < 1", "the window of mean has an end"),
        ("mean(v, -1) < 1", "must be a positive number of seconds"),
        ("abs([0, 1]) < 1", "abs takes numbers, and no interval"),
        ("unit(3, 4) < 1", "unknown function 'unit'"),
        ("G[3, 3) v < 1", "an interval without one of its ends is longer"),
        ("G[0, inf) v < 1", "an interval without one of its ends is longer"),
        ("always (rates(v) < 1)", "did you mean 'rate'"),
    ],
)
def test_what_cannot_be_read_is_told(text, error):
    with pytest.raises(mtl.FormulaSyntaxError, match=error):
        mtl.parse(text)


def test_units_are_no_words_of_the_grammar():
    assert mtl.parse("x < 6deg/2").terms()[1].arguments[0].unit == "deg"
    assert not set(mtl.UNITS) & RESERVED - {"W"}  # A signal may be in watt.
    for base, units in SIZES.items():
        for unit in units:
            if unit != "W":
                q = mtl.parse(f"x < 2.5 {unit}").terms()[1]
                assert (q.unit, q.scale[0], str(q)) == (unit, base, f"2.5 {unit}")


@pytest.mark.slow
def test_what_is_between_the_parentheses_holds_of_all():
    rng = np.random.default_rng(0)
    trace = Trace({"p": rng.normal(size=(9, 3)), "y": rng.normal(size=9)}, dt=1.0)
    p, y = trace["p"], trace["y"]
    for text, expected in (
        ("always all(abs(p) + y) < 2", (2 - (np.abs(p) + y[:, None])).min()),
        ("eventually any(p) >= y", (p - y[:, None]).max()),
        ("always all(p) != 0", np.abs(p).min()),
        ("all(p)", p[0].min()),
    ):
        assert float(HostValues.of(trace)(mtl.parse(text))[0]) == pytest.approx(expected)
        assert mtl.dense_robustness(text, trace, "hold") == pytest.approx(expected)
        assert mtl.explain(text, trace).robustness == pytest.approx(expected, rel=1e-5)
    built = mtl.always(mtl.all_of(mtl.signal("p")) < 3)
    assert built == mtl.parse("always all(p) < 3")


def test_python_has_the_same_words():
    x, p = mtl.signal("x"), mtl.signal("p") > 0
    half = mtl.Interval(0, 5, open_end=True)
    for built, text in (
        (mtl.count(mtl.rise(p), 10) <= 3, "count(rise (p > 0), 10) <= 3"),
        (mtl.mean(x, mtl.Interval(1, 2)) < 1, "mean(x, [1,2]) < 1"),
        (abs(mtl.rate(x)) < 1, "abs(rate(x)) < 1"),
        (mtl.at_last(p, x) < 1, "at_last(p > 0, x) < 1"),
        (mtl.peak_to_peak(x, 3) < 1, "peak_to_peak(x, 3) < 1"),
        (x < mtl.quantity(3, "km/h"), "x < 3 km/h"),
        (mtl.always(p, half), "always[0,5) (p > 0)"),
        (p.weak_until(x > 1, half), "(p > 0) weak_until[0,5) (x > 1)"),
    ):
        assert str(built) == text
        assert mtl.parse(text) == built


def test_gaps_make_what_reads_them_unknown_and_nothing_else():
    x = np.array([1.0, np.nan, 3.0, 4.0])
    values = HostValues.of(Trace({"x": x}, dt=1.0))
    nan = np.nan
    for text, expected in (
        ("mean(x, 2) > 0", [1, nan, nan, 3.5]),
        ("count(x > 2, 2) > 0", [0, nan, nan, 2]),
        ("peak_to_peak(x, 2) > 0", [0, nan, nan, 1]),
        ("at_last(x > 2, x) > 0", [1, nan, 3, 4]),
        ("rate(x) > 0", [0, nan, nan, 1]),
    ):
        np.testing.assert_array_equal(values(mtl.parse(text)), expected, err_msg=text)
        watched = mtl.watch(text, 1.0, every=True)
        np.testing.assert_array_equal([watched.step({"x": v}) for v in x], expected, err_msg=text)


def test_mining_finds_bounds_and_windows_of_functions():
    x = np.array([0, 1, 0, 1, 1, 0, 1, 0.0])
    trace = Trace({"x": x}, dt=1.0)
    assert mtl.mine("always count(rise(x > 0), 4) <= ?n", [trace]).values == {"n": 2.0}
    assert mtl.mine("always count(x > 0, [0, ?T]) <= 2", [trace]).values == {"T": 2.0}
    with pytest.raises(ValueError, match="is an end that belongs to its interval"):
        mtl.mine("always[0, ?T) x > 0", [trace])


@pytest.mark.slow
def test_a_count_has_no_gradient_which_is_said():
    problem = vj.Problem(
        "p", {"a": vj.Box(-1, 1)},
        lambda features, key=None: vj.Trace({"x": features["a"] * np.ones(5)}, dt=1.0),
        "always count(x > 0.5, 3) <= 2",
    )  # fmt: skip
    (note,) = vj.falsify(problem, "gradient", 64).notes
    assert "follows gradients, and that of count(x > 0.5, 3) is zero" in note


def test_a_run_says_what_it_takes_for_granted():
    problem = vj.Problem(
        "car", {"v0": vj.Box(0, 40)},
        lambda features, key=None: vj.Trace({"v": features["v0"] * np.ones(5)}, dt=1.0),
        "always v <= 108 km/h",
    )  # fmt: skip
    run = vj.falsify(problem, "uniform", 64)
    assert any("m/s is taken for granted" in note for note in run.notes)
    assert (run.table.violating["v0"] > 30).all()
