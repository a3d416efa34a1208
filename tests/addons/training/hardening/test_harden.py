"""A hardening as a whole: it is repeatable, it goes on where it was cut off, its result agrees."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from function_training import by_starts

import verifai_jax as vj
from verifai_jax.addons.rl import PPO, Continuous, load_policy
from verifai_jax.addons.rl.batched_training import BatchedTraining
from verifai_jax.addons.rl.task.ode import ode_task
from verifai_jax.addons.training.hardening import HardeningError, _harden, harden
from verifai_jax.addons.training.sweeps import Trainer
from verifai_jax.systems.ode import ode

NOMINAL = {"x0": 0.1, "pull": 1.0}
LOOP = ode(
    lambda time, state, force, features: {"x": features["pull"] * state["x"] + force},
    lambda features, key: {"x": features["x0"]},
    dt=0.1,
    steps=10,
)
TASK = ode_task(
    LOOP,
    Continuous(-1.0, 1.0),
    reward=lambda time, state, force, after: 1.0 - jnp.abs(after["x"]),
    features=NOMINAL,
)
PPO_SMALL = PPO(
    learning_rate=0.03, hidden=(4,), value_hidden=(4,), environments=4, horizon=16, minibatches=1,
)  # fmt: skip
SMALL = {
    "rounds": 2, "steps": 256, "further": vj.FurtherTraining(steps=128, added=32), "episodes": 16,
    "certification": vj.Certification(samples=64, attack_simulations=64), "progress": False,
}  # fmt: skip


def staying_below(bound):
    """Make the problem of a policy that must keep the point below a bound."""

    def problem(policy):
        loop = replace(
            LOOP, controller=lambda time, state, features: policy.act(state["x"][None])[0]
        )
        features = {"x0": vj.Box(-1.0, 1.0), "pull": vj.Box(0.5, 1.5)}
        return vj.Problem("stay", features, loop, f"always (x <= {bound})", nominal=NOMINAL)

    return problem


def numbers(result):
    """Return what must be the same whenever a hardening is repeated."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(dict(sorted(result.policies.items())))]
    return (
        result.table.drop(columns="seconds"),
        result.added,
        leaves,
        str(result.comparison.candidates),
    )


@pytest.fixture(scope="module")
def whole():
    """A hardening that nothing disturbed, and all of its certificates."""
    certificates, certify = [], _harden.certify

    def watched(*arguments, **options):
        certificates.append(certify(*arguments, **options))
        return certificates[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_harden, "certify", watched)
        return harden(
            Trainer(TASK, PPO_SMALL), staying_below(1.5), baseline=True, seed=4, **SMALL
        ), certificates


@pytest.mark.slow
def test_result_agrees_with_its_table(whole):
    result, _ = whole
    table = result.table
    assert list(table["round"]) == [0, 0, 1, 1, 2, 2]
    assert list(table["arm"]) == ["hardened", "randomised"] * 3
    assert list(table["steps"].unique()) == [256, 384, 512]
    own = table[table["arm"] == "hardened"].set_index("round")
    assert 0 < own["failures"][0] < own["simulations"][0]
    np.testing.assert_allclose(own["failure_rate"], own["failures"] / own["simulations"])
    assert (own["failure_low"] <= own["failure_rate"]).all()
    assert (own["failure_high"] >= own["failure_rate"]).all()
    assert own["added"].sum() == len(result.added) > 0
    assert not table[table["arm"] == "randomised"]["added"].any()
    assert set(result.added["source"]) <= {"sample", "counterexample", "shrunk", "rule"}
    # Both arms are one training up to the first round.
    first = table[table["round"] == 0].drop(columns=["arm", "added", "cost", "seconds"])
    pd.testing.assert_series_equal(first.iloc[0], first.iloc[1], check_names=False)
    assert result.stopped == "budget"
    chosen = result.chosen["hardened"]
    assert jax.tree.all(
        jax.tree.map(np.array_equal, result.policy, result.policies["hardened", chosen])
    )
    kept = own[own["return"] >= own["return"][0] - 0.02 * abs(own["return"][0])]
    assert own["failure_rate"][chosen] == kept["failure_rate"].min() or result.notes
    assert result.returns["hardened"].mean() == pytest.approx(own["return"][chosen])
    assert (result.before, result.after) == (result.certificates[0], result.certificates[1])
    assert result.baseline is result.certificates[2]


@pytest.mark.slow
def test_no_certificate_has_a_sample_that_was_trained_on(whole):
    result, certificates = whole
    seeds = [each.seed for each in certificates]
    assert len(seeds) == len(set(seeds)) == 4
    assert result.certificates is certificates[-1]
    trained = _features(result.added)
    for number in range(3):
        fresh = _features(result.certificates.counterexamples(number))
        assert fresh
        assert trained.isdisjoint(fresh)
    # What failed in the certificates of the rounds has been trained on.
    for stage in (0, 1):
        assert not trained.isdisjoint(_features(certificates[stage].counterexamples(0)))
        assert trained.isdisjoint(_features(certificates[2].counterexamples(0)))


def _features(rows):
    return set(map(tuple, rows[["x0", "pull"]].to_numpy(np.float32)))


