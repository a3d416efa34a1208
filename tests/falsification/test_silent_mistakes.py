"""Mistakes that raise nothing get a note, and what is right gets none."""

import itertools
import random
from contextlib import suppress
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.core.compute.jaxprs import programs_read
from verifai_jax.core.compute.purity import difference
from verifai_jax.core.user_code.targets import NothingDefined, definitions
from verifai_jax.problem.problem import ProblemError
from verifai_jax.problem.silent_mistakes import silent_mistakes

ROOT = Path(__file__).parents[2]
SPACE = {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}
KEPT = itertools.count(1)


def both(f, key):
    return vj.Trace({"x": f["a"] * jnp.ones(11), "y": f["b"] * jnp.ones(11)}, dt=0.1)


def python_numbers(f, key):
    return vj.Trace({"x": f["a"] * random.random() * jnp.ones(11)}, dt=0.1)


def numpy_numbers(f, key):
    return vj.Trace({"x": f["a"] + jnp.asarray(np.random.rand(11))}, dt=0.1)  # noqa: NPY002


def numbers_in_a_loop(f, key):
    gain = np.random.rand()  # noqa: NPY002
    loop = vj.ode(lambda t, s, u, f: {"x": f["a"] * gain}, lambda f, k: {"x": 0.0}, dt=0.1, steps=9)
    return loop(f, key)


def counts_its_calls(f, key):
    return vj.Trace({"x": f["a"] * jnp.ones(next(KEPT))}, dt=0.1)


def draws(f, key):
    noise = np.float32(0.1) * jnp.asarray(np.arange(11.0)) * jax.random.normal(key, (11,))
    return vj.Trace({"x": f["a"] + noise + 0 * f["b"]}, dt=0.1)


def notes_of(system, spec="always x < 2", space=SPACE):
    return silent_mistakes(vj.Problem("p", space, system, spec))


@pytest.mark.parametrize("system", [python_numbers, numpy_numbers, numbers_in_a_loop])
def test_numbers_that_are_not_of_the_key(system):
    with pytest.raises(ProblemError, match="computes with other numbers each time") as refused:
        vj.Problem("p", {"a": vj.Box(0, 1)}, system, "always x < 2").check()
    assert "test_silent_mistakes.py, line" in str(refused.value)
    assert "jax.random" in str(refused.value)


def test_what_is_kept_from_one_call_to_the_next():
    with pytest.raises(ProblemError, match="keeps global variable 'KEPT' from one call to the"):
        vj.Problem("p", {"a": vj.Box(0, 1)}, counts_its_calls, "always x < 2").check()
    calls = []

    def late(f, key):
        calls.append(1)
        return vj.Trace({"x": (f["a"] if len(calls) < 100 else 9.0) * jnp.ones(11)}, dt=0.1)

    (note,) = notes_of(late, space={"a": vj.Box(0, 1)})
    assert note.startswith("each call of the system changes variable 'calls' of ")


def test_what_is_right_gets_no_note():
    assert notes_of(draws) == ()
    assert notes_of(both, "always (x < 2 & y < 2)") == ()


def test_a_feature_that_nothing_reads():
    text = "feature 'b' influences no signal that the property speaks of (x): the search varies it"
    assert notes_of(both)[0].startswith(text)
    fields = {
        **SPACE,
        "car": vj.Struct({"v": vj.Box(0, 1), "w": vj.Box(0, 1), "g": vj.Constant(9.8)}),
        "wind": vj.Signal(vj.Box(0, 1), 3),
    }
    (note,) = notes_of(
        lambda f, k: vj.Trace({"x": (f["a"] + f["car"]["v"]) * jnp.ones(3)}, dt=1.0), space=fields
    )
    assert note.startswith("features 'b', 'car.w', 'wind' influence no signal")
    # One that the constraint reads is read.
    space = vj.FeatureSpace(SPACE, where=lambda f: f["b"] < f["a"])
    assert notes_of(both, space=space) == ()


def test_a_choice_compared_with_a_text():
    def system(f, key):
        return vj.Trace({"x": (1.0 if f["alg"] == "sac" else f["a"]) * jnp.ones(3)}, dt=1.0)

    space = {"a": vj.Box(0, 1), "alg": vj.Categorical("ppo", "sac")}
    (note,) = notes_of(system, space=space)
    assert note.startswith("feature 'alg' influences no signal")
    assert note.endswith("has the place of the choice as its value, which no text equals")


