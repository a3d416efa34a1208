import json
import subprocess
import sys
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from checked_types import unchecked
from planted_sweep import SPACE, ToyStudy, ToyTrainer, curve_to, planted_rows, record_of

import verifai_jax as vj
from verifai_jax.addons.rl import load_policy
from verifai_jax.addons.training.sweeps.ranking import on_pareto_front
from verifai_jax.addons.training.sweeps.record import AFTER, BEFORE
from verifai_jax.addons.training.sweeps.result import Sweep, load_sweep
from verifai_jax.addons.training.sweeps.storage import SweepFileError
from verifai_jax.addons.training.sweeps.summary import format_hyperparameters
from verifai_jax.core.messages.errors import MissingExtra, UnknownNameError

NOT_TRAINED = {
    "nominal_return": np.nan,
    "training_return": np.nan,
    "failures": 0,
    "simulations": 0,
    "failure_rate": np.nan,
    "failure_low": np.nan,
    "failure_high": np.nan,
    "worst_robustness": np.nan,
    "verdict": "",
}
UNSAFE = {"failures": 154, "failure_rate": 0.3, "failure_low": 0.25, "failure_high": 0.36}
UNSAFE |= {"worst_robustness": -0.3, "verdict": "unsafe"}
UNDECIDED = {"failures": 2, "failure_rate": 0.004, "failure_low": 0.0, "failure_high": 0.02}
UNDECIDED |= {"worst_robustness": -0.004, "verdict": "undecided"}
ROWS = [
    {"configuration": 0, "seed": 0, "nominal_return": 100.0},
    {"configuration": 0, "seed": 1, "nominal_return": 98.0, **UNDECIDED},
    {"configuration": 1, "seed": 0, "nominal_return": 99.5, **UNSAFE},
    {"configuration": 1, "seed": 1, "nominal_return": 99.7, **UNSAFE},
    {"configuration": 2, "seed": 0, "nominal_return": 40.0, "failure_high": 0.006},
    {"configuration": 2, "seed": 1, "nominal_return": 60.0},
    {"configuration": 3, "seed": 0, "steps": 1000, "nominal_return": 99.9},
    {"configuration": 3, "seed": 0, "steps": 2000, "nominal_return": 99.8, **UNSAFE},
    {"configuration": 3, "seed": 1, "steps": 1000, "status": "stopped", **UNDECIDED},
    {"configuration": 4, "seed": 0, "status": "nonfinite", **NOT_TRAINED},
    {"configuration": 4, "seed": 1, "status": "error: clip must be positive", **NOT_TRAINED},
]


@pytest.fixture(scope="module")
def small():
    return Sweep(record_of(ROWS), ToyStudy())


@pytest.fixture(scope="module")
def large():
    return Sweep(record_of(planted_rows()), ToyStudy())


def test_the_table_has_the_columns_of_the_record(small):
    assert tuple(small.table.columns) == (*BEFORE, *SPACE.domains, *AFTER)
    assert list(small.table.index) == list(range(11))
    assert small.table.index.name == "row"


def test_safe_rows_come_by_their_return(small):
    assert list(small.safe.index) == [0, 6, 5, 4]


def test_the_best_is_the_safe_one_with_most_return(small):
    assert small.best.name == 0
    assert small.best["verdict"] == "safe@0.01"


def test_without_a_safe_one_the_best_has_the_lowest_upper_end():
    rows = [ROWS[2], {**ROWS[3], "failure_high": 0.35}, ROWS[9]]
    sweep = Sweep(record_of(rows))
    assert sweep.best.name == 1
    assert "row 1 comes nearest, unsafe: NONE IS CERTIFIED SAFE" in sweep.summary()


def test_without_any_certificate_there_is_no_best():
    sweep = Sweep(record_of(ROWS[9:]))
    with pytest.raises(ValueError, match="no policy with a certificate: 2 rows, 1 nonfinite"):
        _ = sweep.best
    assert "none has a policy" in sweep.summary()
    assert sweep.pareto().empty
    sweep.plot()


