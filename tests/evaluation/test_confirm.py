"""Which counterexamples are real: against closed forms, and against replays of their own."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked
from click.testing import CliRunner

import verifai_jax as vj
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.values.trace import Trace
from verifai_jax.counterexamples._confirm import confirm
from verifai_jax.evaluation.confirmations import VERDICTS, Confirmations
from verifai_jax.evaluation.confirmer import Confirmer
from verifai_jax.evaluation.replay import replay
from verifai_jax.evaluation.resimulate import ONE_BY_ONE
from verifai_jax.systems.base import System


def oscillator(bound=1.5):
    """A circle of radius `a`, which explicit Euler leaves: it reaches 1.6 `a` in 10 s.

    At a third of the step 1.18 `a`, at a quarter of it 1.13 `a`.
    """
    system = vj.ode(
        lambda t, s, control, f: {"x": s["v"], "v": -s["x"]},
        lambda f, key: {"x": f["a"], "v": jnp.zeros_like(f["a"])},
        dt=0.1,
        duration=10.0,
        method="euler",
    )
    return vj.Problem("circle", {"a": vj.Box(0.5, 2.0)}, system, f"always abs(x) <= {bound}")


@pytest.fixture(scope="module")
def circles():
    return vj.falsify(
        oscillator(), "uniform", 256, batch=256, seed=0, progress=False, confirm=False
    )


@pytest.fixture(scope="module")
def confirmed_circles(circles):
    return confirm(circles)


def plain(function, spec="always x <= 0.8", space=None, **options):
    """A problem whose signal is a function of its features and random key."""

    def system(features, key):
        return Trace({"x": jnp.broadcast_to(function(features, key), (3,))}, dt=0.1)

    return vj.Problem("plain", space or {"x": vj.Box(0.0, 1.0)}, system, spec, **options)


def checked(problem, values, seed=0, **options):
    values = np.asarray(values, np.float32)
    return Confirmer(problem, seed=seed, **options)({"x": values}, np.arange(len(values)))


def test_a_step_that_belongs_to_the_system_is_not_made_finer(circles):
    published = replace(circles.problem, system=replace(circles.problem.system, exact_step=True))
    failing = circles.table.violating
    columns = {name: failing[name].to_numpy() for name in failing.columns}
    found = Confirmer(published)(columns, failing.index.to_numpy())
    assert set(found.rho) == {"float64", "nudged"}
    assert found.notes == ("not checked at a finer step: the step belongs to the system",)
    # What only leaves the circle by Euler's step is a failure of a plant that is Euler's step.
    assert (found.verdict == "confirmed").mean() > 0.95
    assert "refuted" not in found.verdict


@pytest.mark.thorough
def test_artefacts_of_the_step_are_told_from_failures(circles, confirmed_circles):
    a = circles.table.counterexamples["a"]
    verdict = confirmed_circles.table["verdict"]
    # The solution has the radius a: what does not reach the bound may not be claimed.
    assert (a[verdict == "confirmed"] > 1.5).all()
    assert (verdict[a > 1.61] == "confirmed").all()
    assert (verdict[a < 1.16] == "refuted").all()
    assert (verdict[(a > 1.27) & (a < 1.5)] == "fragile").all()
    assert confirmed_circles.counts.keys() == {"confirmed", "fragile", "refuted"}
    assert len(confirmed_circles) == len(a) == sum(confirmed_circles.counts.values())


def aliased(time, x, control, features):
    """Derivatives that look constant at the steps, at their thirds or at their quarters."""
    wave = lambda f: jnp.cos(2 * jnp.pi * f * time)  # noqa: E731
    pulses = jnp.where(jnp.mod(40 * time + 0.004, 1) < 0.04, 1.0, 0.0)
    pulse = jnp.where(jnp.abs(time - 2) < 5e-4, 200.0, 0.0)
    kinds = [wave(80), wave(240), wave(80) + wave(60), wave(480), wave(2400), pulses, pulse]
    return jnp.stack(kinds)[features["kind"]]


@pytest.mark.slow
def test_what_only_looks_constant_at_the_steps_is_not_confirmed():
    system = vj.ode(
        aliased, lambda f, key: f["a"], signals=lambda t, x, control, f: {"x": x},
        dt=0.1, duration=5.0,
    )  # fmt: skip
    space = {"a": vj.Box(-0.1, 0.1), "kind": vj.DiscreteBox(0, 6)}
    run = vj.falsify(
        vj.Problem("alias", space, system, "always x < 0.4"), "uniform", 100, progress=False
    )
    assert len(run.table.violating) == 100
    assert not len(run.table.counterexamples)


@pytest.mark.thorough
@pytest.mark.parametrize("count", [2, 3, 5])
def test_finer_steps_are_as_accurate_however_they_are_divided(count):
    system = vj.ode(
        lambda t, x, control, f: jnp.cos(t), lambda f, key: f["a"] * 1.0,
        signals=lambda t, x, control, f: {"x": x}, dt=0.5, duration=5.0, method="euler",
    )  # fmt: skip
    run = system.refined(count)({"a": 0.0}, jax.random.key(0)).signals["x"]
    # The error of the left rectangle rule, of a step that is at most 0.4 longer.
    bound = 0.5 * 1.4 * 0.5 / count * 2.5
    np.testing.assert_allclose(run, np.sin(np.arange(11) * 0.5), atol=bound)


def test_a_search_is_told_that_what_is_refused_holds():
    verdict = np.array(["confirmed", "refuted", "fragile", "unexamined"], object)
    replayed = {
        "third_step": np.array([-1.0, 0.4, -0.2, np.nan]),
        "quarter_step": np.array([-0.9, 0.5, -0.1, np.nan]),
    }
    rho = np.array([-1.0, -0.1, -0.3, -2.0])
    found = replace(Confirmations.blank("", np.arange(4), rho), verdict=verdict)
    refused, learned = found.refuse()
    assert refused.sum() == 2
    assert np.isnan(learned).all()
    refused, learned = replace(found, rho=replayed).refuse()
    assert refused.tolist() == [False, True, True, False]
    assert learned[1:3].tolist() == [0.5, 1e-6]


@pytest.mark.thorough
def test_robustness_of_each_check_is_that_of_an_own_replay(circles, confirmed_circles):
    row = circles.best
    for factor, name in ((1, "float64"), (3, "third_step"), (4, "quarter_step")):
        problem = replace(oscillator(), system=oscillator().system.refined(factor))
        again = replay(problem, row, run_keys(0)[1], 0, "float64").rho["spec"]
        found = confirmed_circles.table.loc[row.name, f"rho.{name}"]
        np.testing.assert_allclose(found, again, rtol=1e-12)


def test_features_one_rounding_away_are_replayed_beside_the_row_itself(circles):
    rows = circles.table.counterexamples.iloc[:3]
    values = {"a": rows["a"].to_numpy(), "rho": rows["rho"].to_numpy()}
    space = circles.problem.space
    moved = space.nudged(space.features_of(values, "float64"))
    assert np.all(moved["a"] != values["a"])
    found = Confirmer(circles.problem)(values, rows.index.to_numpy())
    again = Confirmer(circles.problem)({**values, **moved}, rows.index.to_numpy())
    # Each of these moved features is a row of its own, at the same step.
    np.testing.assert_allclose(found.rho["nudged"], again.rho["quarter_step"], rtol=1e-12)
    assert np.all(found.rho["nudged"] != found.rho["quarter_step"])


@pytest.mark.thorough
def test_one_row_in_words(circles, confirmed_circles):
    one = confirm(circles, int(circles.best.name))
    assert one.confirmed
    assert one == confirm(circles, circles.best)
    row = confirmed_circles.table.loc[circles.best.name]
    assert (one.verdict, one.band) == (row["verdict"], pytest.approx(row["band"]))
    assert str(one).startswith(
        f"row {circles.best.name} of circle: confirmed, it fails in every replay. Robustness "
    )
    assert "as run (float32)" in str(one)
    assert "at a quarter of the step in float32" in str(one)
    frame = confirmed_circles.table
    least = int(frame.loc[frame["verdict"] == "refuted", "rho"].idxmin())
    refuted = confirm(circles, least)
    assert (
        f"row {least} of circle: refuted, an artefact of the simulation: "
        "it fails only in float64. Robustness" in str(refuted)
    )


def test_all_rows_in_words(circles, confirmed_circles):
    said = str(confirmed_circles)
    counts = confirmed_circles.counts
    assert said.startswith(
        f"circle: of {len(confirmed_circles)} counterexamples, {counts['confirmed']} confirmed "
        "in double precision, at a third and a quarter of the step and one rounding of the "
        f"features away, {counts['refuted']} refuted, {counts['fragile']} fragile\n"
    )
    assert f"the worst confirmed is row {circles.best.name}, robustness" in said


def test_a_mapping_of_features_needs_no_row(circles):
    assert confirm(circles, {"a": 1.9}).verdict == "confirmed"
    assert confirm(circles, {"a": 1.0}).verdict == "refuted"
    assert np.isnan(confirm(circles, {"a": 1.0}).rho["as_run"])


def test_single_precision_is_not_believed():
    # Beside 2^24 single precision has whole numbers only.
    rounded = plain(lambda f, key: (f["x"] + 2.0**24) - 2.0**24)
    found = checked(rounded, [0.6, 0.7, 0.9])
    assert found.verdict.tolist() == ["refuted", "refuted", "confirmed"]
    np.testing.assert_allclose(found.rho["float64"], [0.2, 0.1, -0.1], atol=1e-6)
    assert found.notes == ("not checked at a finer step: the system has no refined(factor)",)
    # A run that is off by as much as it fails by is no proof.
    rows = {"x": np.array([0.9], np.float32), "rho": np.array([-0.2])}
    doubtful = Confirmer(rounded)(rows, [0])
    assert doubtful.verdict.tolist() == ["fragile"]
    assert doubtful.why.tolist() == ["its robustness -0.1 moves by 0.1 between replays"]


@pytest.mark.thorough
def test_chaos_is_fragile():
    def doubled(features, key):
        x = features["x"]
        for _ in range(45):
            x = 4.0 * x * (1.0 - x)
        return x

    run = vj.falsify(
        plain(doubled, "always x <= 0.9"),
        "uniform",
        1024,
        batch=1024,
        seed=0,
        progress=False,
        confirm=False,
    )
    found = confirm(run)
    assert len(found) > 100
    assert len(found.confirmed) < len(found) / 20


@dataclass(frozen=True)
class Steps:
    """A signal that is a function of the feature and of how fine the step is."""

    of: object
    factor: int = 1

    def refined(self, factor):
        return Steps(self.of, self.factor * factor)

    def __call__(self, features, key):
        return Trace({"x": jnp.broadcast_to(self.of(features["x"], self.factor), (3,))}, dt=0.1)


def steps(of, spec="always x <= 0.5"):
    return vj.Problem("steps", {"x": vj.Box(0.0, 1.0)}, Steps(of), spec)


def test_a_row_that_raises_takes_no_other_of_its_call_along():
    def look(x):
        if x > 0.95:
            raise RuntimeError("out of reach")
        return np.asarray(x)

    def called(features, key):
        x = features["x"]
        return jax.pure_callback(look, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    found = checked(plain(called), [0.9, 0.99, 0.85])
    assert found.verdict.tolist() == ["confirmed", "raised", "confirmed"]


def test_a_simulation_that_breaks_down_at_a_finer_step_is_fragile():
    gone = steps(lambda x, factor: x if factor < 4 else x * jnp.nan)
    found = checked(gone, [0.9])
    assert found.verdict.tolist() == ["fragile"]
    assert np.isnan(found.rho["quarter_step"][0])
    assert "the replay at a quarter of the step" in found.why[0]
    assert "is not finite" in found.why[0]

    def raising(x, factor):
        if factor == 3:
            raise RuntimeError("too fine")
        return x

    found = checked(steps(raising), [0.9])
    assert found.verdict.tolist() == ["raised"]
    assert found.why.tolist() == [
        "the replay at a third of the step raised: RuntimeError: too fine"
    ]


def test_steps_that_disagree_are_fragile_and_neither_is_taken_for_the_truth():
    parts = {1: 1.0, 3: 0.4, 4: 1.0}
    found = checked(steps(lambda x, factor: x * parts[factor]), [0.9])
    assert found.verdict.tolist() == ["fragile"]
    assert found.why.tolist() == ["it holds at a third of the step"]


def test_a_factor_that_must_be_an_integer_is_one():
    @dataclass(frozen=True)
    class Boastful(Steps):
        traced_factor = True

    problem = vj.Problem(
        "integers",
        {"x": vj.Box(0.0, 1.0)},
        Boastful(lambda x, factor: x * len(range(factor)) / factor),
        "always x <= 0.5",
    )
    found = checked(problem, [0.9])
    assert found.verdict.tolist() == ["confirmed"]
    assert found.notes == ()
    assert set(found.rho) >= {"third_step", "quarter_step", "quarter_step_float32"}


def test_a_step_that_cannot_be_made_smaller_is_told():
    class Stiff(Steps):
        def refined(self, factor):
            raise ValueError("one step only")

    problem = vj.Problem(
        "stiff", {"x": vj.Box(0.0, 1.0)}, Stiff(lambda x, factor: x), "always x <= 0.5"
    )
    found = checked(problem, [0.9])
    assert found.verdict.tolist() == ["confirmed"]
    assert found.notes == (
        "not checked at a finer step: refined(3) raised ValueError: one step only",
    )
    assert set(found.rho) == {"float64", "nudged"}


def test_at_zero_the_boolean_semantics_decide():
    touching = plain(lambda f, key: 0.0 * f["x"], "always x > 0")
    assert checked(touching, [0.3]).verdict.tolist() == ["confirmed"]
    allowed = plain(lambda f, key: 0.0 * f["x"], "always x >= 0")
    assert checked(allowed, [0.3]).verdict.tolist() == ["refuted"]


@pytest.mark.thorough
def test_random_systems_keep_their_numbers_and_their_precision():
    noisy = plain(lambda f, key: f["x"] + 0.1 * jax.random.normal(key))
    run = vj.falsify(noisy, "uniform", 64, batch=64, seed=3, progress=False, confirm=False)
    found = confirm(run)
    np.testing.assert_allclose(found.table["rho.again"], found.table["rho"], rtol=1e-5, atol=1e-7)
    assert "not checked in float64: in it the system would draw other random numbers" in found.notes
    # With its own key each row comes again.
    assert found.counts == {"confirmed": len(found)}
    assert found.checked.startswith("when simulated again and one rounding of the features away")
    finer = confirm(run, int(run.best.name), engines=noisy)
    assert finer.verdict == "confirmed"


def test_a_system_that_draws_is_traced_in_the_precision_of_the_run_alone():
    traced = []

    class Noisy(System):
        def __call__(self, features, key=None):
            traced.append(features["x"].dtype)
            x = features["x"] + 0.1 * jax.random.uniform(key)
            return Trace({"x": x[None]}, dt=1.0)

        def refined(self, factor):
            return self

    problem = vj.Problem("noisy", {"x": vj.Box(0.0, 1.0)}, Noisy(), "always x <= 0.5")
    found = checked(problem, [0.9])
    assert found.notes == (
        "not checked in float64: in it the system would draw other random numbers",
    )
    assert set(found.rho) == {"again", "third_step", "quarter_step", "nudged"}
    assert set(traced) == {np.dtype(np.float32)}


def test_a_run_in_double_precision_is_replayed_in_it():
    run = vj.falsify(
        plain(lambda f, key: f["x"]),
        "uniform",
        32,
        batch=32,
        precision="float64",
        progress=False,
        confirm=False,
    )
    found = confirm(run)
    assert found.counts == {"confirmed": len(found)}
    assert "no finer step could be tried" in str(found)


def test_formulas_count_together():
    spec = {"low": "always x <= 0.8", "high": "always x >= 0.1"}
    found = checked(plain(lambda f, key: f["x"], spec), [0.05, 0.95, 0.5])
    assert found.verdict.tolist() == ["confirmed", "confirmed", "refuted"]
    np.testing.assert_allclose(found.rho["float64"], [-0.05, -0.15, 0.3], atol=1e-6)


def boxed(function, spec="always x <= 0.5"):
    return vj.Problem("boxed", {"x": vj.Box(0.0, 1.0)}, vj.blackbox(function), spec)


@pytest.mark.thorough
def test_a_black_box_is_simulated_again():
    steady = boxed(lambda f: Trace({"x": np.full(4, f["x"])}, dt=0.1))
    found = checked(steady, [0.7, 0.9])
    assert found.verdict.tolist() == ["confirmed"] * 2
    assert found.notes == (
        "not checked in float64: a black box",
        "not checked at a finer step: the system has no refined(factor)",
    )
    answers = iter([1.0, 0.0, 1.0, 0.0, *[0.0] * 9])
    moody = boxed(lambda f: Trace({"x": np.full(4, next(answers))}, dt=0.1))
    run = vj.falsify(moody, "uniform", 4, batch=4, progress=False, confirm=False)
    assert confirm(run).counts == {"fragile": 2}


def test_a_black_box_may_be_refined():
    def finer(factor):
        def simulate(features):
            if features["x"] > 0.95 and factor > 1:
                raise RuntimeError("diverged")
            return Trace({"x": np.full(4, features["x"] / factor)}, dt=0.1)

        simulate.refined = lambda more: finer(factor * more)
        return simulate

    found = checked(boxed(finer(1), "always x <= 0.2"), [0.3, 0.7, 0.85, 0.99])
    assert found.verdict.tolist() == ["refuted", "fragile", "fragile", "raised"]
    assert "RuntimeError: diverged" in found.why[3]
    np.testing.assert_allclose(
        found.rho["quarter_step"][:3], 0.2 - np.array([0.3, 0.7, 0.85]) / 4, rtol=1e-5
    )


@pytest.mark.slow
def test_features_are_those_of_the_table():
    space = vj.FeatureSpace(
        {
            "point": vj.Box([0.0, 1.0], [1.0, 5.0]),
            "mass": vj.LogUniform(0.1, 10.0),
            "wind": vj.Signal(vj.Box(-1.0, 1.0), knots=3, hold="linear"),
            "kind": vj.Categorical("a", "b"),
            "count": vj.DiscreteBox(1, 6),
            "cars": vj.Array(vj.Struct({"x": vj.Box(0.0, 9.0)}), length=(0, 2)),
            "g": vj.Constant(9.81),
        }
    )
    u = jnp.asarray(np.random.default_rng(0).random((12, space.dim), np.float32))
    columns = space.rows(jax.vmap(space.unflatten)(u))
    for precision in ("float32", "float64"):
        batch = space.features_of(columns, precision)
        with jax.enable_x64(precision == "float64"):
            for i in range(12):
                row = {name: column[i] for name, column in columns.items()}
                one, other = space.from_row(row), jax.tree.map(lambda leaf, i=i: leaf[i], batch)
                assert jax.tree.structure(one) == jax.tree.structure(other)
                for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
                    assert a.dtype == b.dtype
                    np.testing.assert_array_equal(a, b)
    moved = space.nudged(space.features_of(columns, "float64"))
    np.testing.assert_array_equal(moved["g"], 9.81)
    share = np.abs(moved["mass"] / space.features_of(columns, "float64")["mass"] - 1)
    np.testing.assert_allclose(share, 2.0**-23, rtol=1e-6)
    corner = space.nudged({**moved, "point": np.array([[1.0, 5.0]])})["point"]
    assert np.all(corner < [1.0, 5.0])
    with pytest.raises(UnknownNameError, match="unknown column 'mass'"):
        space.features_of({name: c for name, c in columns.items() if name != "mass"}, "float32")


@pytest.mark.thorough
def test_of_many_the_worst_and_the_first_are_examined():
    smooth = plain(lambda f, key: f["x"], "always x <= 0.2")
    run = vj.falsify(smooth, "uniform", 1024, batch=1024, seed=1, progress=False, confirm=False)
    failing = run.table.counterexamples
    found = confirm(run, max_rows=100)
    left = found.verdict == "unexamined"
    assert (~left).sum() == 100
    assert not left[:99].any()
    assert not left[np.argmin(failing["rho"])]
    assert set(found.why[left]) == {found.notes[0]}
    assert found.notes[0].endswith(f"of {len(failing)} were not replayed, as max_rows is 100")
    assert np.isnan(found.rho["float64"][left]).all()
    assert confirm(run).counts == {"confirmed": len(failing)}
    with pytest.raises(ValueError, match="max_rows"):
        confirm(run, max_rows=0)


def test_a_row_worse_than_all_before_is_examined_whatever_the_limit():
    smooth = plain(lambda f, key: f["x"], "always x <= 0.2")
    confirmer = Confirmer(smooth)

    def verdicts(x, limit):
        x = np.asarray(x)
        rows = {"x": x, "rho": 0.2 - x}
        return confirmer(rows, np.arange(len(x)), limit).verdict.tolist()

    many = np.linspace(0.5, 0.6, 40)
    assert verdicts(many, 4).count("confirmed") == 4
    # No worse than the worst one so far: none.
    assert set(verdicts(many, 4)) == {"unexamined"}
    # A worse one, and some beside it, in the program that is compiled already.
    found = verdicts(np.append(many, 0.9), 4)
    assert found[-1] == "confirmed"
    assert found.count("confirmed") == 1 + ONE_BY_ONE
    assert verdicts([0.7, 0.8], 4) == ["unexamined"] * 2
    assert verdicts([0.7, 0.95], 4) == ["confirmed"] * 2


@pytest.mark.slow
def test_the_worst_row_of_a_long_run_has_a_verdict():
    smooth = plain(lambda f, key: f["x"], "always x <= 0.2")
    run = vj.falsify(smooth, budget=4096, batch=256, seed=1, progress=False)
    assert run.verdict_counts["unexamined"] > 0
    assert run.table.all["verdict"][run.table.all["rho"].idxmin()] == "confirmed"


def test_what_is_finished_survives_ctrl_c(circles, monkeypatch):
    monkeypatch.setattr(sys.modules[confirm.__module__], "BLOCK", 16)
    calls = iter([True, False])
    whole = Confirmer.__call__

    def interrupted(self, rows, numbers):
        if not next(calls):
            raise KeyboardInterrupt
        return whole(self, rows, numbers)

    monkeypatch.setattr(Confirmer, "__call__", interrupted)
    found = confirm(circles)
    assert found.counts["unexamined"] == len(found) - 16
    assert found.notes == ("interrupted after 16 rows",)


@pytest.mark.thorough
def test_another_simulator_has_to_agree(circles):
    exact = vj.ode(
        lambda t, s, control, f: {"x": s["v"], "v": -s["x"]},
        lambda f, key: {"x": f["a"], "v": jnp.zeros_like(f["a"])},
        dt=0.1,
        duration=10.0,
    )
    row = int(circles.best.name)
    agreed = confirm(circles, row, engines=exact)
    assert agreed.verdict == "confirmed"
    assert agreed.transferable
    assert "The failure is transferable. Robustness" in str(agreed)
    assert confirm(circles, row).transferable is None
    assert agreed.rho["engine.the other engine"] == pytest.approx(1.5 - circles.best["a"], abs=1e-2)
    calm = replace(exact, initial=lambda f, key: {"x": 0.1 * f["a"], "v": 0.0 * f["a"]})
    calmer = replace(circles.problem, system=calm)
    other = confirm(circles, row, engines={"exact": exact, "calm": calmer})
    assert other.verdict == "fragile"
    assert other.why == "it holds in calm"
    assert other.transferable is False
    with pytest.raises(ValueError, match="no backends; an engine must be a system or a Problem"):
        confirm(circles, row, engines="native")
    stranger = vj.Problem("other", {"b": vj.Box(0.5, 2.0)}, exact, "always x <= 1")
    with pytest.raises(UnknownNameError, match="unknown feature of the engine 'b'"):
        confirm(circles, row, engines=stranger)


def test_errors_say_what_to_do(circles, tmp_path):
    safe = int(circles.table.safe.index[0])
    with pytest.raises(ValueError, match=f"row {safe} is not a counterexample: it keeps"):
        confirm(circles, safe)
    with pytest.raises(IndexError, match="row 999 is not in the table of 256 simulations"):
        confirm(circles, 999)
    with pytest.raises(UnknownNameError, match="did you mean 'engines'"):
        confirm(circles, engine="native")
    with unchecked(), pytest.raises(TypeError, match="confirm needs a Run; got Problem"):
        confirm(circles.problem)
    circles.save(tmp_path / "run")
    with pytest.raises(ValueError, match=r"was loaded without its problem.*vj.load\(path, problem"):
        confirm(vj.load(tmp_path / "run"))
    loaded = vj.load(tmp_path / "run", circles.problem)
    assert confirm(loaded, int(loaded.best.name)).verdict == "confirmed"


def test_a_run_without_failures():
    calm = vj.falsify(oscillator(5.0), "uniform", 16, batch=16, progress=False, confirm=False)
    assert str(confirm(calm)) == "circle: no counterexample to confirm"
    assert len(confirm(calm).confirmed) == 0


SPEC = """
from tests.evaluation.test_confirm import oscillator
circle = oscillator()
"""


@pytest.mark.slow
def test_command_line(circles, tmp_path):
    from verifai_jax.cli.confirm import confirm as command

    target = tmp_path / "circle.py"
    target.write_text(SPEC)
    circles.save(tmp_path / "run")
    folder, problem = str(tmp_path / "run"), ["--problem", f"{target}:circle"]
    call = CliRunner().invoke
    done = call(command, [folder, str(circles.best.name), *problem, "--fail-on", "unconfirmed"])
    assert done.exit_code == 0, done.output
    assert "of circle: confirmed, it fails in every replay" in done.output
    done = call(command, [folder, *problem])
    assert done.exit_code == 0
    assert "circle: of" in done.output
    done = call(command, [folder, *problem, "--fail-on", "unconfirmed"])
    assert done.exit_code == 1
    assert "refuted" in done.output


def independent(run, numbers, factors):
    """Robustness `[rows, factors]` of rows, each replayed by itself in double precision."""
    rho = []
    for number in numbers:
        row = run.table.all.loc[number]
        each = []
        for factor in factors:
            finer = replace(run.problem, system=run.problem.system.refined(factor))
            again = replay(finer, row, run_keys(run.seed)[1], int(number), "float64")
            each.append(min(again.rho.values()))
        rho.append(each)
    return np.array(rho)


@pytest.mark.slow
def test_automatic_transmission_is_believed():
    from specs.arch import automatic_transmission as at

    run = vj.falsify(at.at2, "uniform", 256, batch=256, seed=1, progress=False, confirm=False)
    found = confirm(run)
    assert found.counts.keys() == {"confirmed"}
    assert found.notes == ()
    numbers = found.confirmed.index[:3]
    finer = independent(run, numbers, (4, 8))
    assert np.all(finer < 0)
    np.testing.assert_allclose(found.table.loc[numbers, "rho.quarter_step"], finer[:, 0], rtol=1e-6)


@pytest.mark.slow
def test_a_chaotic_loop_is_not_believed_and_what_is_holds_up():
    from specs.arch import neural_network_controller as nn

    run = vj.falsify(nn.nn, "uniform", 20_480, batch=1024, seed=1, progress=False, confirm=False)
    found = confirm(run)
    assert len(found) > 50
    assert len(found.confirmed) < len(found) / 4
    numbers = found.confirmed.index[:4]
    assert len(numbers)
    assert np.all(independent(run, numbers, (4, 8)) < 0)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["native", "mjx"])
def test_mujoco_on_both_engines(backend):
    pytest.importorskip("mujoco")
    from specs import mujoco_cartpole

    run = vj.falsify(
        mujoco_cartpole.balance,
        "uniform",
        256,
        batch=256,
        run_on=vj.RunOn(backend=backend),
        progress=False,
        confirm=False,
    )
    other = "mjx" if backend == "native" else "native"
    row = int(run.best.name)
    found = confirm(run, row, engines="all")
    assert found.transferable
    assert found.rho[f"engine.{other}"] == pytest.approx(found.rho["as_run"], abs=1e-4)
    assert {"third_step", "quarter_step"} <= found.rho.keys()
    assert found.rho["third_step"] != found.rho["as_run"]
    every = confirm(run, engines=[other])
    assert len(every) == len(run.table.counterexamples)
    assert every.transferable is not None
    assert every.transferable.any()
    assert " transferable" in str(every)


def test_the_page_says_what_comes_out():
    text = (Path(__file__).parents[2] / "docs" / "confirm.md").read_text()
    for verdict in VERDICTS:
        assert f"`{verdict}`" in text


WEIGHTS = np.array([0.5, 0.3, 0.2])


def weighted(features, key):
    return Trace({"x": jnp.sum(features["a"] * WEIGHTS) * jnp.ones(11)}, dt=0.1)


@pytest.mark.slow
def test_numpy_constants_work_in_both_precisions():
    problem = vj.Problem("weighted", {"a": vj.Box(0.0, 1.0)}, weighted, "always x < 0.2")
    single = vj.falsify(problem, "uniform", 16, batch=16, progress=False)
    assert single.verdict_counts == {"confirmed": int(single.table.all["violated"].sum())}
    double = vj.falsify(problem, "uniform", 16, batch=16, precision="float64", progress=False)
    a = double.table.all["a"].to_numpy(np.float64)
    np.testing.assert_allclose(double.table.all["rho"], 0.2 - a * WEIGHTS.sum(), rtol=1e-15)
    # And back: a program in single precision after those in double precision.
    gradient = vj.falsify(problem, "gradient", 16, batch=16, progress=False)
    assert gradient.verdict_counts["confirmed"] == len(gradient.table.counterexamples)


def test_a_precision_that_cannot_be_traced_is_said_and_loses_no_failure():
    def only_single(features, key):
        if features["a"].dtype == jnp.float64:
            raise RuntimeError("single precision only")
        return Trace({"x": features["a"] * jnp.ones(3)}, dt=0.1)

    problem = vj.Problem("single", {"a": vj.Box(0.0, 1.0)}, only_single, "always x < 0.2")
    run = vj.falsify(problem, "uniform", 16, batch=16, progress=False)
    failing = int(run.table.all["violated"].sum())
    assert len(run.table.counterexamples) == failing
    assert run.verdict_counts == {"confirmed": failing}
    assert "not checked in float64: RuntimeError: single precision only" in run.summary()
    assert "in double precision" not in run.checked
