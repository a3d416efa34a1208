"""Why a run has no failure rate: the reason is the right one, and the same in every text."""

import re
from typing import get_args

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax import search as searches
from verifai_jax.falsification.no_rate import what_lies_between
from verifai_jax.falsification.running import Origin, origin_of

OTHERS = {
    "first": "rows were given",
    "given": "its rows were given",
    "sequence": "its points are those of a sequence, spread on purpose",
    "coverage": "this search goes where coverage grows",
    "learned": "this search goes where failures are",
}


@pytest.mark.parametrize(
    ("search", "first", "origin"),
    [
        ("uniform", 0, "prior"),
        ("uniform", 3, "first"),
        ("halton", 0, "sequence"),
        ("halton", 3, "sequence"),
        pytest.param("grid", 0, "sequence", marks=pytest.mark.addons),
        (searches.Split({"x": searches.Halton()}, searches.Uniform()), 0, "sequence"),
        (searches.Split({"x": searches.CrossEntropy()}, searches.Uniform()), 0, "learned"),
        (searches.PointList([[0.5]]), 0, "given"),
        pytest.param("coverage", 0, "coverage", marks=pytest.mark.addons),
        ("portfolio", 0, "learned"),
        ("cross_entropy", 3, "learned"),
    ],
)
def test_each_search_has_its_origin(search, first, origin):
    search = searches.named(search) if isinstance(search, str) else search
    assert origin_of(search, first) == origin


def test_every_search_with_a_name_has_one():
    for name in searches.names():
        assert origin_of(searches.named(name), 0) in get_args(Origin)


@pytest.fixture(scope="module")
def runs():
    def system(features):
        return vj.Trace({"y": np.array([features["a"] - 0.3])}, dt=1.0)

    space = {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}
    problem = vj.Problem("slope", space, vj.blackbox(system), "y >= 0")
    rows = [{"a": 0.1 * i, "b": 0.5} for i in range(11)]
    return {
        "prior": vj.falsify(problem, "uniform", 48, batch=16),
        "first": vj.falsify(problem, vj.Start("uniform", rows=rows[:2]), 48, batch=16),
        "given": vj.simulate(problem, rows),
        "sequence": vj.falsify(problem, "halton", 48, batch=16),
        "learned": vj.falsify(problem, "cross_entropy", 48, batch=16),
    }


@pytest.mark.slow
def test_every_text_gives_the_reason(runs, tmp_path):
    for origin, run in runs.items():
        assert (run.origin, run.prior) == (origin, origin == "prior")
        report = run.report(tmp_path / f"{origin}.html", studies=False, traces=0).read_text()
        analysis = str(run.analyze())
        for text in (run.summary(), analysis, report):
            if origin == "prior":
                assert "not given" not in text
                assert "no probability" not in text
                continue
            said = {why for why in OTHERS.values() if why in text} - {OTHERS["first"]}
            wanted = {OTHERS[origin]} if origin != "first" else set()
            assert said == wanted, (origin, said)
        assert ("by what it had found before" in report) == (origin == "learned")
    assert "its first 2 rows were given; leave out Start(rows=)" in runs["first"].summary()


@pytest.mark.slow
def test_the_reason_is_stored(runs, tmp_path):
    for origin, run in runs.items():
        assert vj.load(run.save(tmp_path / origin)).origin == origin


@pytest.mark.thorough
def test_times_of_a_black_box_add_up(runs, tmp_path):
    seconds = r"([\d.]+) s (?:to|for)"
    for run in runs.values():
        line = next(each for each in run.summary().splitlines() if each.startswith("  time"))
        assert "nan" not in line
        assert "-" not in line
        spent = run.compile_seconds + run.run_seconds + run.confirm_seconds
        assert sum(map(float, re.findall(seconds, line))) == pytest.approx(spent, abs=0.08)
        parts = run.search_seconds + run.simulate_seconds
        assert 0 <= parts <= run.run_seconds + 1e-9


@pytest.mark.thorough
def test_where_nothing_has_a_verdict_no_rate_is_spoken_of():
    def system(features):
        return vj.Trace({"y": np.full(2, np.nan)}, dt=1.0)

    problem = vj.Problem("lost", {"a": vj.Box(0, 1)}, vj.blackbox(system), "y >= 0")
    run = vj.falsify(problem, "uniform", 4, progress=False)
    assert what_lies_between(run) == "The points between the 4 samples: nothing is known of them."