def test_a_sweep_that_was_stopped_at_once_is_empty(tmp_path):
    columns = {name: np.array(column)[:0] for name, column in record_of(ROWS).columns.items()}
    record = replace(
        record_of(ROWS), columns=columns, policies=(), worst=(), curves={}, certified=()
    )
    sweep = Sweep(replace(record, complete=False), ToyStudy())
    assert sweep.summary().startswith("toy: no configuration was trained\n  NOT FINISHED")
    assert sweep.configurations.empty
    assert sweep.safe.empty
    assert sweep.pareto().empty
    assert "no hyper-parameter varies" in str(sweep.importance())
    assert sweep._repr_html_()
    sweep.plot()
    assert load_sweep(sweep.save(tmp_path)).summary() == sweep.summary()


def test_configurations_are_the_worst_of_their_seeds(small):
    groups = small.configurations
    assert list(groups["verdict"]) == ["undecided", "unsafe", "safe@0.01", "unsafe", ""]
    assert list(groups["seeds"]) == [2, 2, 2, 2, 2]
    assert list(groups["seeds_safe"]) == [1, 0, 2, 0, 0]
    assert groups["nominal_return"].tolist()[:3] == pytest.approx([99.0, 99.6, 50.0])
    assert groups["failure_rate_worst"].tolist()[:2] == pytest.approx([0.004, 0.3])
    # The early checkpoint of configuration 3 is safe, its end is not.
    assert list(groups["best_row"]) == [0, 3, 5, 6, -1]
    assert groups.loc[3, "best_steps"] == 1000
    assert groups.loc[3, "best_verdict"] == "safe@0.01"
    assert groups.loc[4, "status"] == "nonfinite, error: clip must be positive"


def test_a_seed_that_did_not_train_leaves_a_configuration_undecided():
    rows = [{"seed": 0}, {"seed": 1, "status": "nonfinite", **NOT_TRAINED}]
    assert Sweep(record_of(rows)).configurations.loc[0, "verdict"] == "undecided"


def test_the_lead_counts_the_safe_among_those_with_full_return(small, large):
    # Means 99, 99.6, 50 and 99.9: with a span of 49.9 full is 99.4 and more.
    assert small.headline == (
        "5 configurations; 2 reach full return (at least 99.4), and 0 of those 2 are certified "
        "safe (failure probability below 1 %)"
    )
    groups = large.configurations
    full = groups.loc[groups["nominal_return"] >= 500 - 0.01 * np.ptp(groups["nominal_return"])]
    safe = int((full["verdict"] == "safe@0.01").sum())
    assert f"{len(full)} reach full return" in large.headline
    assert f"{safe} of those {len(full)} are certified safe" in large.headline
    one = Sweep(record_of([ROWS[0]]), ToyStudy())
    assert "1 reaches full return (at least 100), and it is certified safe" in one.headline


class Particular(ToyTrainer):
    """PPO has no `discount`; an algorithm does not use a hyper-parameter that it lacks."""

    def used_hyperparameters(self, values):
        return tuple(n for n in values if values["algorithm"] != "ppo" or n != "discount")


def changed_study(**changes):
    """A study like the toy, with other attributes."""
    return type("Changed", (ToyStudy,), changes)()


def test_what_an_algorithm_lacks_is_not_told_of_it(tmp_path):
    sweep = Sweep(record_of(planted_rows(40)), changed_study(trainer=Particular()))
    assert sweep.used["ppo"] == ("learning_rate", "width", "algorithm")
    ppo = sweep.table.index[sweep.table["algorithm"] == "ppo"][0]
    sac = sweep.table.index[sweep.table["algorithm"] == "sac"][0]
    assert "discount" not in format_hyperparameters(sweep, dict(sweep.table.loc[ppo]))
    assert "discount" in format_hyperparameters(sweep, dict(sweep.table.loc[sac]))
    assert load_sweep(sweep.save(tmp_path)).used == sweep.used


