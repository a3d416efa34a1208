"""The pytest plugin, as a project that has it installed sees it."""

import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import jax
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.addons.checking import Check, CounterexampleFound
from verifai_jax.addons.checking.check import min_budget
from verifai_jax.statistics.confidence_sequences import anytime_interval

pytest_plugins = ["pytester"]
PLUGIN = ("-p", "_verifai_jax_pytest", "-p", "no:cacheprovider", "-p", "no:zarr")
CONTROLLER = """
import jax.numpy as jnp
import verifai_jax as vj

LIMIT = {limit}


def system(f, key):
    return vj.Trace({{"x": f["push"] * (f["push"] > LIMIT) * jnp.ones(3)}}, dt=1.0)


space = {{"push": vj.Box(0.0, 1.0), "wind": vj.Box(-1.0, 1.0)}}
nominal = {{"push": 0.0, "wind": 0.0}}
settle = vj.Problem("settle", space, system, "always x < 0.5", nominal=nominal)
"""
SETTINGS = """
[pytest]
vj_specs = specs/*.py
vj_budget = 128
"""


@pytest.fixture
def project(pytester, shared_cache, monkeypatch):
    (pytester.path / "specs").mkdir()
    monkeypatch.setenv("VERIFAI_JAX_CACHE", shared_cache["VERIFAI_JAX_CACHE"])
    return pytester


def write(project, limit, feature="push"):
    text = CONTROLLER.format(limit=limit).replace("push", feature)
    (project.path / "specs" / "settle.py").write_text(text)


def run(project, *options):
    """In a process of its own, since it imports what cannot be imported twice."""
    return project.runpytest_subprocess(*PLUGIN, *options, timeout=240)


@pytest.mark.slow
def test_a_failure_is_kept_replayed_first_and_fixed(project):
    project.makeini(SETTINGS)
    write(project, 0.6)
    result = run(project, "--junitxml", "report.xml")
    result.assert_outcomes(failed=1)
    text = result.stdout.str()
    assert "settle: " in text
    assert "counterexample, shrunk, robustness" in text
    assert "push  0 -> 0.6" in text
    assert "wind" not in text.partition("away from nominal")[2].partition("reproduce")[0]
    (saved,) = (project.path / "counterexamples").glob("*.json")
    command = (
        f"verifai-jax replay-counterexamples specs/settle.py:settle counterexamples/{saved.name}"
    )
    assert f"reproduce    {command}" in text
    assert json.loads(saved.read_text())["target"] == "specs/settle.py:settle"
    cases = ElementTree.parse(project.path / "report.xml").iter("property")
    properties = {case.get("name"): case.get("value") for case in cases}
    assert properties["vj_counterexamples"] != "0"
    assert properties["vj_saved"] == f"counterexamples/{saved.name}"
    # Now the corpus alone says so, before any search.
    again = run(project)
    again.assert_outcomes(failed=1)
    assert "settle: 1 counterexample in counterexamples: 1 failing" in again.stdout.str()
    assert "simulations violate" not in again.stdout.str()
    write(project, 1.0, feature="shove")
    lost = run(project)
    lost.assert_outcomes(failed=1)
    assert "the space has no feature push" in lost.stdout.str()
    project.makeini(f"{SETTINGS}vj_rename = push=shove\n")
    fixed = run(project, "-rP", "--vj-budget", "64")
    fixed.assert_outcomes(passed=1)
    assert "settle: 1 counterexample in counterexamples: 1 fixed" in fixed.stdout.str()
    assert "settle: 0 of 64 simulations violate the property" in fixed.stdout.str()


@pytest.mark.slow
def test_what_steers_a_terminal_is_written_out(project):
    project.makeini(SETTINGS)
    write(project, 0.6)
    corpus = project.path / "counterexamples"
    corpus.mkdir()
    (corpus / "evil\x1b[2J.json").write_text("{")
    (project.path / "specs" / "broken.py").write_text('raise ValueError("\\x1b[2J\\u202e")\n')
    result = run(project, "--junitxml", "report.xml", "-rA", "--continue-on-collection-errors")
    text = result.stdout.str()
    assert "evil\\x1b[2J.json" in text
    assert "\x1b[2J" not in text
    assert "\u202e" not in text
    ElementTree.parse(project.path / "report.xml")


