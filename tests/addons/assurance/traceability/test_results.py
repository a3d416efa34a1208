"""What tests and runs found of a requirement, and what was edited after they were run."""

import re
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.assurance.traceability.evidence import outcome_of
from verifai_jax.addons.assurance.traceability.tested import LIMIT, read_cases
from verifai_jax.addons.checking import Session
from verifai_jax.addons.checking._test import session, source_hash
from verifai_jax.mtl import Requirement, parse

DEMANDS = [Requirement("A", None, "a text"), Requirement("B")]


def simulate(features):
    if features["a"] > 0.98:
        raise RuntimeError("out of order")
    values = {"x": np.full(3, features["a"]), "y": np.full(3, 0.5 - features["a"])}
    return vj.Trace(values, dt=0.1)


def problem_of(first="always x < 0.9", high=1.0, second="always y < 2", **options):
    spec = {"A": first, "B": second}
    space = {"a": vj.Box(0.0, high)}
    return vj.Problem("some", space, vj.blackbox(simulate), spec, requirements=DEMANDS, **options)


PROBLEM = problem_of(high=0.95)


@vj.test(PROBLEM, budget=12, search="uniform", max_failure_probability=0.4)
def test_of_it(): ...


# It belongs to no session of this file.
test_of_it.__test__ = False  # pyright: ignore


def falsified(problem, folder=None, budget=64, **options):
    return vj.falsify(problem, "uniform", budget, progress=False, folder=folder, **options)


@pytest.mark.slow
def test_outcomes_of_runs():
    run = falsified(PROBLEM)
    broken = np.count_nonzero(run.table.all["a"] > 0.9)
    assert outcome_of(run, "A") == ("violated", f"violated in {broken} of 64 simulations")
    assert outcome_of(run, "B") == ("met", "not violated in 64 simulations")
    raised = falsified(problem_of(first="always x < 2"))
    without = raised.table.counts.without_verdict
    assert outcome_of(raised, "A") == (
        "error", f"{without} of 64 simulations have no verdict",
    )  # fmt: skip

    def stop(step, values):
        raise KeyboardInterrupt

    ended = falsified(problem_of("always x < 2", 0.5), budget=4000, batch=8, callbacks=[stop])
    kind, text = outcome_of(ended, "A")
    assert (kind, text) == (
        "error", f"it ended early (interrupted) after {ended.simulations} of 4,000",
    )  # fmt: skip


def junit(path, outcome="", name="test_of_it", **properties):
    said = "".join(
        f'<property name="{key}" value={quoteattr(str(value))}/>'
        for key, value in properties.items()
    )
    path.write_text(
        f'<testsuites><testsuite><testcase classname="tests.testing.test_results" name="{name}">'
        f"<properties>{said}</properties>{outcome}</testcase></testsuite></testsuites>"
    )
    return path


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("inside", "properties", "outcome", "text"),
    [
        ("", {"vj_simulations": 12}, "met", "it passed, with 12 simulations"),
        ("", {"vj_simulations": 12, "vj_without_verdict": 3}, "error", "3 of 12 simulations have"),
        ('<failure message="no"/>', {"vj_counterexamples": 1}, "violated", "it failed: no"),
        ('<failure message="no"/>', {"vj_replayed_failing": 1}, "violated", "it failed: no"),
        ('<failure message="few"/>', {}, "error", "it failed without a counterexample: few"),
        ('<error message="no file"/>', {}, "error", "it raised: no file"),
        ('<skipped type="pytest.skip" message="later"/>', {}, "skipped", "it was skipped: later"),
        ('<skipped type="pytest.xfail" message="bug"/>', {}, "violated", "it is expected to fail"),
    ],
)
def test_outcomes_of_tests(tmp_path, inside, properties, outcome, text):
    file = junit(tmp_path / "junit.xml", inside, **properties)
    found = vj.trace_matrix(PROBLEM, tests=[test_of_it], results=[file])
    assert found.complete
    for row in found.rows:
        assert row.outcome == outcome
        assert text in row.results[0].text
    assert bool(found.unmet) == (outcome != "met")
    assert f"every link is there, and fits; 2 {outcome}" in str(found)