def test_the_summary_says_what_was_found_and_at_what_price(small):
    text = str(small)
    assert text.startswith("toy: 5 configurations; 2 reach full return")
    assert "configurations  1 safe, 2 unsafe, 1 undecided, 1 not certified" in text
    assert "row 0, safe@0.01; nominal return 100" in text
    assert "0 of 512 simulations fail: between 0 % and 0.72 %" in text
    assert "learning_rate=0.001, discount=0.99, width=16, algorithm=ppo" in text
    assert "cost 2,000 environment steps in 1.5 s of a core, then 512 simulations" in text
    assert "1 configuration is safe with all seeds; the best is 2: nominal return 50" in text
    assert "1 not finite; 1 error, the first in row 10: clip must be positive" in text
    assert "stopped 1 training before the end" in text
    assert "all intervals hold together at 95 % confidence" in text
    assert "12.0 s training, 3.5 s certification" in text
    cut = Sweep(record_of(ROWS, complete=False))
    assert "NOT FINISHED" in cut.summary()


def test_rank_correlation_is_that_of_scipy(large):
    from scipy.stats import spearmanr

    rho = spearmanr(large.table["nominal_return"], -large.table["failure_rate"]).statistic
    assert f"rank correlation {rho:.2f}" in large.summary()


def test_the_html_escapes_and_colours():
    rows = [{**ROWS[0], "algorithm": "<b>ppo"}, {**ROWS[2], "algorithm": "sac"}]
    page = Sweep(record_of(rows), ToyStudy())._repr_html_()
    assert "&lt;b&gt;ppo" in page
    assert "<b>ppo" not in page
    assert page.count("<tr>") == 3


def test_the_pareto_front_is_that_of_the_definition(large):
    table = large.table
    points = np.stack([-table["nominal_return"], table["failure_high"], table["steps"]], axis=1)
    front = large.pareto()
    assert sorted(front.index) == undominated(points)
    assert front["failure_high"].is_monotonic_increasing


def undominated(points):
    """By the definition: rows of numbers that no other row is at most, and less in one."""

    def dominates(one, other):
        pairs = list(zip(one, other, strict=True))
        return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)

    known = [p for p in points.tolist() if not any(np.isnan(p))]
    rows = enumerate(points.tolist())
    return [i for i, p in rows if p in known and not any(dominates(q, p) for q in known)]


@pytest.mark.parametrize("seed", range(5))
def test_the_front_of_rows_that_are_equal_infinite_or_unknown(seed):
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 6, (60, 3)).astype(float)
    points[rng.random(points.shape) < 0.03] = np.nan
    points[rng.random(points.shape) < 0.03] = np.inf
    names = ("nominal_return", "failure_high", "steps")
    table = pd.DataFrame(points * [-1, 1, 1], columns=names)
    assert np.flatnonzero(on_pareto_front(table)).tolist() == undominated(points)
    assert on_pareto_front(table[:0]).tolist() == []


def test_a_policy_acts_as_its_row_says(small):
    # Rows 2 and 0: fails for x above 0.7, and never.
    assert int(small.policy(2).act(jnp.array([0.8]))) == 1
    assert int(small.policy(2).act(jnp.array([0.6]))) == 0
    assert int(small.policy(0).act(jnp.array([0.99]))) == 0


def test_rows_that_are_not_there_say_so(small):
    with pytest.raises(IndexError, match="row 11 is not in the table of 11 rows"):
        small.policy(11)
    with pytest.raises(ValueError, match="row 10 has no policy: error: clip must be positive"):
        small.problem(10)
    with (
        unchecked(),
        pytest.raises(TypeError, match="a row is named by its number in the table; got '3'"),
    ):
        small.policy("3")


def test_the_problem_has_the_policy_in_the_loop(small):
    assert small.problem(2) is small.problem(np.int64(2))
    run = vj.falsify(small.problem(2), "uniform", budget=512, seed=0, progress=False)
    x = run.table.counterexamples["x"]
    assert len(x) == pytest.approx(0.3 * 512, abs=40)
    assert x.min() > 0.7


def test_counterexamples_are_failing_features(small):
    found = small.counterexamples(2, simulations=512, search="uniform")
    assert list(found.columns) == ["x", "rho"]
    assert found["rho"].is_monotonic_increasing
    assert (found["rho"] < 0).all()
    assert (found["x"] > 0.7).all()
    assert len(found) > 1
    stored = small.counterexamples(2)
    assert stored.to_dict("records") == [{"x": pytest.approx(0.85), "rho": pytest.approx(-0.3)}]
    # The best never fails.
    assert small.counterexamples().empty
    with pytest.raises(UnknownNameError, match="did you mean 'simulations'"):
        small.counterexamples(2, simulation=3)