def test_a_state_of_a_loop_that_is_not_monitored():
    loop = vj.ode(
        lambda t, s, u, f: {"x": f["a"], "y": f["b"]},
        lambda f, k: {"x": 0.0, "y": 0.0},
        dt=0.1, steps=9,
    )  # fmt: skip
    assert "feature 'b' influences no signal" in notes_of(loop)[0]
    assert notes_of(loop, "always x + y < 2") == ()


def test_a_formula_that_looks_beyond_the_trace():
    (note,) = notes_of(both, "always[0, 3] (x < 2 & y < 2)")
    assert note == (
        "in the formula, always[0,3] (x < 2 & y < 2) looks 3 s ahead and a trace lasts 1 s: its "
        "last sample is taken for all that comes after"
    )
    # A window that slides over the end is no mistake, nor is one period more than there is.
    for spec in ("always eventually[0, 0.5] x + y > 0", "always[0, 1.1] x + y < 3"):
        assert notes_of(both, spec) == ()
    assert notes_of(both, {"a": "always[0, 1] eventually[0, 0.5] x + y > 0"}) == (
        "in the formula, always[0,1] asks for eventually[0,0.5] that begins as late as 1 s, when "
        "0 s of its 0.5 s are left of a trace of 1 s, so that the end alone may break it. "
        "Probably meant: "
        "always[0,0.5] eventually[0,0.5] (x + y > 0)",
    )


def test_parts_of_formulas_that_say_less_than_they_seem_to():
    short = "eventually[0, 1] always[0, 0.5] abs(x) <= 0.1"
    (note,) = notes_of(both, {"settles": short, "b": "always y < 2"})
    assert note.startswith("in formula 'settles', eventually[0,1] lets always[0,0.5] begin")
    assert note.endswith("Probably meant: eventually[0,0.5] always[0,0.5] (abs(x) <= 0.1)")
    (note,) = notes_of(both, "x + y < 2")
    assert note == (
        "in the formula, there is no temporal operator, so that only the first sample is tested. "
        "Probably meant: always (x + y < 2)"
    )

    def single(f, key):
        return vj.Trace({"x": (f["a"] + f["b"])[None]}, dt=0.1)

    assert notes_of(single, "x < 2") == ()


@pytest.mark.slow
def test_the_specifications_of_this_project_get_no_false_note():
    # In a model of an aircraft the heading has no part in the altitude; who knows the distance of
    # the cones needs no eyes for colours and weather.
    right = ("feature 'psi' influences no signal", "features 'car_hue', 'car_value', 'car_gap'")
    problems: dict[str, vj.Problem] = {}
    for file in sorted((ROOT / "specs").glob("**/*.py")):
        if file.stem in ("__init__", "tuning", "hopper", "reacher", "lstm"):
            continue
        with suppress(NothingDefined):  # Such as a training.
            problems |= {f"{file}:{n}": p for n, p in definitions(str(file), vj.Problem).items()}
    assert len(problems) > 40
    for name, problem in problems.items():
        found = [note for note in silent_mistakes(problem) if not note.startswith(right)]
        assert not found, f"{name}: {found}"


