"""The loop: budgets, seeds, statuses, stopping, storing, and what is refused before compiling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked_types import unchecked

import verifai_jax as vj
from verifai_jax.evaluation import engine as engine_module
from verifai_jax.falsification.running import RunError
from verifai_jax.falsification.validation import usual_batch

SPACE = {"a": vj.Box(0.0, 1.0), "b": vj.Box(-1.0, 1.0)}
T = 8


def ramp(features, key):
    """X = a + b t: violates x <= 1 where a + b > 1."""
    t = jnp.linspace(0.0, 1.0, T + 1)
    return vj.Trace({"x": features["a"] + features["b"] * t}, dt=1 / T)


@pytest.fixture(scope="module")
def problem():
    return vj.Problem("ramp", space=SPACE, system=ramp, spec="always[0, 1] x <= 1")


@pytest.mark.thorough
def test_rows_are_what_was_simulated(problem):
    run = vj.falsify(problem, "uniform", 500, batch=64, seed=3)
    table = run.table.all
    assert len(table) == 500
    assert list(table.columns) == ["a", "b", "rho", "violated", "status", "verdict"]
    why = run.replay(run.best).explain()
    assert str(why.predicate) == "x <= 1"
    assert why.time == (1.0 if run.best["b"] > 0 else 0.0)
    expected = 1 - np.maximum(table["a"], table["a"] + table["b"])
    np.testing.assert_allclose(table["rho"], expected, atol=1e-6)
    assert (table["violated"] == (table["rho"] < 0)).all()
    assert run.stopped == "budget"
    assert len(run.table.counterexamples) + len(run.table.unconfirmed) < 250
    assert (table["violated"] != table.index.isin(run.table.safe.index)).all()
    # a + b > 1 and a > 1 - b: a triangle of area 1/2 in a rectangle of area 2.
    assert run.failure_rate.low < 0.25 < run.failure_rate.high
    assert run.best["rho"] == table["rho"].min()


@pytest.mark.slow
def test_the_usual_batch_leaves_a_search_time_to_learn(problem):
    assert vj.falsify(problem, "uniform", 3000).batch == 1024
    # A search that does not learn, and that nothing but the budget ends, has few rounds.
    batches = [usual_batch(vj.search.Uniform(), n, whole=True) for n in (10_000, 131_072, 10**7)]
    assert batches == [1024, 16_384, 131_072]
    # One that ends with the first failure has small rounds, but not a great many of them.
    batches = [usual_batch(vj.search.Halton(), n, after=1) for n in (10_000, 100_000, 10**7)]
    assert batches == [16, 128, 1024]
    assert vj.falsify(problem, "cross_entropy", 1000).batch == 32
    assert vj.falsify(problem, "cross_entropy", 5).batch == 5


@pytest.mark.thorough
def test_same_seed_same_table(problem):
    one = vj.falsify(problem, "cross_entropy", 300, batch=64, seed=5).table.all
    two = vj.falsify(problem, "cross_entropy", 300, batch=64, seed=5).table.all
    other = vj.falsify(problem, "cross_entropy", 300, batch=64, seed=6).table.all
    assert one.equals(two)
    assert not one.equals(other)


@pytest.mark.thorough
@pytest.mark.parametrize("search", ["uniform", "halton"])
def test_passive_searches_do_not_depend_on_the_batch(problem, search):
    one = vj.falsify(problem, search, 200, batch=64, seed=1).table.all
    two = vj.falsify(problem, search, 200, batch=200, seed=1).table.all
    np.testing.assert_array_equal(one[["a", "b"]], two[["a", "b"]])
    np.testing.assert_allclose(one["rho"], two["rho"], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("search", ["uniform", "gradient"])
def test_results_do_not_depend_on_a_users_64_bit_setting(search):
    def run():
        problem = vj.Problem("ramp", space=SPACE, system=ramp, spec="always[0, 1] x <= 1")
        return vj.falsify(problem, search, 48, batch=16, seed=2).table.all

    plain = run()
    with jax.enable_x64(True):
        wide = run()
    assert (wide.dtypes == plain.dtypes).all()
    np.testing.assert_allclose(wide["rho"], plain["rho"], atol=1e-5)


@pytest.mark.slow
def test_random_systems_replay_and_do_not_depend_on_the_batch():
    def noisy(features, key):
        return vj.Trace({"x": features["a"] + jax.random.normal(key, (4,))}, dt=1.0)

    problem = vj.Problem("noisy", space={"a": vj.Box(0, 1)}, system=noisy, spec="always x > -1")
    one = vj.falsify(problem, "uniform", 96, batch=32)
    two = vj.falsify(problem, "uniform", 96, batch=96)
    np.testing.assert_allclose(one.table.all["rho"], two.table.all["rho"], rtol=1e-6)
    for row in (0, 31, 32, 95):
        seen = one.replay(row)
        assert seen.rho["spec"] == pytest.approx(one.table.all["rho"][row], rel=1e-6)
        assert seen.row == row


def test_stops_after_counterexamples_at_once(problem):
    run = vj.falsify(problem, "uniform", 10_000, batch=16, stop=vj.Stop(after=5))
    assert run.stopped == "stop_after"
    assert 5 <= len(run.table.counterexamples) < 5 + 16
    before_last = run.table.all.iloc[: run.simulations - 16]
    assert before_last["violated"].sum() < 5
    # How many were simulated depends on the outcomes, so no binomial interval holds.
    assert run.failure_rate == vj.anytime_interval(len(run.table.counterexamples), run.simulations)
    assert "whenever stopped" in run.summary()


def test_stops_in_time(problem):
    vj.falsify(problem, "uniform", 64, batch=64)
    run = vj.falsify(problem, "uniform", 10**9, batch=64, stop=vj.Stop(seconds=0.3))
    assert run.stopped == "max_seconds"
    assert 0 < run.simulations < 10**9


def test_what_is_not_finite_is_a_status_not_a_verdict():
    def breaks(features, key):
        a = features["a"]
        return vj.Trace({"x": jnp.where(a > 0.5, jnp.nan, a) * jnp.ones(3)}, dt=1.0)

    problem = vj.Problem("breaks", space={"a": vj.Box(0, 1)}, system=breaks, spec="always x < 0.4")
    run = vj.falsify(problem, "uniform", 400, batch=128)
    table = run.table.all
    assert ((table["status"] == "nonfinite") == (table["a"] > 0.5)).all()
    assert table["rho"].isna().equals(table["status"] == "nonfinite")
    assert len(run.table.counterexamples) == ((table["a"] > 0.4) & (table["a"] <= 0.5)).sum()
    assert f"{len(run.table.failed)} nonfinite" in run.summary()
    rate = run.failure_rate
    assert (rate.simulations, rate.undecided) == (400, len(run.table.failed))
    assert rate.low < 0.1
    assert rate.high > 0.6
    assert f"violate the property; {len(run.table.failed)} have no verdict" in run.summary()


def test_infinite_signals_are_not_counterexamples():
    def breaks(features, key):
        return vj.Trace({"x": features["a"] / jnp.zeros(3)}, dt=1.0)

    problem = vj.Problem("inf", space={"a": vj.Box(0.5, 1)}, system=breaks, spec="always x < 0.4")
    run = vj.falsify(problem, "uniform", 10, batch=16)
    assert len(run.table.failed) == 10
    assert "10 nonfinite" in run.summary()
    with pytest.raises(ValueError, match="no simulation with a verdict"):
        _ = run.best


@pytest.mark.thorough
@pytest.mark.parametrize("signal", ["p", "inverse"])
def test_a_loop_that_diverges_has_no_verdict(signal):
    # p doubles its growth each step until float32 overflows; 1 / p is infinite at the start.
    system = vj.ode(
        lambda time, state, control, f: {"p": f["rate"] * state["p"] ** 2},
        lambda f, key: {"p": f["p0"]},
        dt=0.1,
        steps=40,
        method="euler",
        signals=lambda time, state, control, f: {"p": state["p"], "inverse": 1 / state["p"]},
    )
    space = {"rate": vj.Constant(30.0), "p0": vj.Categorical(0.0, 1.0)}
    problem = vj.Problem("diverges", space=space, system=system, spec=f"always {signal} < 5")
    table = vj.falsify(problem, "uniform", 16, batch=16).table.all
    assert set(table["p0"]) == {0.0, 1.0}
    diverged = (table["p0"] == 1.0) if signal == "p" else (table["p0"] < 2)
    assert (table["status"] == np.where(diverged, "nonfinite", "ok")).all()


def test_samples_behind_the_end_do_not_count():
    def ends(features, key):
        x = jnp.array([0.0, 0.5, 99.0, jnp.nan])
        return vj.Trace({"x": x + features["a"]}, dt=1.0, valid=jnp.int32(2))

    problem = vj.Problem("ends", space={"a": vj.Box(0, 0.1)}, system=ends, spec="always x < 1")
    run = vj.falsify(problem, "uniform", 8, batch=8)
    np.testing.assert_allclose(run.table.all["rho"], 0.5 - run.table.all["a"], atol=1e-6)


AT_ZERO = pytest.mark.parametrize(
    ("spec", "violated"), [("always x >= 0", False), ("always x > 0", True)]
)


@pytest.mark.thorough
@AT_ZERO
def test_at_zero_the_comparator_decides(spec, violated):
    problem = vj.Problem(
        "edge",
        space={"a": vj.DiscreteBox(0, 1)},
        system=lambda f, key: vj.Trace({"x": f["a"] * jnp.ones(3)}, dt=1.0),
        spec=spec,
    )
    run = vj.falsify(problem, "uniform", 32, batch=32)
    table = run.table.all
    assert set(table["a"]) == {0, 1}
    assert (table["violated"] == ((table["a"] == 0) & violated)).all()
    assert run.replay(run.best).violated == violated


def test_several_formulas_give_a_column_each():
    problem = vj.Problem(
        "two", space=SPACE, system=ramp, spec={"low": "always x > -0.5", "high": "always x <= 1"}
    )
    table = vj.falsify(problem, "uniform", 64, batch=64).table.all
    assert list(table.columns[2:5]) == ["rho", "rho.low", "rho.high"]
    np.testing.assert_array_equal(table["rho"], table[["rho.low", "rho.high"]].min(axis=1))


class TestBlackBox:
    def problem(self, function):
        return vj.Problem(
            "box",
            space={"a": vj.Box(0, 1), "color": vj.Categorical("red", "blue")},
            system=vj.blackbox(function),
            spec="always x < 0.8",
        )

    @pytest.mark.thorough
    def test_a_row_that_raises_carries_its_message_and_the_run_goes_on(self):
        def simulate(features):
            if features["a"] > 0.5:
                raise RuntimeError("wheel fell off")
            return vj.Trace({"x": np.full(1 + int(10 * features["a"]), 2 * features["a"])}, dt=0.1)

        run = vj.falsify(self.problem(simulate), "uniform", 60, batch=25, progress=False)
        table = run.table.all
        assert len(table) == 60
        raised = table["a"] > 0.5
        assert (table["status"] == np.where(raised, "error", "ok")).all()
        (message,) = set(table.loc[raised, "message"])
        assert message.startswith("RuntimeError: wheel fell off (tests/falsification/test_falsify")
        assert set(table.loc[~raised, "message"]) == {""}
        assert (table["violated"] == (~raised & (table["a"] >= 0.4))).all()
        assert f"{raised.sum()} error" in run.summary()
        assert "wheel fell off" in run.summary()

    def test_a_wrong_trace_is_an_error_of_the_row(self):
        run = vj.falsify(self.problem(lambda f: {"x": 1}), "uniform", 3, batch=3)
        assert set(run.table.all["status"]) == {"error"}
        assert "must return a Trace; it returned dict" in run.table.all["message"][0]
        run = vj.falsify(
            self.problem(lambda f: vj.Trace({"y": np.zeros(3)}, dt=1.0)), "uniform", 3, batch=3
        )
        assert "'x'" in run.table.all["message"][0]

    @pytest.mark.thorough
    @AT_ZERO
    def test_at_zero_the_comparator_decides_without_simulating_again(self, spec, violated):
        calls = []

        def simulate(features):
            calls.append(features["n"])
            return vj.Trace({"x": np.full(3, float(features["n"]))}, dt=1.0)

        problem = vj.Problem("zero", {"n": vj.DiscreteBox(0, 1)}, vj.blackbox(simulate), spec)
        table = vj.falsify(problem, "uniform", 16, batch=8).table.all
        assert set(table["n"]) == {0, 1}
        assert (table["violated"] == ((table["n"] == 0) & violated)).all()
        assert len(calls) == 16 + table["violated"].sum()  # Claimed means repeated.

    def test_gradients_are_refused(self):
        with pytest.raises(ValueError, match="black box, which has no gradient"):
            vj.falsify(self.problem(lambda f: None), "gradient", 10)


class TestStoring:
    def test_a_run_survives_on_disk(self, problem, tmp_path):
        run = vj.falsify(problem, "uniform", 100, batch=32, folder=tmp_path / "run")
        back = vj.load(tmp_path / "run", problem)
        assert back.table.all.equals(run.table.all)
        assert back.summary() == run.summary()
        assert back.replay(7).rho == run.replay(7).rho
        copy = vj.load(run.save(tmp_path / "copy"))
        assert copy.table.all.equals(run.table.all)
        with pytest.raises(ValueError, match="was loaded without its problem"):
            copy.replay(0)

    def test_a_folder_is_used_once(self, problem, tmp_path):
        vj.falsify(problem, "uniform", 10, folder=tmp_path / "run")
        with pytest.raises(ValueError, match="exists and is not empty"):
            vj.falsify(problem, "uniform", 10, folder=tmp_path / "run")

    def test_of_another_problem(self, problem, tmp_path):
        vj.falsify(problem, "uniform", 10, folder=tmp_path / "run")
        other = vj.Problem("ramp", space=SPACE, system=ramp, spec="always[0, 1] x <= 2")
        with pytest.raises(ValueError, match="another problem: its formulas"):
            vj.load(tmp_path / "run", other)
        with pytest.raises(FileNotFoundError, match="no run in"):
            vj.load(tmp_path)

    @pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("disk full")])
    def test_what_is_finished_is_kept(self, problem, tmp_path, monkeypatch, error):
        evaluate = engine_module.Engine.evaluate
        calls = []

        def breaks(self, *arguments, **shared):
            # Replays of counterexamples share a factor; the search's own batches share nothing.
            if not shared:
                calls.append(arguments)
                if len(calls) == 3:
                    raise error
            return evaluate(self, *arguments, **shared)

        monkeypatch.setattr(engine_module.Engine, "evaluate", breaks)
        if error is KeyboardInterrupt:
            run = vj.falsify(problem, "uniform", 320, batch=32, folder=tmp_path / "run")
            assert run.stopped == "interrupted"
        else:
            with pytest.raises(RunError, match="broke down after 64 simulations") as raised:
                vj.falsify(problem, "uniform", 320, batch=32, folder=tmp_path / "run")
            run = raised.value.run
        monkeypatch.undo()
        whole = vj.falsify(problem, "uniform", 320, batch=32)
        assert run.table.all.equals(whole.table.all.iloc[:64])
        assert vj.load(tmp_path / "run").table.all.equals(run.table.all)


@pytest.mark.thorough
def test_nothing_compiles_twice(problem):
    vj.falsify(problem, "uniform", 128, batch=128)
    engine = engine_module.engine_for(problem, 128)
    spent = engine.compile_seconds
    assert spent > 0
    vj.falsify(problem, "halton", 256, batch=128, seed=4)
    assert engine.compile_seconds == spent


@pytest.mark.thorough
@pytest.mark.parametrize("dim", [3, 20])
def test_gradients_equal_finite_differences(dim):
    # Above and below the number of features at which the engine changes modes.
    def system(features, key):
        w = features["w"]
        t = jnp.arange(6.0)
        return vj.Trace({"x": jnp.sin(w @ jnp.cos(jnp.outer(jnp.arange(dim), t)))}, dt=1.0)

    problem = vj.Problem(
        "wave",
        space={"w": vj.Array(vj.Box(-1, 1), length=dim)},
        system=system,
        spec="always[0, 3] (x < 0.5 | eventually[0, 2] x < 0)",
    )
    u = np.random.default_rng(0).random((5, dim)).astype(np.float32)
    key = jax.random.key(0)
    tau = 0.3
    gradient = engine_module.engine_for(problem, 5, True).evaluate(u, key, 0, tau).gradient

    with jax.enable_x64():

        def value(u):
            trace = system(problem.space.unflatten(u), None)
            (formula,) = problem.formulas.values()
            return vj.robustness(formula, trace, vj.mtl.smooth(tau))

        step = 1e-6 * np.eye(dim)
        for row, point in zip(gradient, u.astype(np.float64), strict=True):
            numeric = [(value(point + s) - value(point - s)) / 2e-6 for s in step]
            np.testing.assert_allclose(row, numeric, atol=2e-4)


class TestRefusedBeforeAnythingCompiles:
    @pytest.fixture(autouse=True)
    def nothing_compiles(self, monkeypatch):
        def refuse(*_):
            raise AssertionError("compiled")

        monkeypatch.setattr(engine_module.Engine, "compile", refuse)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"budget": 0}, "budget must be an integer of at least 1; got 0"),
            ({"batch": -1}, "batch must be an integer of at least 1; got -1"),
            ({"budget": 1.5}, "budget must be an integer of at least 1; got 1.5"),
            ({"seed": -1}, "seed must be an integer"),
            ({"stop": 3}, r"falsify needs a vj\.Stop; got 3"),
            ({"run_on": "native"}, r"falsify needs a vj\.RunOn; got 'native'"),
            ({"search": "cros_entropy"}, "did you mean 'cross_entropy'"),
            ({"search": 3}, "search must be a name or a search like"),
        ],
    )
    def test_options_that_cannot_work_are_refused(self, problem, options, message):
        with unchecked(), pytest.raises((ValueError, TypeError), match=message):
            vj.falsify(problem, **options)

    def test_a_misspelt_option_names_itself(self, problem):
        with pytest.raises(ValueError, match="'run_in'; did you mean 'run_on'"):
            vj.falsify(problem, run_in=3)
        with pytest.raises(ValueError, match=r"'elit'.*did you mean 'elite"):
            vj.search.named("cross_entropy", elit=0.1)
        with unchecked(), pytest.raises(ValueError, match="'controler'; did you mean 'controller'"):
            vj.ode(None, None, dt=0.1, steps=3, controler=None)

    def test_a_misspelt_feature_names_itself(self):
        with pytest.raises(ValueError, match="'theta'; did you mean 'theta0'"):
            vj.Problem(
                "typo", {"theta0": vj.Box(0, 1)}, ramp, "always x < 1", nominal={"theta": 0.5}
            )

    def test_a_formula_over_a_signal_that_is_not_there(self):
        problem = vj.Problem("typo", space=SPACE, system=ramp, spec="always xx <= 1")
        with pytest.raises(ValueError, match="the trace has no signal 'xx'; did you mean 'x'"):
            vj.falsify(problem, "uniform", 10)

    def test_gradients_need_something_continuous(self):
        problem = vj.Problem(
            "discrete",
            space={"n": vj.DiscreteBox(0, 3)},
            system=lambda f, key: vj.Trace({"x": f["n"] * jnp.ones(2)}, dt=1.0),
            spec="always x < 2",
        )
        with pytest.raises(ValueError, match="continuous"):
            vj.falsify(problem, "gradient", 10)

    def test_a_system_that_does_not_fit(self):
        def asks_for_more(features, key):
            return vj.Trace({"x": features["c"] * jnp.ones(3)}, dt=1.0)

        problem = vj.Problem("misfit", space=SPACE, system=asks_for_more, spec="always x < 1")
        with pytest.raises(vj.ProblemError, match=r"there is no feature .c.*are a, b"):
            vj.falsify(problem, "uniform", 10)
        problem = vj.Problem("misfit", space=SPACE, system=lambda f, k: f["a"], spec="always x < 1")
        message = "must return a Trace; it returned"
        with unchecked(), pytest.raises(vj.ProblemError, match=message):
            vj.falsify(problem, "uniform", 10)


class TestProblems:
    @pytest.mark.thorough
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"name": " "}, "needs a name"),
            ({"system": 3}, "system must be a function"),
            ({"spec": {}}, "spec has no formula"),
            ({"spec": 7}, "must be a formula or its text; got int 7"),
            ({"spec": "always ("}, r"\^"),
            ({"space": [1]}, "space must be a FeatureSpace"),
            ({"nominal": {"a": 0.5}}, "b"),
            ({"nominal": {"a": 0.5, "b": 4.0}}, "b"),
        ],
    )
    def test_bad_parts_are_refused_where_they_are_made(self, changes, message):
        parts = {"name": "p", "space": SPACE, "system": ramp, "spec": "always x <= 1"} | changes
        with unchecked(), pytest.raises(ValueError, match=message):
            vj.Problem(parts.pop("name"), **parts)