def test_no_result_is_no_result(tmp_path):
    found = vj.trace_matrix(PROBLEM, tests=[test_of_it])
    assert [row.outcome for row in found.unmet] == ["not run", "not run"]

    @pytest.mark.skip
    @vj.test(PROBLEM)
    def skipped(): ...

    found = vj.trace_matrix(PROBLEM, tests=[skipped])
    assert {row.outcome for row in found.rows} == {"skipped"}
    gone = junit(tmp_path / "junit.xml", name="test_gone", vj_problem="some")
    found = vj.trace_matrix(PROBLEM, tests=[test_of_it], results=[gone])
    assert "has a result of tests.testing.test_results.test_gone, which is not one of" in str(found)
    (tmp_path / "junit.xml").write_text("<other/>")
    with pytest.raises(ValueError, match=r"junit.xml is not of JUnit"):
        read_cases([tmp_path])


@pytest.mark.thorough
def test_tests_that_were_edited(tmp_path):
    with session(Session(root=tmp_path)) as now:
        test_of_it()
    said = {**now.outcomes[0].properties, "vj_source": source_hash(test_of_it)}
    file = junit(tmp_path / "junit.xml", **said)
    assert vj.trace_matrix(PROBLEM, tests=[test_of_it], results=[file]).complete
    for key, value, text in (
        ("vj_budget", 2000, "the budget of test_of_it has changed since .*: 2000 then, 12 now"),
        ("vj_seed", 3, "the seed of test_of_it has changed since"),
        (LIMIT, 0.5, "the max failure probability of test_of_it has changed since"),
        ("vj_source", "0" * 64, "the source of test_of_it has changed since"),
        ("vj_formulas", '{"A": "always x < 7"}', "the formula of test_of_it has changed since"),
    ):
        file = junit(tmp_path / "junit.xml", **{**said, key: value})
        found = vj.trace_matrix(PROBLEM, tests=[test_of_it], results=[file])
        assert {gap.link for gap in found.suspect} == {"tests"}, key
        assert re.search(text, found.suspect[0].text), key
    other = vj.test(problem_of(first="always x < 3", high=0.95))(lambda: None)
    found = vj.trace_matrix(PROBLEM, tests=[other])
    assert "tests always (x < 3), and the problem has always (x < 0.9)" in str(found)


@pytest.mark.slow
def test_evidence_that_was_edited(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("odd.yaml").write_text(
        'TAXONOMY:\n  a: float length\nMODULES:\n  m: {LABEL: x, INCLUDE_AND: {a: "[0 .. 1] m"}}\n'
    )
    run = falsified(PROBLEM, "runs/some-1")
    run.report("runs/some-1/report.html", studies=False, odd=vj.read_odd("odd.yaml"))
    claims = Path("runs/some-1/report.claims.json")
    traced = lambda problem=PROBLEM: vj.trace_matrix(problem, runs=["runs"])  # noqa: E731
    whole = traced()
    assert whole.complete, str(whole)
    assert {each.name for each in whole.inputs} == {
        "runs/some-1/run.json", "runs/some-1/report.claims.json", "runs/some-1/report.html",
    }  # fmt: skip
    written = whole.report("trace.html").read_text()
    assert all(each.sha256 in written for each in whole.inputs)
    for path, text in (
        (claims, "report.claims.json was edited since it was written"),
        (claims.with_name("report.html"), "report.html was edited since runs/some-1"),
        (Path("odd.yaml"), "odd.yaml was edited since runs/some-1/report.claims.json"),
    ):
        before = path.read_text()
        path.write_text(before.replace("64 simulations", "65 simulations") + " ")
        if path == claims:
            path.write_text(before.replace("of 64 simulations", "of 65 simulations"))
        found = traced()
        assert {gap.subject for gap in found.suspect} == {"A", "B"}, path
        assert text in str(found), path
        path.write_text(before)
    Path("odd.yaml").unlink()
    assert "odd.yaml, which runs/some-1/report.claims.json rests on, is not there" in str(traced())
    # Of a black box the features are compared as data.
    changed = traced(problem_of(high=0.9))
    assert "A: the features have changed since runs/some-1" in str(changed)


def test_a_formula_of_no_problem():
    demands = [*DEMANDS, Requirement("C", parse("always z < 1"), "a third")]
    found = vj.trace_matrix(PROBLEM, requirements=demands)
    assert "no problem has the formula of requirement C" in str(found)
    assert (found.rows[2].formula, found.rows[2].outcome) == ("always (z < 1)", "not run")
