"""Runs by native code against runs by XLA, and what is done where there is no native code."""

import os
import re
import stat

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import verifai_jax as vj
from verifai_jax.addons.native import native_engine, native_program
from verifai_jax.addons.native.native_code import machine_code
from verifai_jax.addons.native.native_engine import FIRST, NativeEngine
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.evaluation.engine import engine_for

pytestmark = pytest.mark.thorough

BATCH = 1024
SPACE = {"x0": vj.Box(-1.0, 1.0), "push": vj.Signal(vj.Box(-1.0, 1.0), knots=3)}


def swing(**more):
    """A damped pendulum that is pushed, and ends where it turns over."""
    return vj.ode(
        lambda time, state, control, features: {
            "angle": state["rate"],
            "rate": control - jnp.sin(state["angle"]) - 0.1 * state["rate"],
        },
        lambda features, key: {"angle": features["x0"], "rate": 0.0},
        controller=lambda time, state, features: 2 * features["push"](time),
        control_period=0.1,
        dt=0.05,
        duration=3.0,
        **more,
    )


def problem_of(system, spec="always (abs(angle) < 2)", space=SPACE, **more):
    return vj.Problem("swing", space, system, spec, **more)


@pytest.fixture(scope="module")
def ending():
    return problem_of(swing(terminate=lambda state, features: jnp.abs(state["angle"]) > 2.5))


def evaluated(problem, u, key=None, first=0, **options):
    """Return verdicts of a native engine and of XLA's, and the native one."""
    key = run_keys(0)[1] if key is None else key
    engine = engine_for(problem, BATCH, **options)
    native = NativeEngine(engine, "native", len(u))
    ours = native.evaluate(u, key, first, 0.1)
    assert native.notes == ()
    assert native.chosen == "native"
    return ours, engine.evaluate(u, key, first, 0.1), native


def points(problem, n=BATCH):
    return np.random.default_rng(0).random((n, problem.space.dim), np.float32)


@pytest.mark.slow
def test_verdicts_are_those_of_xla(ending):
    ours, theirs, _ = evaluated(ending, points(ending))
    assert 0.01 < theirs.violated.mean() < 0.9
    assert np.array_equal(ours.violated, theirs.violated)
    assert np.array_equal(ours.status, theirs.status)
    assert np.allclose(ours.rho, theirs.rho, atol=1e-4)
    assert jax.tree.structure(ours.features) == jax.tree.structure(theirs.features)


@pytest.mark.slow
def test_rows_before_the_first_native_one_are_those_of_xla(ending):
    u = points(ending)
    ours, theirs, native = evaluated(ending, u)
    assert np.array_equal(ours.rho[:FIRST], theirs.rho[:FIRST])
    parts = [native.evaluate(u[i : i + 100], run_keys(0)[1], i) for i in range(0, BATCH, 100)]
    assert np.array_equal(np.concatenate([part.rho for part in parts]), ours.rho)


@pytest.mark.slow
def test_gradients_are_those_of_xla(ending):
    ours, theirs, _ = evaluated(ending, points(ending), gradient=True)
    size = np.abs(theirs.gradient).max(1, keepdims=True) + 1e-3
    assert np.quantile(np.abs(ours.gradient - theirs.gradient) / size, 0.99) < 1e-4


def test_nan_and_infinities_are_those_of_xla():
    """States that overflow, and a function that is not defined everywhere."""
    system = vj.ode(
        lambda time, state, control, features: state * state * 4,
        lambda features, key: jnp.sqrt(features["x0"]) * 0.1,
        dt=0.1,
        duration=3.0,
        signals=lambda time, state, control, features: {"angle": state, "log": jnp.log(state)},
    )
    problem = problem_of(system, "always (angle < 9) | eventually (log > 1)", {"x0": vj.Box(-1, 1)})
    ours, theirs, _ = evaluated(problem, points(problem))
    assert len(set(theirs.status)) > 1
    assert np.array_equal(ours.status, theirs.status)
    assert np.array_equal(np.isnan(ours.rho), np.isnan(theirs.rho))


