"""Windows that the ends of a trace cut, and parts that one sample decides."""

import itertools

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.mtl import parse
from verifai_jax.mtl.shortfalls import shortfalls

FOUND = {
    # One good instant is enough, and the end makes it easy.
    "eventually[0,5] always[0,1] x > 0": "eventually[0,4] always[0,1] (x > 0)",
    "eventually always[0,1] x > 0": "eventually[0,4] always[0,1] (x > 0)",
    "!(always[0,5] eventually[0,1] x > 0)": "!(always[0,4] eventually[0,1] (x > 0))",
    "x > 0 until[0,5] always[0,1] y > 0": "(x > 0) until[0,4] (always[0,1] (y > 0))",
    "eventually[0,5] (y > 0 & eventually[0,1] always[0,1] x > 0)": (
        "eventually[0,3] (y > 0 & (eventually[0,1] always[0,1] (x > 0)))"
    ),
    "always (y > 0 -> eventually[0,5] always[0,1] x > 0)": (
        "always (y > 0 -> eventually[0,4] always[0,1] (x > 0))"
    ),
    "eventually[0,5] always[1,2] x > 0": "eventually[0,3] always[1,2] (x > 0)",
    "eventually[0,5] !(y > 0 & eventually[0,1] x > 0)": (
        "eventually[0,4] !(y > 0 & (eventually[0,1] (x > 0)))"
    ),
    "eventually[0,5] (y > 0 weak_until[0,1] x > 0)": (
        "eventually[0,4] ((y > 0) weak_until[0,1] (x > 0))"
    ),
    # The beginning does the same to windows that look back.
    "eventually[0,5] historically[0,1] x > 0": "eventually[1,5] historically[0,1] (x > 0)",
    "eventually historically x > 0": "",
    # Each instant has to be good, and the end makes it hard.
    "always[0,5] eventually[0,1] x > 0": "always[0,4] eventually[0,1] (x > 0)",
    "always[0,5] (y > 0 -> eventually[0,1] x > 0)": (
        "always[0,4] (y > 0 -> eventually[0,1] (x > 0))"
    ),
    "x > 0 release[0,5] eventually[0,1] y > 0": "(x > 0) release[0,4] (eventually[0,1] (y > 0))",
    # The last sample decides.
    "eventually always x > 0": "eventually[0,2.5] always (x > 0)",
    "eventually[0,5] always x > 0": "eventually[0,2.5] always (x > 0)",
    "always eventually x > 0": "always[0,2.5] eventually[0,2.5] (x > 0)",
    "always[5,inf] x > 0": "",
    # The first sample decides.
    "x > 0": "always (x > 0)",
    "x > 0 | y > 0": "always (x > 0 | y > 0)",
    "x > 0 and always y > 0": "(always (x > 0)) & (always (y > 0))",
    "x > 0 -> eventually y > 0": "always (x > 0 -> eventually (y > 0))",
    "historically[0,1] x > 0": "always historically[0,1] (x > 0)",
    "once x > 0": "always once (x > 0)",
    "rise x > 0": "always rise (x > 0)",
    "always[0,0] x > 0": "always[0,0] always (x > 0)",
    # Nothing is where these look.
    "always[0,1] once[2,3] x > 0": "",
    "always (x > 0 -> once[7,8] y > 0)": "",
    "always[0,9] x > 0": "",
    "eventually[6,7] x > 0": "",
    "always (x > 0 -> eventually[6,7] y > 0)": "",
}

FITTING = [
    "always x > 0",
    "always[0,5] x > 0",
    "always[0,5.1] x > 0",  # Many count samples for periods.
    "eventually x > 0",
    "eventually[0,4] always[0,1] x > 0",
    "eventually[0,2] always x > 0",
    "always[0,4] eventually[0,1] x > 0",
    "always (x > 0 -> eventually[0,5] y > 0)",
    "always (x > 0 -> eventually y > 0)",
    "always eventually[0,1] x > 0",
    "always[0,5] always[0,1] x > 0",
    "eventually[0,5] eventually[0,1] x > 0",
    "always (x > 0 -> eventually[0,0.1] always[0,2.5] y > 0)",
    "always (x > 0 -> once[0,1] y > 0)",
    "always[0,5] once[0,1] x > 0",
    "eventually (x > 0 & historically y > 0)",
    "eventually[1,5] historically[0,1] x > 0",
    "(eventually[0,1] x > 0) until[0,5] y > 0",
    "x > 0 until y > 0",
    "x > 0 unless[0,5] y > 0",
    "next x > 0",
    "(always[0,3] x > 0) -> (always[0,4] y > 0)",
    "(x > 0 until y > 0) & (always ((rise x > 0) -> y > 0))",
    "TRUE",
]


@pytest.mark.parametrize(("text", "meant"), FOUND.items())
def test_what_does_not_fit_is_found(text, meant):
    (found,) = shortfalls(parse(text), 0.1, 5.0)
    assert found.meant == meant
    for part in [meant] if meant and found.kind == "cut" else []:
        assert not shortfalls(parse(part), 0.1, 5.0)


@pytest.mark.parametrize("text", FITTING)
def test_what_fits_is_not(text):
    assert not shortfalls(parse(text), 0.1, 5.0)


def test_a_formula_that_holds_its_parts_often_takes_no_longer():
    deep = parse("x > 0")
    for i in range(40):
        deep = parse(f"always[0,0.1] y > {i}").iff(deep)
    (found,) = shortfalls(deep, 0.1, 5.0)
    assert found.part == parse("x > 0")


def test_single_samples_need_no_temporal_operator():
    assert not shortfalls(parse("x > 0"), 0.1, 0.0)


@pytest.mark.parametrize(("outer", "inner"), [("eventually", "always"), ("always", "eventually")])
def test_two_windows_against_all_their_choices(outer, inner):
    for a, b, c, d in itertools.product(range(5), repeat=4):
        if a > b or c > d:
            continue
        fits = [t + d <= 4 for t in range(a, b + 1)]
        found = shortfalls(parse(f"{outer}[{a},{b}] {inner}[{c},{d}] x > 0"), 0.01, 4.0)
        kinds = {each.kind for each in found} - {"start"}
        assert kinds == (set() if all(fits) else {"cut"} if any(fits) else {"beyond"}), (a, b, c, d)
        if kinds == {"cut"}:
            (cut,) = [each for each in found if each.kind == "cut"]
            assert cut.meant == f"{outer}[{a},{a + sum(fits) - 1}] {inner}[{c},{d}] (x > 0)"


def test_the_formula_that_was_meant_is_not_met_by_one_sample():
    t = np.arange(0, 5.05, 0.1)
    wave = np.sin(5 * t)
    wave[-1] = 0
    trace = vj.Trace({"x": wave}, dt=0.1)
    said = "eventually[0,5] always[0,1] abs(x) <= 0.05"
    (found,) = shortfalls(parse(said), 0.1, 5.0)
    assert vj.robustness(said, trace) > 0 > vj.robustness(found.meant, trace)