class TestRuns:
    @pytest.mark.slow
    def test_the_nominal_features_fail(self, capsys):
        def run(limit, system=both, **options):
            spec = f"always (x < {limit} & y < 2)"
            problem = vj.Problem("p", SPACE, system, spec, nominal={"a": 0.5, "b": 0.5})
            return vj.falsify(problem, "uniform", 40, batch=40, **options)

        found = run(0.25, progress=True)
        note = "the nominal features fail themselves, with robustness -0.25"
        assert found.notes[0].startswith(note)
        assert note in found.summary()
        assert note in capsys.readouterr().err.replace("\n", " ")
        assert run(0.75).notes == ()
        simulated = []

        def simulate(f):
            simulated.append(f["a"])
            return vj.Trace({"x": f["a"] * np.ones(2), "y": f["b"] * np.ones(2)}, dt=0.1)

        assert run(0.25, vj.blackbox(simulate), confirm=False).notes[0].startswith(note)
        assert len(simulated) == 41
        # Resumed it is told, and not simulated again.
        again = vj.resume(found, budget=48)
        assert again.notes[0].startswith(note)

    @pytest.mark.thorough
    @pytest.mark.parametrize("precision", ["float32", "float64"])
    def test_the_nominal_features_fail_before_rows_that_somebody_gives(self, precision):
        # The engine takes rows with given features then, which are longer than points.
        nominal = {"a": 0.5, "b": 0.5}
        problem = vj.Problem("p", SPACE, both, "always (x < 0.25 & y < 2)", nominal=nominal)
        first = [{"a": 0.125, "b": 0.75}]
        run = vj.falsify(problem, vj.Start("uniform", rows=first), 8, batch=8, precision=precision)
        assert run.notes[0].startswith("the nominal features fail themselves, with robustness -0.2")
        assert run.table.all["a"][0] == 0.125

    def test_what_may_take_long_is_not_simulated_for_it(self, monkeypatch):
        monkeypatch.setattr("verifai_jax.falsification.silent_mistakes.MAX_SAMPLES", 100)
        nominal = {"a": 0.5, "b": 0.5}
        problem = vj.Problem("p", SPACE, both, "always x + y < 0.9", nominal=nominal)
        assert vj.falsify(problem, "uniform", 40, batch=40).notes == ()

    @pytest.mark.thorough
    def test_the_table_is_the_same(self):
        problem = vj.Problem("p", SPACE, both, "always x < 0.2")
        told = vj.Problem("p", SPACE, both, "always x < 0.2", nominal={"a": 0.5, "b": 0.5})
        tables = [vj.falsify(p, "cross_entropy", 64, batch=16).table.all for p in (problem, told)]
        assert tables[0].equals(tables[1])

    def test_everything_fails(self):
        problem = vj.Problem("p", SPACE, both, "always x + y < -1")
        notes = vj.falsify(problem, "uniform", 40, batch=40).notes
        assert notes == (
            "all 40 simulations with a verdict violate the property: are the formula and its "
            "units right?",
            "the property is violated already at time 0: does the start satisfy it?",
        )
        rows = vj.simulate(problem, [{"a": 0.5, "b": 0.5}] * 40)
        assert rows.notes == ()

    def test_the_first_trace_of_a_black_box_shows_its_duration(self):
        for length, start in ((11, "in the formula, there is no temporal operator"), (1, "")):
            box = vj.blackbox(lambda f, n=length: vj.Trace({"x": f["a"] * np.arange(n)}, dt=0.1))
            problem = vj.Problem("p", {"a": vj.Box(0, 1)}, box, "x > -1")
            notes = vj.falsify(problem, "uniform", 4, confirm=False).notes
            assert [note[: len(start)] for note in notes] == ([start] if start else [])

    def test_a_start_that_violates_the_property_is_told(self):
        for spec, told in (("always x > 2", True), ("always[0.1, 1] x > 2", False)):
            problem = vj.Problem("p", SPACE, both, spec)
            notes = vj.falsify(problem, "uniform", 64, batch=64).notes
            assert any("all 64 simulations" in note for note in notes)
            assert any("violated already at time 0" in note for note in notes) == told

    def test_nearly_everything_fails(self):
        problem = vj.Problem("p", SPACE, both, "always (x > 0.98 & y < 2)")
        note, early = vj.falsify(problem, "uniform", 200, batch=40).notes
        assert early.startswith("the property is violated already at time 0")
        assert "of 200 simulations with a verdict violate the property, nearly all of the" in note

    def test_nothing_comes_near(self):
        spec = {"far": "always x < 1000", "near": "always y < 1.01"}
        (note,) = vj.falsify(vj.Problem("p", SPACE, both, spec), "uniform", 40, batch=40).notes
        assert note.startswith("formula 'far' was never near being violated: its robustness lay")

    @pytest.mark.slow
    def test_a_search_that_follows_slopes_where_there_are_none(self):
        def steps(f, key):
            return vj.Trace({"x": jnp.floor(4 * f["a"] + f["b"]) * jnp.ones(3)}, dt=1.0)

        problem = vj.Problem("p", SPACE, steps, "always x < 4")
        notes = vj.falsify(problem, "gradient", 16, batch=16).notes
        assert any("follows gradients and there are none" in note for note in notes)


def test_programs_inside_an_operation_may_take_constants_as_operands():
    # As those of equinox and diffrax do.
    table = jnp.arange(3.0)
    one, other = (jax.make_jaxpr(lambda x, k=k: k * x + table)(table).jaxpr for k in (2.0, 3.0))
    assert one.constvars
    assert list(programs_read({"jaxpr": one})) == [one]
    assert difference(one, one) == (False, None)
    assert difference(one, other)[0]