@pytest.mark.slow
def test_a_system_that_draws_draws_the_same():
    def simulate(features, key):
        noise = jax.random.normal(key, (20,)) * 0.1
        _, angle = jax.lax.scan(lambda x, n: (0.9 * x + n,) * 2, features["x0"], noise)
        return vj.Trace({"angle": angle}, dt=0.1)

    space = {"x0": vj.Box(-0.4, 0.4), "gain": vj.Normal(1.0, 0.1)}
    problem = problem_of(simulate, "always[0, 1.9] (abs(angle) < 0.3)", space)
    ours, theirs, native = evaluated(problem, points(problem), first=10_000)
    assert native._program.draws
    assert np.array_equal(ours.violated, theirs.violated)
    assert np.allclose(ours.rho, theirs.rho, atol=1e-5)


def test_what_is_near_to_zero_is_decided_by_xla():
    """Half of the rows have a robustness of exactly zero, where `<=` holds and `<` does not."""
    system = lambda features, key: vj.Trace(  # noqa: E731
        {"angle": jnp.maximum(features["x0"], 0.0)[None]}, dt=0.1
    )
    strict = problem_of(system, {"strict": "angle > 0", "loose": "angle >= 0"}, {"x0": SPACE["x0"]})
    ours, theirs, _ = evaluated(strict, points(strict))
    assert 0.4 < np.mean(theirs.rho[:, 0] == 0) < 0.6
    assert np.array_equal(ours.violated, theirs.violated)
    assert np.array_equal(ours.rho, theirs.rho)


@pytest.mark.slow
def test_the_same_table_resumed_or_not(ending):
    options = {"run_on": vj.RunOn(engine="native"), "batch": 700, "progress": False}
    whole = vj.falsify(ending, "uniform", 2100, **options)
    part = vj.falsify(ending, "uniform", 900, **options)
    assert part.engine == whole.engine == "native"
    again = vj.resume(part, budget=2100, progress=False)
    assert again.engine == "native"
    # Which rows are examined depends on the earlier budget, whatever the engine.
    rows, others = (run.table.all.drop(columns="verdict") for run in (whole, again))
    assert rows.equals(others)
    other = vj.falsify(ending, "uniform", 2100, **{**options, "run_on": vj.RunOn(engine="xla")})
    assert other.engine == "xla"
    assert (other.table.all["violated"] == whole.table.all["violated"]).all()
    assert whole.notes == other.notes


def test_the_record_says_which_engine(ending, tmp_path):
    options = {"batch": 700, "progress": False, "confirm": False}
    run = vj.falsify(
        ending, "halton", 1400, run_on=vj.RunOn(engine="native"), folder=tmp_path / "run", **options
    )
    assert vj.load(tmp_path / "run").engine == run.engine == "native"
    small = vj.falsify(ending, "halton", 700, folder=tmp_path / "small", **options)
    assert vj.load(tmp_path / "small", ending).engine == small.engine == "xla"


def test_auto_is_native_where_the_budget_is_worth_it(ending):
    engine = engine_for(ending, BATCH)
    enough = int(native_engine.WORTH / engine.program.work) + 1
    assert NativeEngine(engine, "auto", enough)._is_worth
    assert not NativeEngine(engine, "auto", enough - 2)._is_worth


@pytest.mark.slow
def test_by_default_it_is_native_unless_few_simulations_may_do(ending, monkeypatch):
    monkeypatch.setattr(native_engine, "WORTH", 1)
    options = {"batch": 700, "confirm": False, "progress": False}
    run = vj.falsify(ending, "uniform", 700, **options)
    assert run.engine == "native"
    natively = vj.falsify(ending, "uniform", 700, run_on=vj.RunOn(engine="native"), **options)
    assert run.table.all.equals(natively.table.all)
    assert vj.falsify(ending, "uniform", 700, stop=vj.Stop(after=10**6), **options).engine == "xla"
    assert vj.falsify(ending, "uniform", 300, **options).engine == "xla"
    assert vj.falsify(ending, "cross_entropy", 700, **options).engine == "xla"