@pytest.mark.slow
def test_killed_and_called_again_it_gives_the_same(whole, tmp_path, monkeypatch):
    options = {"baseline": True, "seed": 4, "folder": tmp_path, **SMALL}

    def again():
        return harden(Trainer(TASK, PPO_SMALL), staying_below(1.5), **options)

    collect, certify = _harden.collect, _harden.certify
    calls = []

    def killed(*arguments, **given):
        calls.append(given["seed"])
        if len(calls) == 2:
            raise KeyboardInterrupt
        return collect(*arguments, **given)

    with monkeypatch.context() as patch:
        patch.setattr(_harden, "collect", killed)
        with pytest.raises(KeyboardInterrupt):
            again()
    # Ctrl-C in a certificate gives a part of it, which must not become a row.
    with monkeypatch.context() as patch:
        patch.setattr(
            _harden, "certify", lambda *a, **k: replace(certify(*a, **k), stopped="interrupted")
        )
        with pytest.raises(KeyboardInterrupt):
            again()
    one, two = numbers(again()), numbers(whole[0])
    pd.testing.assert_frame_equal(one[0], two[0])
    pd.testing.assert_frame_equal(one[1], two[1])
    assert all(map(np.array_equal, one[2], two[2]))
    assert one[3] == two[3]
    # Finished work is not done again.
    monkeypatch.setattr(BatchedTraining, "advance", None)
    monkeypatch.setattr(_harden, "collect", None)
    finished = again()
    pd.testing.assert_frame_equal(numbers(finished)[0], numbers(whole[0])[0])
    with pytest.raises(ValueError, match="seed"):
        harden(Trainer(TASK, PPO_SMALL), staying_below(1.5), **{**options, "seed": 5})


@pytest.mark.thorough
def test_it_is_shown_and_saved(whole, tmp_path):
    result, _ = whole
    summary = result.summary()
    assert summary == str(result)
    for part in ("stay: hardened in 2 rounds (budget)", "before:", "after:", "randomised (round"):
        assert part in summary
    assert f"{result.before.failures:,} of {result.before.simulations:,}" in summary
    assert "<table" in result._repr_html_()
    picture = tmp_path / "hardening.png"
    result.plot(picture)
    assert picture.stat().st_size > 5_000
    folder = result.save(tmp_path / "saved")
    assert (folder / "summary.txt").read_text() == f"{summary}\n"
    pd.testing.assert_frame_equal(pd.read_parquet(folder / "table.parquet"), result.table)
    observed = jnp.array([0.3])
    loaded = load_policy(folder / "policy.npz")
    np.testing.assert_array_equal(loaded.act(observed), result.policy.act(observed))


@pytest.mark.slow
def test_a_function_that_trains_gets_where_its_episodes_begin(tmp_path):
    trainer = Trainer(
        by_starts, example=lambda observation: jnp.zeros(1), observation=np.zeros(1), workers=1
    )
    options = {**SMALL, "rounds": 1, "folder": tmp_path}
    result = harden(trainer, staying_below(1.5), **options)
    own = result.table.set_index("round")
    # As many of its episodes begin near failures as the shares say, and it learns of them.
    assert list(own["return"]) == [0.0, pytest.approx(0.75, abs=0.05)]
    assert own["failures"][0] > 0 == own["failures"][1]
    assert result.chosen == {"hardened": 1}
    assert "return 0;" not in str(result)
    assert "by the intervals (no sample fails after)" in str(result)
    again = harden(trainer, staying_below(1.5), **options)
    assert str(again.table.drop(columns="seconds")) == str(result.table.drop(columns="seconds"))


@pytest.mark.slow
def test_where_nothing_fails_it_is_certified_at_once():
    result = harden(Trainer(TASK, PPO_SMALL), staying_below(100.0), p=0.1, **SMALL)
    assert (result.stopped, result.safe) == ("certified", True)
    assert len(result.table) == 1
    assert result.chosen == {"hardened": 0}
    assert not len(result.added)
    assert result.comparison is None
    assert "hardened in 0 rounds (certified)" in str(result)
    assert "times that after" not in str(result)


@pytest.mark.slow
def test_where_everything_fails_the_budget_ends_it():
    result = harden(Trainer(TASK, PPO_SMALL), staying_below(-100.0), **{**SMALL, "rounds": 1})
    assert (result.stopped, result.safe, len(result.table)) == ("budget", False, 2)
    assert list(result.table["failure_rate"]) == [1.0, 1.0]
    assert set(result.added["source"]) == {"sample", "counterexample", "shrunk"}  # No rule.
    assert result.times_safer == 1
    assert result.after.rate is not None
    assert result.after.rate.low > 0.9


def test_what_cannot_be_hardened_is_refused_before_anything_trains():
    def train(key, hyperparameters, steps):
        return lambda observation: jnp.zeros(1)

    with pytest.raises(ValueError, match="give example="):
        harden(train, staying_below(1.5))
    with pytest.raises(HardeningError, match="give train an argument starts, a list of features"):
        harden(Trainer(train, example=lambda observation: jnp.zeros(1)), staying_below(1.5))
    with pytest.raises(ValueError, match="rounds"):
        harden(Trainer(TASK, PPO_SMALL), staying_below(1.5), rounds=0)