@pytest.mark.slow
def test_a_decorated_function_with_fixtures_and_a_probability(project):
    write(project, 0.8)
    project.makepyfile(
        """
        import pytest
        import verifai_jax as vj
        from specs.settle import settle

        @pytest.fixture
        def least():
            return -0.6

        @vj.test(settle, budget=2000, max_failure_probability=0.3)
        def test_rarely(run, least):
            assert run.best["rho"] > least

        @vj.test("specs/settle.py:settle", budget=2000, max_failure_probability=0.1, seed=3)
        def test_more_rarely():
            raise AssertionError("not reached")

        class TestNever:
            @vj.test(settle, corpus="elsewhere")
            def test_never(self):
                pass
        """
    )
    result = run(project, "-rP", "--vj-seed", "5")
    result.assert_outcomes(passed=1, failed=2)
    text = result.stdout.str()
    assert "accepted     the failure probability is at most 30 %" in text
    assert "too often    the failure probability is above 10 %" in text
    assert "not reached" not in text
    assert "seed 5" in text
    name = "test_a_decorated_function_with_fixtures_and_a_probability.py"
    assert f"reproduce    pytest {name}::TestNever::test_never" in text
    assert len(list((project.path / "elsewhere").iterdir())) == 1


@pytest.mark.slow
def test_with_xdist_each_problem_is_tested_once(project):
    pytest.importorskip("xdist")
    project.makeini(SETTINGS)
    write(project, 0.6)
    result = run(project, "-n", "1", "--dist", "loadgroup")
    result.assert_outcomes(failed=1)
    assert "reproduce    verifai-jax replay-counterexamples specs/settle.py" in result.stdout.str()


@pytest.mark.thorough
def test_a_pattern_without_a_file_and_a_file_that_cannot_be_run(project):
    project.makeini("[pytest]\nvj_specs = spec/*.py\n")
    result = project.runpytest(*PLUGIN)
    assert "vj_specs: no file in" in result.stderr.str()
    project.makeini(SETTINGS)
    (project.path / "specs" / "broken.py").write_text("import nothing_like_it\n")
    result = project.runpytest(*PLUGIN)
    result.assert_outcomes(errors=1)
    assert "specs/broken.py cannot be run" in result.stdout.str()


def test_the_plugin_is_light():
    code = (
        "import sys, _verifai_jax_pytest\n"
        "print(*[m for m in ('jax', 'numpy', 'verifai_jax') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.thorough
def test_a_test_is_called_as_a_function_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def system(f, key):
        return vj.Trace({"x": f["a"][None].repeat(2)}, dt=1.0)

    problem = vj.Problem("ramp", {"a": vj.Box(0.0, 1.0)}, system, "always x < 0.5")
    seen = []
    vj.test(problem, budget=64, search="uniform", max_failure_probability=0.9)(seen.append)
    with pytest.raises(CounterexampleFound, match="counterexample, robustness") as found:
        vj.test(problem, budget=16, search="uniform")(lambda: None)()
    assert len(found.value.outcome.saved) == 1
    assert seen == []


@pytest.mark.slow
def test_tests_of_one_problem_share_what_they_compile(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    compiled = []

    def listen(event, _, **about):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(about.get("fun_name"))

    def system(f, key):
        return vj.Trace({"x": f["a"][None].repeat(2)}, dt=1.0)

    problem = vj.Problem("ramp", {"a": vj.Box(0.0, 1.0)}, system, "always x < 2")
    jax.monitoring.register_event_duration_secs_listener(listen)
    vj.test(problem, budget=64)(lambda: None)()
    assert compiled
    compiled.clear()
    vj.test(problem, budget=64, seed=3)(lambda: None)()
    assert compiled == []


def test_what_is_refused():
    with unchecked(), pytest.raises(TypeError, match="needs a Problem or the name of one"):
        vj.test(3)
    message = "500 simulations cannot show a failure probability of at most 0.1 %: it needs"
    with pytest.raises(ValueError, match=message):
        Check(budget=500, max_failure_probability=0.001)
    with pytest.raises(ValueError, match="did you mean 'budget'"):
        vj.test("specs/a.py:a", buget=3)
    least = min_budget(0.01, 0.95)
    assert anytime_interval(0, least).high <= 0.01 < anytime_interval(0, least - 1).high