@pytest.mark.slow
def test_given_features_are_simulated_natively(ending):
    rows = vj.falsify(ending, "uniform", 800, confirm=False, progress=False).table.all
    run = vj.simulate(ending, rows, run_on=vj.RunOn(engine="native"), progress=False)
    assert run.engine == "native"
    assert np.allclose(run.table.all["rho"], rows["rho"], atol=1e-4)


def test_an_unknown_engine(ending):
    with pytest.raises(UnknownNameError, match=r"unknown engine 'fast'.*auto, xla, native"):
        vj.falsify(ending, "uniform", 10, run_on=vj.RunOn(engine="fast"))


def sorted_problem():
    """What is not translated."""

    def system(features, key):
        return vj.Trace({"angle": jnp.sort(features["x0"] * jnp.arange(3.0))[:1]}, dt=0.1)

    return problem_of(system, "angle > -1.5", {"x0": SPACE["x0"]})


def fallback_note(problem, **options):
    run = vj.falsify(
        problem, "uniform", 700, run_on=vj.RunOn(engine="native"), progress=False, **options
    )
    (note,) = [each for each in run.notes if "natively" in each]
    assert run.engine == "xla"
    assert run.simulations == 700
    assert run.table.all["rho"].notna().all()
    return note


def test_what_is_not_translated_is_simulated_by_xla():
    note = fallback_note(sorted_problem())
    assert "not natively: it has the operation sort, which is not translated" in note


@pytest.mark.slow
def test_without_a_compiler(ending, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    ending.programs.clear()
    assert "none of c++, g++, clang++ is in PATH" in fallback_note(ending)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("echo 'no space left' >&2; exit 1", "c++ failed: no space left"),
        ("exit 0", "c++ failed: it said nothing"),
        ("sleep 5", "took more than 1 s"),
        ('while [ "$1" != -o ]; do shift; done; echo damaged > "$2"', "cannot be loaded"),
    ],
)
def test_with_a_broken_compiler(ending, monkeypatch, tmp_path, script, words):
    compiler = tmp_path / "c++"
    compiler.write_text(f"#!/bin/sh\n{script}\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(machine_code, "MAX_SECONDS", 1.0)
    ending.programs.clear()
    assert words in fallback_note(ending)


@pytest.mark.slow
def test_with_a_cache_that_cannot_be_written(ending, monkeypatch, tmp_path):
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "native").write_text("a file")
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path / "cache"))
    ending.programs.clear()
    assert "the cache of compiled programs cannot be used" in fallback_note(ending)
    monkeypatch.setenv("VERIFAI_JAX_CACHE", "off")
    ending.programs.clear()
    assert "the cache of compiled programs is switched off" in fallback_note(ending)


@pytest.mark.slow
def test_a_folder_that_others_can_write_to_is_refused(ending, monkeypatch, tmp_path):
    (tmp_path / "native").mkdir()
    (tmp_path / "native").chmod(0o777)
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path))
    ending.programs.clear()
    assert "others can write to" in fallback_note(ending)


@pytest.mark.slow
def test_a_damaged_library_is_made_anew(ending, monkeypatch, tmp_path):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path))
    ending.programs.clear()
    evaluated(ending, points(ending))
    folder = tmp_path / "native"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    (file,) = folder.glob("*.so")
    written = file.read_bytes()
    # A library that is loaded must not change under the process: the damaged one is another file.
    file.unlink()
    file.write_bytes(written[:-2000] + bytes(2000))
    ending.programs.clear()
    evaluated(ending, points(ending))
    assert file.read_bytes() == written or len(list(folder.glob("*.so"))) == 2


@pytest.mark.slow
def test_a_program_that_computes_something_else_is_not_used(ending, monkeypatch, tmp_path):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path))
    ending.programs.clear()
    honest = native_program.translate
    wrong = lambda program: honest(program).replace("= sine(", "= cosine(")  # noqa: E731
    monkeypatch.setattr(native_program, "translate", wrong)
    assert "differ from those of XLA" in fallback_note(ending)
    # Another process would know: it is neither compiled nor compared again.
    ending.programs.clear()
    monkeypatch.setattr(native_program, "translate", None)
    assert "differ from those of XLA" in fallback_note(ending)
    ending.programs.clear()


