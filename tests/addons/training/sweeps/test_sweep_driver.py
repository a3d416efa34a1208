"""Sweeps of a toy: what is trained, what is remembered, and that interruptions change nothing."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from checked_types import unchecked
from drifting import Drift, Point, drifting, quick_certificates

import verifai_jax as vj
from verifai_jax.addons.rl import evaluate, train
from verifai_jax.addons.rl._evaluate import batched_mean_returns
from verifai_jax.addons.training.sweeps import running as driver
from verifai_jax.addons.training.sweeps import training_runs
from verifai_jax.addons.training.sweeps._sweep import sweep
from verifai_jax.addons.training.sweeps.halving import Halving
from verifai_jax.addons.training.sweeps.optuna import OptunaSampler
from verifai_jax.addons.training.sweeps.proposers import WORST, SearchProposer, objective
from verifai_jax.addons.training.sweeps.record import AFTER, BEFORE
from verifai_jax.addons.training.sweeps.trainer import StudyError
from verifai_jax.core.messages.errors import MissingExtra, UnknownNameError
from verifai_jax.core.store.cache import Cache, CacheError


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(driver, "certify", quick_certificates)


def same_tables(one, other, but=("training_seconds",)):
    """Equal tables and bit-equal policies and curves."""
    left, right = one.record, other.record
    assert list(left.columns) == list(right.columns)
    for name in left.columns:
        if name not in but:
            np.testing.assert_array_equal(left.columns[name], right.columns[name], err_msg=name)
    assert left.worst == right.worst
    assert left.curves.keys() == right.curves.keys()
    for key, curve in left.curves.items():
        np.testing.assert_array_equal(curve.mean_return, right.curves[key].mean_return)
    for a, b in zip(left.policies, right.policies, strict=True):
        same_policies(a, b)


def same_policies(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.fixture(scope="module")
def whole():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "certify", quick_certificates)
        return sweep(
            drifting(seeds=2), configurations=5, certification=vj.Certification(samples=64)
        )


@pytest.mark.slow
def test_one_row_a_policy(whole):
    columns = whole.record.columns
    assert list(columns) == [*BEFORE, "rate", *AFTER]
    assert columns["configuration"].tolist() == list(np.repeat(range(5), 6))
    assert columns["seed"].tolist() == [0, 0, 0, 1, 1, 1] * 5
    assert columns["steps"].tolist() == [32, 64, 128] * 10
    assert set(columns["status"]) == {"trained"}
    assert (columns["simulations"] == 64).all()
    assert columns["rate"].dtype == np.float64
    assert columns["failures"].dtype == np.int64
    np.testing.assert_array_equal(columns["failure_rate"], columns["failures"] / 64)
    assert whole.record.certified == tuple(range(30))
    assert whole.record.complete
    assert {"training", "certifying"} <= set(whole.record.seconds)


@pytest.mark.slow
def test_callbacks_see_each_policy_twice_also_from_the_cache(tmp_path):
    calls = [[], []]
    for seen in calls:
        result = sweep(
            drifting(), configurations=2, certification=vj.Certification(samples=64),
            folder=tmp_path / "sweep", callbacks=[lambda *call, seen=seen: seen.append(call)],
        )  # fmt: skip
    assert calls[0] == calls[1]
    table = result.record.columns
    assert [step for step, _ in calls[0]] == list(range(1, 2 * len(table["seed"]) + 1))
    certified = [values for _, values in calls[0] if "failures" in values]
    assert [v["failures"] for v in certified] == table["failures"].tolist()
    assert [v["nominal_return"] for v in certified] == table["nominal_return"].tolist()
    assert [v["environment_steps"] for v in certified] == table["steps"].tolist()


@pytest.mark.thorough
def test_rows_are_what_a_training_of_their_own_gives(whole):
    for row in (0, 1, 11, 20):
        cell = {name: column[row] for name, column in whole.record.columns.items()}
        alone = train(
            Point(), Drift(rate=float(cell["rate"])), seed=int(cell["seed"]), steps=128,
            checkpoints=(32, 64),
        )  # fmt: skip
        of_it = {at.steps: at.policy for at in alone.checkpoints} | {128: alone.policy}
        same_policies(whole.record.policies[row], of_it[cell["steps"]])
        steps, returns = whole.record.curves[cell["configuration"], cell["seed"]]
        np.testing.assert_array_equal(steps, alone.steps)
        np.testing.assert_array_equal(returns, alone.mean_return)
    # An episode ends in every other update; the last tenth of them is one update.
    returns = np.float64(whole.record.curves[0, 0].mean_return)
    expected = [np.nan, returns[1], returns[3]]
    np.testing.assert_array_equal(whole.record.columns["training_return"][:3], expected)


@pytest.mark.thorough
@pytest.mark.parametrize("halving", [None, Halving(2.0)])
def test_trainings_on_workers_give_the_same_table(halving):
    options = {"configurations": 4, "halving": halving}
    options["certification"] = vj.Certification(samples=32)
    study = drifting({"rate": vj.LogUniform(0.01, 1.0), "limit": vj.Box(0.05, 9.0)}, seeds=2)
    here = sweep(study, **options)
    with ThreadPoolExecutor(2) as executor:
        there = sweep(study, **options, run_on=vj.RunOn(executor=executor))
    same_tables(here, there)


@pytest.mark.thorough
def test_nominal_returns_are_those_of_the_task_itself():
    # The reset is not random: one episode says all.
    study = drifting({"rate": vj.LogUniform(0.01, 1.0), "reward_scale": vj.Box(1.0, 9.0)})
    found = sweep(study, configurations=3, certification=vj.Certification(samples=8))
    for row, policy in enumerate(found.record.policies):
        expected = float(evaluate(Point(), policy, episodes=1)[0])
        assert found.record.columns["nominal_return"][row] == pytest.approx(expected, rel=1e-6)


@pytest.mark.thorough
def test_returns_do_not_depend_on_company(whole):
    def returns_of(policies):
        measured = batched_mean_returns(Point(), policies, episodes=4)
        return np.concatenate([values for _, values in measured])

    policies = whole.record.policies
    together = returns_of(policies)
    for some in ([0], [29, 3], list(range(7, 29))):
        np.testing.assert_array_equal(returns_of([policies[i] for i in some]), together[some])


@pytest.mark.thorough
def test_what_cannot_train_or_explodes_is_a_row():
    space = {"limit": vj.Categorical(0.3, 100.0), "rate": vj.Categorical(0.1, 0.5)}
    found = sweep(
        drifting(space), search="grid", configurations=4, certification=vj.Certification(samples=16)
    )
    table = found.table
    assert len(table) == 1 + 3 * 3
    refused = table["status"] == "error: Drift's rate must be less than limit = 0.3; got 0.5"
    assert (refused == ((table["limit"] == 0.3) & (table["rate"] == 0.5))).all()
    lost = table["status"] == "nonfinite"
    # 0.1 an update: beyond 0.3 before the fourth.
    assert lost.sum() == 1
    assert (lost == ((table["limit"] == 0.3) & (table["steps"] == 128) & ~refused)).all()
    assert table.loc[lost, "nominal_return"].isna().all()
    assert table.loc[lost | refused, "verdict"].eq("").all()
    assert table.loc[lost | refused, "failure_high"].isna().all()
    assert [policy is None for policy in found.record.policies] == list(lost | refused)


@pytest.mark.thorough
def test_a_training_that_raises_is_a_row(monkeypatch):
    def step(self, task, state, step=Drift.step):
        if self.environments == 8:
            raise RuntimeError("no room\nfor so many")
        return step(self, task, state)

    monkeypatch.setattr(Drift, "step", step)
    study = drifting({"environments": vj.Categorical(4, 8), "rate": vj.Box(0.1, 0.2)}, seeds=2)
    table = sweep(study, configurations=4, certification=vj.Certification(samples=8)).table
    assert set(table["status"]) == {"trained", "error: RuntimeError: no room"}
    assert (table["status"] == "trained").sum() == 2 * 2 * 3


@pytest.mark.thorough
def test_algorithms_and_widths_in_one_sweep():
    space = {
        "algorithm": vj.Categorical("slow", "fast"),
        "width": vj.Categorical(4, 5),
        "rate": vj.Box(0.05, 0.06),
    }
    study = drifting(space, algorithms={"slow": Drift(), "fast": Drift(noise=0.0)}, checkpoints=())
    found = sweep(study, configurations=4, certification=vj.Certification(samples=8))
    assert len(found.table) == 4
    for row, policy in zip(found.table.itertuples(), found.record.policies, strict=True):
        assert policy.layers[0][0].shape == (2, row.width)
        noise = {"slow": 0.01, "fast": 0.0}[row.algorithm]
        chosen = Drift(rate=row.rate, noise=noise, hidden=(row.width,))
        same_policies(policy, train(Point(), chosen, steps=128).policy)


def test_steps_are_a_hyper_parameter_too():
    space = {"steps": vj.Categorical(64, 96), "rate": vj.Box(0.05, 0.06)}
    study = drifting(space, checkpoints=(32, 80))
    found = sweep(study, configurations=2, certification=vj.Certification(samples=8))
    assert list(found.record.columns)[:4] == ["configuration", "seed", "steps", "rate"]
    assert found.record.hyperparameters == ("steps", "rate")
    of_one = found.table.groupby("configuration")["steps"].apply(list)
    assert sorted(of_one) == [[32, 64], [32, 80, 96]]


def test_a_curve_is_judged():
    found = sweep(
        drifting(curve="always return >= 9.8"),
        configurations=3,
        certification=vj.Certification(samples=8),
    )
    table = found.table
    for row in table.itertuples():
        curve = found.record.curves[row.configuration, 0]
        known = np.asarray(curve.mean_return)[: row.steps // 32]
        known = known[np.isfinite(known)]
        expected = known.min() - 9.8 if len(known) else np.nan
        assert row.curve_robustness == pytest.approx(expected, abs=1e-5, nan_ok=True)


def test_configurations_are_distinct():
    space = {"rate": vj.Categorical(0.1, 0.2, 0.3), "noise": vj.Categorical(0.0, 0.1)}
    found = sweep(
        drifting(space, checkpoints=()),
        search="uniform",
        configurations=50,
        certification=vj.Certification(samples=8),
    )
    assert len(found.table) == 6
    assert not found.table[["rate", "noise"]].duplicated().any()


class Stopped(Cache):
    """Interrupted as soon as so many pieces of work are finished."""

    after = 10**9

    def put(self, work):
        super().put(work)
        if self.computed >= self.after:
            raise KeyboardInterrupt


CASES = {
    "halton": {"configurations": 5},
    "cross_entropy": {"configurations": 6, "search": "cross_entropy", "batch": 2},
    "halving": {"configurations": 6, "halving": Halving(2)},
    "until safe": {"configurations": 6, "halving": Halving(1, until_safe=True)},
    "halving by safety": {"configurations": 6, "halving": Halving(2, by="safety")},
}


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_interrupted_and_resumed_it_is_the_same_sweep(case, monkeypatch, tmp_path):
    study, how = drifting(), {"certification": vj.Certification(samples=64), **CASES[case]}
    through = sweep(study, folder=tmp_path / "through", **how)
    kept = Cache(tmp_path / "through")
    pieces = len(kept.names())
    monkeypatch.setattr("verifai_jax.core.store.cache.Cache", Stopped)
    for after in (1, pieces // 2, pieces - 2):
        monkeypatch.setattr(Stopped, "after", after)
        some = sweep(study, folder=tmp_path / str(after), **how)
        assert not some.record.complete
        assert "from the cache" not in str(some)
        assert len(some.table) <= len(through.table)
        monkeypatch.setattr(Stopped, "after", 10**9)
        again = sweep(study, folder=tmp_path / str(after), **how)
        assert again.record.complete
        same_tables(again, through)
        trained, trainings = again.reuse["train"]
        assert 0 < trained <= trainings
        assert sum(used for _, used in again.reuse.values()) == pieces
        assert sum(cached for cached, _ in again.reuse.values()) >= min(after, pieces)
        assert f"  from the cache  {again.reuse['certify'][0]} of " in str(again)
    same_tables(vj.load_sweep(tmp_path / "through"), through, but=())
    # Nothing is trained again: all is remembered, with the seconds that it took.
    monkeypatch.setattr(training_runs.BatchedTraining, "advance", None)
    same_tables(sweep(study, folder=tmp_path / "through", **how), through, but=())


@pytest.mark.thorough
@pytest.mark.parametrize("case", ["halton", "population"])
def test_a_checkpoint_that_a_damaged_cache_lacks_is_trained_again(case, monkeypatch, tmp_path):
    cases = {**CASES, "population": {"configurations": 4, "search": vj.Population()}}
    study, how = drifting(), {"certification": vj.Certification(samples=64), **cases[case]}
    through = sweep(study, folder=tmp_path, **how)

    class Damaged(Cache):
        def get(self, name):
            lost = name.endswith("32 of 128") and name not in self._own
            return None if lost else super().get(name)

    monkeypatch.setattr("verifai_jax.core.store.cache.Cache", Damaged)
    same_tables(sweep(study, folder=tmp_path, **how), through)


@pytest.mark.slow
def test_a_store_of_another_sweep_says_what_differs(tmp_path):
    sweep(drifting(), configurations=2, certification=vj.Certification(samples=8), folder=tmp_path)
    for other, how, told in (
        (
            drifting(), {"certification": vj.Certification(16)},
            "options.samples is 16, in the cache 8",
        ),
        (drifting(), {"search": "grid"}, "options.search.name is grid, in the cache halton"),
        (drifting(steps=256), {}, "steps is 256, in the cache 128"),
        (
            drifting(algorithms=Drift(noise=0.5)), {},
            "algorithms.drift.noise is 0.5, in the cache 0.01",
        ),
        (
            drifting({"rate": vj.Box(0.1, 0.3)}), {},
            r"space.rate is Box\(0.1, 0.3\), in the cache LogUniform\(0.01, 1\)",
        ),
    ):  # fmt: skip
        with pytest.raises(CacheError, match=f"holds a different sweep: {told}"):
            sweep(
                other,
                **{"configurations": 2, "certification": vj.Certification(8), **how},
                folder=tmp_path,
            )
    # More of the same is the same sweep.
    more = sweep(
        drifting(), configurations=3, certification=vj.Certification(samples=8), folder=tmp_path
    )
    same_tables(
        more, sweep(drifting(), configurations=3, certification=vj.Certification(samples=8))
    )


def test_halving_keeps_the_best_by_return():
    study = drifting()
    all_of_them = sweep(study, configurations=7, certification=vj.Certification(samples=8)).table
    table = sweep(
        study, configurations=7, certification=vj.Certification(samples=8), halving=Halving(2.0)
    ).table
    alive = set(range(7))
    for steps, after in itertools.pairwise((32, 64, 128)):
        here = all_of_them[all_of_them["steps"] == steps].set_index("configuration")
        order = sorted(alive, key=lambda n: (-here["nominal_return"][n], n))
        going = set(order[: -(-len(alive) // 2)])
        rows = table[table["steps"] == steps].set_index("configuration")
        assert set(rows.index) == alive
        assert set(rows.index[rows["status"] == "stopped"]) == alive - going
        assert set(table.loc[table["steps"] == after, "configuration"]) == going
        alive = going
    # The rows that there are, are those of the sweep that stops nobody.
    merged = table.merge(all_of_them, on=["configuration", "steps"])
    assert len(merged) == len(table) == 7 + 4 + 2
    np.testing.assert_array_equal(merged["nominal_return_x"], merged["nominal_return_y"])


def test_only_configurations_that_are_shown_to_be_unsafe_end():
    result = sweep(
        drifting(), configurations=8, certification=vj.Certification(samples=64),
        halving=Halving(reduction=1, p=0.3),
    )  # fmt: skip
    table, stopped = result.table, result.table["status"] == "stopped"
    assert set(table.loc[stopped, "steps"]) <= {32, 64}
    assert 0 < stopped.sum() < 8
    rates = quick_certificates(
        None, [result.policy(i) for i in table.index], p=0.3, seed=99, remember=lambda _, f: f(),
        certification=vj.Certification(samples=20_000),
    ).rows  # fmt: skip
    true = np.array([one.failures / one.simulations for one in rates])
    assert np.all(true[stopped] > 0.3)
    # The verdict is only open near p.
    going = ~stopped & (table["steps"] < 128)
    assert np.all(true[going] < 0.6)
    ended = set(table.loc[stopped, "configuration"])
    assert set(table.loc[table["steps"] == 128, "configuration"]) == set(range(8)) - ended


def test_a_training_ends_where_its_policy_passes_and_only_its_last_policy_is_certified():
    study, p = drifting(p=0.2), 0.2
    result = sweep(
        study, configurations=8, certification=vj.Certification(samples=512),
        halving=Halving(reduction=1, until_safe=True),
    )  # fmt: skip
    table = result.table
    rates = quick_certificates(
        None, [result.policy(i) for i in table.index], p=p, seed=99, remember=lambda _, f: f(),
        certification=vj.Certification(samples=20_000),
    ).rows  # fmt: skip
    true = np.array([one.failures / one.simulations for one in rates])
    last = table.groupby("configuration")["steps"].transform("max") == table["steps"]
    assert (table["status"] == "trained").all()
    assert ((table["simulations"] > 0) == last).all()
    early = last & (table["steps"] < 128)
    assert 0 < early.sum() < last.sum() == 8
    # The test of 256 samples at half of p errs by four standard deviations at most.
    error = 4 * np.sqrt(0.25 * p / 256)
    assert np.all(true[early] < p / 2 + error)
    assert np.all(true[~last] > p / 2 - error)
    assert table["nominal_return"].notna().all()
    # The rows that there are, are those of the sweep that ends nobody.
    plain = sweep(study, configurations=8, certification=vj.Certification(samples=8)).table
    both = table.merge(plain, on=["configuration", "steps"])
    assert len(both) == len(table)
    np.testing.assert_array_equal(both["nominal_return_x"], both["nominal_return_y"])


@pytest.mark.thorough
def test_a_search_is_told_how_bad_the_policies_are(monkeypatch):
    told = []

    observe = SearchProposer.observe

    def record(self, objectives):
        told.extend(objectives)
        return observe(self, objectives)

    monkeypatch.setattr(SearchProposer, "observe", record)
    space = {"rate": vj.Box(0.01, 0.45), "limit": vj.Categorical(0.5, 100.0)}
    found = sweep(
        drifting(space),
        search="mutation",
        configurations=8,
        batch=4,
        certification=vj.Certification(samples=64),
    )
    last = found.table[found.table["steps"] == 128]
    assert len(told) == len(last) == 8
    for bad, row in zip(told, last.itertuples(), strict=True):
        if row.status == "nonfinite":
            assert bad == WORST
        else:
            # Of other samples than the table's.
            assert -0.25 <= bad - row.failure_rate <= 0.25 + 0.11
    finite = [b for b, s in zip(told, last["status"], strict=True) if s == "trained"]
    assert len(finite) < 8
    assert max(finite) < WORST


def test_the_objective_is_failures_first_then_robustness_then_return():
    ordered = [
        objective(0.0, 0.5, 9.0, (0.0, 10.0)),
        objective(0.0, 0.5, 1.0, (0.0, 10.0)),
        objective(0.0, 0.1, 9.0, (0.0, 10.0)),
        objective(0.0, -2.0, 9.0, (0.0, 10.0)),
        objective(0.2, -2.0, 9.0, (0.0, 10.0)),
        objective(1.0, -1e30, 0.0, (0.0, 10.0)),
    ]
    assert ordered == sorted(ordered)
    assert len(set(ordered)) == 6
    assert ordered[-1] < WORST
    assert objective(float("nan"), 0.0, 0.0, (0.0, 1.0)) is None


@pytest.mark.slow
def test_optuna_proposes_and_is_told(tmp_path):
    pytest.importorskip("optuna")
    space = {
        "rate": vj.LogUniform(0.01, 1.0),
        "noise": vj.TruncatedNormal(0.05, 0.02, 0.0, 0.1),
        "limit": vj.DiscreteBox(50, 60),
        "reward_scale": vj.Categorical(1.0, 2.0),
    }
    study = drifting(space, checkpoints=())
    how = {"configurations": 14, "batch": 3, "certification": vj.Certification(16)}
    one = sweep(study, search="optuna:tpe", folder=tmp_path, **how)
    assert len(one.table) == 14
    assert one.table["limit"].isin(range(50, 61)).all()
    assert set(one.table["reward_scale"]) == {1.0, 2.0}
    assert one.table["rate"].between(0.01, 1.0).all()
    assert one.table["noise"].between(0.0, 0.1).all()
    same_tables(sweep(study, search=OptunaSampler("tpe"), folder=tmp_path, **how), one, but=())
    same_tables(sweep(study, search=OptunaSampler("tpe"), **how), one)
    with pytest.raises(UnknownNameError, match="unknown sampler of Optuna 'tp'; did you mean"):
        sweep(study, search="optuna:tp")
    with pytest.raises(TypeError, match="unexpected keyword argument 'multivarate'"):
        sweep(study, search=OptunaSampler("tpe", {"multivarate": True}))
    with pytest.raises(ValueError, match=r"is the sweep's: sweep\(..., seed=...\)"):
        OptunaSampler("tpe", {"seed": 3})


def test_without_optuna_it_says_how_to_get_it(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(MissingExtra, match=r"pip install 'verifai_jax\[optuna\]'"):
        sweep(drifting(), search="optuna:tpe")


def test_out_of_time_is_what_there_is():
    found = sweep(
        drifting(),
        configurations=4,
        certification=vj.Certification(samples=8),
        stop=vj.Stop(seconds=1e-6),
    )
    assert not found.record.complete
    assert len(found.table) in range(1, 4 * 3)


def test_what_was_trained_in_time_is_certified(monkeypatch):
    monkeypatch.setattr(driver, "FOR_TRAINING", 1e-9)
    found = sweep(
        drifting(),
        configurations=4,
        certification=vj.Certification(samples=8),
        stop=vj.Stop(seconds=1000.0),
    )
    assert not found.record.complete
    assert len(found.table) in range(1, 4 * 3)
    assert (found.table["simulations"] == 8).all()
    assert found.table["nominal_return"].notna().all()


def test_a_budget_is_for_all_policies():
    study = drifting(seeds=2)
    for how, least in (({}, 7 * 3 * 2 * 8), ({"halving": Halving(2)}, (7 + 4 + 2) * 2 * 8)):
        with pytest.raises(ValueError, match=f"need a budget of at least {least}; got {least - 1}"):
            sweep(
                study,
                configurations=7,
                certification=vj.Certification(samples=8, budget=least - 1),
                **how,
            )
        found = sweep(
            study, configurations=7, certification=vj.Certification(samples=8, budget=least), **how
        )
        assert len(found.table) * 8 == least


def test_options_are_refused_first(monkeypatch):
    monkeypatch.setattr(driver, "TrainingRuns", None)
    for how, error, told in (
        ({"configurations": 0}, ValueError, "configurations must be an integer of at least 1"),
        ({"stop": vj.Stop(after=1)}, ValueError, "sweep does not use after= of vj.Stop"),
        ({"search": "halten"}, UnknownNameError, "did you mean 'halton'"),
        ({"search": "gradient"}, ValueError, "needs gradients, which trainings do not have"),
        ({"search": 3}, TypeError, "search must be a name, a Search or an OptunaSampler; got 3"),
        ({"halving": 3}, TypeError, "halving must be a Halving; got 3"),
        ({"certificaton": 3}, UnknownNameError, "did you mean 'certification'"),
        ({"seed": -1}, ValueError, "seed must be an integer of at least 0; got -1"),
        (
            {"certification": vj.Certification(attack="cross_entrpy")},
            UnknownNameError,
            "did you mean 'cross_entropy'",
        ),
        (
            {"certification": vj.Certification(attack="gradient")},
            ValueError,
            "follows gradients",
        ),
    ):
        with unchecked(), pytest.raises(error, match=told):
            sweep(drifting(), **how)
    with unchecked(), pytest.raises(TypeError, match="sweep needs a Study"):
        sweep(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(StudyError, match="the study has none before the end at 128 steps"):
        sweep(drifting(checkpoints=()), halving=Halving())
    with pytest.raises(StudyError, match="take steps out of the space"):
        sweep(drifting({"steps": vj.Categorical(64, 128)}), halving=Halving())
    with pytest.raises(ValueError, match="reduction must be greater than 1; got 1"):
        Halving(1)
    with pytest.raises(ValueError, match="p must lie between 0 and 1"):
        Halving(1, p=1.5)
    with pytest.raises(UnknownNameError, match="unknown criterion of halving 'retrun'"):
        Halving(by="retrun")