class ToyCertificates:
    """What a certification says of its policies: here of rows 2 and 3."""

    def counterexamples(self, number):
        return pd.DataFrame({"x": [0.9, 0.75], "rho": [-0.2, -0.05 * (number + 1)]})


def test_what_the_certification_met_is_kept(tmp_path):
    record = record_of(ROWS, certificates=ToyCertificates(), certified=(2, 3))
    sweep = Sweep(record, ToyStudy())
    assert sweep.counterexamples(3)["rho"].tolist() == [-0.2, -0.1]
    loaded = load_sweep(sweep.save(tmp_path))
    pd.testing.assert_frame_equal(loaded.counterexamples(3), sweep.counterexamples(3))
    assert loaded.counterexamples(1)["rho"].tolist() == [-0.004]
    assert loaded.counterexamples(0).empty


def test_a_curve_goes_up_to_the_rows_own_checkpoint(small):
    curve = curve_to(99.8)
    early, late = small.curve(6), small.curve(7)
    assert early.clock()[-1] == 1000
    assert late.clock()[-1] == 2000
    held = np.concatenate([[curve.mean_return[1]] * 2, curve.mean_return[1:]])
    assert late["return"] == pytest.approx(held)
    with pytest.raises(ValueError, match="no episode ended"):
        small.curve(9)


def same(one, other):
    pd.testing.assert_frame_equal(one.table, other.table)
    assert one.summary() == other.summary()
    assert one.record.worst == other.record.worst
    assert dict(one.record.options) == dict(other.record.options)
    assert one.record.curves.keys() == other.record.curves.keys()
    for key, curve in one.record.curves.items():
        assert np.array_equal(curve.steps, other.record.curves[key].steps)
        assert np.array_equal(
            curve.mean_return, other.record.curves[key].mean_return, equal_nan=True
        )
    for mine, its in zip(one.record.policies, other.record.policies, strict=True):
        if mine is None:
            assert its is None
            continue
        assert mine.action == its.action
        for layer, again in zip(mine.layers, its.layers, strict=True):
            assert np.array_equal(layer[0], again[0])
            assert np.array_equal(layer[1], again[1])


def test_saved_and_loaded_it_is_the_same(small, tmp_path):
    folder = small.save(tmp_path / "mine")
    loaded = load_sweep(folder, ToyStudy())
    same(small, loaded)
    assert loaded.folder == folder
    assert loaded.problem(2).name == "toy"
    # Saved again elsewhere, and over a larger one.
    same(small, load_sweep(loaded.save(tmp_path / "again")))
    fewer = Sweep(record_of(ROWS[:2]), ToyStudy())
    same(fewer, load_sweep(fewer.save(folder)))
    assert len(list((folder / "policies").iterdir())) == 2
    assert load_policy(folder / "policies" / "0.npz").action.n == 2


def test_choices_of_several_kinds_are_kept(tmp_path):
    record = record_of(ROWS[:2])
    columns = {**record.columns, "algorithm": np.array([None, 0.5], object)}
    sweep = Sweep(replace(record, columns=columns))
    loaded = load_sweep(sweep.save(tmp_path))
    assert loaded.table["algorithm"].tolist() == [None, 0.5]
    assert isinstance(loaded.summary(), str)


def test_loaded_without_its_study_everything_but_simulations_works(small, tmp_path):
    loaded = load_sweep(small.save(tmp_path))
    assert loaded.space == SPACE
    assert loaded.best.name == 0
    assert int(loaded.policy(2).act(jnp.array([0.8]))) == 1
    assert len(loaded.counterexamples(2)) == 1
    with pytest.raises(ValueError, match=r"without its study.*load_sweep\(folder, study\)"):
        loaded.problem(2)
    named = replace(small.record, options={**small.record.options, "target": "specs/toy.py:toy"})
    loaded = load_sweep(Sweep(named).save(tmp_path))
    with pytest.raises(ValueError, match=r"give it: load_sweep\(folder, 'specs/toy.py:toy'\)"):
        loaded.problem(2)
    with pytest.raises(ValueError, match=r"no file specs/toy.py"):
        load_sweep(tmp_path, "specs/toy.py:toy")