def test_double_precision_and_black_boxes_are_not_native(ending):
    run = vj.falsify(
        ending,
        "uniform",
        20,
        run_on=vj.RunOn(engine="native"),
        precision="float64",
        confirm=False,
        progress=False,
    )
    assert run.engine == "xla"
    assert any("single precision" in note for note in run.notes)


def falling(**more):
    """A pendulum with constants that are easily found in its code."""
    return vj.ode(
        lambda time, state, control, features: {
            "angle": state["rate"],
            "rate": -9.81 * jnp.sin(state["angle"]) - 0.37 * state["rate"],
        },
        lambda features, key: {"angle": features["x0"], "rate": 0.0 * features["x0"]},
        dt=0.05,
        duration=2.0,
        signals=lambda time, state, control, features: {"angle": state["angle"]},
        **more,
    )


@pytest.mark.slow
@pytest.mark.parametrize("number", ["9.81", "0.37", "0.75"])
def test_a_constant_that_is_off_by_a_ten_thousandth_is_found(monkeypatch, tmp_path, number):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path))
    problem = problem_of(falling(), "always (angle < 0.75)", {"x0": SPACE["x0"]})
    honest = native_program.translate

    def edited(program):
        source, times = re.subn(
            rf"(?<![\d.]){re.escape(number)}\d*f",
            lambda found: f"{float(found[0][:-1]) * (1 + 1e-4):.9f}f",
            honest(program),
        )
        assert times
        return source

    monkeypatch.setattr(native_program, "translate", edited)
    assert "differ from those of XLA by more than rounding" in fallback_note(problem)
    monkeypatch.setattr(native_program, "translate", honest)
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path / "other"))
    problem.programs.clear()
    native = vj.RunOn(engine="native")
    run = vj.falsify(problem, "uniform", 700, run_on=native, progress=False)
    assert run.engine == "native"


@pytest.mark.slow
def test_a_system_that_draws_is_compared_at_rounding_too(monkeypatch, tmp_path):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path))

    def simulate(features, key):
        noise = jax.random.normal(key, (20,)) * 0.1
        _, angle = jax.lax.scan(lambda x, n: (0.87 * x + n,) * 2, features["x0"], noise)
        return vj.Trace({"angle": angle}, dt=0.1)

    problem = problem_of(simulate, "always[0, 1.9] (abs(angle) < 0.3)", {"x0": vj.Box(-1, 1)})
    honest = native_program.translate
    edited = lambda program: honest(program).replace("0.87", "0.8701")  # noqa: E731
    monkeypatch.setattr(native_program, "translate", edited)
    assert "differ from those of XLA by more than rounding" in fallback_note(problem)


def test_a_network_of_convolutions_is_simulated_by_xla():
    """Products by 1 x 1 convolutions, as in networks of ONNX, by default and natively."""
    weights = np.random.default_rng(0).normal(size=(3, 2, 1, 1)).astype(np.float32)

    def simulate(features, key):
        image = jnp.stack([features["x0"], 1.0]).reshape(1, 2, 1, 1)
        out = jax.lax.conv(image, weights, (1, 1), "VALID").ravel()
        return vj.Trace({"angle": out[:1]}, dt=0.1)

    problem = problem_of(simulate, "angle > -1.5", {"x0": SPACE["x0"]})
    assert "the operation conv_general_dilated, which is not translated" in fallback_note(problem)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (native_program, "translate"),
        (native_program, "load"),
        (native_program, "library_name"),
        (native_program.NativeProgram, "begin"),
        (native_program.NativeProgram, "__call__"),
        (native_program.NativeProgram, "compare"),
        (native_program.NativeProgram, "otherwise_rounded"),
        (native_engine, "compiler"),
    ],
)
def test_whatever_native_code_raises_xla_goes_on(ending, monkeypatch, tmp_path, owner, name):
    monkeypatch.setenv("VERIFAI_JAX_CACHE", str(tmp_path))
    ending.programs.clear()

    def raises(*arguments, **options):
        raise KeyError("a part that is not there")

    monkeypatch.setattr(owner, name, raises)
    assert "it failed (KeyError: 'a part that is not there')" in fallback_note(ending)
    ending.programs.clear()
