"""Population-based training: who succeeds whom, and that interruptions change nothing."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy_training
import pytest
from drifting import Drift, Point, drifting, quick_certificates
from test_sweep_driver import same_policies, same_tables

import verifai_jax as vj
from verifai_jax.addons.rl.batched_training import BatchedTraining, Configuration
from verifai_jax.addons.training.sweeps import running as driver
from verifai_jax.addons.training.sweeps import training_runs
from verifai_jax.addons.training.sweeps.halving import Halving
from verifai_jax.addons.training.sweeps.population import Population
from verifai_jax.addons.training.sweeps.trainer import StudyError
from verifai_jax.core.store.cache import Cache

SPACE = {"rate": vj.LogUniform(0.01, 1.0), "width": vj.Categorical(3, 4)}
FEW = {"configurations": 5, "certification": vj.Certification(samples=32)}
WIDE = Population(share=0.4, step=0.2)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(driver, "certify", quick_certificates)


@pytest.fixture(scope="module")
def whole():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "certify", quick_certificates)
        return vj.sweep(drifting(SPACE, seeds=2), WIDE, **FEW)


def test_the_worst_end_and_some_of_the_best_go_on_in_their_place():
    rng, pairs = np.random.default_rng(0), []
    objective = dict(enumerate([0.3, np.nan, 0.1, 0.9, 0.2, 0.4, 0.5, 0.6]))
    for _ in range(40):
        found = Population(share=0.25).pairs(objective, 8, rng)
        assert [ended for ended, _ in found] == [3, 1]
        pairs += found
    assert {best for _, best in pairs} == {2, 4}
    assert Population(share=0.25).pairs(dict.fromkeys(range(8), np.nan), 8, rng) == []
    assert Population(share=0.25).pairs({0: 0.1, 1: 0.2, 2: 0.3}, 12, rng) == [(2, 0)]


def test_hyper_parameters_move_in_their_range_and_keep_the_structure():
    study, rng = drifting(SPACE), np.random.default_rng(0)
    before = {"rate": 0.1, "width": 3}
    moves = [
        Population(step=0.1, anew=0.0).changed(before, study.space, study.trainer, rng)
        for _ in range(20)
    ]
    assert {each["width"] for each in moves} == {3}
    # A tenth of two decades.
    factors = sorted({round(each["rate"] / 0.1, 3) for each in moves})
    assert factors == pytest.approx([10**-0.2, 10**0.2], rel=1e-3)
    last = {"rate": 1.0, "width": 4}  # At its end there is one way only.
    moved = Population(step=0.1, anew=0.0).changed(last, study.space, study.trainer, rng)
    assert moved == {"rate": pytest.approx(10**-0.2, rel=1e-3), "width": 4}
    anew = [Population(anew=1.0).changed(before, study.space, study.trainer, rng) for _ in "12345"]
    assert len({each["rate"] for each in anew}) == 5
    mixed = {"rate": vj.Box(0.1, 0.9), "width": vj.Categorical(3, None)}
    one = {"rate": 0.5, "width": 3}
    found = WIDE.changed(one, vj.FeatureSpace(mixed), study.trainer, rng)
    assert found["width"] == 3
    assert found["rate"] != 0.5
    only = vj.FeatureSpace({"rate": vj.LogUniform(0.01, 1.0)}, where=lambda f: f["rate"] > 0.08)
    for _ in range(5):
        assert WIDE.changed({"rate": 0.1}, only, study.trainer, rng)["rate"] > 0.08


@pytest.mark.slow
def test_a_member_is_a_training_whose_hyper_parameters_change(whole, tmp_path):
    table, parents = whole.table, whole.record.options["parents"]
    assert len(parents) == 4
    assert (table.groupby("steps").size() == 10).all()  # Five members with two seeds.
    assert set(table["status"]) == {"trained", "stopped"}
    assert "population      stopped 8 trainings before the end" in str(whole)
    number, (parent, at) = next(
        (int(n), each) for n, each in parents.items() if str(each[0]) in parents
    )
    grandparent, before = parents[str(parent)]
    values = [table[table["configuration"] == n].iloc[0] for n in (grandparent, parent, number)]
    assert len({each["width"] for each in values}) == 1
    batch = BatchedTraining([Configuration(Point(), Drift(hidden=(values[0]["width"],)), 128, 1)])
    for each, end in zip(values, (before, at, 128), strict=True):
        drift = Drift(rate=float(each["rate"]), hidden=(each["width"],))
        batch.change(0, Configuration(Point(), drift, 128, 1))
        assert list(batch.advance({0: end})) == [0]
    rows = table[(table["configuration"] == number) & (table["seed"] == 1)]
    assert rows["steps"].iloc[0] > at
    same_policies(whole.policy(rows.index[-1]), batch.policy(0))
    np.testing.assert_array_equal(whole.record.curves[number, 1].mean_return, batch.curve(0)[1])
    # It leaves the sweep, also one that was read again, with its lineage; the bits are the same.
    one = vj.load_sweep(whole.save(tmp_path)).configuration(rows.index[-1])
    assert [at for at, _ in one.before] == [before, at]
    same_policies(one.train(drifting(SPACE, seeds=2)), one.policy)


@pytest.mark.slow
def test_interrupted_and_resumed_it_is_the_same_population(whole, monkeypatch, tmp_path):
    put, calls = Cache.put, []

    def killed(self, entries):
        calls.append(None)
        if len(calls) in (2, 7, 13, 30):
            raise KeyboardInterrupt
        put(self, entries)

    monkeypatch.setattr(Cache, "put", killed)
    for _ in range(5):
        found = vj.sweep(drifting(SPACE, seeds=2), WIDE, folder=tmp_path, **FEW)
    assert len(calls) > 30
    assert found.record.complete
    same_tables(found, whole)
    monkeypatch.setattr(training_runs.BatchedTraining, "advance", None)
    same_tables(vj.sweep(drifting(SPACE, seeds=2), WIDE, folder=tmp_path, **FEW), whole)
    with pytest.raises(ValueError, match=r"share is 0.25, in the cache 0.4"):
        vj.sweep(drifting(SPACE, seeds=2), Population(step=0.2), folder=tmp_path, **FEW)


@pytest.mark.slow
def test_on_workers_it_is_the_same_population(whole):
    with ThreadPoolExecutor(2) as executor:
        there = vj.sweep(drifting(SPACE, seeds=2), WIDE, **FEW, run_on=vj.RunOn(executor=executor))
    same_tables(there, whole)


@pytest.mark.slow
def test_members_end_where_they_are_safe():
    study = drifting({"rate": vj.LogUniform(0.01, 1.0)}, p=0.1)
    found = vj.sweep(study, Population(by="safety"), halving=Halving(1, until_safe=True), **FEW)
    last = found.table.groupby("configuration").last()
    assert (last.loc[last["steps"] < 128, "failure_rate"] <= 0.1).any()


def test_what_a_population_cannot_do_is_refused_before_anything_trains():
    study = drifting()
    for options, match in (
        ({"share": 0.6}, "share must be at most a half; got 0.6"),
        ({"step": 0}, "step"),
        ({"by": "returns"}, "did you mean 'return'"),
    ):
        with pytest.raises(ValueError, match=match):
            Population(**options)
    with pytest.raises(StudyError, match="a population stops trainings at checkpoints; the study"):
        vj.sweep(drifting(checkpoints=()), Population())
    with pytest.raises(ValueError, match=r"a population keeps its size: give reduction=1"):
        vj.sweep(study, Population(), halving=Halving(2))
    with pytest.raises(ValueError, match="a population is one round of all configurations"):
        vj.sweep(study, Population(), batch=4)
    few = vj.Certification(samples=64, budget=64 * 14)
    with pytest.raises(ValueError, match="budget"):
        vj.sweep(study, Population(), 5, certification=few, halving=Halving(1, until_safe=True))
    trainer = vj.Trainer(numpy_training.train, example=lambda observation: np.zeros(1), steps=128)
    function = vj.Study("f", study.space, trainer, study.problem, checkpoints=(64,))
    with pytest.raises(StudyError, match="train is a training function"):
        vj.sweep(function, Population())