def test_folders_that_hold_no_such_sweep(small, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no sweep in .*sweep.json is missing"):
        load_sweep(tmp_path)
    folder = small.save(tmp_path / "mine")
    other = changed_study(name="tony")
    with pytest.raises(SweepFileError, match="its name is 'toy', the given one's 'tony'"):
        load_sweep(folder, other)
    other = changed_study(space=vj.FeatureSpace({"clip": vj.Box(0, 1)}))
    with pytest.raises(SweepFileError, match=r"its hyper-parameters is .*'clip'"):
        load_sweep(folder, other)
    data = json.loads((folder / "sweep.json").read_text())
    (folder / "sweep.json").write_text("{")
    with pytest.raises(SweepFileError, match=r"sweep.json is damaged"):
        load_sweep(folder)
    (folder / "sweep.json").write_text(json.dumps({**data, "seed": data["seed"] + 1}))
    with pytest.raises(SweepFileError, match=r"sweep.json is damaged: its content has changed"):
        load_sweep(folder)
    (folder / "sweep.json").write_text(json.dumps(data))
    policy = folder / "policies" / "0.npz"
    for file in ("curves.npz", "failing.parquet", "policies/0.npz", "table.parquet"):
        whole = (folder / file).read_bytes()
        (folder / file).write_bytes(whole[:-30] + bytes([whole[-30] ^ 1]) + whole[-29:])
        with pytest.raises(SweepFileError, match=f"is damaged: {file} has changed since"):
            load_sweep(folder)
        (folder / file).write_bytes(whole)
    policy.unlink()
    assert load_sweep(folder).record.policies[0] is None
    (folder / "curves.npz").unlink()
    with pytest.raises(SweepFileError, match="is incomplete"):
        load_sweep(folder)


@pytest.mark.thorough
def test_the_picture_is_written(small, tmp_path):
    figure = small.plot(tmp_path / "sweep.png")
    assert (tmp_path / "sweep.png").stat().st_size > 10_000
    # Too few configurations for a panel of importance.
    assert [axes.get_title() for axes in figure.axes] == ["Return is not safety", "Learning curves"]
    values_of_features = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert "safe (3)" in values_of_features
    assert "safe, earlier checkpoint (1)" in values_of_features
    assert "wanted: below 1 %" in values_of_features


@pytest.mark.slow
def test_a_large_sweep_shows_what_matters(large):
    figure = large.plot()
    assert figure.axes[2].get_title() == "Importance"
    assert {text.get_text() for text in figure.axes[2].get_yticklabels()} >= {"learning_rate"}


@pytest.mark.slow
def test_nothing_heavy_is_imported_to_read_a_summary():
    code = (
        "import sys, verifai_jax.addons.training.sweeps.result\n"
        "print(*[m for m in ('pandas', 'sklearn', 'matplotlib', 'optuna') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_without_optuna_the_command_is_said(small, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises((MissingExtra, ImportError), match=r"optuna"):
        small.to_optuna()


def test_an_optuna_study_has_a_trial_for_each_configuration(small):
    optuna = pytest.importorskip("optuna")
    made = small.to_optuna()
    assert made.study_name == "toy"
    assert [d.name for d in made.directions] == ["MINIMIZE", "MAXIMIZE"]
    trials = made.trials
    assert [trial.user_attrs["configuration"] for trial in trials] == [0, 1, 2, 3, 4]
    states = optuna.trial.TrialState
    assert [trial.state for trial in trials] == [states.COMPLETE] * 3 + [states.PRUNED, states.FAIL]
    assert trials[1].values == pytest.approx([0.36, 99.6])
    assert trials[0].params == {
        "learning_rate": pytest.approx(1e-3),
        "discount": pytest.approx(0.99),
        "width": 16,
        "algorithm": "ppo",
    }
    kinds = trials[0].distributions
    assert kinds["learning_rate"] == optuna.distributions.FloatDistribution(1e-4, 1e-2, log=True)
    assert kinds["discount"] == optuna.distributions.FloatDistribution(0.9, 0.999)
    assert kinds["width"] == optuna.distributions.CategoricalDistribution([16, 64])
    assert len(made.best_trials) >= 1
